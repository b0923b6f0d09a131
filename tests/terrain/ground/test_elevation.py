"""Heights from rasters: interpolation, units, holes, windows, and rejected input."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.terrain.errors import SourceError
from skugga.terrain.ground import elevation as module
from skugga.terrain.ground.elevation import MAX_FILL_CELLS, Elevation
from tests.rasters import ENGINEERING

UTM = "EPSG:32633"


def heights_at(elevation: Elevation, row, col, level: int = 0):
    """Return heights and validity at fractional rows and columns of an overview level (0: the raster itself)."""
    row, col = np.broadcast_arrays(np.atleast_2d(row).astype(float), np.atleast_2d(col).astype(float))
    return elevation.heights_at(level, row, col)


def test_heights_are_bilinear_and_clamped_at_the_border(write_raster):
    values = np.array([[0, 10], [20, 50]], np.float32)
    elevation = Elevation(str(write_raster(values, UTM, 0, 20, 10)))
    height, valid = heights_at(elevation, [[0, 0.5, 1, -0.5, -0.6]], [[0, 0.5, 0.25, 1.5, 0]])
    np.testing.assert_allclose(height[0, :4], [0, 20, 27.5, 10])
    assert np.isnan(height[0, 4]) and valid.tolist() == [[True, True, True, True, False]]


def test_windows_agree_with_the_whole_raster(write_raster):
    values = np.random.default_rng(0).normal(size=(150, 170)).astype(np.float32)
    values[60:90, 50:120] = np.nan  # filled from its rim, equal in every window
    elevation = Elevation(str(write_raster(values, UTM, 0, 1500, 10)))
    col, row = np.meshgrid(np.arange(0, 169, 0.7), np.arange(0, 149, 0.7))
    full_heights, _ = elevation.heights_at(0, row, col)
    window_heights, _ = elevation.heights_at(0, row[80:140, 60:200], col[80:140, 60:200])
    np.testing.assert_array_equal(full_heights[80:140, 60:200], window_heights)


def test_coarse_cells_are_means_counted_from_the_corner(write_raster):
    values = np.arange(64 * 64, dtype=np.float32).reshape(64, 64)
    elevation = Elevation(str(write_raster(values, UTM, 0, 640, 10)))
    mean = values.reshape(16, 4, 16, 4).mean(axis=(1, 3))
    centre = np.arange(16) * 4 + 1.5
    col, row = np.meshgrid(centre, centre)
    full_heights, _ = elevation.heights_at(2, row, col)
    np.testing.assert_allclose(full_heights, mean, rtol=1e-6)
    window_heights, _ = elevation.heights_at(2, row[5:7, 9:11], col[5:7, 9:11])
    np.testing.assert_array_equal(window_heights, full_heights[5:7, 9:11])


@pytest.mark.parametrize("sentinel", [-9999.0, 3.4e38, -32768.0, np.nan, np.inf, -np.inf])
def test_holes_are_invalid_and_neither_walls_nor_pits(write_raster, sentinel):
    values = np.full((60, 60), 100.0, np.float32)
    values[20:40, 20:40] = sentinel
    is_declared = sentinel == -9999.0
    elevation = Elevation(str(write_raster(values, UTM, 0, 600, 10, nodata=sentinel if is_declared else None)))
    col, row = np.meshgrid(np.arange(60.0), np.arange(60.0))
    height, valid = elevation.heights_at(0, row, col)
    np.testing.assert_allclose(height, 100.0)
    assert (~valid).sum() == 400 and not valid[20:40, 20:40].any()
    coarse_heights, _ = elevation.heights_at(2, row, col)
    np.testing.assert_allclose(coarse_heights[np.isfinite(coarse_heights)], 100.0)


def test_centre_of_a_large_hole_is_not_filled(write_raster):
    values = np.full((30, 400), 7.0, np.float32)
    values[:, 50:350] = np.nan
    elevation = Elevation(str(write_raster(values, UTM, 0, 300, 10)))
    height, valid = heights_at(elevation, 15, np.arange(400))
    assert np.isnan(height[0, 50 + MAX_FILL_CELLS + 2 : 350 - MAX_FILL_CELLS - 2]).all()
    assert np.isfinite(height[0, :52]).all() and not valid[0, 50:350].any()


def test_hole_in_a_slope_is_filled_between_its_rims(write_raster):
    values = np.tile(np.arange(40, dtype=np.float32) * 10, (40, 1))
    values[15:25, 15:25] = np.nan
    elevation = Elevation(str(write_raster(values, UTM, 0, 400, 10)))
    height, _ = heights_at(elevation, np.arange(15, 25)[:, None], np.arange(15, 25)[None, :])
    assert height.min() >= 140 - 1e-3 and height.max() <= 250 + 1e-3


@pytest.mark.parametrize(
    ("keys", "factor"),
    [
        ({}, 1.0),
        ({"units": "ft"}, 0.3048),
        ({"units": "us-ft"}, 1200 / 3937),
        ({"units": "ft", "exaggeration": 2.0}, 0.6096),
    ],
)
def test_units_and_exaggeration(write_raster, keys, factor):
    elevation = Elevation(str(write_raster(np.full((3, 3), 1000, np.int16), UTM, 0, 30, 10)), **keys)
    assert heights_at(elevation, 1, 1)[0][0, 0] == pytest.approx(1000 * factor)


def test_unit_of_the_raster_is_the_default(write_raster):
    path = write_raster(np.full((3, 3), 1000, np.int16), UTM, 0, 30, 10)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("ft",)
    assert heights_at(Elevation(str(path)), 1, 1)[0][0, 0] == pytest.approx(304.8)


def test_first_band_is_used(write_raster):
    bands = np.stack([np.full((4, 4), v, np.float32) for v in (5, 6, 7)])
    assert heights_at(Elevation(str(write_raster(bands, UTM, 0, 40, 10))), 1, 1)[0][0, 0] == 5


def test_global_raster_has_no_border_at_its_seam(write_raster):
    values = np.broadcast_to(np.cos(np.radians(np.arange(-179.5, 180))) * 100, (180, 360)).astype(np.float32)
    elevation = Elevation(str(write_raster(values, "EPSG:4326", -180, 90, 1.0)))
    height, valid = heights_at(elevation, 90, np.array([-1.0, -0.5, 359.5, 360.0]))
    np.testing.assert_allclose(height[0], [values[0, 359], values[0, 359], values[0, 0], values[0, 0]], atol=0.02)
    assert valid.all()


@pytest.mark.parametrize("hole_cols", [8, 40, 200])
def test_hole_across_the_seam_of_a_global_raster_is_filled(write_raster, hole_cols):
    """The same cells start at another meridian: the hole lies across the seam in one file and in the middle of the other."""
    values = np.random.default_rng(4).normal(500, 200, (128, 256)).astype(np.float32)
    values[40:90, np.arange(-hole_cols // 2, hole_cols // 2)] = np.nan
    seam_elevation = Elevation(str(write_raster(values, "EPSG:4326", -180, 90, 360 / 256, name="across.tif")))
    inner_elevation = Elevation(str(write_raster(np.roll(values, 128, axis=1), "EPSG:4326", 0, 90, 360 / 256, name="within.tif")))
    for level in (0, 1, 2):
        for first, last in ((-20, 20), (236, 276), (0, 30), (230, 255.5), (-128, 128), (0, 255.5)):
            row, col = np.meshgrid(np.arange(0, 127, 0.5), np.arange(first, last, 0.5), indexing="ij")
            heights, valid = seam_elevation.heights_at(level, row, col)
            expected, expected_valid = inner_elevation.heights_at(level, row, (col + 128) % 256)
            np.testing.assert_array_equal(heights, expected)
            np.testing.assert_array_equal(valid, expected_valid)
            assert np.isfinite(heights[~valid]).any(), "some of the hole is filled"


def test_global_raster_without_its_last_column_has_a_hole(write_raster):
    values = np.broadcast_to(np.arange(359, dtype=np.float32) * 10, (20, 359))
    elevation = Elevation(str(write_raster(values, "EPSG:4326", -180, 10, 1.0)))
    for first, last in ((0, 359), (350, 359), (355, 365), (-5, 5)):
        col = np.arange(first, last)
        height, valid = heights_at(elevation, 5, col)
        has_data = col % 360 < 359
        np.testing.assert_array_equal(height[0, has_data], 10.0 * (col % 360)[has_data])
        np.testing.assert_array_equal(valid[0], has_data)
        assert (height[0, ~has_data] == 3580 / 2).all(), "filled between its rims"


@pytest.mark.parametrize("level", range(7))
def test_coarse_global_raster_is_periodic_with_a_partial_cell(write_raster, level):
    """360 columns are 22.5 cells of 16.

    Heights repeat every 360 degrees, and errors at the seam are at most 1.5 times those elsewhere.
    """
    longitude = np.radians(np.arange(360.0))
    values = np.broadcast_to((1000 * np.cos(longitude) + 500 * np.sin(2 * longitude)).astype(np.float32), (180, 360))
    elevation = Elevation(str(write_raster(values, "EPSG:4326", 0, 90, 1.0)))
    col = np.arange(0, 360.0)
    height, valid = heights_at(elevation, 90, col, level)
    for revolutions in (-2, -1, 1):
        other, is_valid = heights_at(elevation, 90, col + 360 * revolutions, level)
        np.testing.assert_allclose(other, height, atol=1e-3)
        assert is_valid.all()
    assert valid.all()
    error_m = np.abs(height[0] - values[0])
    at_seam = (col < 2**level) | (col > 360 - 2 * 2**level)
    assert error_m[at_seam].max() <= max(1.5 * error_m[~at_seam].max(initial=0.0), 1e-3)


def test_overview_contains_the_highest_cell(write_raster):
    values = np.zeros((1100, 1300), np.float32)
    values[777, 555] = 3000.0
    elevation = Elevation(str(write_raster(values, UTM, 0, 11000, 10)))
    assert elevation.overview.lod == 2 and np.nanmax(elevation.overview.max_heights_m) == 3000.0


def test_ground_m_is_bilinear_and_nan_off_the_surface(write_raster):
    values = np.tile(np.arange(40, dtype=np.float32) * 10, (40, 1))
    values[15:25, 15:25] = np.nan
    elevation = Elevation(str(write_raster(values, UTM, 1000, 400, 10)))
    x, y = np.array([[1005.0, 1047.5], [1200.0, 900.0], [np.nan, 1399.9]]), np.array([[395.0, 5.0], [200.0, 5.0], [5.0, 0.1]])
    ground_m, filled_m = elevation.ground_m(x, y), elevation.filled_ground_m(x, y)
    np.testing.assert_allclose(ground_m, [[0.0, 42.5], [np.nan, np.nan], [np.nan, 390.0]], atol=1e-4)
    assert ground_m.dtype == filled_m.dtype == np.float64
    assert 140 < filled_m[1, 0] < 250, "a hole between 140 m and 250 m"
    np.testing.assert_array_equal(np.delete(filled_m.ravel(), 2), np.delete(ground_m.ravel(), 2))
    assert elevation.ground_m(np.float64(1005), np.float64(395)).shape == () and elevation.ground_m([], []).shape == (0,)


@pytest.mark.parametrize("crs", [UTM, "EPSG:4326"])
def test_ground_m_does_not_depend_on_block_size(write_raster, monkeypatch, crs):
    """In degrees, the points go around the whole earth and the raster covers half of it."""
    rng = np.random.default_rng(1)
    values = rng.normal(size=(90, 180)).astype(np.float32)
    values[30:50, 60:100] = np.nan
    elevation = Elevation(str(write_raster(values, crs, -180, 45, 1.0)))
    x, y = rng.uniform(-190, 350, 500), rng.uniform(-46, 46, 500)
    expected = elevation.ground_m(x, y), elevation.filled_ground_m(x, y)
    assert np.isnan(expected[0]).sum() > np.isnan(expected[1]).sum() > 0
    monkeypatch.setattr(module, "READ_BLOCK_SIDE_CELLS", 7)
    np.testing.assert_array_equal((elevation.ground_m(x, y), elevation.filled_ground_m(x, y)), expected)


def test_two_distant_points_do_not_load_the_cells_between(write_raster, monkeypatch):
    elevation = Elevation(str(write_raster(np.ones((3000, 3000), np.float32), UTM, 0, 30000, 10, tiled=True)))
    read_windows = []
    inside = elevation._read_inside
    monkeypatch.setattr(elevation, "_read_inside", lambda *window: read_windows.append(inside(*window)) or read_windows[-1])
    np.testing.assert_array_equal(elevation.ground_m([5.0, 29995.0], [29995.0, 5.0]), 1.0)
    assert sum(window.size for window in read_windows) < 100


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 3))
@settings(max_examples=25, deadline=None)
def test_any_shape_can_be_read_at_any_level(tmp_path_factory, rows, cols, level):
    path = tmp_path_factory.mktemp("r") / "dem.tif"
    values = np.arange(rows * cols, dtype=np.float32).reshape(rows, cols)
    with rasterio.open(
        path, "w", driver="GTiff", width=cols, height=rows, count=1, dtype="float32", crs=UTM,
        transform=rasterio.Affine(10, 0, 0, 0, -10, 0),
    ) as dataset:  # fmt: skip
        dataset.write(values, 1)
    height, valid = heights_at(Elevation(str(path)), (min(rows, 2**level) - 1) / 2, (min(cols, 2**level) - 1) / 2, level)
    assert valid.all() and values.min() <= height[0, 0] <= values.max()


def test_unusable_rasters_are_rejected_with_their_name(tmp_path, write_raster):
    text = tmp_path / "broken.tif"
    text.write_text("this is no raster")
    no_crs = tmp_path / "no_crs.tif"
    with rasterio.open(
        no_crs,
        "w",
        driver="GTiff",
        width=3,
        height=3,
        count=1,
        dtype="float32",
        transform=rasterio.Affine(2, 0, 0, 0, -2, 0),
    ) as dataset:
        dataset.write(np.ones((1, 3, 3), np.float32))
    empty = write_raster(np.full((5, 5), -9999, np.float32), UTM, 0, 5, 1, name="empty.tif", nodata=-9999)
    nans = write_raster(np.full((5, 5), np.nan, np.float32), UTM, 0, 5, 1, name="nans.tif")
    complex_ = write_raster(np.ones((5, 5), np.complex64), UTM, 0, 5, 1, name="complex.tif")
    for path, words in (
        (tmp_path / "absent.tif", "raster that GDAL reads"),
        (text, "raster that GDAL reads"),
        (no_crs, "a raster with a CRS"),
        (empty, "all nodata"),
        (nans, "all nodata"),
        (complex_, "real numbers"),
    ):
        with pytest.raises(SourceError) as caught:
            Elevation(str(path))
        assert words in str(caught.value) and path.name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("kept_share", [0.3, 0.9])
def test_damaged_raster_fails_with_one_line(write_raster, kept_share):
    values = np.random.default_rng(0).normal(size=(400, 400)).astype(np.float32)
    path = write_raster(values, UTM, 0, 4000, 10, compress="deflate", tiled=True, blockxsize=128, blockysize=128)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept_share)])
    with pytest.raises(SourceError) as caught:
        heights_at(Elevation(str(path)), np.arange(400)[:, None], np.arange(400)[None, :])
    assert path.name in str(caught.value) and "\n" not in str(caught.value)


def test_engineering_crs_is_flat(write_raster):
    assert Elevation(str(write_raster(np.ones((3, 3), np.float32), ENGINEERING, 0, 3, 1))).flat


REAL_RASTERS = {
    # file: share of valid cells, lowest and highest height in metres, from SOURCES.md or gdalinfo
    "mountain/bigtujunga_30m_utm11.tif": (1.0, 315, 2295),
    "mountain/zion_srtm_4326.tif": (1.0, 1000, 2900),
    "odd/vanderford_64m_epsg3031.tif": (0.07, -2340, -19),
    "odd/nz_elev_1km_oceanholes.tif": (0.17, 0, 4141),
    "large/globe_30arcsec_himalaya_4326.tif": (1.0, 0, 8752),
}


@pytest.mark.parametrize("name", REAL_RASTERS)
def test_real_rasters_have_their_heights(shared_data, name):
    share, low, high = REAL_RASTERS[name]
    overview = Elevation(str(shared_data / name)).overview
    assert np.isfinite(overview.mean_heights_m).mean() == pytest.approx(share, abs=0.02)
    assert low - 1 <= np.nanmin(overview.mean_heights_m) and np.nanmax(overview.max_heights_m) <= high + 1
    assert np.nanmax(overview.max_heights_m) >= high * 0.9 - 10 if high > 0 else True


def test_raster_that_reaches_the_pole_has_a_positive_cell_size(write_raster):
    elevation = Elevation(str(write_raster(np.ones((4, 8), np.float32), "EPSG:4326", 10, 90, 0.015)))
    assert elevation.cell_size_m(1.0) > 10.0


@pytest.mark.parametrize(("latitude", "share"), [(0.0, 1.0), (60.0, 0.5)])
def test_cell_size_is_measured_on_the_ground(write_raster, latitude, share):
    """Web Mercator stretches cells by one over the cosine of the latitude."""
    north = 6378137.0 * np.arctanh(np.sin(np.radians(latitude)))
    elevation = Elevation(str(write_raster(np.ones((9, 9), np.float32), "EPSG:3857", 0.0, north + 135.0, 30.0)))
    assert elevation.cell_size_m(1.0) == pytest.approx(30.0 * share, rel=0.005)


def test_geocentric_raster_is_rejected(write_raster):
    with pytest.raises(SourceError, match="projected, geographic or engineering"):
        Elevation(str(write_raster(np.ones((4, 4), np.float32), "EPSG:4978", 0, 4, 1)))


def test_resolution_limits_the_level_of_detail(write_raster, make_scene):
    values = np.zeros((64, 64), np.float32)
    values[32, 32] = 100.0
    path = write_raster(values, UTM, 500_000, 5_000_640, 10)
    highest = []
    for keys in ({}, {"resolution": 40}):
        scene = make_scene(path, terrain=keys)
        view = scene.view(size=(64, 64))
        height, _ = scene.surface(view.grid).heights(int(view.row0), int(view.col0), 90, 90)
        highest.append(np.nanmax(height))
    assert highest[0] > 60 and highest[1] < 15


@pytest.mark.parametrize("nodata", [None, -9999.0])
def test_undeclared_sentinel_is_not_averaged_into_heights(write_raster, nodata):
    """A single cell that no sample of the raster would find, next to declared or undeclared holes."""
    heights = np.full((1100, 1100), 100.0, np.float32)
    heights[333, 777] = -32768.0
    heights[5:9, 5:9] = -9999.0 if nodata else 100.0
    elevation = Elevation(str(write_raster(heights, "EPSG:32633", 500_000, 5_300_000, 10.0, nodata=nodata)))
    for level in (1, 2, 3):
        read_heights, valid = elevation.heights_at(level, np.array([[333.0, 330.0]]), np.array([[777.0, 770.0]]))
        assert valid[0, 1] and np.allclose(read_heights[valid], 100.0)
    lowest = np.nanmin(elevation.overview.mean_heights_m)
    assert lowest == np.nanmax(elevation.overview.max_heights_m) == 100.0
