"""Meshes: buildings, models and generated bodies, placed on the ground as one set of triangles."""
