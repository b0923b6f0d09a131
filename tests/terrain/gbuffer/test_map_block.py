"""Cached blocks of maps with meshes and trees: equal to what is computed anew, and the same under every sun."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from pyproj import Transformer

from skugga.api.catalogue import find_level
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.map_block import EDGE_SAMPLES_PER_SIDE, map_block, nodes_of_samples, trim_map_block_cache
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, view_frame
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.render import block_at

VILLAGE_LON_LAT, RASTER_CORNER_LON_LAT = (-84.1577, 36.2270), (-84.4137, 36.4462)
"""Places in the village, and at a corner of the level's raster."""


@pytest.fixture(scope="module")
def wooded() -> Scene:
    """Scene of the bundled level with trees and houses."""
    return build_scene(load_level(find_level("jacksboro_wooded")))


def small_map(lon: float, lat: float, zoom: int) -> MapView:
    """Return 240 x 200 pixels of a web tile matrix whose middle lies near a place."""
    block = block_at(lon, lat, zoom)
    east, north = Transformer.from_crs(4326, block.grid.crs, always_xy=True).transform(lon, lat)
    row, col = int(block.grid.row(north)) - 100, int(block.grid.col(east)) - 120
    return MapView(block.grid, float(row), float(col), 1.0, 1.0, 200, 240)


def assert_same_arrays(first: GeometryBuffer, second: GeometryBuffer, pixels: np.ndarray | None = None) -> None:
    """Assert that two buffers have equal arrays, at the pixels of a mask if one is given."""
    compared = 0
    for item in fields(GeometryBuffer):
        value, other = getattr(first, item.name), getattr(second, item.name)
        if isinstance(value, np.ndarray) and value.shape[:2] == first.valid.shape:
            value, other = (array if pixels is None else array[pixels] for array in (value, other))
            np.testing.assert_array_equal(value, other, err_msg=item.name)
            compared += 1
        else:
            assert (value is None) == (other is None), item.name
    assert compared >= 10


@pytest.mark.parametrize(("place", "zoom"), [(VILLAGE_LON_LAT, 16), (VILLAGE_LON_LAT, 14), (RASTER_CORNER_LON_LAT, 14)])
def test_cached_block_equals_a_new_one(gl, wooded, place, zoom):
    """The nodes are equal, too, with the rim beyond the raster and the diagonals of their quads."""
    view = small_map(*place, zoom)
    buffer, new = map_block(wooded, view).buffer(wooded), geometry_buffer(wooded, view)
    assert_same_arrays(buffer, new)
    assert buffer.surface is not None and new.surface is not None
    assert (buffer.surface.row0, buffer.surface.col0) == (new.surface.row0, new.surface.col0)
    assert (buffer.surface.rim is None) == (new.surface.rim is None)
    if place == RASTER_CORNER_LON_LAT:
        assert new.surface.rim is not None and not new.valid.all()
    for window, new_window in ((buffer.surface, new.surface), (buffer.surface.with_rim, new.surface.with_rim)):
        for name in ("height_m", "valid", "position_frame_m"):
            np.testing.assert_array_equal(getattr(window, name), getattr(new_window, name), err_msg=name)
        np.testing.assert_array_equal(window.sheet.is_cut_nw_se, new_window.sheet.is_cut_nw_se)


def test_block_shows_all_kinds_of_surface(gl, wooded):
    """The test above compares meshes, trees and ground."""
    kind = map_block(wooded, small_map(*VILLAGE_LON_LAT, 16)).buffer(wooded).surface_kind
    assert all((kind == each).sum() > 20 for each in (RELIEF, MESHES, FOREST))


@pytest.mark.parametrize("place", [VILLAGE_LON_LAT, RASTER_CORNER_LON_LAT])
def test_samples_on_a_blocks_nodes_equal_those_on_nodes_of_their_own(gl, wooded, place):
    """Pixels that are not selected show nothing; the others equal those of a buffer without selection."""
    view = small_map(*place, 15)
    part = view.part(40, 60, 80, 90).finer(EDGE_SAMPLES_PER_SIDE)
    mask = np.random.default_rng(3).random((part.rows, part.cols)) < 0.2
    frame = view_frame(wooded, view)
    samples = geometry_buffer(wooded, part, frame, pixel_mask=mask, nodes=nodes_of_samples(wooded, view, part))
    whole = geometry_buffer(wooded, part, frame)
    shown = mask & whole.valid
    np.testing.assert_array_equal(samples.valid, shown)
    assert shown.sum() > 300
    assert_same_arrays(samples, whole, shown)
    assert np.isnan(samples.height_m[~shown]).all()


def test_block_is_kept_under_another_sun(gl, wooded):
    view = small_map(*VILLAGE_LON_LAT, 16)
    block = map_block(wooded, view)
    assert map_block(wooded.with_sun(SunSpec(azimuth=10, altitude=20)), view) is block
    assert map_block.cache.nbytes == sum(each.nbytes for each in map_block.cache.values) <= map_block.cache.limit_bytes
    trim_map_block_cache(0)
    assert map_block.cache.nbytes == 0
