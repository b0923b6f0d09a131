"""``draw``: returns what is needed and nothing else; the results by heights and by frames agree, across blocks and off the data."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows import draw as module
from skugga.shadows.draw import LIT, SHADED, draw, heights_suffice
from skugga.shadows.picture import Needs
from skugga.shadows.render import render_frame
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


def nodes_of(scene, rows: int = 140, cols: int = 1130) -> MapView:
    """Return a map of the grid's nodes that extends beyond the data on each side."""
    own = scene.view("map")
    return MapView(own.grid, float(np.floor(own.row0)) - 9.0, float(np.floor(own.col0)) - 9.0, 1.0, 1.0, rows, cols)


@pytest.mark.parametrize("needs", [{"color"}, {"opacity"}, {"visibility"}, {"color", "reach"}, {"visibility", "reach"}, {"frame"}])
@pytest.mark.parametrize("kind", ["hills", "between nodes", "clouds"])
def test_draw_returns_only_what_is_needed(gl, hills, needs, kind):
    scene = hills(225.0, 22.0, **({"weather": {"cloud_cover": 0.5}} if kind == "clouds" else {}))
    view = scene.view("map", size=(90, 60)) if kind == "between nodes" else nodes_of(scene, 60, 80)
    picture = draw(scene, view, plan_of(scene, view), frozenset(needs))
    assert {name for name in ("color", "opacity", "visibility", "reach", "frame") if getattr(picture, name) is not None} == needs
    assert picture.valid.shape == (view.rows, view.cols) and picture.passes


def test_draw_by_heights_equals_the_frame_across_blocks(gl, hills):
    scene = hills(225.0, 22.0)
    view = nodes_of(scene)
    plan = plan_of(scene, view)
    assert view.cols > BLOCK_PX and heights_suffice(scene, view, plan, SHADED)
    done: list[tuple[int, int]] = []
    shown, frame = draw(scene, view, plan, SHADED, lambda *count: done.append(count)), render_frame(scene, view, plan)
    assert shown.color is not None and shown.opacity is not None and shown.reach is not None
    # The search for casters starts at the ground that a block shows, not at its whole square: up to a hundredth less far here.
    assert shown.reach.used_m == pytest.approx(frame.reach.used_m, rel=0.02) and shown.reach.clipped == frame.reach.clipped
    assert len(done) > 1 and done[-1][0] == done[-1][1] == len(done)
    np.testing.assert_array_equal(shown.valid, frame.valid)
    np.testing.assert_array_equal(shown.opacity, frame.opacity)
    apart = np.abs(shown.color.astype(int) - frame.color).max(axis=-1)
    assert apart.max() <= 1 and (apart > 0).mean() <= 1e-4
    assert [record.name for record in shown.passes] == plan.passes


@pytest.mark.parametrize("altitude", [8.0, 30.0, -3.0])
def test_draw_visibility_by_heights_equals_the_frame(gl, hills, altitude):
    """Points in grazing light may differ by rounding: one method finds them lit, the other in shadow."""
    scene = hills(225.0, altitude)
    view = nodes_of(scene)
    plan = plan_of(scene, view)
    assert heights_suffice(scene, view, plan, LIT)
    lit, frame = draw(scene, view, plan, LIT), render_frame(scene, view, plan)
    assert lit.visibility is not None and lit.reach == frame.reach
    np.testing.assert_array_equal(lit.valid, frame.valid)
    np.testing.assert_array_equal(np.isnan(lit.visibility), ~frame.valid)
    wrong = (lit.visibility != frame.visibility) & frame.valid
    assert wrong.sum() / frame.valid.sum() < 5e-4
    assert altitude < 0.0 or 0.05 < np.nanmean(lit.visibility) < 0.98
    assert set(record.name for record in lit.passes) <= set(plan.passes)


def test_draw_falls_back_to_frames_for_single_blocks(gl, hills, monkeypatch):
    """Heights may turn out not to suffice for one of several blocks."""
    scene = hills(225.0, 22.0)
    view = nodes_of(scene)
    plan, by_heights = plan_of(scene, view), module.ground_picture
    whole = draw(scene, view, plan, SHADED)
    calls: list[int] = []

    def every_other(*asked):
        calls.append(1)
        return None if len(calls) % 2 else by_heights(*asked)

    monkeypatch.setattr(module, "ground_picture", every_other)
    mixed = draw(scene, view, plan, SHADED)
    assert len(calls) > 1 and whole.color is not None and mixed.color is not None
    np.testing.assert_array_equal(mixed.opacity, whole.opacity)
    assert np.abs(mixed.color.astype(int) - whole.color).max() <= 1


@pytest.mark.parametrize("needs", [SHADED, LIT])
def test_draw_off_the_data_is_empty(gl, hills, needs: Needs):
    scene = hills(225.0, 22.0)
    near = nodes_of(scene, 60, 80)
    far = MapView(near.grid, near.row0, near.col0 + 20 * BLOCK_PX, 1.0, 1.0, 60, 80)
    picture = draw(scene, far, plan_of(scene, near), needs)
    assert not picture.valid.any() and picture.reach is not None and not picture.reach.clipped
    assert picture.color is None or not picture.color.any()
    assert picture.visibility is None or np.isnan(picture.visibility).all()


def test_draw_refuses_too_many_pixels(hills):
    scene = hills(225.0, 22.0)
    view = nodes_of(scene, 60, 80)
    with pytest.raises(InputError, match="size"):
        draw(scene, MapView(view.grid, 0.0, 0.0, 1.0, 1.0, 9000, 9000), plan_of(scene, view), SHADED)
