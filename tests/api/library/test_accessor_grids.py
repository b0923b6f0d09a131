"""``da.skugga`` in one piece and in chunks, in several CRSs, and for each direction of rows and columns."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import rioxarray
import xarray
from affine import Affine
from pyproj import CRS, Geod, Transformer
from pyproj.crs import DerivedGeographicCRS, GeographicCRS
from pyproj.crs.coordinate_operation import RotatedLatitudeLongitudeConversion

import skugga
from tests.api.library.test_library import IGNORE_NOT_GEOREFERENCED
from tests.rasters import write_geotiff

ROTATED_TRANSFORM = Affine(30.0, 5.0, 500e3, 5.0, -30.0, 5200e3)

SUN = {"azimuth": 250.0, "altitude": 12.0}

GRIDS_BY_CRS = {
    "EPSG:4326": (10.0, 47.0, 1 / 3600), "EPSG:3035": (4321e3, 2700e3, 30.0), "EPSG:3031": (-100e3, -1500e3, 30.0),
    "EPSG:2056": (2600e3, 1200e3, 30.0), "EPSG:32633": (500e3, 5200e3, 30.0), "EPSG:3857": (1000e3, 6000e3, 30.0),
}  # fmt: skip
"""CRS -> west and north edge and cell size of a raster."""

PRODUCTS: dict[str, Callable[[xarray.DataArray], xarray.DataArray]] = {
    "shadow": lambda array: array.skugga.shadow(**SUN),
    "shadow of a time": lambda array: array.skugga.shadow(time="2024-03-21T15:00Z"),
    "hours": lambda array: array.skugga.sun_hours("2024-12-21", step_min=60.0),
    "first sun": lambda array: array.skugga.sun_hours("2024-12-21", step_min=60.0, quantity="first", clock="utc"),
    "sky view": lambda array: array.skugga.sky_view("tilted", azimuths=12),
    "horizons": lambda array: array.skugga.horizons(azimuths=12),
}


def hills() -> np.ndarray:
    """Return heights of hills in metres (90, 120) with a hole of NaN."""
    row, col = np.mgrid[:90, :120].astype(np.float32)
    height = 900 + 300 * np.sin(col / 9) * np.cos(row / 13)
    height[20:30, 50:70] = np.nan
    return height


def georeferenced_hills(crs: str) -> xarray.DataArray:
    """Return the hills as a DataArray on the grid of ``GRIDS_BY_CRS``."""
    west, north, cell = GRIDS_BY_CRS[crs]
    y, x = north - cell * (np.arange(90) + 0.5), west + cell * (np.arange(120) + 0.5)
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # CF cannot say all of EPSG:2056
        return xarray.DataArray(hills(), dims=("y", "x"), coords={"y": y, "x": x}).rio.write_crs(crs)


def assert_chunks_equal(product: str, lazy: xarray.DataArray, whole: xarray.DataArray) -> None:
    """Check that a result in chunks is that of the whole array.

    Horizons are computed in the plane that touches each block's centre. True north differs a little from block to block, so a ray
    may just meet a step, or just miss it.
    """
    if product not in ("sky view", "horizons"):
        xarray.testing.assert_equal(lazy, whole)
        return
    np.testing.assert_array_equal(np.isnan(lazy), np.isnan(whole))
    error, (mean, largest) = np.abs(lazy - whole), {"sky view": (1e-4, 0.01), "horizons": (0.02, 5.0)}[product]
    assert float(error.mean()) < mean and float(error.max()) < largest


@cache
def whole_result(product: str, crs: str) -> xarray.DataArray:
    """Return a product of the hills in one piece. Several tests compare with it."""
    return PRODUCTS[product](georeferenced_hills(crs))


PRODUCTS_BY_CRS: dict[str, list[str]] = {
    "EPSG:4326": list(PRODUCTS), "EPSG:3035": ["hours", "horizons"], "EPSG:3031": ["shadow of a time", "first sun"],
    "EPSG:2056": ["shadow", "sky view"], "EPSG:32633": ["shadow", "hours", "horizons"], "EPSG:3857": ["shadow", "first sun"],
}  # fmt: skip
"""Products that are compared in a CRS: all in degrees, and in each projection some of those that depend on it."""


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize(("crs", "product"), [(crs, product) for crs, names in PRODUCTS_BY_CRS.items() for product in names])
def test_chunks_equal_the_whole_in_any_crs(crs, product):
    full_result = whole_result(product, crs)
    assert full_result.rio.crs.to_string() == crs and full_result.notnull().any()
    lazy = PRODUCTS[product](georeferenced_hills(crs).chunk({"y": 40, "x": 70}))
    assert lazy.chunks is not None and lazy.chunks[-2:] == ((40, 40, 10), (70, 50)) and lazy.dtype == full_result.dtype
    assert_chunks_equal(product, lazy.compute(), full_result)


ROTATED_POLE = "+proj=ob_tran +o_proj=longlat +o_lat_p=39.25 +o_lon_p=0 +lon_0=18 +datum=WGS84"
ROTATED_POLE_CF = {
    "grid_mapping_name": "rotated_latitude_longitude", "grid_north_pole_latitude": 39.25, "grid_north_pole_longitude": -162.0,
}  # fmt: skip
"""The same CRS as PROJ's text and as the grid mapping of climate models (EURO-CORDEX)."""

