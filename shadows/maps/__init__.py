"""Depth maps: `shadow_map` and `perspective_shadow_map`, their windows in light space, their drawing and their look-ups.

A perspective shadow map is the method of Stamminger and Drettakis 2002, "Perspective shadow maps".
"""
