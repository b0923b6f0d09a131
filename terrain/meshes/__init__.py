"""Solid things: buildings, models and generated bodies, set on the ground as one set of triangles."""
