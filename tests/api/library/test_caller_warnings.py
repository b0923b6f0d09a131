"""Warnings of open levels: what the command line prints, the library issues for the line that called it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from affine import Affine

import skugga
from tests.api.library.test_nodata_in_memory import caught_warnings
from tests.rasters import write_geotiff

CRS, WEST, NORTH, CELL_M, SIDE_CELLS = "EPSG:32633", 500e3, 5000e3, 10.0, 61
SUN = {"azimuth": 180.0, "altitude": 30.0}
NODATA_TEXT = "0.672 % of the raster's cells are -9999"  # 25 of 3,721 cells

RESULTS: dict[str, Callable[[skugga.OpenLevel], Any]] = {
    "shade": lambda level: level.shade("mask", **SUN),
    "compute": lambda level: level.compute("mask", **SUN),
    "sun_hours": lambda level: level.sun_hours("2024-06-21", step_min=60.0, window="10:00-12:00"),
    "point": lambda level: level.point(WEST + 300.0, NORTH - 300.0, crs=CRS, date="2024-06-21"),
    "horizon": lambda level: level.horizon(WEST + 300.0, NORTH - 300.0, crs=CRS),
    "render": lambda level: level.render(size=(16, 16), **SUN),
    "film": lambda level: list(level.film(start="2024-06-21T10:00Z", end="2024-06-21T11:00Z", step="1h", size=(16, 16))),
}


def heights_with_undeclared_nodata() -> np.ndarray:
    """Return heights of a plain with a block of 7 x 7 cells, 60 m high, and 25 cells of -9999 in the corner."""
    heights = np.zeros((SIDE_CELLS, SIDE_CELLS), np.float32)
    heights[27:34, 27:34] = 60.0
    heights[2:7, 2:7] = -9999.0
    return heights


def write_plain_raster(path: Path, values: np.ndarray) -> Path:
    """Write values (rows, cols) as a GeoTIFF and return its path."""
    return write_geotiff(path, values.astype(np.float32), CRS, WEST, NORTH, CELL_M)


@pytest.fixture
def plain(tmp_path) -> Path:
    """File of a raster of level ground."""
    return write_plain_raster(tmp_path / "plain.tif", np.zeros((SIDE_CELLS, SIDE_CELLS)))


def test_open_level_warns_of_undeclared_nodata(tmp_path):
    """The shadow of the block is 60 m / tan(30 degrees) = 104 m long: 10 cells behind each of its 7 columns."""
    path = write_plain_raster(tmp_path / "dem.tif", heights_with_undeclared_nodata())
    with caught_warnings() as caught, skugga.open_level(path) as level:
        level.shade("mask", **SUN)
    (warning,) = caught
    assert str(warning.message).startswith(f"{path}: {NODATA_TEXT}") and warning.filename == __file__
    assert str(warning.message).endswith("write terrain: {nodata: -9999} (without a level file: nodata=-9999)")
    with skugga.open_level(path, nodata=-9999) as level:  # without a warning, which would be an error
        assert (level.shade("mask", **SUN) == 0).sum() == 7 * 10


def test_open_heights_warns_of_undeclared_nodata():
    transform = Affine(CELL_M, 0.0, WEST, 0.0, -CELL_M, NORTH)
    with caught_warnings() as caught, skugga.open_heights(heights_with_undeclared_nodata(), transform, CRS) as level:
        level.shade("mask", **SUN)
    (warning,) = caught
    assert str(warning.message).startswith(f"the array: {NODATA_TEXT}") and warning.filename == __file__
    assert str(warning.message).endswith("If that means no data, set those cells to NaN")


def test_warnings_on_arrays_name_no_file():
    """Heights of 12 km and more are in another unit."""
    heights = np.linspace(12_000.0, 90_000.0, SIDE_CELLS**2, dtype=np.float32).reshape(SIDE_CELLS, SIDE_CELLS)
    heights[:30] = 100.0
    with caught_warnings() as caught:
        skugga.open_heights(heights, Affine(CELL_M, 0.0, WEST, 0.0, -CELL_M, NORTH), CRS).close()
    (warning,) = caught
    assert str(warning.message).endswith("are in another unit, convert the heights to metres")


def test_sun_hours_of_an_array_warn_of_undeclared_nodata():
    with caught_warnings() as caught:
        skugga.sun_hours(heights_with_undeclared_nodata(), CELL_M, "2024-06-21", 45.0, step_min=60.0)
    (warning,) = caught
    assert NODATA_TEXT in str(warning.message) and warning.filename == __file__


@pytest.mark.parametrize("result", RESULTS)
def test_the_first_result_warns_of_objects(request, tmp_path, plain, result):
    if result in ("render", "film"):
        request.getfixturevalue("gl")
    canopy = write_plain_raster(tmp_path / "canopy.tif", np.zeros((SIDE_CELLS, SIDE_CELLS)))
    with skugga.open_level(plain, canopy=canopy) as level:  # without a warning: no file of trees is read
        with caught_warnings() as caught:
            RESULTS[result](level)
        RESULTS[result](level)  # without a second warning
    (warning,) = caught
    assert str(warning.message).startswith(f"{canopy}: no tree is planted") and warning.filename == __file__


def test_wrong_arguments_do_not_warn_of_objects(tmp_path, plain):
    canopy = write_plain_raster(tmp_path / "canopy.tif", np.zeros((SIDE_CELLS, SIDE_CELLS)))
    with skugga.open_level(plain, canopy=canopy) as level, pytest.raises(skugga.SkuggaError, match="^layer: 'depth'"):
        level.shade("depth", **SUN)


def test_messages_of_an_array_name_no_option_of_a_file():
    """Neither the warnings that the level keeps, nor the error where no height is possible."""
    heights = np.full((40, 40), 300.0, np.float32)
    heights[10:14, 10:14] = 20_000.0
    with (
        pytest.warns(UserWarning),
        skugga.open_heights(heights, (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0), "EPSG:32633") as level,
    ):
        (text,) = level.warnings
    with pytest.raises(skugga.SkuggaError) as error_info:
        skugga.open_heights(np.full((40, 40), 20_000.0, np.float32), (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0), "EPSG:32633")
    for message in (text, str(error_info.value)):
        assert "set those cells to NaN" in message or "convert the heights to metres" in message
        assert "terrain:" not in message and "units=" not in message, message
