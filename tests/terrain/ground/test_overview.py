"""Overviews of rasters: estimate the highest ground from means, and check which overviews a file needs."""

from __future__ import annotations

import numpy as np
import pytest

import skugga
from skugga.terrain.errors import SourceError
from skugga.terrain.ground import overview
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.overview import check_overviews, lacks_overviews

SIDE = 1024
PEAK_M = 3000.0


@pytest.fixture
def big_raster(write_raster, monkeypatch) -> Elevation:
    """Return a plain of 500 m with a narrow peak, a narrow pit and a hole: too large for an exact read."""
    monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", 128 * 128)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 128 * 128)
    monkeypatch.setattr(overview, "OVERVIEW_SIDE_CELLS", 32)
    row, col = np.mgrid[:SIDE, :SIDE]

    def bell(at_row: float, at_col: float) -> np.ndarray:
        return np.exp(-((row - at_row) ** 2 + (col - at_col) ** 2) / (2.0 * 6.0**2))

    heights = 500.0 + PEAK_M * bell(352, 671.5) - 400.0 * bell(700, 200)
    heights[800:960, 800:960] = np.nan
    return Elevation(str(write_raster(heights.astype(np.float32), "EPSG:32633", 500_000, 5_300_000, 30.0, tiled=True)))


def test_peak_is_estimated_from_means(big_raster):
    raster_overview = big_raster.overview
    assert raster_overview.lod == 5 and raster_overview.max_heights_m.shape == (32, 32)
    # The mean of the 32 x 32 cells around the peak is less than a quarter of its height.
    assert np.nanmax(raster_overview.mean_heights_m) < 500.0 + PEAK_M / 4
    assert 500.0 + 0.8 * PEAK_M < np.nanmax(raster_overview.max_heights_m) < 500.0 + 1.6 * PEAK_M
    assert np.unravel_index(np.nanargmax(raster_overview.max_heights_m), (32, 32))[1] in (20, 21)
    assert raster_overview.lowest_ground_m < 500.0 - 0.8 * 400.0


def test_max_heights_are_at_least_the_mean_and_nan_in_holes(big_raster):
    raster_overview = big_raster.overview
    valid = np.isfinite(raster_overview.mean_heights_m)
    assert (raster_overview.max_heights_m[valid] >= raster_overview.mean_heights_m[valid] - 1e-3).all()
    assert (
        np.isnan(raster_overview.max_heights_m[26:29, 26:29]).all() and np.isnan(raster_overview.mean_heights_m[25:30, 25:30]).all()
    )
    assert (raster_overview.max_heights_m[2:8, 22:30] == 500.0).all()


def test_overview_does_not_depend_on_strip_height(big_raster, monkeypatch):
    monkeypatch.setattr(overview, "MEAN_ROWS_PER_READ", 4)
    reopened = Elevation(big_raster.name)
    np.testing.assert_array_equal(reopened.overview.max_heights_m, big_raster.overview.max_heights_m)
    assert reopened.overview.lowest_ground_m == big_raster.overview.lowest_ground_m


@pytest.mark.parametrize(
    ("side", "factors", "lacks"),
    [
        (5_000, [], False),  # read at full resolution
        (10_000, [], True),
        (10_000, [2, 4, 8, 16], False),
        (10_000, [4, 16], False),
        (10_000, [2], True),
        (10_000, [16], True),
        (40_000, [2, 4, 8, 16, 32, 64], False),
    ],
)
def test_lacks_overviews_for_large_rasters(side, factors, lacks):
    assert lacks_overviews(side, side, factors) is lacks


def test_check_overviews_rejects_rasters_without_enough():
    check_overviews("dem.tif", 30_000, 30_000, [])
    check_overviews("dem.tif", 100_000, 100_000, [4])
    with pytest.raises(SourceError, match="40000 x 40000 cells and no overview.*1,000 million.*'skugga overviews dem.tif'"):
        check_overviews("dem.tif", 40_000, 40_000, [])
    with pytest.raises(SourceError, match="no overviews that are coarser than 2 cells a pixel side"):
        check_overviews("dem.tif", 100_000, 100_000, [2])


def test_scene_warns_about_missing_overviews(make_scene, write_raster, monkeypatch):
    path = write_raster(np.zeros((600, 700), np.float32), "EPSG:32633", 500_000, 5_300_000, 30.0)
    assert make_scene(path).warnings == ()
    monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", 10_000)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 10_000)
    monkeypatch.setattr(overview, "OVERVIEW_SIDE_CELLS", 64)
    (warning,) = make_scene(path).warnings
    assert f"'skugga overviews {path}'" in warning
    with skugga.open_heights(np.zeros((600, 700), np.float32), (30.0, 0.0, 5e5, 0.0, -30.0, 5.3e6), "EPSG:32633") as level:
        assert level.warnings == (), "no command makes overviews in memory"


@pytest.mark.parametrize("max_exact_cells", [10**9, 64 * 64])
@pytest.mark.parametrize("peak", [(642, 300), (200, 1196), (642, 1196), (0, 0)])
def test_the_last_cells_hold_the_ground_beyond_the_last_whole_one(write_raster, monkeypatch, peak, max_exact_cells):
    """A ridge on the edge of a raster whose sides are no multiples of the overview's cells."""
    monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", max_exact_cells)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", max_exact_cells)
    heights = np.full((643, 1197), 500.0, np.float32)
    heights[max(peak[0] - 31, 0) : peak[0] + 32, max(peak[1] - 31, 0) : peak[1] + 32] = 900.0
    heights[peak] = 2000.0 if max_exact_cells > heights.size else 900.0
    raster = Elevation(str(write_raster(heights, "EPSG:32633", 500_000, 5_300_000, 30.0)))
    (m, n), cell = raster.overview.max_heights_m.shape, 2**raster.overview.lod
    at = min(peak[0] // cell, m - 1), min(peak[1] // cell, n - 1)
    assert raster.overview.max_heights_m[at] >= heights[peak]
