"""Bundled rasters: the highest cell has the published position and height of its summit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import rasterio.warp

from skugga.api.catalogue import bundled_levels
from skugga.terrain.geo.world import LONGITUDE_LATITUDE
from skugga.terrain.level.bundled import BUNDLED
from skugga.terrain.level.level import load_level


@dataclass(frozen=True)
class Summit:
    """The published summit of a raster: degrees, and metres above the sea."""

    longitude: float
    latitude: float
    height_m: float


CROSS_MOUNTAIN = Summit(-84.23056, 36.19833, 1077.0)
"""Cross Mountain in Tennessee: 36°11'54" N, 84°13'50" W, 3,534 feet (https://en.wikipedia.org/wiki/Cross_Mountain_(Tennessee))."""

SUMMITS = {"jacksboro": CROSS_MOUNTAIN, "jacksboro_utm": CROSS_MOUNTAIN}

SRTM_CELL_DEG = 3.0 / 3600.0
"""Warping to finer cells does not improve the position of a summit."""

MAX_OFFSET_CELLS = 1.0
"""Maximum distance of the highest cell from the summit, along either axis: half a cell to the cell's centre, a sixth for a position
published in whole seconds, and a fifth for the 20 m within which 90 % of SRTM's heights lie (its specification).
"""

MAX_HEIGHT_ERROR_M = 16.0
"""90 % of SRTM's heights have a smaller error (its specification)."""


def test_every_bundled_raster_has_a_known_summit():
    assert set(SUMMITS) == set(BUNDLED)
    level_sources = {load_level(path).source for path in bundled_levels()} - {""}
    assert level_sources and level_sources <= set(SUMMITS), "a level over another real raster needs a summit too"


@pytest.mark.parametrize("name", BUNDLED)
def test_highest_cell_is_the_published_summit(name):
    summit = SUMMITS[name]
    with BUNDLED[name]().open() as dataset:
        heights_m = dataset.read(1)
        row, col = np.unravel_index(np.nanargmax(heights_m), heights_m.shape)
        (longitude,), (latitude,) = rasterio.warp.transform(dataset.crs, LONGITUDE_LATITUDE, *([v] for v in dataset.xy(row, col)))
    off_deg = longitude - summit.longitude, latitude - summit.latitude
    assert np.abs(off_deg).max() <= MAX_OFFSET_CELLS * SRTM_CELL_DEG, (
        f"cells off east and north: {np.array(off_deg) / SRTM_CELL_DEG}"
    )
    assert abs(heights_m[row, col] - summit.height_m) <= MAX_HEIGHT_ERROR_M


def test_srtm_cells_are_centred_on_whole_arc_seconds():
    """SRTM samples lie at whole multiples of 3 arc seconds. The summit test cannot detect an offset of half a cell."""
    with BUNDLED["jacksboro"]().open() as dataset:
        middle = dataset.shape[0] // 2, dataset.shape[1] // 2
        steps = np.array([*dataset.xy(0, 0), *dataset.xy(*middle)]) / SRTM_CELL_DEG
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)
