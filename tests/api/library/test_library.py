"""The Python library: arrays, open levels, xarray."""

from __future__ import annotations

import threading
from datetime import date, datetime
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import pytest
import rasterio
import xarray
from affine import Affine
from PIL import Image

import skugga
from skugga.api.products.mask import MASK_SHADOW
from tests.rasters import write_geotiff

IGNORE_NOT_GEOREFERENCED = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
"""For chunks computed by several threads: rasterio silences this warning with ``warnings.catch_warnings``, which is not
thread-safe.
"""

CELL_M = 30.0
LOW_SUN = {"azimuth": 250.0, "altitude": 12.0}


@pytest.fixture(scope="module")
def height_m() -> np.ndarray:
    """Heights of hills (200, 300) with a hole of NaN."""
    row, col = np.mgrid[:200, :300].astype(np.float32)
    height = 900 + 300 * np.sin(col / 9) * np.cos(row / 13)
    height[20:30, 50:70] = np.nan
    return height


@pytest.fixture(scope="module")
def heights(height_m) -> xarray.DataArray:
    """The same heights as a DataArray in UTM."""
    y, x = 5200e3 - CELL_M * (np.arange(200) + 0.5), 500e3 + CELL_M * (np.arange(300) + 0.5)
    return xarray.DataArray(height_m, dims=("y", "x"), coords={"y": y, "x": x}).rio.write_crs("EPSG:32633")


def test_a_wall_shades_six_cells():
    """The wall is 90 m high and the sun in the west at a slope of 1:2. The shadow has 180 m, 6 cells of 30 m."""
    height_m = np.zeros((40, 200), np.float32)
    height_m[:, 100] = 90.0
    in_shadow = skugga.shadow(height_m, CELL_M, 270.0, float(np.degrees(np.arctan(0.5)) - 0.01))
    np.testing.assert_array_equal(np.flatnonzero(in_shadow[20]), np.arange(101, 107))
    assert in_shadow.dtype == np.bool_


def test_holes_have_no_shadow_and_night_shades_all_ground(height_m):
    in_shadow = skugga.shadow(height_m, CELL_M, 250.0, -1.0)
    np.testing.assert_array_equal(in_shadow, np.isfinite(height_m))
    assert not skugga.shadow(height_m, CELL_M, 250.0, 12.0)[~np.isfinite(height_m)].any()


def test_heights_that_are_no_grid_are_refused():
    with pytest.raises(ValueError, match=r"\(4,\)"):
        skugga.shadow(np.zeros(4), CELL_M, 0.0, 10.0)


def test_an_open_raster_is_shaded_and_drawn(gl, height_m, tmp_path):
    raster = write_geotiff(tmp_path / "hills.tif", height_m, "EPSG:32633", 500e3, 5200e3, CELL_M, nodata=float("nan"))
    with skugga.open_level(raster) as level, rasterio.open(raster) as dataset:
        assert (level.transform, level.shape, level.crs.to_epsg(), level.name) == (dataset.transform, dataset.shape, 32633, "hills")
        mask = level.shade(**LOW_SUN)
        assert mask.shape == level.shape and 0.1 < (mask == MASK_SHADOW).mean() < 0.7
        part = level.shade(bounds=(500e3, 5197e3, 503e3, 5200e3), **LOW_SUN)
        np.testing.assert_array_equal(part, mask[:100, :100])
        picture = level.render(size=(60, 40), **LOW_SUN)
        assert picture.shape == (40, 60, 4) and picture.dtype == np.uint8 and picture[..., :3].std() > 5
        shadows_by_time = [level.shade(time=time) for time in ("2024-03-21T16:00+01:00", np.datetime64("2024-03-21T15:00"))]
        np.testing.assert_array_equal(*shadows_by_time)
        np.testing.assert_array_equal(shadows_by_time[0], level.shade(time=datetime.fromisoformat("2024-03-21T15:00Z")))
        assert (shadows_by_time[0] != mask).any()


def test_a_film_is_an_iterator_of_pictures(gl, height_m):
    with skugga.open_heights(height_m, Affine(CELL_M, 0, 500e3, 0, -CELL_M, 5200e3), "EPSG:32633") as level:
        start, size = datetime.fromisoformat("2024-03-21T09:00:00+01:00"), (48, 32)
        pictures = list(level.film(start=start, end="2024-03-21T11:00:00+01:00", step="1h", size=size))
        assert [picture.shape for picture in pictures] == [(32, 48, 3)] * 3
        for number, picture in enumerate(pictures):
            expected_picture = level.render(time=start.replace(hour=9 + number), size=size)
            np.testing.assert_array_equal(picture, np.where(expected_picture[..., 3:] > 0, expected_picture[..., :3], picture))
        with pytest.raises(skugga.SkuggaError, match="step: missing"):  # before the first frame is drawn
            level.film(start=start, end=start)


