"""Supersampling: pixels larger than the data's cells show the mean visibility of their ground."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from morecantile import tms

from skugga.shadows.passes import PassLog
from skugga.shadows.render import render_frame
from skugga.shadows.supersampling import _visibilities_at_nodes, lit_nodes, supersampling
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.supersampling import covered_nodes, max_in_pixels, means_in_pixels, subdivision_level, subpixel_grid
from skugga.terrain.geo.grid import Grid, MapView, tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING, write_geotiff
from tests.render import block_at, plan_of, render

MERCATOR = tms.get("WebMercatorQuad")

SIDE, PERIOD, CREST = 64, 8, 4
"""Cells of 1 m. Ridges run from north to south, one per ``PERIOD`` columns, in column ``CREST`` of each period."""

IS_SHADED_COLUMN = np.isin(np.arange(SIDE) % PERIOD, (CREST - 1, CREST - 2))
"""Under a sun in the east, 45 degrees high, crests of 2.5 m shade exactly the nodes one and two metres west of them."""


@pytest.fixture
def ridges(tmp_path):
    """Return ridges that are lost when 8 cells are averaged."""
    heights = np.zeros((SIDE, SIDE), np.float32)
    heights[:, CREST::PERIOD] = 2.5
    write_geotiff(tmp_path / "dem.tif", heights, ENGINEERING, 0.0, float(SIDE), 1.0)
    level = {"version": 1, "terrain": {"source": "dem.tif"}, "sun": {"azimuth": 90.0, "altitude": 45.0}}
    (tmp_path / "level.yaml").write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(tmp_path / "level.yaml"))


@pytest.fixture(scope="module")
def jacksboro():
    """Scene of a bundled level of terrain only, under a low sun."""
    scene = build_scene(load_level(Path(__file__).parents[2] / "configs" / "jacksboro.yaml"))
    return scene.with_sun(SunSpec(azimuth=250.0, altitude=12.0))


def view_of(scene, pixels: int) -> MapView:
    """Return a map of the whole ground with ``pixels`` pixels a side."""
    return scene.view(bounds=(0.0, 0.0, float(SIDE), float(SIDE)), size=(pixels, pixels))


@pytest.mark.parametrize("pixels", [32, 16, 8, 4, 12, 20])
def test_supersampling_shows_the_lit_share_of_a_pixel(ridges, pixels):
    """12 and 20 pixels cut through the squares of nodes, which are weighted by their share in the pixel."""
    width = SIDE / pixels
    expected = []
    for i in range(pixels):
        overlap = np.clip(np.minimum((i + 1) * width, np.arange(SIDE) + 1.0) - np.maximum(i * width, np.arange(SIDE)), 0.0, 1.0)
        expected.append(1.0 - (overlap * IS_SHADED_COLUMN).sum() / overlap.sum())
    frame = render(ridges, view_of(ridges, pixels), algorithm="sweep")
    assert frame.valid.all()
    np.testing.assert_allclose(frame.visibility, np.broadcast_to(expected, (pixels, pixels)), atol=1e-6)


@pytest.mark.parametrize("algorithm", ["sweep", "shadow_map", "shadow_volume", "truth"])
def test_supersampling_works_for_every_algorithm(ridges, algorithm):
    frame = render(ridges, view_of(ridges, 8), algorithm=algorithm)
    np.testing.assert_allclose(frame.visibility, 0.75, atol=0.02)


def test_point_sampling_of_coarse_pixels_loses_shadows(ridges):
    """This is why supersampling exists: on ground averaged over 8 cells nothing casts a shadow."""
    view = view_of(ridges, 8)
    frame = render_frame(ridges, view, plan_of(ridges, view, algorithm="sweep"), pixel_sampling="points")
    assert (frame.visibility == 1.0).all()


def test_supersampling_is_off_for_pixels_up_to_a_cell(ridges):
    for pixels in (64, 128, 50):
        view = view_of(ridges, pixels)
        plan = plan_of(ridges, view, algorithm="sweep")
        assert subdivision_level(ridges, view) == 0 and supersampling(ridges, view, plan) is None
        mean_visibility, point_visibility = (
            render_frame(ridges, view, plan, pixel_sampling=pixel_sampling).visibility for pixel_sampling in ("means", "points")
        )
        np.testing.assert_array_equal(mean_visibility, point_visibility)
        assert set(np.unique(mean_visibility)) == {0.0, 1.0}


def test_subdivision_level_uses_the_levels_resolution(ridges, tmp_path):
    level = json.loads((tmp_path / "level.yaml").read_text())
    level["terrain"]["resolution"] = 4
    (tmp_path / "rough.yaml").write_text(json.dumps(level), encoding="utf-8")
    coarse_scene = build_scene(load_level(tmp_path / "rough.yaml"))
    assert [subdivision_level(ridges, view_of(ridges, pixels)) for pixels in (64, 32, 16, 8)] == [0, 1, 2, 3]
    assert [subdivision_level(coarse_scene, view_of(coarse_scene, pixels)) for pixels in (64, 32, 16, 8)] == [0, 0, 0, 1]


def test_descriptor_of_a_supersampled_map_is_the_finer_maps(ridges):
    coarse_descriptor, fine_descriptor, coarse_view = (
        describe(ridges, view_of(ridges, 8)),
        describe(ridges, view_of(ridges, 64)),
        view_of(ridges, 8),
    )
    assert (coarse_descriptor.pieces, fine_descriptor.pieces, describe(ridges, coarse_view, pixel_sampling="points").pieces) == (
        8,
        1,
        1,
    )
    assert (
        coarse_descriptor.pixel_m == fine_descriptor.pixel_m == 1.0
        and describe(ridges, coarse_view, pixel_sampling="points").pixel_m == 8.0
    )
    assert coarse_descriptor.pixels == fine_descriptor.pixels == SIDE**2
    assert coarse_descriptor.facts["cast_shadows"] == fine_descriptor.facts["cast_shadows"]
    assert any(reason.name == "supersampling" and "8 x 8" in reason.reason for reason in plan_of(ridges, coarse_view).reasons)


def test_subpixel_grid_of_a_tile_is_a_finer_zoom(jacksboro):
    view = block_at(-84.25, 36.6, 9)
    nodes = covered_nodes(view, subpixel_grid(view, subdivision_level(jacksboro, view)))
    grid = tile_grid(MERCATOR, 11)
    assert nodes.rows == 4096 and (nodes.row0, nodes.col0) == (4 * view.row0, 4 * view.col0)
    assert abs(nodes.grid.x0 - grid.x0) < 1e-6 and abs(nodes.grid.y0 - grid.y0) < 1e-6
    assert abs(nodes.grid.step - grid.step) < 1e-9


def test_supersampled_map_is_the_mean_of_the_finer_map(jacksboro):
    """This holds across blocks, too: the finer map's blocks begin and end elsewhere."""
    fine_view, coarse_view = (view_around_middle(jacksboro, zoom) for zoom in (11, 9))
    fine_frame, coarse_frame = (render(jacksboro, view, algorithm="sweep") for view in (fine_view, coarse_view))
    visibility = fine_frame.visibility.reshape(coarse_view.rows, 4, coarse_view.cols, 4)
    valid = ~np.isnan(visibility).any(axis=(1, 3)) & coarse_frame.valid
    difference = np.abs(coarse_frame.visibility - visibility.mean(axis=(1, 3)))[valid]
    assert valid.sum() > 5000 and 0.2 < coarse_frame.visibility[valid].mean() < 0.9
    assert difference.mean() < 1e-3 and (difference > 1e-6).mean() < 0.02


