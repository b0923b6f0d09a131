"""Move shadow-ray starts to the smooth ground between nodes where it faces a light and the facet does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.lift import up_at
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.geo.grid import MapView
from skugga.terrain.lights import LightPosition


def move_to_smooth_ground(buffer: GeometryBuffer, light: LightPosition) -> GeometryBuffer:
    """Return a buffer whose points lie on the smooth ground where only the smooth ground faces a light.

    These points (``skugga.terrain.gbuffer.lift``) lie on no triangle. Returns the same buffer if no point moves, or if its points
    were moved already.
    """
    if buffer.lift_m is None or buffer.lifted is not None:
        return buffer
    lifted = facing_normals(buffer, light).lifted
    if not lifted.any():
        return buffer
    position = np.empty_like(buffer.position_frame_m)
    corners = None if buffer.corners_frame_m is None else np.empty_like(buffer.corners_frame_m)
    in_map = isinstance(buffer.view, MapView)
    if isinstance(buffer.view, MapView):
        assert buffer.surface is not None
        origin_frame_m = buffer.surface.centre_frame_m
    else:
        origin_frame_m = buffer.view.in_frame(buffer.frame)[0]
    run_in_chunks(
        len(lifted), _move_lifted_points, buffer.position_frame_m, buffer.corners_frame_m, lifted, buffer.lift_m,
        origin_frame_m, in_map, position,
        corners,
    )  # fmt: skip
    return replace(buffer, position_frame_m=position, corners_frame_m=corners, lifted=lifted)


@compiled
def _move_lifted_points(first, last, points, triangles, lifted, lift, origin, in_map, position, corners):
    """Copy points, and move the lifted ones: up, away from a centre, in a map; else towards the eye, at most half-way."""
    direction = np.empty(3)
    for i in range(first, last):
        for j in range(lifted.shape[1]):
            p = position[i, j]
            for k in range(3):
                p[k] = points[i, j, k]
            if corners is not None:
                for k in range(9):
                    corners[i, j, k] = triangles[i, j, k]
            if not lifted[i, j]:
                continue
            if in_map:
                up_at(p, origin, direction)
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
