"""Lift points of ground triangles to the smooth surface that the triangles approximate.

Triangles are chords of the smooth ground: where the ground is convex, it lies a little above them. Under grazing light this makes a
visible error, the shadow terminator problem: a triangle that faces away from the light lies in the shadow of the triangle before
it, though the smooth ground there is lit. The remedy is to lift the points of such triangles to the smooth ground (J. Hanika,
Hacking the Shadow Terminator, Ray Tracing Gems II, 2021). Each corner of the triangle has a tangent plane, perpendicular to the
smooth normal there. A point's lift is the mean of its distances to the three tangent planes, with barycentric weights.

Hanika moves points along the normals. Here they move along the line of sight, in a map upwards. So a point stays in its pixel, and
every shadow algorithm can use it. Points of concave ground do not move.

Ground that bends sharply, as at cliffs and roofs, is not smooth: points of triangles beside such a crease are not lifted.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal

MIN_FACING_COSINE = 0.25
"""Minimum divisor of a lift.

The divisor is the cosine between the smooth normal and the line of sight, which vanishes on surfaces seen edge-on.
"""

MIN_CREASE_COSINE = float(np.cos(np.radians(30.0)))
"""Minimum cosine between a triangle's normal and the smooth normals at its corners. At a smaller cosine a corner lies on a crease.

The ground bends there by twice the angle between the two normals.
"""


@internal
def is_smooth(face, smooth_normal):
    """Return whether a corner has a smooth normal, and no crease lies between it and the triangle's normal ``face``."""
    length = np.sqrt(
        smooth_normal[0] * smooth_normal[0] + smooth_normal[1] * smooth_normal[1] + smooth_normal[2] * smooth_normal[2]
    )
    return face[0] * smooth_normal[0] + face[1] * smooth_normal[1] + face[2] * smooth_normal[2] >= MIN_CREASE_COSINE * length


@internal
def write_up(point, up_origin, out):
    """Write the unit vector up (3,) at a point: away from ``up_origin``, or the third axis if that is infinitely far below."""
    x, y, z = point[0] - up_origin[0], point[1] - up_origin[1], point[2] - up_origin[2]
    length = np.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = (0.0, 0.0, 1.0) if np.isinf(length) else (x / length, y / length, z / length)


@internal
def lift_distance(node, smooth_normal, point, direction):
    """Return the distance from a point, along the unit vector ``direction``, to the tangent plane at a node.

    The plane is perpendicular to the node's smooth normal. The distance is 0 if the point lies above the plane, or if the normal is
    missing.
    """
    below = (
        smooth_normal[0] * (node[0] - point[0]) + smooth_normal[1] * (node[1] - point[1]) + smooth_normal[2] * (node[2] - point[2])
    )
    facing = smooth_normal[0] * direction[0] + smooth_normal[1] * direction[1] + smooth_normal[2] * direction[2]
    return below / max(facing, MIN_FACING_COSINE) if below > 0.0 else 0.0