@pytest.mark.parametrize("algorithm", ["sweep", "shadow_map"])
@pytest.mark.parametrize("pixels", [8, 64], ids=["coarse", "fine"])
def test_outside_casters_follow_the_plan(gl, tmp_path, pixels, algorithm):
    """A ridge 19.5 m high stands 15.5 m beside the window, under a sun 45 degrees high. Its shadow ends 4 m inside."""
    heights = np.zeros((SIDE, 2 * SIDE), np.float32)
    heights[:, SIDE + 15] = 19.5
    write_geotiff(tmp_path / "dem.tif", heights, ENGINEERING, 0.0, float(SIDE), 1.0)
    shares = {}
    for switch in ("on", "off"):
        sun, effects = {"azimuth": 90.0, "altitude": 45.0}, {"outside_casters": switch}
        keys = {"version": 1, "terrain": {"source": "dem.tif"}, "sun": sun, "effects": effects}
        (tmp_path / "level.yaml").write_text(json.dumps(keys), encoding="utf-8")
        scene = build_scene(load_level(tmp_path / "level.yaml"))
        frame = render(scene, view_of(scene, pixels), algorithm=algorithm)
        shares[switch] = float(frame.shown_visibilities["sun"].mean())
        assert shares[switch] == pytest.approx(float(frame.visibility.mean()), abs=0.01)
    assert shares == {"on": pytest.approx(1.0 - 4.0 / SIDE, abs=0.01), "off": 1.0}


