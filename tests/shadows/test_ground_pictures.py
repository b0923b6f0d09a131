"""Maps of bare ground without a geometry buffer: they equal the results of ``render_frame``."""

from __future__ import annotations

import numpy as np
import pytest
from morecantile import tms as matrix_sets

from skugga.selector.film import COLOR_NEEDS
from skugga.shadows import ground_pictures
from skugga.shadows.draw import SHADING_NEEDS, can_draw_from_heights, draw
from skugga.shadows.render import render_frame
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import BLOCK_PX, MapView, tile_grid
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.params import mark_long_except
from tests.products import draw_by_heights, draw_map
from tests.render import plan_of

MAX_DIFFERING_SHARE = 1e-4
"""Share of the pixels whose colour may differ by a step of 255: shares of the sky are rounded before the multiplication."""

SUNS = ((225.0, 22.0), (180.0, 4.0), (91.0, 2.0), (20.0, 65.0), (300.0, -3.0))
"""Azimuth and altitude: noon, slanted lines, grazing light, a high sun, and night."""

ZOOMS_AND_OFFSETS = mark_long_except(
    [(10, 0, 0), (12, 0, 0), (13, 0, 0), (13, -300, -300), (14, 0, 0), (15, 800, 0)], (12, 0, 0)
)  # fmt: skip
"""Zoom, and offset in pixels from the level's middle: coarse pixels, pixels of the data's size, and magnified ones."""


def view_of(scene: Scene, zoom: int, rows: int = 0, cols: int = 0) -> MapView:
    """Return the block of tiles that holds a level's middle, or the pixel at an offset from it."""
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    row, col = (BLOCK_PX * np.floor(middle_px / BLOCK_PX) for middle_px in ((north + south) / 2 + rows, (west + east) / 2 + cols))
    return MapView(grid, float(row), float(col), 1.0, 1.0, BLOCK_PX, BLOCK_PX)


@pytest.fixture
def hills(write_raster, make_scene):
    """Return rough ground of 200 x 200 cells of 30 m, with a hole in it, under a sun."""

    def make(azimuth: float, altitude: float, **keys) -> Scene:
        row, col = np.mgrid[:200, :200]
        rough = np.random.default_rng(7).normal(0.0, 12.0, (200, 200))
        heights = (700.0 + 350.0 * np.sin(row / 14.0) * np.cos(col / 19.0) + rough).astype(np.float32)
        heights[40:60, 90:140] = np.nan
        heights[55, 100:130] = 600.0
        raster = write_raster(heights, "EPSG:32633", 420_000.0, 5_200_000.0, 30.0, nodata=np.nan)
        return make_scene(raster, azimuth, altitude, **keys)

    return make


@pytest.mark.parametrize(("azimuth", "altitude"), SUNS)
@pytest.mark.parametrize(("zoom", "rows", "cols"), ZOOMS_AND_OFFSETS)
def test_ground_picture_equals_the_frame(gl, hills, azimuth, altitude, zoom, rows, cols):
    scene = hills(azimuth, altitude)
    view = view_of(scene, zoom, rows, cols)
    plan = plan_of(scene, view)
    assert can_draw_from_heights(scene, view, plan, SHADING_NEEDS)
    picture, frame = draw_by_heights(scene, view, plan), render_frame(scene, view, plan)
    assert picture is not None and frame.valid.any() and not frame.valid.all()
    assert np.array_equal(picture.valid, frame.valid)
    if scene.sun_is_up:
        assert np.array_equal(picture.opacity, frame.opacity)
    else:  # by day, coarse pixels without a valid node count as lit; here it is night
        assert (picture.opacity[picture.valid] == 255).all() and (picture.opacity == frame.opacity).mean() > 0.999
    color_difference = np.abs(picture.color.astype(int) - frame.color).max(axis=-1)
    assert color_difference.max() <= 1 and (color_difference > 0).mean() <= MAX_DIFFERING_SHARE
    assert [record.name for record in picture.passes] == plan.passes


@pytest.mark.parametrize(("style", "exaggeration"), [("swiss", 2.5), ("urban", None), ("analysis", None)])
@pytest.mark.parametrize("altitude", [4.0, 22.0])
def test_ground_picture_has_the_colours_of_a_style(gl, hills, style, exaggeration, altitude):
    """The styles exaggerate or limit slopes, add aerial haze, or use Lambert's law alone."""
    scene = hills(225.0, altitude).with_style(style, exaggeration)
    view = view_of(scene, 12)
    plan = plan_of(scene, view)
    picture, frame = draw_by_heights(scene, view, plan), render_frame(scene, view, plan)
    assert picture is not None and can_draw_from_heights(scene, view, plan, SHADING_NEEDS)
    color_difference = np.abs(picture.color.astype(int) - frame.color)
    assert color_difference.max() <= 1 and (color_difference > 0).mean() <= MAX_DIFFERING_SHARE


def test_ground_picture_contains_shadow(gl, hills):
    """The comparisons are not vacuous: opacity ranges from 0 to 255, and heights give many colours."""
    picture = draw_map(scene := hills(225.0, 22.0), view := view_of(scene, 13), plan_of(scene, view))
    assert {0, 255} < set(np.unique(picture.opacity)) and len(np.unique(picture.color.reshape(-1, 3), axis=0)) > 1000


