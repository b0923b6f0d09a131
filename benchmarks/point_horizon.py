"""The sun at points: how long a horizon and a day's report take, cold and warm, and how far they are from rays.

Usage: ``python -m benchmarks.point_horizon LEVEL [LEVEL ...] [--points 20] [--date 2024-10-21]``. A level is a level file, a raster
or a bundled level's name. Cold is the first point of a scene that was just opened (loops are compiled before); warm are the other
points, each of them at another place: medians in milliseconds, by the clock and of computing, which other work on the machine
disturbs less, and the slowest of computing. The horizon is compared with Embree's rays against a mesh of the raster's own cells, at
rays that pass 0.02 degrees over and under it.
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

MAX_CELLS = 4_000_000
"""Largest raster that is compared with rays."""

ASIDE_DEG = 0.02


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Milliseconds that work takes, and of computing: the same on an idle machine, since one thread does it all."""
    start, computed = time.perf_counter(), time.process_time()
    work()
    return (time.perf_counter() - start) * 1000.0, (time.process_time() - computed) * 1000.0


def places_of(scene: Scene, count: int) -> list[tuple[float, float]]:
    """Coordinates in the raster's CRS of cells with ground, drawn by a seed."""
    rng, elevation, found = np.random.default_rng(7), scene.elevation, []
    while len(found) < count:
        row, col = rng.uniform(0.05, 0.95) * elevation.rows, rng.uniform(0.05, 0.95) * elevation.cols
        x, y = (float(v) for v in elevation.xy(row, col))
        if np.isfinite(elevation.ground_m(x, y)):
            found.append((x, y))
    return found


def report(scene: Scene, at: tuple[float, float], crs: CRS, day: date) -> None:
    """What a day's report takes: the place, what stands round it, its day."""
    around = load_surroundings(scene, place_at(scene, at, crs, 1.6))
    sun_day(around, day, clock_of("solar", around.place.lon_deg, day))


def whole(scene: Scene, at: tuple[float, float], crs: CRS) -> None:
    """What a horizon of 720 directions takes."""
    horizon_profile(load_surroundings(scene, place_at(scene, at, crs, 1.6)))


def share_agreeing(scene: Scene, places: list[tuple[float, float]], crs: CRS) -> float:
    """Share of rays a little over the horizon by ground that meet nothing, and under it that meet something, of Embree's."""
    ground = paged_relief(scene)
    frame = scene.world.frame_near(ground.grid.crs, scene.world.anchor_x, scene.world.anchor_y)
    sheet = scene.surface(ground.grid).window(0, 0, scene.elevation.rows, scene.elevation.cols, frame).sheet
    rays = RayScene([sheet])
    agree = []
    for at in places:
        around = load_surroundings(scene, place_at(scene, at, crs, 1.6))
        bare = replace(around, triangles=around.triangles[:0], trees=None)
        horizon = horizon_profile(bare)
        for aside in (ASIDE_DEG, -ASIDE_DEG):
            agree += _as_rays(bare.place, frame, rays, horizon.azimuth_deg, horizon.relief_deg + aside, aside < 0)
    return float(np.mean(agree))


def _as_rays(place: PointPlace, frame, rays: RayScene, azimuth: np.ndarray, altitude: np.ndarray, hidden: bool) -> list[bool]:  # noqa: ANN001
    known = altitude > -89.0
    enu = np.stack([direction_enu(a, h) for a, h in zip(azimuth[known], altitude[known], strict=True)])
    towards = frame.directions_from_earth(enu @ place.earth_from_enu.T)
    start = np.repeat(frame.points_from_earth(place.eye_earth_m)[None], len(enu), axis=0)
    return list(rays.blocked(start, towards) == hidden)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("levels", nargs="+")
    parser.add_argument("--points", type=int, default=20)
    parser.add_argument("--date", type=date.fromisoformat, default=date(2024, 10, 21))
    asked = parser.parse_args()
    print("| level | cells | report, cold | warm | computing | slowest | horizon | computing | slowest | as rays |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in asked.levels:
        row = measured(name, asked.points, asked.date)
        print(row, flush=True)


def measured(name: str, count: int, day: date) -> str:
    """A row of the table."""
    path = Path(name) if Path(name).exists() else find_level(name)
    scene = build_scene(load_level(path))
    crs = scene.elevation.crs
    places = places_of(scene, count)
    report(scene, places[0], crs, day), whole(scene, places[0], crs)  # compiles
    clear_caches("light", "scene")
    cold, _ = timed(lambda: report(scene, places[0], crs, day))
    warm = np.array([timed(lambda at=at: report(scene, at, crs, day)) for at in places[1:]])
    horizons = np.array([timed(lambda at=at: whole(scene, at, crs)) for at in places[1:]])
    agree = "-"
    if scene.elevation.rows * scene.elevation.cols <= MAX_CELLS and scene.elevation.is_north_up:
        try:
            agree = f"{100.0 * share_agreeing(scene, places[:8], crs):.2f} %"
        except InputError:
            pass
    figures = [cold, *np.median(warm, axis=0), warm[:, 1].max(), *np.median(horizons, axis=0), horizons[:, 1].max()]
    cells = f"{scene.elevation.cols} x {scene.elevation.rows}"
    return f"| {scene.loaded.name} | {cells} | {' | '.join(f'{figure:.0f}' for figure in figures)} | {agree} |"


if __name__ == "__main__":
    main()
