"""The plane of the ground's own slope at a point."""

from __future__ import annotations

import numpy as np

from skugga.shadows.irradiation.planes import TiltedPlane
from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import paged_relief
from skugga.terrain.scene import Scene


def ground_plane(scene: Scene, place: PointPlace) -> TiltedPlane:
    """Return the plane of the ground's own slope at a place.

    Its slope is that between the ground one cell before and one cell after the place, or on one side beside missing ground. Columns
    with flat tops are level.
    """
    ground = paged_relief(scene)
    if ground.has_columns:
        return TiltedPlane(0.0, 180.0)
    row, col = place.row + np.array([-1.0, 1.0, 0.0, 0.0]), place.col + np.array([0.0, 0.0, -1.0, 1.0])
    height_m, _ = ground.ground_at(row, col)
    opposite_m = 2.0 * place.ground_m - height_m[[1, 0, 3, 2]]
    height_m = np.where(np.isfinite(height_m), height_m, np.where(np.isfinite(opposite_m), opposite_m, place.ground_m))
    foot, up = scene.world.points_at_zero_height(ground.grid.crs, ground.grid.x(col), ground.grid.y(row))
    points = place.in_enu(foot + height_m[:, None] * up)
    normal = np.cross(points[1] - points[0], points[3] - points[2])
    normal *= np.sign(normal[2])
    tilt_deg = float(np.degrees(np.arctan2(np.hypot(normal[0], normal[1]), normal[2])))
    return TiltedPlane(tilt_deg, float(np.degrees(np.arctan2(normal[0], normal[1])) % 360.0))
