"""Raster cells that a map shows: all cells of its pixels, few others, and the whole raster for a block of tiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import BLOCK_PX, map_view
from skugga.terrain.geo.world import LONGITUDE_LATITUDE
from skugga.terrain.ground.visible_cells import block_slices, full_cell_range, is_block, visible_cells


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Scene of heights that differ in every cell, in degrees of longitude and latitude."""
    from skugga.terrain.level.level import load_level
    from skugga.terrain.scene import build_scene
    from tests.rasters import write_geotiff

    folder = tmp_path_factory.mktemp("shown")
    y, x = np.mgrid[0:50, 0:80]
    write_geotiff(folder / "dem.tif", (x + 100.0 * y).astype(np.float32), "EPSG:4326", 12.0, 61.0, (0.002, 0.001))
    (folder / "level.yaml").write_text('{"version": 1, "terrain": {"source": "dem.tif"}}', encoding="utf-8")
    return build_scene(load_level(folder / "level.yaml"))


@given(
    st.floats(12.0, 12.16), st.floats(60.95, 61.0), st.floats(0.001, 0.2), st.sampled_from(["EPSG:32633", "EPSG:4326", "EPSG:3857"])
)
def test_visible_cells_contain_all_cells_of_the_pixels(scene, lon: float, lat: float, side: float, crs: str):
    from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer

    x, y = transformer(LONGITUDE_LATITUDE, scene._parse_crs(crs)).transform(
        [lon - side, lon + side], [lat - side / 2, lat + side / 2]
    )
    view = scene.view(bounds=(x[0], y[0], x[1], y[1]), crs=crs, size=(24, 24))
    cells = visible_cells(scene.elevation, view)
    buffer = geometry_buffer(scene, view)
    if cells is None:
        assert not buffer.valid.any()
        return
    # Heights encode the cell: 100 per row and 1 per column. Coarser pixels are means.
    (first, last), (left, right) = cells
    height = buffer.height_m[buffer.valid]
    assert ((height >= 100.0 * first + left - 101.0) & (height <= 100.0 * last + right + 101.0)).all()
    rows, cols = block_slices(cells, 8, (7, 10))
    assert 0 <= rows.start < rows.stop <= 7 and 0 <= cols.start < cols.stop <= 10


def test_small_window_shows_few_cells(scene):
    view = scene.view(bounds=(12.08, 60.97, 12.084, 60.972), crs="EPSG:4326", size=(32, 32))
    (first, last), (left, right) = visible_cells(scene.elevation, view)
    assert last - first < 6.0 and right - left < 6.0
    assert first < 28.0 < last and left < 41.0 < right


def test_window_beside_the_raster_shows_no_cells(scene):
    assert (
        visible_cells(scene.elevation, map_view(scene.world, LONGITUDE_LATITUDE, (13.0, 60.0, 13.1, 60.1), rows=32, cols=32))
        is None
    )


def test_block_of_tiles_shows_the_whole_raster(scene):
    small_view = scene.view(bounds=(12.08, 60.97, 12.084, 60.972), crs="EPSG:4326", size=(32, 32))
    block = replace(small_view, row0=float(-BLOCK_PX), col0=0.0, row_step=1.0, col_step=1.0, rows=BLOCK_PX, cols=BLOCK_PX)
    assert is_block(block) and not is_block(small_view)
    assert visible_cells(scene.elevation, block) == full_cell_range(scene.elevation)
    assert not is_block(replace(block, col0=256.0)) and not is_block(replace(block, rows=256))
