"""From the triangles of the ground to the smooth surface that they stand for.

Triangles are chords: ground that bulges lies a little above them. Where light grazes it, a point of a triangle that is turned away
lies in the shadow of the triangle before it, though the ground there is lit. So such points are lifted to the planes through their
triangle's corners, each across the smooth normal there, weighted as heights are (J. Hanika, Hacking the Shadow Terminator, Ray
Tracing Gems II, 2021). He moves them along the normals. Here they go along the line of sight, in a map upwards: a point stays in
its pixel, and every algorithm can take it. What lies in a hollow stays where it is.

Ground that bends by a right angle, as at cliffs and roofs, is not smooth: triangles beside such a crease stand for themselves.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal

LEAST_FACING = 0.25
"""Least cosine, between a smooth normal and the line of sight, that a lift is divided by: surfaces are seen edge-on, too."""

CREASE = float(np.cos(np.radians(30.0)))
"""Cosine between a triangle's normal and a smooth one round it below which a crease lies between: there the ground bends twice as
much.
"""


@internal
def is_smooth(face, smooth):
    """Whether a smooth normal is near enough to a triangle's that no crease lies between them; not where there is none."""
    length = np.sqrt(smooth[0] * smooth[0] + smooth[1] * smooth[1] + smooth[2] * smooth[2])
    return face[0] * smooth[0] + face[1] * smooth[1] + face[2] * smooth[2] >= CREASE * length


@internal
def up_at(point, centre, out):
    """The unit vector up at a point, away from a centre: along the third axis where that is infinitely far below."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    length = np.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = (0.0, 0.0, 1.0) if np.isinf(length) else (x / length, y / length, z / length)


@internal
def lift_to(node, smooth, point, way):
    """How far a point has to go along a unit vector to the plane through a node across its smooth normal; 0 if it lies above, or
    where there is no normal.
    """
    below = smooth[0] * (node[0] - point[0]) + smooth[1] * (node[1] - point[1]) + smooth[2] * (node[2] - point[2])
    facing = smooth[0] * way[0] + smooth[1] * way[1] + smooth[2] * way[2]
    return below / max(facing, LEAST_FACING) if below > 0.0 else 0.0