@pytest.mark.parametrize("zoom", [10, 12, 14])
def test_ground_picture_of_gentle_ground_is_lit(gl, write_raster, make_scene, zoom):
    """Nothing casts and nothing faces away. No geometry buffer is needed to know this."""
    heights = np.random.default_rng(7).normal(500.0, 2.0, (120, 120)).astype(np.float32)
    heights[:, :7] = np.nan
    scene = make_scene(write_raster(heights, "EPSG:32633", 420_000.0, 5_200_000.0, 30.0, nodata=np.nan), 160.0, 50.0)
    view = view_of(scene, zoom)
    plan = plan_of(scene, view)
    assert plan.algorithms_text == "none"
    picture, frame = draw_by_heights(scene, view, plan), render_frame(scene, view, plan)
    assert picture is not None and picture.valid.any() and not picture.opacity.any()
    assert np.array_equal(picture.valid, frame.valid) and np.array_equal(picture.opacity, frame.opacity)
    assert np.abs(picture.color.astype(int) - frame.color).max() <= 1
    assert [record.name for record in picture.passes] == plan.passes
    steep = make_scene(scene.elevation.name, 160.0, 1.0, effects={"cast_shadows": "off"})
    assert draw_by_heights(steep, view, plan_of(steep, view)) is None  # this needs the triangles


OTHER_LEVEL_SETTINGS = {
    "clouds": {"weather": {"cloud_cover": 0.5}}, "a resolution": {"terrain": {"resolution": 90.0}},
    "no sky view": {"effects": {"sky_view": "off"}},
}  # fmt: skip


@pytest.mark.parametrize("keys", OTHER_LEVEL_SETTINGS.values(), ids=OTHER_LEVEL_SETTINGS)
def test_ground_picture_with_other_level_settings(gl, hills, keys):
    scene = hills(225.0, 22.0, **keys)
    view = view_of(scene, 12)
    plan = plan_of(scene, view)
    picture, frame = draw_map(scene, view, plan), render_frame(scene, view, plan)
    assert can_draw_from_heights(scene, view, plan, SHADING_NEEDS) != ("weather" in keys)
    assert np.array_equal(picture.opacity, frame.opacity)
    assert np.abs(picture.color.astype(int) - frame.color).max() <= 1


@pytest.mark.parametrize("altitude", [4.0, 22.0, 65.0, -3.0])
@pytest.mark.parametrize("size", [(150, 150), (331, 207), (900, 900)])
def test_ground_picture_between_nodes_equals_the_frame(gl, hills, altitude, size):
    """Pixels are coarse, of about the data's size, or magnified. None lies on a node, and all are equal to the bit."""
    scene = hills(225.0, altitude)
    view = scene.view(size=size)
    assert isinstance(view, MapView) and not view.is_on_nodes
    plan = plan_of(scene, view)
    assert can_draw_from_heights(scene, view, plan, COLOR_NEEDS)
    frame = render_frame(scene, view, plan)
    assert np.array_equal(draw(scene, view, plan, COLOR_NEEDS).color, frame.color) and frame.valid.any() and not frame.valid.all()
    if scene.sun_is_up:
        assert len(np.unique(frame.opacity)) > 2


def test_ground_picture_caches_its_ground_for_all_suns(gl, hills, monkeypatch):
    scene = hills(225.0, 22.0)
    view = scene.view(size=(90, 90))
    buffered_views: list[MapView] = []
    monkeypatch.setattr(
        ground_pictures, "geometry_buffer", lambda *arguments: buffered_views.append(arguments[1]) or geometry_buffer(*arguments)
    )
    for azimuth in (200.0, 220.0, 240.0):
        lit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=20.0))
        draw(lit_scene, view, plan_of(lit_scene, view), COLOR_NEEDS)
    assert len(buffered_views) == 1


def test_ground_picture_off_the_ground_is_empty(gl, hills):
    scene = hills(225.0, 22.0)
    view = view_of(scene, 13, rows=2000)
    picture = draw_map(scene, view, plan_of(scene, view))
    assert not picture.valid.any() and not picture.color.any() and not picture.opacity.any()


def test_ground_picture_of_one_node_wide_ground(gl, write_raster, make_scene):
    """Such ground has no smooth normal. A geometry buffer uses the normal of the adjacent triangles."""
    heights = np.full((64, 64), np.nan, np.float32)
    heights[:, 20] = heights[30, :] = 500.0
    heights[31, 10:50] = 480.0
    scene = make_scene(write_raster(heights, "EPSG:32633", 420_000.0, 5_200_000.0, 30.0, nodata=np.nan), 200.0, 30.0)
    for zoom in (12, 13, 15):
        view = view_of(scene, zoom)
        plan = plan_of(scene, view)
        picture, frame = draw_map(scene, view, plan), render_frame(scene, view, plan)
        assert np.array_equal(picture.valid, frame.valid) and np.array_equal(picture.opacity, frame.opacity)
        assert np.abs(picture.color.astype(int) - frame.color).max() <= 1