def test_an_array_of_heights_is_a_level(height_m, tmp_path):
    with skugga.open_heights(height_m, Affine(CELL_M, 0, 500e3, 0, -CELL_M, 5200e3), "EPSG:32633") as level:
        visibility = level.shade("visibility", **LOW_SUN)
    np.testing.assert_array_equal(np.isnan(visibility), np.isnan(height_m))
    flat_world = skugga.shadow(height_m, CELL_M, 250.0, 12.0)  # on the globe the direction of north varies, and the ground curves
    assert ((visibility == 0.0) != flat_world).mean() < 0.01


@pytest.mark.parametrize(
    ("call", "expected_texts"),
    [
        (lambda: skugga.open_level("nowhere.tif"), ("LEVEL", "nowhere.tif")),
        (lambda: skugga.open_level("jacksboro").shade("depth"), ("layer", "depth", "mask")),
        (lambda: skugga.open_level("jacksboro").shade(time="2024-02-30T00:00Z"), ("time", "2024-02-30")),
        (lambda: skugga.open_level("jacksboro").shade(azimuth=10.0), ("altitude",)),
    ],
)
def test_wrong_input_is_an_error_that_names_it(call, expected_texts):
    with pytest.raises(skugga.SkuggaError) as error:
        call()
    for text in expected_texts:
        assert text in str(error.value)


def test_the_accessor_keeps_coordinates_and_equals_the_level(heights, height_m):
    in_shadow = heights.skugga.shadow(**LOW_SUN)
    assert in_shadow.dtype == np.bool_ and in_shadow.dims == ("y", "x") and in_shadow.rio.crs.to_epsg() == 32633
    xarray.testing.assert_equal(in_shadow.x, heights.x)
    with skugga.open_heights(height_m, heights.rio.transform(), "EPSG:32633") as level:
        np.testing.assert_array_equal(in_shadow, level.shade(**LOW_SUN) == MASK_SHADOW)


def test_row_order_and_dimension_order_do_not_matter(heights):
    in_shadow = heights.skugga.shadow(**LOW_SUN)
    southern_first = heights.isel(y=slice(None, None, -1)).skugga.shadow(**LOW_SUN)
    assert float(southern_first.y[0]) < float(southern_first.y[-1])
    xarray.testing.assert_equal(southern_first.isel(y=slice(None, None, -1)), in_shadow)
    xarray.testing.assert_equal(heights.T.skugga.shadow(**LOW_SUN), in_shadow.T)


@IGNORE_NOT_GEOREFERENCED
def test_chunks_are_computed_lazily_and_equal_the_whole(heights):
    """Shadows fall from one chunk on another. Only requested chunks are computed, and none before the request."""
    read_chunk_shapes, lock = [], threading.Lock()

    def record_read(chunk: np.ndarray) -> np.ndarray:
        with lock:
            read_chunk_shapes.append(chunk.shape)
        return chunk

    chunked = heights.chunk({"y": 70, "x": 110})
    chunked = chunked.copy(data=chunked.data.map_blocks(record_read, dtype=np.float32, meta=np.empty((0, 0), np.float32)))
    lazy = chunked.skugga.shadow(**LOW_SUN)
    assert lazy.chunks == chunked.chunks and not read_chunk_shapes
    xarray.testing.assert_equal(lazy.compute(), heights.skugga.shadow(**LOW_SUN))
    assert len(read_chunk_shapes) == 9, "each chunk is read once"
    np.testing.assert_array_equal(lazy[80:90, 120:130].compute(), heights.skugga.shadow(**LOW_SUN)[80:90, 120:130])


@IGNORE_NOT_GEOREFERENCED
def test_sun_hours_are_equal_through_every_interface(heights, height_m):
    """The interfaces are an array with a latitude, an open level, and the accessor, in one piece or in chunks."""
    hours = heights.skugga.sun_hours("2024-12-21", step_min=30.0)
    assert hours.dtype == np.float32 and 0.0 <= float(hours.min()) < 4.0 < float(hours.max()) < 9.0
    np.testing.assert_array_equal(np.isnan(hours), np.isnan(height_m))
    xarray.testing.assert_equal(heights.chunk({"y": 120, "x": 200}).skugga.sun_hours("2024-12-21", step_min=30.0).compute(), hours)
    with skugga.open_heights(height_m, heights.rio.transform(), "EPSG:32633") as level:
        level_hours = level.sun_hours(date(2024, 12, 21), step_min=30.0)
        first = level.sun_hours("2024-12-21", quantity="first", step_min=30.0)
        with pytest.raises(skugga.SkuggaError, match="quantity"):
            level.sun_hours("2024-12-21", quantity="hour")
        with pytest.raises(skugga.SkuggaError, match="2023-02-29"):
            level.sun_hours("2023-02-29")
    np.testing.assert_array_equal(level_hours, hours)
    assert 6 * 60 < np.nanmin(first) < 9 * 60
    array_hours = skugga.sun_hours(height_m, CELL_M, "2024-12-21", 46.9, 15.0, step_min=30.0)
    np.testing.assert_array_equal(np.isnan(array_hours), np.isnan(height_m))
    assert np.nanmean(np.abs(array_hours - hours.to_numpy())) < 0.1  # north of another grid, and the sun of another place


