"""Geometry buffers: the triangle, the point and the normal that each pixel shows, with extra samples at edges."""