ROTATED_WEST, ROTATED_NORTH = -5.0, 1.0


def hills_of_rotated_pole(y_dim: str = "y", x_dim: str = "x") -> xarray.DataArray:
    """Return the hills as a DataArray in degrees of a rotated pole, without a CRS."""
    y, x = ROTATED_NORTH - (np.arange(90) + 0.5) / 3600, ROTATED_WEST + (np.arange(120) + 0.5) / 3600
    return xarray.DataArray(hills(), dims=(y_dim, x_dim), coords={y_dim: y, x_dim: x})


def hills_of_climate_model() -> xarray.DataArray:
    """Return hills as xarray opens a file by the CF conventions: dimensions ``rlat``, ``rlon``, and a grid mapping."""
    array = hills_of_rotated_pole("rlat", "rlon").assign_coords(rotated_pole=xarray.DataArray(0, attrs=ROTATED_POLE_CF))
    array.encoding["grid_mapping"] = "rotated_pole"
    array.rlat.attrs = {"standard_name": "grid_latitude", "units": "degrees"}
    array.rlon.attrs = {"standard_name": "grid_longitude", "units": "degrees"}
    return array


ROTATED_POLES: dict[str, Callable[[], xarray.DataArray]] = {
    "PROJ": lambda: hills_of_rotated_pole().rio.write_crs(ROTATED_POLE),
    "WKT": lambda: hills_of_rotated_pole().rio.write_crs(DerivedGeographicCRS(
        GeographicCRS(), RotatedLatitudeLongitudeConversion(o_lat_p=39.25, o_lon_p=0, lon_0=18),
    ).to_wkt()),
    "CF": hills_of_climate_model,
}  # fmt: skip


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize(
    ("crs_form", "product"),
    [*(("PROJ", product) for product in PRODUCTS), *((form, name) for form in ("WKT", "CF") for name in ("shadow", "first sun"))],
)
def test_chunks_of_a_rotated_pole_equal_the_whole(crs_form, product):
    """All forms of the CRS give the same result."""
    array = ROTATED_POLES[crs_form]()
    full_result = PRODUCTS[product](array)
    assert full_result.dims[-2:] == array.dims and full_result.notnull().any()
    assert full_result.rio.crs == array.rio.crs
    lazy = PRODUCTS[product](array.chunk(dict(zip(array.dims, (40, 70), strict=True))))
    assert lazy.chunks is not None and lazy.chunks[-2:] == ((40, 40, 10), (70, 50))
    assert_chunks_equal(product, lazy.compute(), full_result)
    if crs_form != "PROJ":
        np.testing.assert_array_equal(full_result, PRODUCTS[product](ROTATED_POLES["PROJ"]()))


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize("crs_form", ROTATED_POLES)
def test_shadows_of_a_rotated_pole_follow_true_north(crs_form):
    """A tower's shadow runs away from the sun by the compass, which no row or column of the grid does here."""
    array = ROTATED_POLES[crs_form]()
    array = array.copy(data=np.zeros(array.shape, np.float32))
    row, col = 45, 60
    array[row, col] = 300.0
    shadow = array.skugga.shadow(azimuth=180.0, altitude=20.0)
    y, x = (array[dim].to_numpy() for dim in array.dims)
    to_degrees = Transformer.from_crs(CRS(ROTATED_POLE), "EPSG:4326", always_xy=True).transform
    rows, cols = np.nonzero(shadow.to_numpy())
    lon, lat = to_degrees(x[cols], y[rows])
    tower_lon, tower_lat = to_degrees(x[col], y[row])
    geod = Geod(ellps="WGS84")
    bearing, _, distance_m = geod.inv(*np.broadcast_arrays(tower_lon, tower_lat, lon, lat))
    assert abs(bearing[distance_m > 200.0].mean()) < 2.0
    grid_north, _, _ = geod.inv(tower_lon, tower_lat, *to_degrees(x[col], y[row] + 1e-3))
    assert abs(grid_north) > 5.0


