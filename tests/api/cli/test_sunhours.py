"""``skugga sunhours``: its options, and their errors in one line."""

from __future__ import annotations

import numpy as np
import pyogrio
import pytest
import rasterio

from tests.rasters import ENGINEERING, write_geotiff


@pytest.fixture
def raster(tmp_path):
    """File of a level floor with a wall of 60 m that runs from north to south."""
    heights = np.zeros((50, 50), np.float32)
    heights[:, 25] = 60.0
    return write_geotiff(tmp_path / "wall.tif", heights, "EPSG:32632", 500e3, 5200e3, 10.0)


def test_a_window_of_solar_time_with_contours(run, raster, tmp_path):
    status, _, error = run(
        "sunhours", str(raster), "-o", str(tmp_path / "hours.tif"), "--date", "2024-12-01", "--to", "2024-12-21", "--every", "10d",
        "--window", "08:00-16:00", "--step", "15m", "--contours", str(tmp_path / "lines.gpkg"), "--levels", "2,4",
    )  # fmt: skip
    assert status == 0, error
    with rasterio.open(tmp_path / "hours.tif") as dataset:
        hours = dataset.read(1)
    assert 7.5 < hours.max() < 8.01 and hours.min() < 4.5
    assert set(pyogrio.raw.read(tmp_path / "lines.gpkg")[3][0]) <= {2.0, 4.0}


def test_days_over_a_threshold_are_counted(run, raster, tmp_path):
    arguments = ["--date", "2024-03-30", "--to", "2024-03-31", "--clock", "Europe/Oslo", "--step", "30m", "--quantity", "days"]
    status, _, error = run("sunhours", str(raster), "-o", str(tmp_path / "d.tif"), *arguments, "--threshold", "7h")
    assert status == 0, error
    with rasterio.open(tmp_path / "d.tif") as dataset:
        assert set(np.unique(dataset.read(1))) == {0.0, 2.0}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--date", "2023-02-29"], "--date: '2023-02-29' is not allowed. Allowed: a calendar date such as 2024-03-21"),
        (["--to", "2024-03-20"], "to: '2024-03-20'"),
        (["--window", "16:00-08:00"], "window: '16:00-08:00'"),
        (["--clock", "Europe/Gotham"], "--clock: 'Europe/Gotham'"),
        (["--clock", ""], "--clock: '' is not allowed"),
        (["--clock", "Pacific/Apia", "--date", "2011-12-30"], "date: '2011-12-30'"),
        (["--step", "5"], "--step: '5'"),
        (["--step", "2h"], "--step: '2h'"),
        (["--every", "12h"], "--every: '12h'"),
        (["--threshold", "soon"], "--threshold: 'soon'"),
        (["--quantity", "shade"], "--quantity: 'shade'"),
        (["--least-altitude", "95"], "--least-altitude: '95.0'"),
        (["--height", "-1"], "--height: '-1.0'"),
        (["--contours", "lines.shp"], "--contours: 'lines.shp'"),
        (["--contours", "lines.gpkg", "--levels", "a"], "--levels: 'a'"),
        (["-o", "hours.png"], "--output: 'hours.png'"),
    ],
)
def test_wrong_options_are_one_line(run, raster, tmp_path, options, message):
    status, _, error = run("sunhours", str(raster), "-o", str(tmp_path / "h.tif"), "--date", "2024-03-21", *options)
    assert status == 2
    assert message in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "h.tif").exists()


def test_an_engineering_crs_has_no_dates(run, tmp_path):
    flat = write_geotiff(tmp_path / "flat.tif", np.zeros((9, 9), np.float32), ENGINEERING, 0.0, 90.0, 10.0)
    status, _, error = run("sunhours", str(flat), "-o", str(tmp_path / "h.tif"), "--date", "2024-03-21")
    assert status == 2 and "date: '2024-03-21'" in error and "engineering" in error
