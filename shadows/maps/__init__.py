"""Depth maps: `shadow_map` and `perspective_shadow_map`, their windows, their drawing and their look-ups."""
