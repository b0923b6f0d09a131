"""Heights of grid nodes: cached in tiles, refined, and projected on an axis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from scipy.ndimage import binary_dilation

from skugga.terrain.geo.grid import Grid
from skugga.terrain.ground.columns import Columns
from skugga.terrain.ground.height_tiles import TILE_MARGIN_NODES, TILE_NODES, _tile_ranges
from skugga.terrain.ground.surface import HeightWindow, RefinedWindow
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING, write_geotiff


@given(st.integers(-3000, 3000), st.integers(1, 2500))
def test_tile_ranges_contain_every_node_once(first, count):
    given_nodes: list[int] = []
    for tile, start, stop in _tile_ranges(first, count):
        assert tile * TILE_NODES - TILE_MARGIN_NODES <= start < stop <= (tile + 1) * TILE_NODES + TILE_MARGIN_NODES
        given_nodes += range(start, stop)
    assert given_nodes == list(range(first, first + count))


@pytest.fixture
def scene(write_raster, make_scene):
    """Scene of hills with a hole."""
    row, col = np.mgrid[:300, :300]
    heights = (600.0 + 200.0 * np.sin(row / 9.0) * np.cos(col / 11.0)).astype(np.float32)
    heights[100:140, 200:230] = np.nan
    return make_scene(write_raster(heights, "EPSG:32633", 420_000.0, 5_200_000.0, 30.0, nodata=np.nan))


def mercator_grid(scene, step: float) -> Grid:
    """Return a Mercator grid with node (0, 0) at the centre of the level."""
    crs = CRS.from_epsg(3857)
    x, y, _ = scene.world.map_position(crs, scene.world.anchor_earth_m)
    return Grid(crs, float(x), float(y), step)


def test_block_and_its_rim_need_only_its_own_tiles():
    assert [tile for tile, _, _ in _tile_ranges(-TILE_MARGIN_NODES, 2 * TILE_NODES + 2 * TILE_MARGIN_NODES)] == [0, 1]


@pytest.mark.parametrize("window", [(-40, -90, 70, 200), (500, -530, 30, 60), (-520, 505, 20, 20), (900, 900, 10, 10)])
def test_height_window_equals_heights_read_at_once(scene, window):
    surface = scene.surface(mercator_grid(scene, 20.0))
    height, valid = surface.heights(*window)
    for _ in range(2):  # read, then cached
        height_window = surface.height_window(*window)
        assert np.array_equal(height_window.height_m, height, equal_nan=True)
        assert np.array_equal(height_window.valid, valid & np.isfinite(height))


def test_cached_heights_are_not_read_again(scene, monkeypatch):
    surface = scene.surface(mercator_grid(scene, 20.0))
    first = surface.height_window(-40, -90, 70, 200)
    monkeypatch.setattr(type(surface), "heights", None)
    assert np.array_equal(scene.surface(mercator_grid(scene, 20.0)).height_window(-40, -90, 70, 200).height_m, first.height_m)


@pytest.mark.parametrize("row0", [-741, -740])
@pytest.mark.parametrize("col0", [-33, 10])
@pytest.mark.parametrize("turn", [(1, 1, False), (-1, 1, False), (1, -1, False), (1, 1, True), (-1, -1, True)])
def test_along_equals_the_coordinates_of_the_points(scene, row0, col0, turn):
    """Compare with points in a frame, for any orientation of the array, and for heights refined on the fly or in advance."""
    down, right, swapped = turn
    surface, frame = scene.surface(mercator_grid(scene, 20.0).refined()), scene.world.frame_near_earth(scene.world.anchor_earth_m)
    rows, cols = 150, 190
    window = surface.height_window(row0, col0, rows, cols)
    assert isinstance(window, RefinedWindow)
    refined_window = HeightWindow(row0, col0, window.height_m, window.valid)
    axis, origin = np.array([0.48, 0.6, 0.64]), scene.world.anchor_earth_m + 5.0
    arrays = []
    for grid_window in (window, refined_window):
        memory = np.full((cols, rows) if swapped else (rows, cols), np.nan, np.float32)
        array = (memory.T if swapped else memory)[::down, ::right]
        surface.write_axis_coordinates(axis, origin, [grid_window], [array])
        arrays.append(array)
    assert np.array_equal(*arrays, equal_nan=True)
    exact = (frame.points_to_earth(surface.window_positions(row0, col0, window.height_m, frame)) - origin) @ axis
    assert np.isnan(arrays[0]).any() and np.array_equal(np.isnan(arrays[0]), np.isnan(exact))
    assert np.nanmax(np.abs(arrays[0] - exact)) < 2e-3  # float32 at distances of kilometres


def test_refined_heights_are_midpoints_of_higher_diagonals():
    coarse_heights = np.array([[0.0, 4.0, 6.0], [2.0, 8.0, np.nan], [1.0, 1.0, 1.0]], np.float32)
    window = RefinedWindow(0, 0, (5, 5), HeightWindow(0, 0, coarse_heights, np.isfinite(coarse_heights)))
    nan = np.nan
    expected = [
        [0.0, 2.0, 4.0, 5.0, 6.0],
        [1.0, 4.0, 6.0, 7.0, nan],  # 4 from 0 and 8, not 3 from 4 and 2; 7 from 8 and 6, because the other diagonal lacks a corner
        [2.0, 5.0, 8.0, nan, nan],
        [1.5, 4.5, 4.5, 4.5, nan],
        [1.0, 1.0, 1.0, 1.0, 1.0],
    ]
    assert np.array_equal(window.height_m, np.array(expected, np.float32), equal_nan=True)
    assert np.array_equal(window.valid, np.isfinite(window.height_m))
    part = RefinedWindow(1, 3, (3, 2), HeightWindow(0, 1, coarse_heights[:, 1:], np.isfinite(coarse_heights[:, 1:])))
    assert np.array_equal(part.height_m, np.array(expected, np.float32)[1:4, 3:5], equal_nan=True)


# -- the rim


@pytest.mark.parametrize(("a", "b"), [(17_000.0, 5_500.0), (2_500.0, 2_500.0)])
def test_positions_on_small_bodies_are_exact(make_scene, tmp_path, a, b):
    """Interpolated nodes lie within millimetres of geocentric coordinates by PROJ."""
    crs = CRS.from_user_input(f"+proj=longlat +a={a} +b={b} +type=crs")
    cell_deg = np.degrees(10.0 / a)
    raster = write_geotiff(tmp_path / "body.tif", np.zeros((130, 130), np.float32), crs.to_wkt(), 12.0, 21.3, cell_deg)
    scene = make_scene(raster)
    grid = Grid(scene.elevation.crs, 12.0 + cell_deg / 2, 21.3 - cell_deg / 2, cell_deg)
    frame = scene.world.frame_near(grid.crs, 12.0, 21.3)
    position = frame.points_to_earth(scene.surface(grid).window(0, 0, 130, 130, frame).position_frame_m)
    row, col = np.mgrid[:130, :130]
    to_earth = Transformer.from_pipeline(f"+proj=cart +a={a} +b={b}")
    expected = np.stack(to_earth.transform(grid.x(col), grid.y(row), np.zeros(row.shape), radians=False), axis=-1)
    np.testing.assert_allclose(position, expected, rtol=0.0, atol=3e-3)


def test_rim_extends_the_raster_by_one_node(write_raster, make_scene):
    """On the raster's own nodes, the rim is a ring of its outermost heights, which are not valid."""
    heights = np.arange(20, dtype=np.float32).reshape(4, 5) ** 2
    scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 40.0, 10.0))
    surface = scene.surface(Grid(scene.map_crs, 5.0, 35.0, 10.0))
    window = surface.height_window(-3, -3, 10, 11, includes_rim=True)
    height, valid = window.height_m, window.valid
    np.testing.assert_array_equal(height[2:-2, 2:-2], np.pad(heights, 1, mode="edge"))
    np.testing.assert_array_equal(valid, np.pad(np.ones((4, 5), bool), 3))
    assert np.isnan(height[[0, 1, -2, -1]]).all() and np.isnan(height[:, [0, 1, -2, -1]]).all()


