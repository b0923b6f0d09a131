"""Clearance tangents by marches: walls and mountains against walks, and crossing times against rays and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.sun_hours_accuracy import ray_truth
from benchmarks.sweep_speed import fractal_heights_m
from skugga.shadows.sun_hours import marched_clearances, spells
from skugga.shadows.sun_hours.marched_clearances import clearance_tangents, marched_ground
from skugga.shadows.sun_hours.sight_walks import horizon_tangent, sun_track, walked_ground
from skugga.shadows.sun_hours.sun_hours import SunRules, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.shadows.sweep.rays import rays_at
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from tests.shadows.sun_hours.test_sun_hours import SPRING, SUMMER, forbid_plan, open_scene, raster_cell_view, window_of

__all__ = ["open_scene"]

DAY_MINUTES = [345.0, 420.0, 500.0, 620.0, 700.0, 780.0, 900.0, 1010.0]
"""Moments of a summer day, minutes of UTC: the sun stands in each octant of the grid that it reaches."""


def marched_tangents(
    scene: Scene, view: MapView, minutes: float, eye_height_m: float = 0.0, margin: float = 0.5, is_active: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return clearance tangents (rows, cols) of a block by marches and by walks, at a moment of a summer day.

    ``is_active`` (rows, cols) are the cells that change between sun and shade after the moment; all of them if it is ``None``.
    """
    (day,) = window_suns(scene.world, [window_of(scene, SUMMER)])
    nodes = bare_nodes(scene, view, 1)
    sun = day.sun_at(minutes, scene.world)
    orientation = rays_at(replace(scene, sun=sun), view.grid, *view.centre_node).orientation
    walked = walked_ground(scene, nodes, ())
    track = sun_track(day, nodes, scene.world, orientation, (minutes, minutes + 1.0))
    active = np.ones((view.rows, view.cols), bool) if is_active is None else is_active
    lit = np.ascontiguousarray(orientation.sun_aligned_view(np.where(active, np.float32(1.0), np.float32(-1.0))))
    dark = np.full_like(lit, -1.0)
    tangents = clearance_tangents(marched_ground(nodes, walked, orientation), track, (dark, lit, lit), eye_height_m, margin, 1)
    rows, cols = np.divmod(np.arange(view.rows * view.cols), view.cols)
    i, j = orientation.to_sun_aligned(rows, cols, view.rows, view.cols)
    y, x = i / max(lit.shape[0] - 1, 1), j / max(lit.shape[1] - 1, 1)
    terms = np.stack([np.ones_like(y), y, x, y * y, y * x, x * x])
    down, right, altitude_tangent = (track.direction_coefficients[axis, 0] @ terms for axis in range(3))
    row0, col0 = int(view.row0), int(view.col0)
    horizons = [
        horizon_tangent(walked, row0 + row, col0 + col, eye_height_m, down[n], right[n], altitude_tangent[n] - margin)
        for n, (row, col) in enumerate(zip(rows, cols, strict=True))
    ]
    return orientation.grid_order_view(tangents), (altitude_tangent - horizons).reshape(view.rows, view.cols)


@pytest.mark.parametrize("minutes", DAY_MINUTES)
def test_clearance_tangents_match_walks_over_mountains(open_scene, minutes):
    scene = open_scene(fractal_heights_m(128), cell=30.0)
    marched, walked = marched_tangents(scene, raster_cell_view(scene), minutes)
    error = np.abs(marched - walked)[2:-2, 2:-2]  # walks end on the rim, marches within the last cell
    assert np.median(error) < 1e-4 and np.percentile(error, 99) < 0.005
    assert np.ptp(walked) > 0.3  # the horizons differ


@pytest.mark.parametrize("minutes", DAY_MINUTES)
def test_clearance_tangents_of_a_wall(open_scene, minutes):
    heights = np.zeros((90, 110))
    heights[45, :] = heights[:, 55] = 30.0
    scene = open_scene(heights)
    view = raster_cell_view(scene)
    for eye_height_m in (0.0, 12.0):
        marched, walked = marched_tangents(scene, view, minutes, eye_height_m)
        np.testing.assert_allclose(marched[3:-3, 3:-3], walked[3:-3, 3:-3], atol=1e-3)


def test_clearance_tangents_are_at_most_the_margin(open_scene):
    scene = open_scene(np.zeros((70, 90)))
    marched, _ = marched_tangents(scene, raster_cell_view(scene), 700.0, margin=0.25)
    np.testing.assert_allclose(marched, 0.25, atol=1e-5)


def test_clearance_tangents_of_a_part_equal_those_of_all(open_scene):
    scene = open_scene(fractal_heights_m(150), cell=30.0)
    view = replace(raster_cell_view(scene), row0=7.0, col0=11.0, rows=97, cols=131)
    is_active = np.random.default_rng(4).random((97, 131)) < 0.02
    every, _ = marched_tangents(scene, view, 420.0)
    some, _ = marched_tangents(scene, view, 420.0, is_active=is_active)
    np.testing.assert_allclose(some[is_active], every[is_active], atol=2e-3)


