"""Views of whole levels and the positions of their pixels, for cases about rasters and suns."""

from __future__ import annotations

import numpy as np

from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, View

UTM = "EPSG:32633"

CORNER_M = 500_000.0, 5_000_000.0
"""North-west corner of rasters in ``UTM``: on its central meridian, near 45 degrees north."""

FOV_DEG = 40.0


def view_from_above(trial: Trial, scene: Scene, pixels: int) -> View:
    """Return the level from above, at most ``pixels`` a side: as a map, or from a camera for algorithms without maps."""
    if trial.serves_maps:
        west, south, east, north = scene.elevation.bounds
        sides = np.array([east - west, north - south])
        width, height = np.maximum(np.rint(pixels * sides / sides.max()), 1)
        return scene.view(size=(int(width), int(height)))
    elevation = scene.elevation
    extent_m = elevation.cell_size_m(scene.world.metres_per_unit) * max(elevation.shape)
    x, y = elevation.xy((elevation.rows - 1) / 2, (elevation.cols - 1) / 2)
    return _camera_above(scene, (float(x), float(y)), scene.height_range_m, extent_m, pixels)


def close_view(trial: Trial, scene: Scene, at: tuple[float, float], height_m: float, extent_m: float, pixels: int) -> View:
    """Return a square of a level from above, like ``view_from_above``.

    Its sides are ``extent_m`` long; its centre is at (x, y) in the raster's CRS.
    """
    if trial.serves_maps:
        (x, y), half_m = at, extent_m / 2.0
        return scene.view(bounds=(x - half_m, y - half_m, x + half_m, y + half_m), size=(pixels, pixels))
    return _camera_above(scene, at, (height_m, height_m), extent_m, pixels)


def _camera_above(
    scene: Scene, at: tuple[float, float], height_range_m: tuple[float, float], extent_m: float, pixels: int
) -> PerspectiveView:
    """Return a camera that looks down at a square round a place in the raster's CRS, from a little south of it."""
    elevation = scene.elevation
    point, up = scene.world.points_at_zero_height(elevation.crs, np.float64(at[0]), np.float64(at[1]))
    distance_m = extent_m / 2 / np.tan(np.radians(FOV_DEG / 2))
    low_m, high_m = height_range_m
    north = scene.world.earth_from_enu(point, up)[:, 1]
    eye = point + (high_m + distance_m) * up - 0.2 * distance_m * north
    return look_at(eye, point + (low_m + high_m) / 2 * up, up, FOV_DEG, pixels, pixels)


def map_positions(rendered: RenderedView) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of the pixels' points in the raster's CRS, (rows, cols) each; NaN off the surface."""
    frame = rendered.buffer.frame
    earth = frame.origin_earth_m + rendered.buffer.position_frame_m @ frame.frame_from_earth
    x, y, _ = rendered.scene.world.map_position(rendered.scene.elevation.crs, earth)
    return x, y


def share_of_mask(subset: np.ndarray, mask: np.ndarray) -> float:
    """Return the share of the pixels ``mask`` that are in ``subset`` too, NaN if ``mask`` is empty: a case must have pixels to
    judge.
    """
    return float(np.count_nonzero(subset & mask) / np.count_nonzero(mask)) if mask.any() else float("nan")
