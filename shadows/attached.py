"""Attached shadow: decided once, outside the algorithms, for all of them alike."""

from __future__ import annotations

import numpy as np

from terrain.compiled import compiled
from terrain.geometry import GeometryBuffer
from terrain.scene import Scene


def attached(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Where the geometric normal does not face the sun (n.l <= 0), bool (rows, cols); True off the surface too.

    Everything is, while the sun is nowhere above the horizon or where there is none.
    """
    if scene.sun is None or (scene.highest_sun_deg or 0.0) <= 0.0:
        return np.ones(buffer.there.shape, bool)
    return turned_away(buffer.normal_frame, buffer.frame.frame_from_earth @ scene.sun.to_sun_earth)


@compiled
def turned_away(normal, to_light):  # type: ignore[no-untyped-def]
    """Where unit normals (rows, cols, 3) do not face a direction (3,); True where a normal is NaN."""
    out = np.empty(normal.shape[:2], np.bool_)
    for i in range(normal.shape[0]):
        for j in range(normal.shape[1]):
            n = normal[i, j]
            out[i, j] = not n[0] * to_light[0] + n[1] * to_light[1] + n[2] * to_light[2] > 0.0
    return out