def test_tiles_follow_the_sun_over_a_wide_block(open_scene, monkeypatch):
    scene = open_scene(fractal_heights_m(64) * 40.0, cell=2000.0)
    view = raster_cell_view(scene)
    tiled, walked = marched_tangents(scene, view, 700.0, margin=2.0)
    monkeypatch.setattr(marched_clearances, "MAX_TILES_PER_SIDE", 1)
    untiled, _ = marched_tangents(scene, view, 700.0, margin=2.0)
    tiled_error, untiled_error = (np.abs(values - walked)[2:-2, 2:-2].mean() for values in (tiled, untiled))
    assert tiled_error < 0.5 * untiled_error


@given(
    start=st.floats(0.001, 0.2), stop=st.floats(0.001, 0.2), bulge=st.floats(-0.0002, 0.0002), is_lit=st.booleans(),
    step=st.floats(3.0, 20.0),
)  # fmt: skip
def test_interpolate_crossing_is_the_root_of_the_parabola(start, stop, bulge, is_lit, step):
    c0, c1 = (start, -stop) if is_lit else (-start, stop)
    c0, c1 = float(np.float32(c0)), float(np.float32(c1))
    t = spells._interpolate_crossing.py_func(c0, c1, is_lit, bulge, 100.0, 100.0 + step)
    roots = np.roots([-4.0 * bulge, c1 - c0 + 4.0 * bulge, c0]) if abs(bulge) > 1e-9 else np.array([c0 / (c0 - c1)])
    inside = [root for root in roots.real if -1e-9 <= root <= 1.0 + 1e-9]
    assert len(inside) == 1
    assert (t - 100.0) / step == pytest.approx(inside[0], abs=0.02)


def test_interpolate_crossing_refuses_tangents_of_other_signs():
    interpolate = spells._interpolate_crossing.py_func
    assert interpolate(0.1, -0.3, True, 0.0, 0.0, 12.0) == pytest.approx(3.0)
    assert interpolate(-0.1, 0.3, False, 0.0, 0.0, 12.0) == pytest.approx(3.0)
    for c0, c1, is_lit in ((0.1, 0.2, True), (-0.1, -0.2, False), (0.1, -0.3, False), (-0.1, 0.3, True), (np.nan, 0.1, False)):
        assert np.isnan(interpolate(c0, c1, is_lit, 0.0, 0.0, 12.0))


def hours_errors_min(scene: Scene, view: MapView, cells: int, **rules: float) -> np.ndarray:
    """Return the errors of the hours of sun of random cells against rays, minutes."""
    (day,) = window_suns(scene.world, [window_of(scene, SPRING)])
    row, col = (np.random.default_rng(2).integers(3, side - 3, cells) for side in (view.rows, view.cols))
    hours, _, _ = ray_truth(scene, view, row, col, day, step_min=0.5)
    result = sun_hours(scene, view, [day], SunRules(**rules), forbid_plan)
    return 60.0 * np.abs(result.hours[row, col] - hours)


def test_hours_in_12_minute_steps_match_rays(open_scene, monkeypatch):
    row, col = np.mgrid[0:128, 0:128]
    hills = 300.0 * np.sin(row / 9.0) * np.cos(col / 11.0) + 150.0 * np.sin(row / 23.0 + col / 17.0)
    scene = open_scene(hills, cell=30.0)
    view = raster_cell_view(scene)
    error_min = hours_errors_min(scene, view, 300, step_minutes=12.0)
    monkeypatch.setattr("skugga.shadows.sun_hours.sun_hours.MIN_REFINED_TIME_STEP_MINUTES", np.inf)
    unrefined_error_min = hours_errors_min(scene, view, 300, step_minutes=12.0)
    assert error_min.mean() < 0.5 and error_min.mean() < 0.4 * unrefined_error_min.mean()


def test_hours_of_a_block_count_the_ground_beside_it(open_scene):
    scene = open_scene(fractal_heights_m(160), cell=30.0)
    whole = raster_cell_view(scene)
    block = replace(whole, row0=50.0, col0=50.0, rows=60, cols=60)
    (day,) = window_suns(scene.world, [window_of(scene, SPRING)])
    of_whole, of_block = (sun_hours(scene, view, [day], SunRules(12.0), forbid_plan).hours for view in (whole, block))
    difference_min = 60.0 * np.abs(of_block - of_whole[50:110, 50:110])
    assert difference_min.mean() < 0.05 and np.percentile(difference_min, 99) < 1.0
    alone = open_scene(fractal_heights_m(160)[50:110, 50:110], cell=30.0)
    (day,) = window_suns(alone.world, [window_of(alone, SPRING)])
    of_alone = sun_hours(alone, raster_cell_view(alone), [day], SunRules(12.0), forbid_plan).hours
    assert 60.0 * np.abs(of_alone - of_whole[50:110, 50:110]).mean() > 5.0  # that ground matters
