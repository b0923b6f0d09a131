"""Rasters of one row or one column have shadows on their own cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from affine import Affine

import skugga
from skugga.terrain.gbuffer.bare_ground import bare_ground
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.geo.grid import Grid, MapView
from tests.rasters import ENGINEERING

ALGORITHMS = [None, "sweep", "shadow_map", "shadow_volume", "hybrid", "truth"]
"""``None``: the algorithm that the engine chooses."""

SIDE_CELLS, SPIKE, SPIKE_M, CELL_M = 60, 20, 10.0, 1.0
ALTITUDE = 44.0
"""The spike's shadow is 10 m / tan(44°) = 10.36 m long: it reaches the centres of 10 cells."""

SHADOW = slice(SPIKE + 1, SPIKE + 11)

COSINE_ON_PLAIN = np.sin(np.radians(ALTITUDE))


def spike_heights(is_column: bool) -> np.ndarray:
    """Return a plain with one high cell, as one row or one column."""
    heights = np.zeros((1, SIDE_CELLS), np.float32)
    heights[0, SPIKE] = SPIKE_M
    return heights.T.copy() if is_column else heights


def sun_behind_spike(is_column: bool) -> dict[str, float]:
    """Return a sun that shines along the strip, from its first cell to its last one."""
    return {"azimuth": 0.0 if is_column else 270.0, "altitude": ALTITUDE}


def write_strip(write_raster, heights: np.ndarray) -> Path:
    """Write heights (rows, cols) as a raster in a flat world and return its path."""
    return write_raster(heights, ENGINEERING, 0.0, CELL_M * heights.shape[0], CELL_M)


