"""Nodata in arrays: masked, marked and non-finite cells are no ground. They are neither dark nor casters."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import rasterio
import rioxarray
import xarray
from affine import Affine

import skugga
from tests.api.library.test_library import IGNORE_NOT_GEOREFERENCED
from tests.rasters import write_geotiff

SUN = {"azimuth": 250.0, "altitude": 12.0}
TRANSFORM = Affine(30.0, 0.0, 500e3, 0.0, -30.0, 5200e3)
MASKED_CELLS = np.s_[20:30, 50:70]


@pytest.fixture(scope="module")
def height_m() -> np.ndarray:
    """Heights of hills (90, 120) with NaN in ``MASKED_CELLS``."""
    row, col = np.mgrid[:90, :120].astype(np.float32)
    height = 900 + 300 * np.sin(col / 9) * np.cos(row / 13)
    height[MASKED_CELLS] = np.nan
    return height


def masked(height_m: np.ndarray, fill_value: float) -> np.ma.MaskedArray:
    """Return heights as a masked array whose masked cells hold ``fill_value`` instead of NaN."""
    return np.ma.masked_array(np.where(np.isnan(height_m), np.float32(fill_value), height_m), np.isnan(height_m))


@pytest.mark.parametrize("masked_value", [0.0, 5000.0, -9999.0, -3.4e38])
def test_masked_cells_are_no_ground(height_m, masked_value):
    masked_heights = masked(height_m, masked_value)
    for call in (
        lambda heights: skugga.shadow(heights, 30.0, 250.0, 12.0),
        lambda heights: skugga.horizon(heights, 30.0, 250.0),
        lambda heights: skugga.sun_hours(heights, 30.0, "2024-12-21", 46.9, step_min=60.0),
        lambda heights: skugga.open_heights(heights, TRANSFORM, "EPSG:32633").shade("visibility", **SUN),
    ):
        np.testing.assert_array_equal(call(masked_heights), call(height_m))
    assert not skugga.shadow(masked_heights, 30.0, 250.0, 12.0)[MASKED_CELLS].any()


@pytest.mark.parametrize("sentinel", [np.inf, -np.inf, -3.4e38, 1e30])
def test_sentinels_are_no_ground(height_m, sentinel):
    sentinel_heights = np.where(np.isnan(height_m), np.float32(sentinel), height_m)
    np.testing.assert_array_equal(skugga.shadow(sentinel_heights, 30.0, 250.0, 12.0), skugga.shadow(height_m, 30.0, 250.0, 12.0))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")  # catch_warnings is not safe in dask's threads
@pytest.mark.parametrize("dtype", ["int16", "int32", "uint16", "float32", "float64"])
@pytest.mark.parametrize("options", [{}, {"masked": True}, {"mask_and_scale": True}, {"parse_coordinates": False}, {"chunks": 50}])
def test_nodata_of_a_file_is_no_ground(height_m, dtype, options, tmp_path):
    """By every way that rioxarray opens the file, the result equals that of the file."""
    nodata = 65535 if dtype == "uint16" else -9999
    raster = write_geotiff(
        tmp_path / "dem.tif", np.where(np.isnan(height_m), nodata, height_m).astype(dtype), "EPSG:32633", 500e3, 5200e3, 30.0,
        nodata=nodata,
    )  # fmt: skip
    with skugga.open_level(raster) as level:
        visibility = level.shade("visibility", **SUN)
    in_shadow = rioxarray.open_rasterio(raster, **options).squeeze().skugga.shadow(**SUN)
    np.testing.assert_array_equal(in_shadow, visibility < 0.5)
    assert not in_shadow[MASKED_CELLS].any()


def heights(values: np.ndarray) -> xarray.DataArray:
    """Return values (rows, cols) as a DataArray on the grid ``TRANSFORM``."""
    rows, cols = values.shape
    y, x = TRANSFORM.f + TRANSFORM.e * (np.arange(rows) + 0.5), TRANSFORM.c + TRANSFORM.a * (np.arange(cols) + 0.5)
    return xarray.DataArray(values, dims=("y", "x"), coords={"y": y, "x": x}).rio.write_crs("EPSG:32633")


@contextmanager
def caught_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Record the warnings for users. Warnings of other kinds remain errors."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        # Libraries multiply affine matrices with "*", which affine 3.1 advises against.
        warnings.filterwarnings("ignore", "Use `@` matmul", PendingDeprecationWarning)
        yield caught


def test_nodata_attributes_of_an_array_are_respected(height_m):
    expected = heights(height_m).skugga.shadow(**SUN)
    sentinel_heights = heights(np.where(np.isnan(height_m), -9999.0, height_m).astype(np.float32))
    for array in (
        sentinel_heights.rio.write_nodata(-9999),
        sentinel_heights.assign_attrs(_FillValue=-9999),
        sentinel_heights.assign_attrs(missing_value=-9999.0),
    ):
        xarray.testing.assert_equal(array.skugga.shadow(**SUN), expected)
    with caught_warnings() as caught:
        assert sentinel_heights.skugga.shadow(**SUN)[MASKED_CELLS].sum() > 0, "undeclared nodata is drawn as a deep pit"
    assert ["are -9999, far from all other heights" in str(warning.message) for warning in caught] == [True]


@pytest.mark.parametrize("values", [[-9999.0], (-9999,), np.array([-9999.0]), [-9999.0, -9999.0]])
@pytest.mark.parametrize("name", ["_FillValue", "missing_value", "fill_value", "nodata", "nodatavals"])
def test_a_list_of_one_nodata_value_is_that_value(height_m, name, values):
    array = heights(np.nan_to_num(height_m, nan=-9999.0)).assign_attrs({name: values})
    xarray.testing.assert_equal(array.skugga.shadow(**SUN), heights(height_m).skugga.shadow(**SUN))


@pytest.mark.parametrize("values", [[-9999.0, -1.0], np.array([-9999.0, -1.0]), [], ["x"], {}])
@pytest.mark.parametrize("name", ["_FillValue", "missing_value", "scale_factor", "add_offset"])
@pytest.mark.parametrize("chunks", [None, 50])
def test_attributes_that_are_no_number_are_refused(height_m, name, values, chunks):
    array = heights(height_m).assign_attrs({name: values})
    with pytest.raises(skugga.SkuggaError, match=f"^the array: {name}: .*one number"):
        (array if chunks is None else array.chunk(chunks)).skugga.shadow(**SUN)


def test_nodata_set_without_an_attribute_is_no_ground(height_m):
    array = heights(np.nan_to_num(height_m, nan=-9999.0)).rio.set_nodata(-9999.0)
    xarray.testing.assert_equal(array.skugga.shadow(**SUN), heights(height_m).skugga.shadow(**SUN))


def test_scale_offset_and_unit_equal_those_of_a_file(height_m, tmp_path):
    feet = np.rint((np.nan_to_num(height_m, nan=900.0) / 0.3048 - 1000.0) / 0.5).astype(np.int16)
    raster = write_geotiff(tmp_path / "feet.tif", feet, "EPSG:32633", 500e3, 5200e3, 30.0)
    with rasterio.open(raster, "r+") as dataset:
        dataset.scales, dataset.offsets, dataset.units = (0.5,), (1000.0,), ("ft",)
    with skugga.open_level(raster) as level:
        visibility = level.shade("visibility", **SUN)
    array = rioxarray.open_rasterio(raster).squeeze()
    assert array.attrs["scale_factor"] == 0.5
    np.testing.assert_array_equal(array.assign_attrs(units="ft").skugga.shadow(**SUN), visibility < 0.5)
    metres = heights(height_m * 0 + (feet * 0.5 + 1000.0) * 0.3048).skugga.shadow(**SUN)
    assert (metres.to_numpy() != (visibility < 0.5))[np.isfinite(height_m)].mean() < 0.02, (
        "the hole is filled with 900 m in the file, and casts shadows there"
    )


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize(
    ("units_per_metre", "attributes"),
    [
        (1.0 / 0.3048, {"units": "ft"}),
        (100.0, {"units": "cm"}),
        (-1.0, {"positive": "down"}),
        (-1.0, {"standard_name": "sea_floor_depth_below_geoid"}),
        (-1.0 / 1.8288, {"units": "fathoms", "positive": "down"}),
    ],
)
def test_unit_and_direction_apply_to_chunks_and_whole_arrays(height_m, units_per_metre, attributes):
    expected = heights(height_m).skugga.shadow(**SUN)
    array = heights(height_m.astype(np.float64) * units_per_metre).assign_attrs(attributes)
    full_result, chunked = array.skugga.shadow(**SUN), array.chunk({"y": 40, "x": 70}).skugga.shadow(**SUN).compute()
    xarray.testing.assert_equal(chunked, full_result)
    assert (full_result != expected).mean() < 0.001


@pytest.mark.parametrize("chunks", [None, 50])
def test_an_unknown_unit_of_an_array_is_refused_at_once(height_m, chunks):
    array = heights(height_m).assign_attrs(units="furlong")
    with pytest.raises(skugga.SkuggaError, match="units: 'furlong'.*fathom"):
        (array if chunks is None else array.chunk(chunks)).skugga.shadow(**SUN)


@pytest.mark.parametrize("word", ["left", "upward", 1])
@pytest.mark.parametrize("chunks", [None, 50])
def test_an_unknown_direction_of_an_array_is_refused(height_m, word, chunks):
    array = heights(height_m).assign_attrs(positive=word)
    with pytest.raises(skugga.SkuggaError, match=rf"^the array: positive: '{word}'.*up \(heights\) or down \(depths\)"):
        (array if chunks is None else array.chunk(chunks)).skugga.shadow(**SUN)


@pytest.mark.parametrize(("word", "sign"), [("UP", 1), (" Up ", 1), ("", 1), (None, 1), ("Down", -1), ("DOWN ", -1)])
def test_a_direction_of_an_array_may_have_any_case(height_m, word, sign):
    array = heights(sign * height_m).assign_attrs(positive=word)
    xarray.testing.assert_equal(array.skugga.shadow(**SUN), heights(height_m).skugga.shadow(**SUN))


def test_nodata_outside_the_dtype_is_ignored(height_m):
    array = heights(np.nan_to_num(height_m, nan=900.0).astype(np.int16))
    array_with_nodata = array.assign_attrs(_FillValue=np.nan)
    xarray.testing.assert_equal(array_with_nodata.skugga.shadow(**SUN), array.skugga.shadow(**SUN))


@pytest.mark.parametrize("chunks", [None, 32])
def test_a_collar_of_undeclared_nodata_warns_the_caller(height_m, chunks):
    heights = np.nan_to_num(height_m, nan=900.0)
    heights[:, :20] = -9999.0
    array = xarray.DataArray(heights, dims=("y", "x")).rio.write_crs("EPSG:32633").rio.write_transform(TRANSFORM)
    maybe_chunked = array if chunks is None else array.chunk(chunks)
    with caught_warnings() as caught:
        maybe_chunked.skugga.shadow(azimuth=250.0, altitude=12.0).compute(scheduler="synchronous")
    assert ["the array: " in (text := str(warning.message)) and "border is -9999" in text for warning in caught] == [True]
    if chunks is None:
        assert caught[0].filename == __file__


def test_a_like_raster_beyond_the_level_warns_the_caller(height_m, tmp_path):
    like = write_geotiff(tmp_path / "like.tif", np.zeros((90, 240), np.float32), "EPSG:32633", 500e3, 5200e3, 30.0)
    with skugga.open_heights(height_m, TRANSFORM, "EPSG:32633") as level, caught_warnings() as caught:
        level.shade("mask", **SUN, like=like)
    assert [("extends beyond the level" in str(warning.message), warning.filename) for warning in caught] == [(True, __file__)]
