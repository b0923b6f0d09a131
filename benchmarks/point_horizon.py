"""Time of horizons and of reports of a day at points, cold and warm, and agreement of the horizons with traced rays.

Usage: ``python -m benchmarks.point_horizon LEVEL [LEVEL ...] [--points 20] [--date 2024-10-21]``. A level is a level file, a raster
or a bundled level's name.

Cold is the first point of a newly opened scene, with compiled loops. Warm are the other points, each at another place. Figures are
medians of wall time and of CPU time in milliseconds, and the maximum of CPU time. The horizon is compared with Embree's rays
against a mesh of the raster's own cells. The rays pass 0.02 degrees above and below the horizon. Figures
belong in docs/reports/sun-at-a-point.md, with date, commit and device.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
from pyproj import CRS

from skugga.api.catalogue import find_level
from skugga.shadows.point.clock import clock_of
from skugga.shadows.point.horizon import horizon_profile, load_surroundings
from skugga.shadows.point.place import PointPlace, place_at
from skugga.shadows.point.relief_pages import paged_relief
from skugga.shadows.point.sun_day import sun_day
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

MAX_RAY_CHECK_CELLS = 4_000_000
"""Cells of the largest raster that is compared with rays."""

ALTITUDE_OFFSET_DEG = 0.02
"""Angle between the horizon and the rays that check it, above and below it."""


def measure_ms(function: Callable[[], object]) -> tuple[float, float]:
    """Return wall and CPU milliseconds of a call."""
    start, cpu_start = time.perf_counter(), time.process_time()
    function()
    return (time.perf_counter() - start) * 1000.0, (time.process_time() - cpu_start) * 1000.0


def random_points(scene: Scene, count: int) -> list[tuple[float, float]]:
    """Return ``count`` random points (x, y) in the raster's CRS that lie in cells with valid ground; the seed is fixed."""
    rng, elevation, result = np.random.default_rng(7), scene.elevation, []
    while len(result) < count:
        row, col = rng.uniform(0.05, 0.95) * elevation.rows, rng.uniform(0.05, 0.95) * elevation.cols
        x, y = (float(v) for v in elevation.xy(row, col))
        if np.isfinite(elevation.ground_m(x, y)):
            result.append((x, y))
    return result


def compute_day_report(scene: Scene, xy: tuple[float, float], crs: CRS, day: date) -> None:
    """Compute the report of a day at a point: the place, its horizon, and its sun."""
    surroundings = load_surroundings(scene, place_at(scene, xy, crs, 1.6))
    sun_day(surroundings, day, clock_of("solar", surroundings.place.lon_deg, day))


def compute_horizon(scene: Scene, xy: tuple[float, float], crs: CRS) -> None:
    """Compute the horizon of a point in 720 directions."""
    horizon_profile(load_surroundings(scene, place_at(scene, xy, crs, 1.6)))


def ray_agreement_share(scene: Scene, points: list[tuple[float, float]], crs: CRS) -> float:
    """Return the share of rays from points (x, y) of ``crs`` that agree with the horizon of the ground.

    Embree's rays just above the horizon must hit nothing, and those just below it must hit the ground.
    """
    ground = paged_relief(scene)
    frame = scene.world.frame_near(ground.grid.crs, scene.world.anchor_x, scene.world.anchor_y)
    sheet = scene.surface(ground.grid).window(0, 0, scene.elevation.rows, scene.elevation.cols, frame).sheet
    rays = RayScene([sheet])
    agreements = []
    for xy in points:
        surroundings = load_surroundings(scene, place_at(scene, xy, crs, 1.6))
        ground_only = replace(surroundings, triangles=surroundings.triangles[:0], trees=None)
        horizon = horizon_profile(ground_only)
        for offset_deg in (ALTITUDE_OFFSET_DEG, -ALTITUDE_OFFSET_DEG):
            agreements += _agrees_with_rays(
                ground_only.place, frame, rays, horizon.azimuth_deg, horizon.relief_deg + offset_deg, offset_deg < 0
            )
    return float(np.mean(agreements))


def _agrees_with_rays(
    place: PointPlace, frame, rays: RayScene, azimuth: np.ndarray, altitude: np.ndarray, is_hidden: bool
) -> list[bool]:  # noqa: ANN001
    """Return for each direction whether its ray is blocked or not, as ``is_hidden`` demands.

    ``azimuth`` and ``altitude`` (n,) are in degrees. ``rays`` traces in the local frame ``frame``. Directions close to the nadir
    are omitted.
    """
    is_above_nadir = altitude > -89.0
    enu = np.stack([direction_enu(a, h) for a, h in zip(azimuth[is_above_nadir], altitude[is_above_nadir], strict=True)])
    towards = frame.directions_from_earth(enu @ place.earth_from_enu.T)
    start = np.repeat(frame.points_from_earth(place.eye_earth_m)[None], len(enu), axis=0)
    return list(rays.is_blocked(start, towards) == is_hidden)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("levels", nargs="+")
    parser.add_argument("--points", type=int, default=20)
    parser.add_argument("--date", type=date.fromisoformat, default=date(2024, 10, 21))
    args = parser.parse_args()
    print("| level | cells | report, cold | warm | computing | slowest | horizon | computing | slowest | as rays |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in args.levels:
        row = measure_level(name, args.points, args.date)
        print(row, flush=True)


def measure_level(name: str, count: int, day: date) -> str:
    """Measure the times of a day's report and of a horizon at ``count`` points of a level, and return a row of the printed table.

    ``name`` is a level file, a raster, or the name of a bundled level.
    """
    path = Path(name) if Path(name).exists() else find_level(name)
    scene = build_scene(load_level(path))
    crs = scene.elevation.crs
    places = random_points(scene, count)
    compute_day_report(scene, places[0], crs, day), compute_horizon(scene, places[0], crs)  # compiles
    clear_caches("light", "scene")
    cold, _ = measure_ms(lambda: compute_day_report(scene, places[0], crs, day))
    warm = np.array([measure_ms(lambda at=at: compute_day_report(scene, at, crs, day)) for at in places[1:]])
    horizons = np.array([measure_ms(lambda at=at: compute_horizon(scene, at, crs)) for at in places[1:]])
    agreement_text = "-"
    if scene.elevation.rows * scene.elevation.cols <= MAX_RAY_CHECK_CELLS and scene.elevation.is_north_up:
        try:
            agreement_text = f"{100.0 * ray_agreement_share(scene, places[:8], crs):.2f} %"
        except InputError:
            pass
    figures = [cold, *np.median(warm, axis=0), warm[:, 1].max(), *np.median(horizons, axis=0), horizons[:, 1].max()]
    cells = f"{scene.elevation.cols} x {scene.elevation.rows}"
    return f"| {scene.loaded.name} | {cells} | {' | '.join(f'{figure:.0f}' for figure in figures)} | {agreement_text} |"


if __name__ == "__main__":
    main()
