"""Heights of a grid's nodes: kept in tiles, refined, and along an axis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyproj import CRS
from scipy.ndimage import binary_dilation

from skugga.terrain.geo.grid import Grid
from skugga.terrain.ground.columns import Columns
from skugga.terrain.ground.height_tiles import RIM_NODES, TILE_NODES, _cuts
from skugga.terrain.ground.surface import HeightWindow, RefinedWindow
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING, write_geotiff


@given(st.integers(-3000, 3000), st.integers(1, 2500))
def test_tiles_give_every_node_once(first, count):
    given_nodes: list[int] = []
    for tile, start, stop in _cuts(first, count):
        assert tile * TILE_NODES - RIM_NODES <= start < stop <= (tile + 1) * TILE_NODES + RIM_NODES
        given_nodes += range(start, stop)
    assert given_nodes == list(range(first, first + count))


@pytest.fixture
def scene(write_raster, make_scene):
    row, col = np.mgrid[:300, :300]
    heights = (600.0 + 200.0 * np.sin(row / 9.0) * np.cos(col / 11.0)).astype(np.float32)
    heights[100:140, 200:230] = np.nan
    return make_scene(write_raster(heights, "EPSG:32633", 420_000.0, 5_200_000.0, 30.0, nodata=np.nan))


def grid_over(scene, step: float) -> Grid:
    """A Mercator grid with its node (0, 0) at the level's middle."""
    crs = CRS.from_epsg(3857)
    x, y, _ = scene.world.map_position(crs, scene.world.anchor_earth_m)
    return Grid(crs, float(x), float(y), step)


def test_a_block_and_the_nodes_round_it_take_its_own_tiles():
    assert [tile for tile, _, _ in _cuts(-RIM_NODES, 2 * TILE_NODES + 2 * RIM_NODES)] == [0, 1]


@pytest.mark.parametrize("window", [(-40, -90, 70, 200), (500, -530, 30, 60), (-520, 505, 20, 20), (900, 900, 10, 10)])
def test_windows_of_tiles_are_those_read_at_once(scene, window):
    surface = scene.surface(grid_over(scene, 20.0))
    height, there = surface.heights(*window)
    for _ in range(2):  # read, then kept
        kept = surface.height_window(*window)
        assert np.array_equal(kept.height_m, height, equal_nan=True)
        assert np.array_equal(kept.there, there & np.isfinite(height))


def test_kept_heights_are_not_read_again(scene, monkeypatch):
    surface = scene.surface(grid_over(scene, 20.0))
    first = surface.height_window(-40, -90, 70, 200)
    monkeypatch.setattr(type(surface), "heights", None)
    assert np.array_equal(scene.surface(grid_over(scene, 20.0)).height_window(-40, -90, 70, 200).height_m, first.height_m)


@pytest.mark.parametrize("row0", [-741, -740])
@pytest.mark.parametrize("col0", [-33, 10])
@pytest.mark.parametrize("turn", [(1, 1, False), (-1, 1, False), (1, -1, False), (1, 1, True), (-1, -1, True)])
def test_coordinates_along_an_axis_are_those_of_the_nodes_points(scene, row0, col0, turn):
    """Against points in a frame, whichever way the array lies; and refined on the way as refined before."""
    down, right, swapped = turn
    surface, frame = scene.surface(grid_over(scene, 20.0).refined()), scene.world.frame_near_earth(scene.world.anchor_earth_m)
    rows, cols = 150, 190
    window = surface.height_window(row0, col0, rows, cols)
    assert isinstance(window, RefinedWindow)
    plain = HeightWindow(row0, col0, window.height_m, window.there)
    axis, origin = np.array([0.48, 0.6, 0.64]), scene.world.anchor_earth_m + 5.0
    filled = []
    for each in (window, plain):
        memory = np.full((cols, rows) if swapped else (rows, cols), np.nan, np.float32)
        array = (memory.T if swapped else memory)[::down, ::right]
        surface.along(axis, origin, [each], [array])
        filled.append(array)
    assert np.array_equal(*filled, equal_nan=True)
    exact = (frame.points_to_earth(surface.points(row0, col0, window.height_m, frame)) - origin) @ axis
    assert np.isnan(filled[0]).any() and np.array_equal(np.isnan(filled[0]), np.isnan(exact))
    assert np.nanmax(np.abs(filled[0] - exact)) < 2e-3  # float32 of kilometres


