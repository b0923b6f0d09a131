"""Lift points of ground triangles to the smooth surface that the triangles approximate.

Triangles are chords: convex ground lies a little above them. Under grazing light a triangle that is turned away lies in the shadow
of the triangle before it, though the smooth ground there is lit (the shadow terminator problem). So such points are lifted to the
planes through their triangle's corners, each perpendicular to the smooth normal of its corner, with barycentric weights
(J. Hanika, Hacking the Shadow Terminator, Ray Tracing Gems II, 2021).

Hanika moves points along the normals. Here they move along the line of sight, in a map upwards: a point stays in its pixel, and
every algorithm can use it. Points in concave ground stay where they are.

Ground that bends by a right angle, as at cliffs and roofs, is not smooth: triangles beside such a crease are not lifted.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal

MIN_FACING = 0.25
"""Minimum divisor of a lift: the cosine between a smooth normal and the line of sight vanishes on surfaces that are seen edge-on.
"""

MIN_CREASE_COSINE = float(np.cos(np.radians(30.0)))
"""Minimum cosine between a triangle's normal and the smooth normals at its corners. Below it a crease lies between: the ground
bends by twice the angle there.
"""


@internal
def is_smooth(face, smooth_normal):
    """Return whether a smooth normal exists and is so near to a triangle's normal that no crease lies between them."""
    length = np.sqrt(
        smooth_normal[0] * smooth_normal[0] + smooth_normal[1] * smooth_normal[1] + smooth_normal[2] * smooth_normal[2]
    )
    return face[0] * smooth_normal[0] + face[1] * smooth_normal[1] + face[2] * smooth_normal[2] >= MIN_CREASE_COSINE * length


@internal
def up_at(point, centre, out):
    """Write the unit vector up at a point, away from a centre. It is the third axis where the centre is infinitely far below."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    length = np.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = (0.0, 0.0, 1.0) if np.isinf(length) else (x / length, y / length, z / length)


@internal
def lift_distance(node, smooth_normal, point, direction):
    """Return the distance from a point, along a unit vector, to the plane through a node perpendicular to its smooth normal.

    It is 0 where the point lies above the plane, or where the normal is missing.
    """
    below = (
        smooth_normal[0] * (node[0] - point[0]) + smooth_normal[1] * (node[1] - point[1]) + smooth_normal[2] * (node[2] - point[2])
    )
    facing = smooth_normal[0] * direction[0] + smooth_normal[1] * direction[1] + smooth_normal[2] * direction[2]
    return below / max(facing, MIN_FACING) if below > 0.0 else 0.0