def view_around_middle(scene, zoom: int) -> MapView:
    """Return 96 x 96 pixels of zoom 9, or the same ground in pixels of another zoom."""
    grid, side = tile_grid(MERCATOR, 9), 96
    x, y, _ = scene.world.map_position(grid.crs, scene.world.anchor_earth_m)
    row, col = round((grid.y0 - float(y)) / grid.step) - side // 2, round((float(x) - grid.x0) / grid.step) - side // 2
    scale = 2 ** (zoom - 9)
    return MapView(tile_grid(MERCATOR, zoom), float(row * scale), float(col * scale), 1.0, 1.0, side * scale, side * scale)


def test_lit_nodes_by_heights_match_geometry_buffers(jacksboro):
    view = view_around_middle(jacksboro, 9)
    pixels = supersampling(jacksboro, view, plan_of(jacksboro, view, algorithm="sweep"))
    assert pixels is not None and pixels.uses_heights_only
    nodes = pixels.covered_nodes(view)
    (heights_valid, heights_visibility), (buffer_valid, buffer_visibility) = (
        lit_nodes(pixels, nodes, True, PassLog()),
        _visibilities_at_nodes(pixels, nodes, True, PassLog()),
    )
    np.testing.assert_array_equal(heights_valid, buffer_valid)
    assert ((buffer_visibility["sun"] > 0.5) != heights_visibility["sun"])[
        buffer_valid
    ].mean() < 2e-3  # a pixel's lines are spread over its nodes


def test_supersampling_averages_penumbrae(ridges):
    view = view_of(ridges, 8)
    soft = render(ridges, view, algorithm="sweep", filter="sun")
    np.testing.assert_allclose(soft.visibility, 0.75, atol=0.02)


def test_supersampled_layers_have_the_maps_size(ridges):
    view = view_of(ridges, 8)
    frame = render_frame(ridges, view, plan_of(ridges, view, algorithm="sweep"), layers=frozenset({"shadow-height"}))
    height = frame.layers["shadow-height"]["sun"]
    assert height.shape == (8, 8) and np.isfinite(height).all()
    # The eight nodes across have 2.5 m on the crest, and 1.5 m and 0.5 m in its shadow.
    np.testing.assert_allclose(height, 4.5 / 8, atol=1e-3)


@pytest.mark.parametrize("algorithm", ["hybrid", "shadow_volume"])
def test_supersampled_mark_layers_have_the_maps_size(ridges, algorithm):
    view = view_of(ridges, 8)
    frame = render_frame(ridges, view, plan_of(ridges, view, algorithm=algorithm), layers=frozenset({"silhouettes"}))
    assert frame.layers["silhouettes"]["sun"].shape == (8, 8)


def test_means_in_pixels_ignore_invalid_nodes():
    grid = Grid(None, 2.0, -2.0, 4.0)
    view = MapView(grid, 0.0, 0.0, 1.0, 1.0, 1, 3)
    nodes = MapView(grid.subdivided(2), 0.0, 0.0, 1.0, 1.0, 4, 12)
    assert (nodes.grid.x0, nodes.grid.y0, nodes.grid.step) == (0.5, -0.5, 1.0)
    values, valid = np.zeros((4, 12), np.float32), np.ones((4, 12), bool)
    values[:, :2] = 1.0
    valid[:, 1:4], valid[:, 8:] = False, False
    np.testing.assert_array_equal(means_in_pixels(view, nodes, values, valid), [[1.0, 0.0, np.nan]])
    np.testing.assert_array_equal(max_in_pixels(view, nodes, (2 * values).astype(np.uint8)), [[2, 0, 0]])


def test_supersampling_at_night_is_dark(ridges):
    night = ridges.with_sun(SunSpec(azimuth=90.0, altitude=-10.0))
    assert (render(night, view_of(night, 8)).visibility == 0.0).all()


@pytest.mark.parametrize("finer", [lambda grid: grid.refined(), lambda grid: grid.subdivided(1), lambda grid: grid.subdivided(2)])
def test_means_in_pixels_of_booleans_equal_means_of_floats(finer):
    """Pixels that cut squares alike are counted in integers, with results equal to the bit."""
    random = np.random.default_rng(1)
    grid = Grid(tile_grid(MERCATOR, 0).crs, 0.5, -0.5, 1.0)
    view = MapView(grid, 16.0, 24.0, 1.0, 1.0, 9, 7)
    nodes = covered_nodes(view, finer(grid))
    lit, valid = (random.random((nodes.rows, nodes.cols)) < share for share in (0.5, 0.7))
    valid[:9, :9] = False
    integer_means = means_in_pixels(view, nodes, lit, valid)
    assert np.isnan(integer_means).any() and np.isfinite(integer_means).any()
    assert np.array_equal(integer_means, means_in_pixels(view, nodes, lit.astype(np.float32), valid), equal_nan=True)