def test_refined_heights_are_middles_along_the_higher_diagonals():
    coarse = np.array([[0.0, 4.0, 6.0], [2.0, 8.0, np.nan], [1.0, 1.0, 1.0]], np.float32)
    window = RefinedWindow(0, 0, (5, 5), HeightWindow(0, 0, coarse, np.isfinite(coarse)))
    nan = np.nan
    expected = [
        [0.0, 2.0, 4.0, 5.0, 6.0],
        [1.0, 4.0, 6.0, 7.0, nan],  # 4 of 0 and 8, not 3 of 4 and 2; 7 of 8 and 6: the other diagonal has no corner
        [2.0, 5.0, 8.0, nan, nan],
        [1.5, 4.5, 4.5, 4.5, nan],
        [1.0, 1.0, 1.0, 1.0, 1.0],
    ]
    assert np.array_equal(window.height_m, np.array(expected, np.float32), equal_nan=True)
    assert np.array_equal(window.there, np.isfinite(window.height_m))
    part = RefinedWindow(1, 3, (3, 2), HeightWindow(0, 1, coarse[:, 1:], np.isfinite(coarse[:, 1:])))
    assert np.array_equal(part.height_m, np.array(expected, np.float32)[1:4, 3:5], equal_nan=True)


# -- the rim


def test_ground_goes_on_for_a_node_beyond_its_raster(write_raster, make_scene):
    """On the raster's own nodes that is a ring of its outermost heights, which shows nothing."""
    heights = np.arange(20, dtype=np.float32).reshape(4, 5) ** 2
    scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 40.0, 10.0))
    surface = scene.surface(Grid(scene.map_crs, 5.0, 35.0, 10.0))
    height, there = surface.heights(-3, -3, 10, 11)
    np.testing.assert_array_equal(height[2:-2, 2:-2], np.pad(heights, 1, mode="edge"))
    np.testing.assert_array_equal(there, np.pad(np.ones((4, 5), bool), 3))
    assert np.isnan(height[[0, 1, -2, -1]]).all() and np.isnan(height[:, [0, 1, -2, -1]]).all()


@given(st.floats(-0.49, 0.49), st.floats(-0.49, 0.49), st.sampled_from([0.4, 1.0, 1.4, 3.0]))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_node_beyond_belongs_to_one_on_the_raster(scene_of_cells, row, col, step):
    """Wherever nodes lie on the cells: those that show ground, and each of the eight round them."""
    scene = scene_of_cells
    surface = scene.surface(Grid(scene.map_crs, 10.0 * col + 5.0, 395.0 - 10.0 * row, 10.0 * step))
    height, there = surface.heights(-5, -5, 120, 120)
    assert there.any() and not there[[0, 1, -2, -1]].any()
    np.testing.assert_array_equal(np.isfinite(height), binary_dilation(there, np.ones((3, 3), bool)))


@pytest.fixture(scope="module")
def scene_of_cells(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cells")
    heights = np.random.default_rng(1).normal(size=(40, 40)).astype(np.float32)
    raster = write_geotiff(folder / "dem.tif", heights, ENGINEERING, 0.0, 400.0, 10.0)
    (folder / "level.yaml").write_text(f"version: 1\nterrain: {{source: {raster}}}\nsun: {{azimuth: 180, altitude: 30}}\n")
    return build_scene(load_level(folder / "level.yaml"))


def test_windows_say_the_same_of_the_rim(scene):
    """Also one that holds no node on the raster, only of those beyond."""
    surface = scene.surface(grid_over(scene, 20.0))
    height, there = surface.heights(-300, -400, 600, 800)
    rim = np.argwhere(np.isfinite(height) & ~there)
    assert len(rim) > 500
    for row, col in rim[:: len(rim) // 20]:
        single, _ = surface.heights(int(row) - 300, int(col) - 400, 1, 1)
        assert single[0, 0] == height[row, col]


def test_no_ground_goes_on_beyond_a_pole(write_raster, make_scene):
    heights = np.zeros((18, 36), np.float32)
    scene = make_scene(write_raster(heights, "EPSG:4326", -180.0, 90.0, 10.0))
    height, there = scene.surface(Grid(CRS.from_epsg(4326), -175.0, 85.0, 10.0)).heights(-2, 0, 22, 36)
    assert there[2:-2].all() and np.isnan(height[:2]).all() and np.isnan(height[-2:]).all()


def test_columns_end_with_their_cells(write_raster, make_scene):
    scene = make_scene(write_raster(np.ones((4, 5), np.float32), ENGINEERING, 0.0, 40.0, 10.0), terrain={"surface": "blocks"})
    height, _ = Columns(scene.world, scene.elevation, 0).heights(-2, -2, 8, 9)
    np.testing.assert_array_equal(np.isfinite(height), np.pad(np.ones((4, 5), bool), 2))
