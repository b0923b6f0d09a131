"""Depth maps: `shadow_map` and `perspective_shadow_map`, their windows in light space, their drawing and their look-ups."""