@pytest.mark.parametrize("crs_form", ROTATED_POLES)
@pytest.mark.parametrize("chunks", [None, 50])
def test_the_horizon_of_a_rotated_pole_is_a_point_s(crs_form, chunks):
    array = ROTATED_POLES[crs_form]()
    x, y = ROTATED_WEST + 60.5 / 3600, ROTATED_NORTH - 40.5 / 3600
    horizon = (array if chunks is None else array.chunk(chunks)).skugga.horizon(x, y)
    transform = Affine(1 / 3600, 0.0, ROTATED_WEST, 0.0, -1 / 3600, ROTATED_NORTH)
    with skugga.open_heights(hills(), transform, ROTATED_POLE) as level:
        expected = level.horizon(x, y, crs=level.crs).elevation_deg
    np.testing.assert_allclose(horizon, expected, atol=1e-4)
    assert np.ptp(expected) > 1.0


@IGNORE_NOT_GEOREFERENCED
def test_a_geographic_file_in_chunks_equals_the_file(tmp_path):
    """``rioxarray.open_rasterio`` opens the chunked array."""
    raster = write_geotiff(tmp_path / "dem.tif", hills(), "EPSG:4326", 10.0, 47.0, 1 / 3600, nodata=float("nan"))
    chunked = rioxarray.open_rasterio(raster, masked=True, chunks={"y": 40, "x": 70}).squeeze()
    with skugga.open_level(raster) as level:
        np.testing.assert_array_equal(chunked.skugga.shadow(**SUN).compute(), level.shade("visibility", **SUN) < 0.5)
        hours = level.sun_hours("2024-12-21", step_min=60.0)
        np.testing.assert_array_equal(chunked.skugga.sun_hours("2024-12-21", step_min=60.0).compute(), hours)
        horizon = chunked.skugga.horizon(10.02, 46.99)
        np.testing.assert_array_equal(horizon, level.horizon(10.02, 46.99).elevation_deg)


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize(
    ("crs", "steps", "chunks"),
    [
        ("EPSG:4326", (-1, 1), {"y": 40, "x": 70}), ("EPSG:4326", (1, -1), None),
        ("EPSG:32633", (-1, -1), {"y": 40, "x": 70}), ("EPSG:32633", (1, -1), None),
    ],
)  # fmt: skip
def test_rows_and_columns_may_run_either_way(crs, steps, chunks):
    upright = georeferenced_hills(crs)
    flipped = upright.isel(y=slice(None, None, steps[0]), x=slice(None, None, steps[1]))
    for product in ("shadow", "hours", "sky view", "horizons"):
        answer = PRODUCTS[product](flipped if chunks is None else flipped.chunk(chunks)).compute()
        xarray.testing.assert_equal(answer.y, flipped.y)
        xarray.testing.assert_equal(answer.x, flipped.x)
        assert_chunks_equal(product, answer.sortby("x").sortby("y", ascending=False), whole_result(product, crs))


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize("chunks", [None, 50])
def test_horizons_have_azimuth_as_their_first_dimension(chunks):
    array = georeferenced_hills("EPSG:32633").transpose("x", "y")
    horizons = (array if chunks is None else array.chunk(chunks)).skugga.horizons(azimuths=8)
    assert horizons.dims == ("azimuth", "x", "y") and horizons.azimuth.to_numpy().tolist() == [45.0 * k for k in range(8)]
    assert horizons.name == "horizons" and horizons.rio.crs.to_epsg() == 32633 and horizons.dtype == np.float32
    transform = Affine(30.0, 0.0, 500e3, 0.0, -30.0, 5200e3)
    with skugga.open_heights(hills(), transform, "EPSG:32633") as level:
        error = np.abs(horizons.sel(azimuth=90.0).transpose("y", "x").to_numpy() - level.horizons(8)[2])
        assert np.nanmean(error) < 0.02 and np.nanpercentile(error, 99) < 0.1
        np.testing.assert_array_equal(np.isnan(horizons).all("azimuth").transpose("y", "x"), np.isnan(hills()))


@pytest.mark.parametrize("chunks", [None, 50])
@pytest.mark.parametrize(("fault", "text"), [("no CRS", "write_crs"), ("one row", "cell size")])
def test_horizons_need_a_grid_in_a_crs(fault, text, chunks):
    array = INVALID_ARRAYS[fault][0](georeferenced_hills("EPSG:32633"))
    array = array if chunks is None else array.chunk(chunks)
    for call in (array.skugga.sky_view, array.skugga.horizons):
        with pytest.raises(skugga.SkuggaError, match=text) as error:
            call()
        assert "\n" not in str(error.value)


def test_too_many_azimuths_are_refused():
    array = georeferenced_hills("EPSG:32633")
    for call in (array.skugga.sky_view, array.skugga.horizons):
        with pytest.raises(skugga.SkuggaError, match="azimuths: '100000' is not allowed. Allowed: .*360"):
            call(azimuths=100_000)


