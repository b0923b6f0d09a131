"""From where a light is looked for between nodes: from the smooth ground, where that faces it and the facet does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrain.compiled import compiled
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gbuffer.lift import up_at
from terrain.gbuffer.shared_points import facing_normals
from terrain.geo.grid import MapView
from terrain.lights import LightPosition


def on_smooth_ground(buffer: GeometryBuffer, light: LightPosition) -> GeometryBuffer:
    """A buffer with the points on the smooth ground that see a light from there alone (``terrain.gbuffer.lift``); they lie on no
    triangle. The buffer itself where there are none, or where they have been put there already.
    """
    if buffer.lift_m is None or buffer.lifted is not None:
        return buffer
    lifted = facing_normals(buffer, light).lifted
    if not lifted.any():
        return buffer
    position = buffer.position_frame_m.copy()
    if isinstance(buffer.view, MapView):
        assert buffer.surface is not None
        _move_up(position, lifted, buffer.lift_m, buffer.surface.centre_frame_m)
    else:
        to_eye = buffer.view.in_frame(buffer.frame)[0] - position[lifted]
        length = np.linalg.norm(to_eye, axis=-1)
        position[lifted] += to_eye * (np.minimum(buffer.lift_m[lifted], 0.5 * length) / length)[:, None]
    corners = None if buffer.corners_frame_m is None else buffer.corners_frame_m.copy()
    if corners is not None:
        corners[lifted] = np.tile(position[lifted], 3)
    return replace(buffer, position_frame_m=position, corners_frame_m=corners, lifted=lifted)


@compiled
def _move_up(position, lifted, lift, centre):
    up = np.empty(3)
    for i in range(lifted.shape[0]):
        for j in range(lifted.shape[1]):
            if lifted[i, j]:
                up_at(position[i, j], centre, up)
                for k in range(3):
                    position[i, j, k] += lift[i, j] * up[k]
