"""Heights of a grid's nodes: kept in tiles, refined, and along an axis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from skugga.terrain.geo.grid import Grid
from skugga.terrain.ground.height_tiles import RIM_NODES, TILE_NODES, _tile_ranges
from skugga.terrain.ground.surface import HeightWindow, RefinedWindow


@given(st.integers(-3000, 3000), st.integers(1, 2500))
def test_tiles_give_every_node_once(first, count):
    given_nodes: list[int] = []
    for tile, start, stop in _tile_ranges(first, count):
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
    assert [tile for tile, _, _ in _tile_ranges(-RIM_NODES, 2 * TILE_NODES + 2 * RIM_NODES)] == [0, 1]


@pytest.mark.parametrize("window", [(-40, -90, 70, 200), (500, -530, 30, 60), (-520, 505, 20, 20), (900, 900, 10, 10)])
def test_windows_of_tiles_are_those_read_at_once(scene, window):
    surface = scene.surface(grid_over(scene, 20.0))
    height, valid = surface.heights(*window)
    for _ in range(2):  # read, then kept
        kept = surface.height_window(*window)
        assert np.array_equal(kept.height_m, height, equal_nan=True)
        assert np.array_equal(kept.valid, valid & np.isfinite(height))


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
    plain = HeightWindow(row0, col0, window.height_m, window.valid)
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
    assert np.array_equal(window.valid, np.isfinite(window.height_m))
    part = RefinedWindow(1, 3, (3, 2), HeightWindow(0, 1, coarse[:, 1:], np.isfinite(coarse[:, 1:])))
    assert np.array_equal(part.height_m, np.array(expected, np.float32)[1:4, 3:5], equal_nan=True)
