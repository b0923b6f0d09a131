"""Sight walks: walls and cones in closed form, mountains against the sweep's horizons, and crossing times against rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.sun_hours_accuracy import ray_truth
from benchmarks.sweep_speed import fractal_heights_m
from skugga.api.raster_view import raster_view
from skugga.shadows.sun_hours.sight_walks import WalkedGround, horizon_tangent, walked_ground
from skugga.shadows.sun_hours.sun_hours import SunRules, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.shadows.sweep.horizon import horizon_deg
from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff
from tests.shadows.sun_hours.test_sun_hours import SPRING, forbid_plan, raster_cell_view, window_of

CELL_M = 10.0
NO_LOWER_BOUND = -100.0


@pytest.fixture
def open_scene(tmp_path: Path):
    """A function that returns the scene of heights (rows, cols). ``cell`` is the side of a cell in metres.

    Scenes are closed after the test.
    """
    scenes: list[Scene] = []

    def make(heights: np.ndarray, cell: float = CELL_M) -> Scene:
        path = write_geotiff(tmp_path / f"{len(scenes)}.tif", heights.astype(np.float32), "EPSG:32632", 720e3, 5200e3, cell)
        scenes.append(build_scene(load_level(path)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def ground_and_origin(scene: Scene, patches: tuple[Patch, ...] = ()) -> tuple[WalkedGround, int, int]:
    """Return the ground, and the row and column of the raster's first cell."""
    view = raster_view(scene).view.with_pixels_as_nodes()
    return walked_ground(scene, bare_nodes(scene, view, 1), patches), int(view.row0), int(view.col0)


def tangent_towards(
    ground: WalkedGround, row: int, col: int, azimuth_deg: float, eye_height_m: float = 0.0, min_tangent: float = NO_LOWER_BOUND
) -> float:
    """Return the tangent of the horizon angle of a node towards an azimuth, or ``min_tangent`` if that is larger."""
    down, right = -np.cos(np.radians(azimuth_deg)) / CELL_M, np.sin(np.radians(azimuth_deg)) / CELL_M
    return float(horizon_tangent(ground, row, col, eye_height_m, down, right, min_tangent))


@pytest.mark.parametrize("azimuth", [90.0, 61.0, 122.0, 270.0, 241.0])
def test_horizon_tangent_of_a_wall(open_scene, azimuth):
    heights = np.zeros((301, 201))
    heights[:, 100] = 80.0
    ground, row0, col0 = ground_and_origin(open_scene(heights))
    distance_cells, side = 40, 1 if azimuth < 180.0 else -1
    tangent = tangent_towards(ground, row0 + 150, col0 + 100 - side * distance_cells, azimuth)
    distance_m = distance_cells * CELL_M / abs(np.sin(np.radians(azimuth)))
    assert tangent == pytest.approx((80.0 - distance_m**2 / 2.0 / 6.371e6) / distance_m, abs=1e-6)
    raised_tangent = tangent_towards(ground, row0 + 150, col0 + 100 - side * distance_cells, azimuth, eye_height_m=30.0)
    assert raised_tangent == pytest.approx(50.0 / distance_m, abs=1e-4)


def test_horizon_tangent_is_at_least_the_lower_bound(open_scene):
    ground, row0, col0 = ground_and_origin(open_scene(np.zeros((60, 60))))
    assert tangent_towards(ground, row0 + 30, col0 + 30, 33.0, min_tangent=0.25) == 0.25
    assert tangent_towards(ground, row0 + 30, col0 + 30, 33.0) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("azimuth", [17.0, 71.0, 134.0, 199.0, 255.0, 311.0])
def test_horizon_tangent_matches_the_sweep_horizon(open_scene, azimuth):
    heights = fractal_heights_m(200).astype(np.float32)
    ground, row0, col0 = ground_and_origin(open_scene(heights))
    swept_deg = horizon_deg(heights, CELL_M, azimuth, lines=16)
    cells = np.random.default_rng(5).integers(5, 195, (200, 2))
    walked_deg = np.degrees(np.arctan([tangent_towards(ground, row0 + row, col0 + col, azimuth) for row, col in cells]))
    error_deg = np.abs(walked_deg - swept_deg[cells[:, 0], cells[:, 1]])
    assert np.median(error_deg) < 0.005 and np.percentile(error_deg, 98) < 0.15  # the sweep interpolates between lines


def test_horizon_tangent_ignores_nodata(open_scene):
    heights = np.zeros((80, 80))
    heights[:, 60] = 50.0
    heights[20:60, 30:41] = np.nan
    scene = open_scene(heights)
    view = raster_view(scene).view.with_pixels_as_nodes()
    nodes = bare_nodes(scene, view, 1)
    assert tangent_towards(walked_ground(scene, nodes, ()), int(view.row0) + 40, int(view.col0) + 20, 90.0) == pytest.approx(
        50.0 / 400.0, abs=1e-4
    )


def test_horizon_tangent_walks_fine_and_coarse_patches(open_scene):
    heights = np.zeros((40, 1500))
    heights[:, 600:608], heights[:, 1200:1208] = 60.0, 700.0
    scene = open_scene(heights)
    view = raster_view(scene).view.with_pixels_as_nodes()
    block = replace(view, cols=64)
    nodes = bare_nodes(scene, block, 1)
    row, col = int(block.row0) + 20, int(block.col0) + 30
    first, last = int(block.col0) // PATCH_QUADS, (int(block.col0) + 800) // PATCH_QUADS
    rows = range((row - 20) // PATCH_QUADS, (row + 20) // PATCH_QUADS + 1)
    near = tuple(Patch(0, r, c) for r in rows for c in range(first, last + 1))
    far = tuple(Patch(1, r // 2, c) for r in rows[:1] for c in range(last // 2, last // 2 + 3))
    assert tangent_towards(walked_ground(scene, nodes, ()), row, col, 90.0) < 1e-4
    assert tangent_towards(walked_ground(scene, nodes, near), row, col, 90.0) == pytest.approx(60.0 / 5700.0, rel=0.05)
    assert tangent_towards(walked_ground(scene, nodes, (*near, *far)), row, col, 90.0) == pytest.approx(700.0 / 11700.0, rel=0.05)


def test_walked_crossings_in_15_minute_steps_match_rays(open_scene, monkeypatch):
    scene = open_scene(fractal_heights_m(128), cell=30.0)
    (day,) = window_suns(scene.world, [window_of(scene, SPRING)])
    view = raster_cell_view(scene)
    row, col = (np.random.default_rng(2).integers(3, 125, 300) for _ in range(2))
    hours, _, _ = ray_truth(scene, view, row, col, day, step_min=0.5)

    def mean_error_min() -> float:
        result = sun_hours(scene, view, [day], SunRules(step_minutes=15.0), forbid_plan)
        return float(60.0 * np.abs(result.hours[row, col] - hours).mean())

    walked_error_min = mean_error_min()
    monkeypatch.setattr("skugga.shadows.sun_hours.sun_hours.MIN_REFINED_TIME_STEP_MINUTES", np.inf)
    unwalked_error_min = mean_error_min()
    assert walked_error_min < 1.0 and walked_error_min < 0.5 * unwalked_error_min
