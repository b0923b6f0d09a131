"""Nodata values stated by a level: alone, with the file's own nodata value, and in averages of cells."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio

from skugga.terrain.errors import SourceError
from skugga.terrain.ground.elevation import Elevation
from tests.rasters import write_geotiff


def raster_heights(path, heights: np.ndarray, stated_nodata: float | None, **options) -> np.ndarray:
    """Return the heights of all cells, NaN without a surface."""
    write_geotiff(path / "dem.tif", heights, "EPSG:32633", 500e3, 5200e3, 10.0, **options)
    elevation = Elevation(str(path / "dem.tif"), nodata=stated_nodata)
    row, col = np.mgrid[: heights.shape[0], : heights.shape[1]].astype(float)
    height, valid = elevation.heights_at(0, row, col)
    elevation.close()
    return np.where(valid, height, np.nan)


@pytest.mark.parametrize(
    ("own", "dtype"), [(None, np.float32), (-9999.0, np.float32), (-9999.0, np.int16), (0.0, np.int16), (np.nan, np.float64)]
)
def test_stated_and_own_nodata_are_both_missing(tmp_path, own, dtype):
    heights = np.arange(100, 200).reshape(10, 10).astype(dtype)
    heights[2, 3:6] = 0
    missing = heights == 0
    if own:
        heights[7, 1:4] = own
        missing[7, 1:4] = True
    read_heights = raster_heights(tmp_path, heights, 0.0, nodata=own)
    np.testing.assert_array_equal(np.isnan(read_heights), missing)
    np.testing.assert_array_equal(read_heights[~missing], heights[~missing])
    if own != 0.0:
        assert not np.isnan(raster_heights(tmp_path, heights, None, nodata=own)[2, 3:6]).any()


def test_scale_and_unit_are_kept(tmp_path):
    heights = np.full((8, 8), 1000, np.int16)
    heights[0] = -1
    path = write_geotiff(tmp_path / "feet.tif", heights, "EPSG:32633", 500e3, 5200e3, 10.0)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets, dataset.units = (0.5,), (20.0,), ("ft",)
    elevation = Elevation(str(path), nodata=-1)
    assert elevation.vertical.unit == "ft"
    np.testing.assert_allclose(np.nanmax(elevation.overview.mean_heights_m), 520.0 * 0.3048, rtol=1e-6)
    assert np.isnan(elevation.overview.mean_heights_m[0]).all()


def test_stated_nodata_is_not_averaged_into_heights(tmp_path):
    """The raster is larger than its overview: coarse cells are means of the valid cells."""
    heights = np.full((600, 1024), 500.0, np.float32)
    heights[:, :301] = 0.0
    path = write_geotiff(tmp_path / "wide.tif", heights, "EPSG:32633", 500e3, 5200e3, 10.0)
    overview = Elevation(str(path), nodata=0.0).overview
    assert overview.lod == 1 and overview.lowest_ground_m == 500.0
    is_valid = np.isfinite(overview.mean_heights_m)
    np.testing.assert_array_equal(overview.mean_heights_m[is_valid], 500.0)
    np.testing.assert_array_equal(is_valid.any(axis=0), np.arange(512) >= 150)


def test_stated_nodata_ignores_overviews_in_the_file(tmp_path):
    """The overviews in the file contain averages with the zeros."""
    heights = np.full((1200, 1200), 500.0, np.float32)
    heights[:, :333] = 0.0
    path = write_geotiff(
        tmp_path / "dem.tif", heights, "EPSG:32633", 500e3, 5200e3, 10.0, tiled=True, blockxsize=256, blockysize=256
    )
    with rasterio.open(path, "r+") as dataset:
        dataset.build_overviews([2, 4, 8], rasterio.enums.Resampling.average)
    overview = Elevation(str(path), nodata=0.0).overview
    assert np.nanmin(overview.mean_heights_m) == 500.0


@pytest.mark.parametrize("value", [-9999.0, 70000.0, 0.5])
def test_nodata_value_that_no_cell_can_have_is_rejected(tmp_path, value):
    with pytest.raises(SourceError, match="dem.tif: nodata: .*uint16"):
        raster_heights(tmp_path, np.ones((5, 5), np.uint16), value)


def test_bundled_data_set_accepts_a_stated_nodata():
    lowest = Elevation("jacksboro").overview.lowest_ground_m
    assert Elevation("jacksboro", nodata=lowest).overview.lowest_ground_m > lowest
