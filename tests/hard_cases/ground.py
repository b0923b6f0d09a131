"""Views of whole levels, and where their pixels lie: what the cases about rasters and suns share."""

from __future__ import annotations

import numpy as np

from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import Seen, Trial, View

UTM = "EPSG:32633"

CORNER_M = 500_000.0, 5_000_000.0
"""North-west corner of rasters in ``UTM``: on its central meridian, near 45 degrees north."""

FOV_DEG = 40.0


def whole(trial: Trial, scene: Scene, pixels: int) -> View:
    """The level from above, at most ``pixels`` a side: as a map; from a camera for the algorithm that maps are nothing for."""
    if trial.algorithm != "perspective_shadow_map":
        west, south, east, north = scene.elevation.bounds
        sides = np.array([east - west, north - south])
        width, height = np.maximum(np.rint(pixels * sides / sides.max()), 1)
        return scene.view(size=(int(width), int(height)))
    elevation = scene.elevation
    extent_m = elevation.cell_size_m(scene.world.metres_per_unit) * max(elevation.shape)
    x, y = elevation.xy((elevation.rows - 1) / 2, (elevation.cols - 1) / 2)
    return _from_above(scene, (float(x), float(y)), scene.height_range_m, extent_m, pixels)


def close(trial: Trial, scene: Scene, at: tuple[float, float], height_m: float, extent_m: float, pixels: int) -> View:
    """A square of a level, so many metres a side, round a place in its raster's CRS, from above: as ``whole`` shows all of it."""
    if trial.algorithm != "perspective_shadow_map":
        (x, y), half_m = at, extent_m / 2.0
        return scene.view(bounds=(x - half_m, y - half_m, x + half_m, y + half_m), size=(pixels, pixels))
    return _from_above(scene, at, (height_m, height_m), extent_m, pixels)


def _from_above(
    scene: Scene, at: tuple[float, float], height_range_m: tuple[float, float], extent_m: float, pixels: int
) -> PerspectiveView:
    """A camera that looks down at so much ground round a place in the raster's CRS, from a little south of it."""
    elevation = scene.elevation
    point, up = scene.world.ground(elevation.crs, np.float64(at[0]), np.float64(at[1]))
    distance_m = extent_m / 2 / np.tan(np.radians(FOV_DEG / 2))
    low_m, high_m = height_range_m
    north = scene.world.earth_from_enu(point, up)[:, 1]
    eye = point + (high_m + distance_m) * up - 0.2 * distance_m * north
    return look_at(eye, point + (low_m + high_m) / 2 * up, up, FOV_DEG, pixels, pixels)


def places(seen: Seen) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the pixels' points in the raster's CRS, (rows, cols) each; NaN off the surface."""
    frame = seen.buffer.frame
    earth = frame.origin_earth_m + seen.buffer.position_frame_m @ frame.frame_from_earth
    x, y, _ = seen.scene.world.map_position(seen.scene.elevation.crs, earth)
    return x, y


def share(part: np.ndarray, of: np.ndarray) -> float:
    """Share of the pixels ``of`` that are in ``part`` too, NaN of none: a case must have something to look at."""
    return float(np.count_nonzero(part & of) / np.count_nonzero(of)) if of.any() else float("nan")