@pytest.mark.parametrize("finer", [0, 1])
def test_rim_casts_but_is_not_shown(write_raster, make_scene, finer):
    """Heights and cuts of quads are equal with and without the rim, on the raster's own nodes and on finer nodes."""
    heights = np.random.default_rng(2).normal(size=(4, 5)).astype(np.float32)
    heights[:2, 3:] = np.nan
    scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 40.0, 10.0))
    surface = scene.surface(Grid(scene.map_crs, 5.0, 35.0, 10.0).finer(finer))
    extent = -6, -6, 20, 21
    visible_window, casting_window = surface.height_window(*extent), surface.height_window(*extent, includes_rim=True)
    np.testing.assert_array_equal(visible_window.valid, casting_window.valid)
    is_valid = np.isfinite(visible_window.height_m)
    assert (np.isfinite(casting_window.height_m) & ~is_valid).any()
    for height, valid in ((visible_window.height_m, visible_window.valid), surface.heights(*extent)):
        np.testing.assert_array_equal(np.isfinite(height), is_valid)
        np.testing.assert_array_equal(valid, visible_window.valid)
    window = surface.window(*extent, scene.world.frame_near(scene.map_crs, 0.0, 0.0))
    for actual, expected in (
        (window.height_m, visible_window.height_m),
        (window.with_rim.height_m[is_valid], window.height_m[is_valid]),
    ):
        np.testing.assert_array_equal(actual, expected)
    assert np.isfinite(window.with_rim.position_frame_m[..., 2]).sum() == np.isfinite(casting_window.height_m).sum()
    complete = np.isfinite(window.sheet.normals_frame[..., 0])
    np.testing.assert_array_equal(window.with_rim.sheet.normals_frame[complete], window.sheet.normals_frame[complete])


