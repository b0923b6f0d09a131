"""Undeclared cells that cannot be heights: warn with a remedy, and do not warn about real ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from skugga.terrain.errors import SourceError
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.raster_warnings import raster_warnings
from tests.rasters import write_geotiff
from tests.terrain.ground.test_collar import hills

SIDE_CELLS = 200


def warnings_of(path: Path, heights: np.ndarray, scale: float = 1.0, crs: str = "EPSG:32633", **options) -> tuple[str, ...]:
    """Return the warnings about a raster of heights with a scale factor."""
    write_geotiff(path / "dem.tif", heights, crs, 500e3, 5200e3, 30.0)
    with rasterio.open(path / "dem.tif", "r+") as dataset:
        dataset.scales = (scale,)
    elevation = Elevation(str(path / "dem.tif"), **options)
    try:
        return raster_warnings(elevation)
    finally:
        elevation.close()


@pytest.mark.parametrize("size", [SIDE_CELLS, 1500])
@pytest.mark.parametrize(
    ("value", "dtype", "effect"),
    [
        (-9999.0, "float32", "far from all"), (-9999.0, "int16", "far from all"), (-999.0, "int16", "far from all"),
        (-32768.0, "int16", "left out"), (-32767.0, "int16", "left out"), (32767.0, "int16", "left out"),
        (65535.0, "uint16", "left out"), (-99999.0, "float32", "left out"), (9999.0, "int16", "left out"),
        (-3.4028234663852886e38, "float32", "left out"), (1e38, "float32", "left out"), (1e20, "float64", "left out"),
    ],
)  # fmt: skip
def test_sentinel_inside_is_reported(tmp_path, value, dtype, effect, size):
    heights = hills(size, size).astype(dtype)
    hole = np.s_[size // 2 : size // 2 + size // 10, size // 4 : size // 4 + size // 5]
    heights[hole] = value
    (warning,) = warnings_of(tmp_path, heights)
    value_text = str(np.float32(value)) if abs(value) > 1e9 else f"{value:g}"
    assert warning.startswith(f"2 % of the raster's cells are {value_text}, ") and effect in warning
    assert f"terrain: {{nodata: {value_text}}}" in warning and f"nodata={value_text})" in warning
    assert warnings_of(tmp_path, heights, nodata=float(value_text)) == ()


def test_single_sentinel_cell_is_reported(tmp_path):
    heights = hills(SIDE_CELLS, SIDE_CELLS)
    heights[77, 88] = -9999.0
    (warning,) = warnings_of(tmp_path, heights)
    assert warning.startswith("0.0025 % of the raster's cells are -9999, far")


def test_each_of_several_sentinels_is_reported(tmp_path):
    heights = hills(SIDE_CELLS, SIDE_CELLS)
    heights[50:60, 50:60], heights[90:95, 90:95] = -9999.0, 1e38
    assert [text.split(" are ")[1].split(",")[0] for text in warnings_of(tmp_path, heights)] == ["-9999", "1e+38"]


def test_sentinel_of_a_collar_is_reported_once(tmp_path):
    heights = np.full((SIDE_CELLS, SIDE_CELLS), -9999.0, np.float32)
    heights[40:-40, 40:-40] = hills(SIDE_CELLS - 80, SIDE_CELLS - 80)
    (warning,) = warnings_of(tmp_path, heights)
    assert "of the raster's border is -9999" in warning


def trench() -> np.ndarray:
    """Return a sea floor down to 10,900 m in whole metres: many cells lie at or near 9999 m."""
    row, col = np.mgrid[:SIDE_CELLS, :SIDE_CELLS]
    return (-10900.0 + 60.0 * np.hypot(row - 100, col - 100)).astype(np.int16)


@pytest.mark.parametrize("name", ["hills", "trench", "deep plain", "flat", "depths", "spire"])
def test_real_ground_is_not_reported(tmp_path, name):
    ground = {
        "hills": hills(SIDE_CELLS, SIDE_CELLS),
        "trench": trench(),
        "deep plain": np.maximum(trench(), -9999).astype(np.int16) + np.tri(SIDE_CELLS, dtype=np.int16),
        "flat": np.full((SIDE_CELLS, SIDE_CELLS), 999, np.int16),
        "depths": np.rint(hills(SIDE_CELLS, SIDE_CELLS, -1100.0, -950.0)).astype(np.int16),
        "spire": np.where(np.arange(SIDE_CELLS) == 50, 828.0, 0.0) * np.ones((SIDE_CELLS, 1)),
    }[name].astype(np.float32)
    assert warnings_of(tmp_path, ground) == ()
    assert warnings_of(tmp_path, -ground, positive="down") == ()


def test_nan_and_infinity_are_not_reported(tmp_path):
    heights = hills(SIDE_CELLS, SIDE_CELLS)
    heights[50:60, 50:60], heights[90:95, 90:95] = np.nan, np.inf
    assert warnings_of(tmp_path, heights) == ()


def test_mountains_in_undeclared_feet_are_reported(tmp_path):
    """Heights range from 6,000 to 14,400 feet. Values over 9,500 cannot be metres on earth."""
    feet = hills(SIDE_CELLS, SIDE_CELLS, 6000.0, 14400.0)
    share = 100 * float((feet > 9500.0).mean())
    (warning,) = warnings_of(tmp_path, feet)
    assert warning.startswith(f"{share:.3g} % of the raster's cells have impossible heights and are left out as holes: 9,50")
    assert "to 14,400 m, read as heights in m (no unit is stated)" in warning
    assert "terrain: {units: UNIT}" in warning and "units=UNIT" in warning and "us-ft" in warning
    assert warnings_of(tmp_path, feet, units="ft") == ()


def test_arbitrary_sentinel_suggests_nodata_or_another_unit(tmp_path):
    heights = hills(SIDE_CELLS, SIDE_CELLS)
    heights[50:60, 50:60] = 12345.0
    (warning,) = warnings_of(tmp_path, heights)
    assert warning.startswith("0.25 % of the raster's cells have impossible heights") and "12,345 m, read as" in warning
    assert "mean no data, write terrain: {nodata: 12345}" in warning and "units=UNIT" in warning
    assert warnings_of(tmp_path, heights, nodata=12345.0) == ()


def test_scaled_cells_are_judged_in_metres(tmp_path):
    """Cells are centimetres in whole numbers. The sentinel is a value of the unscaled cells."""
    counts = np.rint(hills(SIDE_CELLS, SIDE_CELLS) * 100.0).astype(np.int32)
    assert warnings_of(tmp_path, counts, scale=0.01) == ()
    counts[50:60, 50:60] = -9999
    (warning,) = warnings_of(tmp_path, counts, scale=0.01)
    assert "are -9999, far" in warning


def test_raster_without_any_plausible_height_names_the_unit(tmp_path):
    with pytest.raises(SourceError) as caught:
        warnings_of(tmp_path, hills(SIDE_CELLS, SIDE_CELLS, 30000.0, 90000.0))
    message = str(caught.value)
    assert all(words in message for words in ("30,000 m to 90,000 m", "units=UNIT", "dem.tif")) and "\n" not in message
    assert warnings_of(tmp_path, hills(SIDE_CELLS, SIDE_CELLS, 30000.0, 90000.0), units="cm") == ()
