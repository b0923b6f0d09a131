"""Sight walks: walls and cones in closed form, mountains against the sweep's horizons, and crossing times against rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.sun_hours_accuracy import ray_truth
from benchmarks.sweep_speed import mountains
from skugga.api.raster_view import raster_view
from skugga.shadows.sun_hours.sight_walks import WalkedGround, horizon_tangent, walked_ground
from skugga.shadows.sun_hours.sun_hours import SunRules, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.shadows.sweep.horizon import horizon_deg
from skugga.terrain.casters.reach import PATCH_QUADS, Patch
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff
from tests.shadows.sun_hours.test_sun_hours import SPRING, cells_of, no_plan, window_of

CELL_M = 10.0
NO_LEAST = -100.0


@pytest.fixture
def opened(tmp_path: Path):
    scenes: list[Scene] = []

    def make(heights: np.ndarray, cell: float = CELL_M) -> Scene:
        path = write_geotiff(tmp_path / f"{len(scenes)}.tif", heights.astype(np.float32), "EPSG:32632", 720e3, 5200e3, cell)
        scenes.append(build_scene(load_level(path)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def ground_of(scene: Scene, patches: tuple[Patch, ...] = ()) -> tuple[WalkedGround, int, int]:
    """Return the ground, and the row and column of the raster's first cell."""
    view = raster_view(scene).view.as_nodes()
    return walked_ground(scene, bare_nodes(scene, view, 1), patches), int(view.row0), int(view.col0)


def seen(ground: WalkedGround, row: int, col: int, azimuth_deg: float, eye_height_m: float = 0.0, least: float = NO_LEAST) -> float:
    down, right = -np.cos(np.radians(azimuth_deg)) / CELL_M, np.sin(np.radians(azimuth_deg)) / CELL_M
    return float(horizon_tangent(ground, row, col, eye_height_m, down, right, least))


@pytest.mark.parametrize("azimuth", [90.0, 61.0, 122.0, 270.0, 241.0])
def test_horizon_tangent_of_a_wall(opened, azimuth):
    heights = np.zeros((301, 201))
    heights[:, 100] = 80.0
    ground, row0, col0 = ground_of(opened(heights))
    away, side = 40, 1 if azimuth < 180.0 else -1
    found = seen(ground, row0 + 150, col0 + 100 - side * away, azimuth)
    metres = away * CELL_M / abs(np.sin(np.radians(azimuth)))
    assert found == pytest.approx((80.0 - metres**2 / 2.0 / 6.371e6) / metres, abs=1e-6)
    eye_height_m = seen(ground, row0 + 150, col0 + 100 - side * away, azimuth, eye_height_m=30.0)
    assert eye_height_m == pytest.approx(50.0 / metres, abs=1e-4)


def test_horizon_tangent_is_at_least_the_lower_bound(opened):
    ground, row0, col0 = ground_of(opened(np.zeros((60, 60))))
    assert seen(ground, row0 + 30, col0 + 30, 33.0, least=0.25) == 0.25
    assert seen(ground, row0 + 30, col0 + 30, 33.0) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("azimuth", [17.0, 71.0, 134.0, 199.0, 255.0, 311.0])
def test_horizon_tangent_matches_the_sweep_horizon(opened, azimuth):
    heights = mountains(200).astype(np.float32)
    ground, row0, col0 = ground_of(opened(heights))
    # What casts goes on for one node beyond the raster, at its border's height: the horizon of an array ends at its centres.
    by_sweep = horizon_deg(np.pad(heights, 1, mode="edge"), CELL_M, azimuth, lines=16)[1:-1, 1:-1]
    places = np.random.default_rng(5).integers(5, 195, (200, 2))
    found = np.degrees(np.arctan([seen(ground, row0 + row, col0 + col, azimuth) for row, col in places]))
    wrong = np.abs(found - by_sweep[places[:, 0], places[:, 1]])
    assert np.median(wrong) < 0.005 and np.percentile(wrong, 98) < 0.15  # the sweep interpolates between lines


def test_horizon_tangent_ignores_nodata(opened):
    heights = np.zeros((80, 80))
    heights[:, 60] = 50.0
    heights[20:60, 30:41] = np.nan
    scene = opened(heights)
    view = raster_view(scene).view.as_nodes()
    nodes = bare_nodes(scene, view, 1)
    assert seen(walked_ground(scene, nodes, ()), int(view.row0) + 40, int(view.col0) + 20, 90.0) == pytest.approx(
        50.0 / 400.0, abs=1e-4
    )


def test_horizon_tangent_walks_fine_and_coarse_patches(opened):
    heights = np.zeros((40, 1500))
    heights[:, 600:608], heights[:, 1200:1208] = 60.0, 700.0
    scene = opened(heights)
    view = raster_view(scene).view.as_nodes()
    block = replace(view, cols=64)
    nodes = bare_nodes(scene, block, 1)
    row, col = int(block.row0) + 20, int(block.col0) + 30
    first, last = int(block.col0) // PATCH_QUADS, (int(block.col0) + 800) // PATCH_QUADS
    rows = range((row - 20) // PATCH_QUADS, (row + 20) // PATCH_QUADS + 1)
    near = tuple(Patch(0, r, c) for r in rows for c in range(first, last + 1))
    far = tuple(Patch(1, r // 2, c) for r in rows[:1] for c in range(last // 2, last // 2 + 3))
    assert seen(walked_ground(scene, nodes, ()), row, col, 90.0) < 1e-4
    assert seen(walked_ground(scene, nodes, near), row, col, 90.0) == pytest.approx(60.0 / 5700.0, rel=0.05)
    assert seen(walked_ground(scene, nodes, (*near, *far)), row, col, 90.0) == pytest.approx(700.0 / 11700.0, rel=0.05)


def test_walked_crossings_in_15_minute_steps_match_rays(opened, monkeypatch):
    scene = opened(mountains(128), cell=30.0)
    (day,) = window_suns(scene.world, [window_of(scene, SPRING)])
    view = cells_of(scene)
    row, col = (np.random.default_rng(2).integers(3, 125, 300) for _ in range(2))
    hours, _, _ = ray_truth(scene, view, row, col, day, every_min=0.5)

    def wrong_min() -> float:
        answer = sun_hours(scene, view, [day], SunRules(step_min=15.0), no_plan)
        return float(60.0 * np.abs(answer.hours[row, col] - hours).mean())

    walked = wrong_min()
    monkeypatch.setattr("skugga.shadows.sun_hours.sun_hours.WALKED_MIN", np.inf)
    guessed = wrong_min()
    assert walked < 1.0 and walked < 0.5 * guessed