@given(st.floats(-0.49, 0.49), st.floats(-0.49, 0.49), st.sampled_from([0.4, 1.0, 1.4, 3.0]))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_rim_nodes_are_neighbours_of_valid_nodes(cell_scene, row, col, step):
    """For any offset of nodes from cells, the heights are those of valid nodes and of their eight neighbours."""
    scene = cell_scene
    surface = scene.surface(Grid(scene.map_crs, 10.0 * col + 5.0, 395.0 - 10.0 * row, 10.0 * step))
    window = surface.height_window(-5, -5, 120, 120, includes_rim=True)
    height, valid = window.height_m, window.valid
    assert valid.any() and not valid[[0, 1, -2, -1]].any()
    np.testing.assert_array_equal(np.isfinite(height), binary_dilation(valid, np.ones((3, 3), bool)))


@pytest.fixture(scope="module")
def cell_scene(tmp_path_factory):
    """Scene of random heights in a flat world."""
    folder = tmp_path_factory.mktemp("cells")
    heights = np.random.default_rng(1).normal(size=(40, 40)).astype(np.float32)
    raster = write_geotiff(folder / "dem.tif", heights, ENGINEERING, 0.0, 400.0, 10.0)
    (folder / "level.yaml").write_text(f"version: 1\nterrain: {{source: {raster}}}\nsun: {{azimuth: 180, altitude: 30}}\n")
    return build_scene(load_level(folder / "level.yaml"))


def test_rim_does_not_depend_on_the_window(scene):
    """This includes windows that contain only rim nodes."""
    surface = scene.surface(mercator_grid(scene, 20.0))
    height, valid, _ = surface._heights_and_rim(-300, -400, 600, 800)
    rim = np.argwhere(np.isfinite(height) & ~valid)
    assert len(rim) > 500
    for row, col in rim[:: len(rim) // 20]:
        single_node, _, _ = surface._heights_and_rim(int(row) - 300, int(col) - 400, 1, 1)
        assert single_node[0, 0] == height[row, col]


def test_rim_does_not_extend_beyond_a_pole(write_raster, make_scene):
    heights = np.zeros((18, 36), np.float32)
    scene = make_scene(write_raster(heights, "EPSG:4326", -180.0, 90.0, 10.0))
    window = scene.surface(Grid(CRS.from_epsg(4326), -175.0, 85.0, 10.0)).height_window(-2, 0, 22, 36, includes_rim=True)
    height, valid = window.height_m, window.valid
    assert valid[2:-2].all() and np.isnan(height[:2]).all() and np.isnan(height[-2:]).all()


def test_columns_have_no_rim(write_raster, make_scene):
    scene = make_scene(write_raster(np.ones((4, 5), np.float32), ENGINEERING, 0.0, 40.0, 10.0), terrain={"surface": "blocks"})
    height, _ = Columns(scene.world, scene.elevation, 0).heights(-2, -2, 8, 9)
    np.testing.assert_array_equal(np.isfinite(height), np.pad(np.ones((4, 5), bool), 2))


@pytest.mark.parametrize("lod", [0, 2])
@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326"])
def test_nodes_beside_the_raster_are_found_without_a_look_at_each(write_raster, make_scene, monkeypatch, crs, lod):
    cell, origin = (30.0, (500e3, 5200e3)) if crs == "EPSG:32633" else (1 / 3600, (15.0, 47.0))
    scene = make_scene(write_raster(np.ones((40, 50), np.float32), crs, *origin, cell))
    surface = scene.surface(scene.view(size=(8, 8)).grid.coarser(lod))
    windows = [(row, col, 16, 16) for row in range(-420, 480, 60) for col in range(-420, 480, 60)]
    found = [surface._heights_and_rim(*window) for window in windows]
    skipped = [
        surface.elevation.is_beyond_cells(surface.lod, *surface.cells_at(*surface.exact_nodes(*window, surface.stride)[2:]))
        for window in windows
    ]
    assert 0 < sum(skipped) < len(windows)
    monkeypatch.setattr(type(surface.elevation), "is_beyond_cells", lambda *_: False)
    for window, (height, valid, rim) in zip(windows, found, strict=True):
        looked_at = surface._heights_and_rim(*window)
        np.testing.assert_array_equal(height, looked_at[0])
        np.testing.assert_array_equal(valid, looked_at[1])
        assert (rim is None) == (looked_at[2] is None)
