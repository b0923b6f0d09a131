"""Collar detection: find fill values around the data that the file does not declare as nodata, and ignore shores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.ndimage import rotate

from skugga.terrain.ground.collar import Collar, detect_collar
from skugga.terrain.ground.elevation import Elevation
from tests.rasters import write_geotiff

FILES_WITH_COLLAR = ("lisbon_1arcsec_4326.tif",)
"""Real rasters with a collar of zeros around the data."""


def hills(rows: int, cols: int, low_m: float = 300.0, high_m: float = 900.0) -> np.ndarray:
    """Return heights (rows, cols) between ``low_m`` and ``high_m`` metres."""
    row, col = np.mgrid[:rows, :cols].astype(np.float32)
    wave = np.sin(col / 37) * np.cos(row / 53) + 0.1 * np.sin(col / 5) * np.sin(row / 7)
    return (low_m + (high_m - low_m) * (wave - wave.min()) / np.ptp(wave)).astype(np.float32)


def collar_of_raster(path: Path, heights: np.ndarray, **options) -> Collar | None:
    """Return the collar that is detected in a raster of heights; ``None`` without one."""
    elevation = Elevation(str(write_geotiff(path / "dem.tif", heights, "EPSG:32633", 500e3, 5200e3, 30.0, **options)))
    try:
        return detect_collar(elevation)
    finally:
        elevation.close()


@pytest.mark.parametrize("value", [0.0, -9999.0, 9000.0])
@pytest.mark.parametrize("size", [200, 1500])
def test_collar_left_by_warping_is_detected(tmp_path, value, size):
    collar = collar_of_raster(tmp_path, rotate(hills(size, size), 15.0, order=0, cval=value))
    assert collar is not None and collar.value == value and collar.border_share > 0.9
    assert collar.cliff_m == pytest.approx(abs(value - 600.0), abs=120.0)
    assert f"nodata: {value:g}" in collar.warning


@pytest.mark.parametrize("side", [np.s_[:3], np.s_[-2:], np.s_[:, :4], np.s_[:, -1:]])
def test_thin_collar_on_one_side_of_a_large_raster_is_detected(tmp_path, side):
    heights = hills(1400, 1300)
    assert collar_of_raster(tmp_path, heights) is None
    heights[side] = 0.0
    collar = collar_of_raster(tmp_path, heights)
    assert collar is not None and collar.value == 0.0


def test_collar_of_scaled_cells_is_measured_in_metres(tmp_path):
    """One count is half a centimetre: a cliff of 600 counts is 3 m, and one of 60,000 counts is 300 m."""
    for metres, has_collar in ((1.0, False), (100.0, True)):
        counts = np.rint(rotate(hills(200, 200, 3.0 * metres, 6.0 * metres) / 0.005, 15.0, order=0, cval=0.0)).astype(np.int32)
        path = write_geotiff(tmp_path / "counts.tif", counts, "EPSG:32633", 500e3, 5200e3, 30.0)
        with rasterio.open(path, "r+") as dataset:
            dataset.scales = (0.005,)
        assert (detect_collar(Elevation(str(path))) is not None) is has_collar


def test_collar_of_depths_is_detected(tmp_path):
    depths = rotate(hills(200, 200), 15.0, order=0, cval=0.0)
    path = write_geotiff(tmp_path / "depths.tif", depths, "EPSG:32633", 500e3, 5200e3, 30.0)
    collar = detect_collar(Elevation(str(path), positive="down"))
    assert collar is not None and collar.value == 0.0 and collar.cliff_m == pytest.approx(600.0, abs=120.0)


@pytest.mark.parametrize("level_m", [350.0, 500.0, 700.0])
def test_sea_or_lake_is_no_collar(tmp_path, level_m):
    for rows in (300, 1400):
        heights = hills(rows, rows)
        assert collar_of_raster(tmp_path, np.maximum(heights, level_m)) is None


def test_river_between_quays_is_no_collar(tmp_path):
    """The quays are walls of 12 m along flat water, in a town on hills."""
    heights = hills(300, 300, 40.0, 160.0)
    col = np.arange(300)
    heights[:, np.abs(col - 150) < 40] = 32.0
    heights[:, np.abs(col - 150) < 20] = 20.0
    assert collar_of_raster(tmp_path, heights) is None


def test_objects_on_a_plain_are_no_collar(tmp_path):
    heights = np.zeros((200, 200), np.float32)
    heights[80:120, 60:110] = 40.0
    assert collar_of_raster(tmp_path, heights) is None
    heights[80:120, 60:110] += hills(40, 50, 0.0, 20.0)
    assert collar_of_raster(tmp_path, heights) is None


def test_declared_nodata_is_no_collar(tmp_path):
    assert collar_of_raster(tmp_path, rotate(hills(200, 200), 15.0, order=0, cval=0.0), nodata=0.0) is None


def test_real_rasters_have_only_the_known_collars(shared_data):
    """No false positives, also where sea level replaces the missing cells."""
    raster_count = 0
    for path in sorted(shared_data.rglob("*.tif")):
        if path.name == "CHM_empty.tif":
            continue
        elevation = Elevation(str(path))
        assert (detect_collar(elevation) is not None) is (path.name in FILES_WITH_COLLAR), path
        elevation.close()
        raster_count += 1
    assert raster_count > 20


def test_real_coasts_are_no_collar(shared_data, tmp_path):
    for name, lowest in (("odd/nz_elev_1km_oceanholes.tif", 0.0), ("odd/etopo1_1deg_global.tif", 0.0),
                         ("urban/sanfrancisco_elev_3857.tif", 0.5), ("mountain/grenoble_copernicus_4326.tif", 300.0)):  # fmt: skip
        with rasterio.open(shared_data / name) as dataset:
            heights = np.nan_to_num(dataset.read(1).astype(np.float32), nan=lowest)
            profile = {"crs": dataset.crs.to_wkt(), "transform": dataset.transform}
        path = write_geotiff(
            tmp_path / "coast.tif", np.maximum(heights, lowest), profile["crs"], 0, 0, 1, transform=profile["transform"]
        )
        assert detect_collar(Elevation(str(path))) is None, name


def test_real_rasters_with_an_added_collar_are_detected(shared_data, tmp_path):
    for name in ("mountain/bigtujunga_30m_utm11.tif", "odd/texas_flat_3arcsec_4326.tif", "urban/goteborg_1m/DSM.tif",
                 "urban/bilbao/DEM.tif", "urban/essen_dom1_32_356_5699_1_nw_2020.tif"):  # fmt: skip
        with rasterio.open(shared_data / name) as dataset:
            turned = rotate(dataset.read(1).astype(np.float32), 10.0, order=0, cval=0.0)
        collar = collar_of_raster(tmp_path, turned)
        assert collar is not None and collar.value == 0.0, name
