"""``draw``: returns what is needed and nothing else; the results by heights and by frames agree, across blocks and off the data."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows import draw as module
from skugga.shadows.draw import SHADING_NEEDS, VISIBILITY_NEEDS, can_draw_from_heights, draw
from skugga.shadows.picture import Needs
from skugga.shadows.render import render_frame, sun_visibility
from skugga.terrain.errors import InputError
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from tests.render import plan_of

CELL_M = 30.0


@pytest.fixture
def hills(write_raster, make_scene):
    """Return ``hills(azimuth, altitude)``: rough ground of 120 x 1100 cells with a hole, so that its map takes two blocks."""

    def make(azimuth: float, altitude: float, **keys):
        row, col = np.mgrid[:120, :1100]
        rough = np.random.default_rng(3).normal(0.0, 10.0, row.shape)
        heights = (700.0 + 300.0 * np.sin(row / 14.0) * np.cos(col / 19.0) + rough).astype(np.float32)
        heights[40:50, 90:140] = np.nan
        raster = write_raster(heights, "EPSG:32633", 420_000.0, 5_200_000.0, CELL_M, nodata=np.nan)
        return make_scene(raster, azimuth, altitude, **keys)

    return make


def node_view(scene, rows: int = 140, cols: int = 1130) -> MapView:
    """Return a map of the grid's nodes that extends beyond the data on each side."""
    full_view = scene.view("map")
    return MapView(
        full_view.grid, float(np.floor(full_view.row0)) - 9.0, float(np.floor(full_view.col0)) - 9.0, 1.0, 1.0, rows, cols
    )


@pytest.mark.parametrize("needs", [{"color"}, {"opacity"}, {"visibility"}, {"color", "reach"}, {"visibility", "reach"}, {"frame"}])
@pytest.mark.parametrize("kind", ["hills", "between nodes", "clouds"])
def test_draw_returns_only_what_is_needed(gl, hills, needs, kind):
    scene = hills(225.0, 22.0, **({"weather": {"cloud_cover": 0.5}} if kind == "clouds" else {}))
    view = scene.view("map", size=(90, 60)) if kind == "between nodes" else node_view(scene, 60, 80)
    picture = draw(scene, view, plan_of(scene, view), frozenset(needs))
    assert {name for name in ("color", "opacity", "visibility", "reach", "frame") if getattr(picture, name) is not None} == needs
    assert picture.valid.shape == (view.rows, view.cols) and picture.passes


@pytest.mark.parametrize("kind", ["nodes across blocks", "coarse pixels"])
def test_sun_visibility_equals_that_of_the_frame(gl, hills, kind):
    scene = hills(225.0, 22.0)
    view = node_view(scene) if kind == "nodes across blocks" else scene.view("map", size=(90, 60))
    plan = plan_of(scene, view)
    expected = render_frame(scene, view, plan).visibilities["sun"]
    np.testing.assert_array_equal(sun_visibility(scene, view, plan), expected)
    assert 0.05 < (expected < 0.5).mean() < 0.95


def test_draw_by_heights_equals_the_frame_across_blocks(gl, hills):
    scene = hills(225.0, 22.0)
    view = node_view(scene)
    plan = plan_of(scene, view)
    assert view.cols > BLOCK_PX and can_draw_from_heights(scene, view, plan, SHADING_NEEDS)
    progress: list[tuple[int, int]] = []
    picture, frame = draw(scene, view, plan, SHADING_NEEDS, lambda *count: progress.append(count)), render_frame(scene, view, plan)
    assert picture.color is not None and picture.opacity is not None and picture.reach is not None
    # The search for casters starts at the ground that a block shows, not at its whole square: up to a hundredth less far here.
    assert picture.reach.used_m == pytest.approx(frame.reach.used_m, rel=0.02) and picture.reach.clipped == frame.reach.clipped
    assert len(progress) > 1 and progress[-1][0] == progress[-1][1] == len(progress)
    np.testing.assert_array_equal(picture.valid, frame.valid)
    np.testing.assert_array_equal(picture.opacity, frame.opacity)
    color_difference = np.abs(picture.color.astype(int) - frame.color).max(axis=-1)
    assert color_difference.max() <= 1 and (color_difference > 0).mean() <= 1e-4
    assert [record.name for record in picture.passes] == plan.passes


@pytest.mark.parametrize("altitude", [8.0, 30.0, -3.0])
def test_draw_visibility_by_heights_equals_the_frame(gl, hills, altitude):
    """Points in grazing light may differ by rounding: one method finds them lit, the other in shadow."""
    scene = hills(225.0, altitude)
    view = node_view(scene)
    plan = plan_of(scene, view)
    assert can_draw_from_heights(scene, view, plan, VISIBILITY_NEEDS)
    picture, frame = draw(scene, view, plan, VISIBILITY_NEEDS), render_frame(scene, view, plan)
    assert picture.visibility is not None and picture.reach == frame.reach
    np.testing.assert_array_equal(picture.valid, frame.valid)
    np.testing.assert_array_equal(np.isnan(picture.visibility), ~frame.valid)
    mismatch = (picture.visibility != frame.visibility) & frame.valid
    assert mismatch.sum() / frame.valid.sum() < 5e-4
    assert altitude < 0.0 or 0.05 < np.nanmean(picture.visibility) < 0.98
    assert set(record.name for record in picture.passes) <= set(plan.passes)


def test_draw_falls_back_to_frames_for_single_blocks(gl, hills, monkeypatch):
    """Heights may turn out not to suffice for one of several blocks."""
    scene = hills(225.0, 22.0)
    view = node_view(scene)
    plan, original = plan_of(scene, view), module.ground_picture
    expected = draw(scene, view, plan, SHADING_NEEDS)
    calls: list[int] = []

    def fail_every_other_call(*arguments):
        calls.append(1)
        return None if len(calls) % 2 else original(*arguments)

    monkeypatch.setattr(module, "ground_picture", fail_every_other_call)
    picture = draw(scene, view, plan, SHADING_NEEDS)
    assert len(calls) > 1 and expected.color is not None and picture.color is not None
    np.testing.assert_array_equal(picture.opacity, expected.opacity)
    assert np.abs(picture.color.astype(int) - expected.color).max() <= 1


@pytest.mark.parametrize("needs", [SHADING_NEEDS, VISIBILITY_NEEDS])
def test_draw_off_the_data_is_empty(gl, hills, needs: Needs):
    scene = hills(225.0, 22.0)
    near = node_view(scene, 60, 80)
    far = MapView(near.grid, near.row0, near.col0 + 20 * BLOCK_PX, 1.0, 1.0, 60, 80)
    picture = draw(scene, far, plan_of(scene, near), needs)
    assert not picture.valid.any() and picture.reach is not None and not picture.reach.clipped
    assert picture.color is None or not picture.color.any()
    assert picture.visibility is None or np.isnan(picture.visibility).all()


def test_draw_refuses_too_many_pixels(hills):
    scene = hills(225.0, 22.0)
    view = node_view(scene, 60, 80)
    with pytest.raises(InputError, match="size"):
        draw(scene, MapView(view.grid, 0.0, 0.0, 1.0, 1.0, 9000, 9000), plan_of(scene, view), SHADING_NEEDS)
