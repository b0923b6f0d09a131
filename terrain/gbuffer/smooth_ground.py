"""Move the starts of shadow rays from a triangle to the smooth ground above it.

They move only where the smooth ground faces the light and the triangle does not. The terminator of a dome, a straight line in
closed form, is then right to a pixel; by triangles alone, 61 pixels of a view of 96 x 72 are wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.lift import write_up
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.geo.grid import MapView
from skugga.terrain.lights import LightPosition


def move_to_smooth_ground(buffer: GeometryBuffer, light: LightPosition) -> GeometryBuffer:
    """Return a buffer whose points are moved to the smooth ground where it faces a light and the point's triangle does not.

    The moved points (``skugga.terrain.gbuffer.lift``) lie on no triangle. In a map their corners become the points themselves. In
    perspective the corners stay, since a copy for all points costs more than to look at ``is_lifted``. The result is ``buffer``
    itself if no point moves, or if its points were moved already.
    """
    if buffer.lift_m is None or buffer.is_lifted is not None:
        return buffer
    is_lifted = facing_normals(buffer, light).is_lifted
    if not is_lifted.any():
        return buffer
    position, in_map = np.empty_like(buffer.position_frame_m), isinstance(buffer.view, MapView)
    triangles = buffer.corners_frame_m if in_map else None
    corners = None if triangles is None else np.empty_like(triangles)
    if isinstance(buffer.view, MapView):
        assert buffer.surface is not None
        origin_frame_m = buffer.surface.up_origin_frame_m
    else:
        origin_frame_m = buffer.view.in_frame(buffer.frame)[0]
    run_in_chunks(
        len(is_lifted), _move_lifted_points, buffer.position_frame_m, triangles, is_lifted, buffer.lift_m, origin_frame_m, in_map,
        position, corners,
    )  # fmt: skip
    return replace(
        buffer, position_frame_m=position, corners_frame_m=corners if in_map else buffer.corners_frame_m, is_lifted=is_lifted
    )


@compiled
def _move_lifted_points(first, last, points, triangles, is_lifted, lift, origin, in_map, position, corners):
    """Copy points and triangles' corners to ``position`` and ``corners``, and move the lifted points by ``lift`` metres.

    With ``in_map`` they move up, away from the point ``origin``. In perspective they move towards the eye ``origin``, at most
    half-way. All three corners of a lifted point become the point itself. ``triangles`` and ``corners`` (rows, cols, 9) are
    ``None`` where no corners are copied. Rows run from ``first`` to ``last`` (exclusive).
    """
    direction = np.empty(3)
    for i in range(first, last):
        for j in range(is_lifted.shape[1]):
            p = position[i, j]
            for k in range(3):
                p[k] = points[i, j, k]
            if corners is not None:
                for k in range(9):
                    corners[i, j, k] = triangles[i, j, k]
            if not is_lifted[i, j]:
                continue
            if in_map:
                write_up(p, origin, direction)
                for k in range(3):
                    p[k] += lift[i, j] * direction[k]
            else:
                for k in range(3):
                    direction[k] = origin[k] - p[k]
                length = np.sqrt(direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2])
                share = min(np.float64(lift[i, j]), 0.5 * length) / length
                for k in range(3):
                    p[k] += direction[k] * share
            if corners is not None:
                for k in range(9):
                    corners[i, j, k] = p[k % 3]