@pytest.mark.parametrize("is_column", [False, True], ids=["row", "column"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_spike_shades_ten_cells_of_its_strip(gl, write_raster, is_column, algorithm):
    """All other cells are lit. No cell is without a surface."""
    options = {} if algorithm is None else {"algorithm": algorithm}
    with skugga.open_level(str(write_strip(write_raster, spike_heights(is_column)))) as level:
        mask = level.shade("mask", **sun_behind_spike(is_column), **options)
        visibility = level.compute("visibility", **sun_behind_spike(is_column), **options)
    expected = np.full(SIDE_CELLS, 255, np.uint8)
    expected[SHADOW] = 0
    np.testing.assert_array_equal(mask.ravel(), expected)
    np.testing.assert_array_equal(visibility.ravel(), expected / 255.0)


@pytest.mark.parametrize("is_column", [False, True], ids=["row", "column"])
def test_arrays_of_one_row_or_column_have_shadows(is_column):
    sun = sun_behind_spike(is_column)
    in_shadow = skugga.shadow(spike_heights(is_column), CELL_M, sun["azimuth"], sun["altitude"])
    sunlit = skugga.sunlit(spike_heights(is_column), CELL_M, sun["azimuth"], sun["altitude"])
    np.testing.assert_array_equal(np.flatnonzero(in_shadow), np.arange(SHADOW.start, SHADOW.stop))
    np.testing.assert_array_equal(sunlit, ~in_shadow)


@pytest.mark.parametrize("is_column", [False, True], ids=["row", "column"])
def test_strips_from_memory_have_light_and_colour(gl, is_column):
    heights, sun = spike_heights(is_column), sun_behind_spike(is_column)
    transform = Affine(CELL_M, 0.0, 500e3, 0.0, -CELL_M, 5200e3)
    with skugga.open_heights(heights, transform, "EPSG:32633") as level:
        cosine = level.compute("cosi", **sun).ravel()
        color = level.shade("color", **sun).reshape(SIDE_CELLS, 4)
        hours = level.sun_hours("2024-06-21", step_min=60.0)  # each sun is drawn: a strip has no triangles
    assert cosine[: SPIKE - 1] == pytest.approx(COSINE_ON_PLAIN, abs=0.02)  # grid north is not true north
    assert np.isfinite(cosine).all() and np.isfinite(hours).all()
    assert (color[:, 3] == 255).all()
    assert color[SHADOW, :3].astype(int).max() < color[: SPIKE - 1, :3].min()


@pytest.mark.parametrize("shape", [(1, 60), (60, 1), (3, 60)], ids=["row", "column", "ordinary"])
def test_flat_tops_have_the_cosine_of_level_ground(write_raster, tmp_path, shape):
    """``surface: blocks`` has no slopes, also beside a spike. Cells without a height have no surface."""
    heights = np.zeros(shape, np.float32)
    heights.flat[SPIKE], heights.flat[40:50] = SPIKE_M, np.nan
    raster = write_raster(heights, ENGINEERING, 0.0, CELL_M * shape[0], CELL_M, nodata=np.nan)
    level_file = tmp_path / "blocks.yaml"
    level_file.write_text(f"version: 1\nterrain: {{source: {raster}, surface: blocks}}\n")
    with skugga.open_level(level_file) as level:
        cosine = level.compute("cosi", azimuth=250.0, altitude=ALTITUDE)
    np.testing.assert_array_equal(np.isnan(cosine), np.isnan(heights))
    assert cosine[~np.isnan(heights)] == pytest.approx(COSINE_ON_PLAIN, abs=1e-6)


@pytest.mark.parametrize("algorithm", ["sweep", "shadow_map", "shadow_volume"])
def test_a_strip_has_the_shadows_of_its_extended_rows(gl, write_raster, algorithm):
    """A raster of three equal rows has the strip's heights, and continues them beyond its border. Both have one map size."""
    strip = np.random.default_rng(4).normal(size=(1, 200)).cumsum(axis=1).astype(np.float32)
    settings = {"map_size": 2048} if algorithm == "shadow_map" else {}
    masks = []
    for heights in (strip, np.repeat(strip, 3, axis=0)):
        with skugga.open_level(str(write_strip(write_raster, heights))) as level:
            masks.append(level.shade("mask", azimuth=270.0, altitude=25.0, algorithm=algorithm, **settings))
    assert 0.05 < (masks[0] == 0).mean() < 0.95
    np.testing.assert_array_equal(masks[0][0], masks[1][1])


def test_a_strip_has_holes_and_a_single_cell_is_lit(gl, write_raster):
    heights = np.zeros((1, 40), np.float32)
    heights[0, 10:30] = np.nan
    masks = []
    for values in (heights, np.full((1, 1), 5.0, np.float32)):
        with skugga.open_level(str(write_raster(values, ENGINEERING, 0.0, 1.0, CELL_M, nodata=np.nan))) as level:
            masks.append(level.shade("mask", azimuth=270.0, altitude=30.0))
    np.testing.assert_array_equal(masks[0][0], np.where(np.isnan(heights[0]), 128, 255))
    np.testing.assert_array_equal(masks[1], [[255]])


@pytest.mark.parametrize("is_column", [False, True], ids=["row", "column"])
def test_points_of_isolated_nodes_lie_on_the_rim_s_triangles(write_raster, make_scene, is_column):
    """They are the points and normals of the middle line of three equal lines. Nodes beside the strip show nothing."""
    strip = np.random.default_rng(1).normal(size=(1, 12)).astype(np.float32)
    buffers = []
    for lines in (1, 3):
        heights = np.repeat(strip, lines, axis=0)
        heights = heights.T.copy() if is_column else heights
        scene = make_scene(write_strip(write_raster, heights))
        grid = Grid(scene.map_crs, CELL_M / 2, CELL_M * (heights.shape[0] - 0.5), CELL_M)
        middle = (lines - 1) // 2
        first_row, first_col = (0, middle - 1) if is_column else (middle - 1, 0)
        shape = (12, 3) if is_column else (3, 12)
        view = MapView(grid, float(first_row), float(first_col), 1.0, 1.0, *shape)
        buffers.append(map_geometry(scene.surface(grid), view, scene.world.frame_near(grid.crs, *view.centre)))
        assert (bare_ground(scene, view, None) is None) == (lines == 1)
    line = (slice(None), 1) if is_column else (1, slice(None))
    on_strip = np.zeros(buffers[0].valid.shape, bool)
    on_strip[line] = True
    np.testing.assert_array_equal(buffers[0].valid, on_strip)
    for name in ("height_m", "normal_frame", "shading_normal_frame", "crease"):
        actual, expected = (getattr(buffer, name)[line] for buffer in buffers)
        np.testing.assert_allclose(actual, expected, atol=1e-6, err_msg=name)
    np.testing.assert_array_equal(buffers[0].height_m[line], strip[0])


def test_pixels_between_nodes_show_no_ground_beside_a_strip(write_raster, make_scene):
    """Off the nodes, visible ground ends at the outermost nodes, and a strip has no width between these."""
    scene = make_scene(write_strip(write_raster, np.zeros((1, 12), np.float32)))
    view = MapView(Grid(scene.map_crs, CELL_M / 2, CELL_M / 2, CELL_M), -0.4, 0.0, 0.8, 1.0, 2, 12)
    assert not map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre)).valid.any()