def test_cells_without_coordinates_use_the_geotransform(tmp_path):
    raster = write_geotiff(tmp_path / "dem.tif", hills(), "EPSG:32633", 500e3, 5200e3, 30.0)
    array_without_coordinates = rioxarray.open_rasterio(raster, masked=True, parse_coordinates=False).squeeze()
    assert "x" not in array_without_coordinates.coords
    np.testing.assert_array_equal(
        array_without_coordinates.skugga.shadow(**SUN), georeferenced_hills("EPSG:32633").skugga.shadow(**SUN)
    )


def test_the_answer_keeps_the_name_of_the_grid_mapping():
    array = georeferenced_hills("EPSG:32633").drop_vars("spatial_ref").rio.write_crs("EPSG:32633", grid_mapping_name="utm")
    assert array.skugga.shadow(**SUN).rio.crs.to_epsg() == 32633


INVALID_ARRAYS: dict[str, tuple[Callable[[xarray.DataArray], Any], str]] = {
    "no coordinates": (lambda array: array.drop_vars(["x", "y"]), "cells have no coordinates"),
    "one row": (lambda array: array[:1], "y: one coordinate gives no cell size"),
    "one column": (lambda array: array[:, 3:4], "x: one coordinate gives no cell size"),
    "uneven rows": (lambda array: array.isel(y=[*range(40), *range(41, 90)]), "y: uneven steps"),
    "the same row": (lambda array: array.assign_coords(y=np.zeros(90)), "y: uneven steps"),
    "no number": (lambda array: array.assign_coords(x=np.full(120, np.nan)), "x: coordinates"),
    "dates": (lambda array: array.assign_coords(x=np.arange(120).astype("datetime64[D]")), "x: coordinates"),
    "turned": (
        lambda array: array.drop_vars(["x", "y"]).rio.write_transform(ROTATED_TRANSFORM), "grid is rotated",
    ),
    "other dimensions": (lambda array: array.rename(x="lon", y="lat"), "set_spatial_dims"),
    "three dimensions": (lambda array: array.expand_dims("band"), "two, y and x"),
    "no cell": (lambda array: array[:0], "at least 1 x 1"),
    "words": (lambda array: array.astype(str), "real numbers"),
    "complex numbers": (lambda array: array.astype(complex), "real numbers"),
    "no CRS": (lambda array: array.drop_vars("spatial_ref"), "write_crs"),
}  # fmt: skip


@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("fault", INVALID_ARRAYS)
def test_arrays_on_no_regular_grid_are_refused_with_a_remedy(fault, chunked):
    change, expected_text = INVALID_ARRAYS[fault]
    array = change(georeferenced_hills("EPSG:32633"))
    with pytest.raises(skugga.SkuggaError, match=expected_text) as error:
        (array.chunk() if chunked else array).skugga.shadow(**SUN)
    assert "\n" not in str(error.value)


def test_an_array_too_large_for_memory_is_refused_unread():
    huge = np.broadcast_to(np.float32(0.0), (10**7, 10**7))
    small = georeferenced_hills("EPSG:32633").rio.write_transform(Affine(0.1, 0.0, 500e3, 0.0, -0.1, 5200e3))
    array = xarray.DataArray(huge, dims=("y", "x"), coords={"spatial_ref": small.spatial_ref})
    with pytest.raises(skugga.SkuggaError, match="GB.*chunks"):
        array.skugga.shadow(**SUN)


@IGNORE_NOT_GEOREFERENCED
@pytest.mark.parametrize("chunks", [None, 50])
def test_answers_have_the_order_of_the_arrays_dimensions(chunks):
    transposed = georeferenced_hills("EPSG:32633").transpose("x", "y")
    answer = (transposed if chunks is None else transposed.chunk(chunks)).skugga.shadow(**SUN)
    assert answer.dims == ("x", "y")
    np.testing.assert_array_equal(answer, georeferenced_hills("EPSG:32633").skugga.shadow(**SUN).to_numpy().T)


@pytest.mark.parametrize("chunks", [None, 50])
def test_a_crs_of_heights_alone_is_refused(chunks):
    heights = georeferenced_hills("EPSG:32633").rio.write_crs("EPSG:5773")
    with pytest.raises(skugga.SkuggaError, match="^crs: .*vertical CRS"):
        (heights if chunks is None else heights.chunk(chunks)).skugga.shadow(**SUN)
    with pytest.raises(skugga.SkuggaError, match="^crs: .*vertical CRS"):
        skugga.open_heights(hills(), Affine(30.0, 0.0, 500e3, 0.0, -30.0, 5200e3), "EPSG:5773")