def test_point_and_horizon_agree_with_the_accessor(heights, height_m):
    with skugga.open_heights(height_m, heights.rio.transform(), "EPSG:32633") as level:
        x, y = float(heights.x[100]), float(heights.y[150])
        report = level.point(x, y, crs=level.crs, time="2024-12-21T09:00:00+01:00", height=2.0)
        assert report.day is not None and 0.0 <= report.day.direct_h < report.day.daylight_h < 9.0
        assert report.elevation_m == pytest.approx(height_m[150, 100], abs=0.01)
        horizon_profile = level.horizon(x, y, crs=level.crs, height=2.0)
    horizon = heights.skugga.horizon(x, y, height=2.0)
    assert horizon.dims == ("azimuth",) and horizon.sizes["azimuth"] == 720
    np.testing.assert_array_equal(horizon, horizon_profile.elevation_deg)
    assert float(horizon.max()) > 5.0


def test_the_accessor_refuses_invalid_arrays(heights):
    with pytest.raises(skugga.SkuggaError, match="write_crs"):
        heights.drop_vars("spatial_ref").skugga.shadow(**LOW_SUN)
    with pytest.raises(skugga.SkuggaError, match="time"):
        heights.skugga.shadow()
    with pytest.raises(ValueError, match="two, y and x"):
        heights.expand_dims("band").skugga.shadow(**LOW_SUN)


@pytest.mark.long
def test_the_layer_of_a_map_has_the_options_of_its_level(tmp_path):
    """The undeclared nodata of the raster's eastern half is no ground in the layer either."""
    heights = np.full((61, 61), 900.0, np.float32)
    heights[:, 30:] = -9999.0
    zoom, col, row, side_m = 13, 4436, 2884, 2 * np.pi * 6378137.0 / 2**13
    west, north = (col - 2**12) * side_m + 1500.0, (2**12 - row) * side_m - 1500.0
    raster = write_geotiff(tmp_path / "undeclared.tif", heights, "EPSG:3857", west, north, 30.0)
    with skugga.open_level(raster, nodata=-9999.0) as level:
        with urlopen(level.as_leaflet_layer().url.format(z=zoom, x=col, y=row)) as answer:
            alpha = np.asarray(Image.open(answer).convert("RGBA"))[..., 3]
    rows, cols = ((alpha > 0).any(axis=axis).sum() for axis in (1, 0))
    assert 0.4 < cols / rows < 0.6


def test_a_level_is_a_layer_of_a_notebook_s_map(height_m):
    """The layer uses its own service, which ends with the level."""
    import ipyleaflet

    with skugga.open_heights(height_m, Affine(CELL_M, 0, 500e3, 0, -CELL_M, 5200e3), "EPSG:32633") as level:
        map_widget = ipyleaflet.Map()
        map_widget.add(level)
        layer = map_widget.layers[-1]
        assert layer.min_zoom <= layer.max_native_zoom < layer.max_zoom
        x, y = mercator_tile(15.02, 46.94, layer.max_native_zoom)
        address = layer.url.format(z=layer.max_native_zoom, x=x, y=y)
        with urlopen(address) as answer:
            tile = np.asarray(Image.open(answer))
        assert tile.shape[:2] == (256, 256) and tile[..., :3].std() > 5
        low_sun_url = level.as_leaflet_layer("mask", azimuth=250.0, altitude=12.0).url
        with urlopen(low_sun_url.format(z=layer.max_native_zoom, x=x, y=y)) as answer:
            assert 0.1 < (np.asarray(Image.open(answer)) == MASK_SHADOW).mean() < 0.9
        with pytest.raises(skugga.SkuggaError, match="layer"):
            level.as_leaflet_layer("depth")
    with pytest.raises(URLError):
        urlopen(address)


def mercator_tile(lon_deg: float, lat_deg: float, zoom: int) -> tuple[int, int]:
    """Return column and row of the tile at a place."""
    y = np.arcsinh(np.tan(np.radians(lat_deg))) / np.pi
    return int((lon_deg + 180.0) / 360.0 * 2**zoom), int((1.0 - y) / 2.0 * 2**zoom)
