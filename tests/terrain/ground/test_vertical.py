"""Vertical references of rasters: units from band units and vertical CRSs, and depths, which grow downwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS

import skugga
from skugga.api.encoding import encode_geotiff
from skugga.api.products.product import RasterProfile
from skugga.terrain.errors import SourceError
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.vertical import UNIT_WORDS
from skugga.terrain.level.parts import METRES_PER_UNIT
from skugga.terrain.trees.canopy import Canopy
from tests.rasters import write_geotiff

UTM = "EPSG:32633"
ORIGIN_AND_CELL_M = (500e3, 5200e3, 10.0)

EXAMPLE_WORDS_OF_UNIT = {
    "m": ("m", "metre", "Meters", "m a.s.l.", "m (NAVD88)", "metres above sea level", "[m]"),
    "ft": ("ft", "Foot", "feet", "ft (EGM96)", "Foot_International", "international foot", "'", "\N{PRIME}"),
    "us-ft": ("us-ft", "Foot_US", "foot_us", "ftUS", "usft", "ft (US)", "US survey foot", "us_survey_feet", "[ft_us]"),
    "dm": ("dm", "decimetre", "Decimeters"),
    "cm": ("cm", "centimetres", "centimeter"),
    "mm": ("mm", "millimeters", "millimetre"),
    "km": ("km", "Kilometre", "kilometers"),
    "yd": ("yd", "yard", "Yards"),
    "fathom": ("fathom", "fathoms", "fath"),
}


def write_with_unit(path: Path, heights: np.ndarray, word: str, crs: str = UTM, **options) -> Path:
    """Write heights as a raster whose unit is ``word``, and return its path."""
    write_geotiff(path, heights, crs, *ORIGIN_AND_CELL_M, **options)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = (word,)
    return path


def write_with_depth(path: Path, depths: np.ndarray, crs: str, **options) -> Path:
    """Write depths as a raster, and return its path."""
    return write_geotiff(path, depths, crs, *ORIGIN_AND_CELL_M, **options)


def seamount_depths() -> np.ndarray:
    """Return depths: a plain at 100 m and a seamount up to 20 m below the surface."""
    depths = np.full((64, 128), 100.0, np.float32)
    depths[30:34, 70:74] = 20.0
    return depths


def shadow_mask(path: Path, **options) -> np.ndarray:
    """Return the shadow mask with the sun in the west, at an altitude where 80 m cast a shadow of 120 m, or 12 cells."""
    with skugga.open_level(path, **options) as level:
        return level.shade("mask", azimuth=270.0, altitude=float(np.degrees(np.arctan2(80.0, 120.0))))


@pytest.mark.parametrize(("unit", "word"), [(unit, word) for unit, words in EXAMPLE_WORDS_OF_UNIT.items() for word in words])
def test_unit_words_are_understood(tmp_path, unit, word):
    elevation = Elevation(str(write_with_unit(tmp_path / "dem.tif", np.full((4, 4), 2.0, np.float32), word)))
    assert (elevation.vertical.unit, elevation.vertical.unit_source) == (unit, "by its band")
    assert elevation.overview.lowest_ground_m == pytest.approx(2.0 * METRES_PER_UNIT[unit], rel=1e-6)


def test_every_unit_has_words():
    assert set(UNIT_WORDS.values()) == set(METRES_PER_UNIT)


@pytest.mark.parametrize("word", ["furlong", "degree", "m/s", "kPa", "metres below the sea", "%", "\N{DEGREE SIGN}"])
def test_unknown_unit_is_rejected_with_the_known_ones(tmp_path, word):
    path = write_with_unit(tmp_path / "dem.tif", np.full((4, 4), 2.0, np.float32), word)
    for reader in (Elevation, Canopy):
        with pytest.raises(SourceError) as caught:
            reader(str(path))
        message = str(caught.value)
        assert (
            all(name in message for name in ("dem.tif", f"unit {word} of its band", "us-ft", "fathom", "units=UNIT"))
            and "\n" not in message
        )
    assert Elevation(str(path), units="ft").overview.lowest_ground_m == pytest.approx(0.6096), "the level takes precedence"


@pytest.mark.parametrize("word", ["", "unknown", "1", "None"])
def test_empty_unit_words_mean_metres(tmp_path, word):
    elevation = Elevation(str(write_with_unit(tmp_path / "dem.tif", np.full((4, 4), 2.0, np.float32), word)))
    assert (elevation.vertical.unit, elevation.vertical.unit_source, elevation.overview.lowest_ground_m) == ("m", None, 2.0)


@pytest.mark.parametrize("version", ["1.0", "1.1"])
@pytest.mark.parametrize(
    ("vertical", "unit", "positive"),
    [
        (5703, "m", "up"), (6360, "us-ft", "up"), (8228, "ft", "up"), (5715, "m", "down"), (5831, "m", "down"),
        (6358, "us-ft", "down"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("horizontal", [32633, 4326])
def test_vertical_crs_gives_unit_and_direction(tmp_path, horizontal, vertical, unit, positive, version):
    """By default, GDAL does not report the vertical CRS of a GeoTIFF 1.0."""
    place = ORIGIN_AND_CELL_M if horizontal == 32633 else (15.0, 47.0, 1e-4)
    path = write_geotiff(
        tmp_path / "dem.tif", np.full((4, 4), 2.0, np.float32), f"EPSG:{horizontal}+{vertical}", *place, geotiff_version=version
    )
    elevation = Elevation(str(path))
    assert (elevation.vertical.unit, elevation.vertical.positive) == (unit, positive)
    sign = -1.0 if positive == "down" else 1.0
    assert elevation.overview.lowest_ground_m == pytest.approx(sign * 2.0 * METRES_PER_UNIT[unit], rel=1e-6)
    assert np.nanmax(elevation.overview.max_heights_m) == elevation.overview.lowest_ground_m


@pytest.mark.parametrize("crs", [f"{UTM}+5715", f"{UTM}+5831"])
def test_seamount_casts_its_shadow(tmp_path, crs):
    depths = seamount_depths()
    mask = shadow_mask(write_with_depth(tmp_path / "depths.tif", depths, crs))
    assert (mask[31:33, 75:85] == 0).all() and (mask[31:33, 86:] == 255).all() and (mask[:, :69] == 255).all()
    expected_mask = shadow_mask(write_with_depth(tmp_path / "heights.tif", -depths, UTM))
    np.testing.assert_array_equal(mask, expected_mask)


@pytest.mark.parametrize("crs", [f"{UTM}+5715", f"{UTM}+6360"])
def test_written_heights_are_metres_upwards(tmp_path, crs):
    """The output has neither depths nor feet, whatever the vertical CRS of its input."""
    path = write_with_depth(tmp_path / "dem.tif", seamount_depths(), crs)
    out = tmp_path / "height.tif"
    with skugga.open_level(path) as level:
        assert level.crs == CRS.from_user_input(UTM)
        out.write_bytes(
            encode_geotiff(level.render(layer="height", size=(128, 64)), level._scene.view("map", size=(128, 64)), RasterProfile())
        )
    original, rewritten = Elevation(str(path)), Elevation(str(out))
    assert rewritten.vertical.unit_source is None and rewritten.vertical.positive_source is None
    assert rewritten.overview.lowest_ground_m == pytest.approx(original.overview.lowest_ground_m, abs=1e-3)


def test_depths_in_feet_with_a_hole_equal_those_in_metres(tmp_path):
    """The file has a nodata value, so that a virtual raster replaces it."""
    depths = seamount_depths()
    depths[5:9, 5:9] = -1.0
    feet = np.where(depths < 0, -1.0, depths / METRES_PER_UNIT["us-ft"]).astype(np.float32)
    mask = shadow_mask(write_with_depth(tmp_path / "feet.tif", feet, f"{UTM}+6358"), nodata=-1.0)
    expected_mask = shadow_mask(write_with_depth(tmp_path / "metres.tif", depths, f"{UTM}+5715", nodata=-1.0))
    np.testing.assert_array_equal(mask, expected_mask)
    assert (mask[5:9, 5:9] == 128).all()


def test_level_overrides_direction_of_vertical_axis(tmp_path):
    depths = seamount_depths()
    mask = shadow_mask(write_with_depth(tmp_path / "depths.tif", depths, f"{UTM}+5715"))
    np.testing.assert_array_equal(mask, shadow_mask(write_with_depth(tmp_path / "plain.tif", depths, UTM), positive="down"))
    wrong_direction_raster = write_with_depth(tmp_path / "wrong.tif", -depths, f"{UTM}+5715")
    np.testing.assert_array_equal(mask, shadow_mask(wrong_direction_raster, positive="up"))


@pytest.mark.parametrize("tags", [{"positive": "down"}, {"standard_name": "sea_floor_depth_below_geoid"}])
@pytest.mark.parametrize("nodata", [None, -1.0])
def test_cf_attributes_declare_depths(tmp_path, tags, nodata):
    path = write_with_depth(tmp_path / "depths.tif", seamount_depths(), UTM)
    with rasterio.open(path, "r+") as dataset:
        dataset.update_tags(1, **tags)
    elevation = Elevation(str(path), nodata=nodata)
    assert elevation.vertical.positive_source == "by its band" and elevation.overview.lowest_ground_m == -100.0


@pytest.mark.parametrize("word", ["left", "upward", "1"])
def test_unknown_direction_is_rejected_with_the_remedy(tmp_path, word):
    path = write_with_depth(tmp_path / "depths.tif", seamount_depths(), UTM)
    with rasterio.open(path, "r+") as dataset:
        dataset.update_tags(1, positive=word)
    with pytest.raises(SourceError, match=f"direction {word} of its band .*positive=up.*depths, down"):
        Elevation(str(path))
    assert Elevation(str(path), positive="down").overview.lowest_ground_m == -100.0, "the level takes precedence"
    assert Canopy(str(path)).heights_m(0, 0, 1, 1) == 100.0, "canopies have one direction"


@pytest.mark.parametrize("word", ["DOWN", " Down"])
def test_direction_may_have_any_case(tmp_path, word):
    path = write_with_depth(tmp_path / "depths.tif", seamount_depths(), UTM)
    with rasterio.open(path, "r+") as dataset:
        dataset.update_tags(1, positive=word)
    assert Elevation(str(path)).overview.lowest_ground_m == -100.0


def test_arrays_of_heights_are_metres_whatever_their_crs():
    heights = -seamount_depths()
    for crs in (UTM, f"{UTM}+5715", f"{UTM}+6360"):
        with skugga.open_heights(heights, rasterio.Affine(10, 0, 500e3, 0, -10, 5200e3), crs) as level:
            mask = level.shade("mask", azimuth=270.0, altitude=float(np.degrees(np.arctan2(80.0, 120.0))))
        assert (mask[31:33, 75:85] == 0).all() and (mask[31:33, 86:] == 255).all(), crs


def test_unit_that_contradicts_the_crs_is_reported(tmp_path, make_scene):
    path = write_geotiff(tmp_path / "dem.tif", np.full((40, 40), 2.0, np.float32), f"{UTM}+6360", *ORIGIN_AND_CELL_M)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("m",)
    (warning,) = make_scene(path).warnings
    assert "heights in m (by its band)" in warning and "in us-ft by its CRS 'NAVD88 height (ftUS)'" in warning
    assert make_scene(path, terrain={"units": "us-ft"}).warnings == ()


def test_canopy_in_decimetres_has_heights_in_metres(tmp_path):
    raster = np.zeros((20, 20), np.float32)
    raster[10, 10] = 150.0
    canopy = Canopy(str(write_with_unit(tmp_path / "chm.tif", raster, "dm")))
    assert canopy.heights_m(0, 0, 20, 20).max() == 15.0
    feet = Canopy(str(write_geotiff(tmp_path / "feet.tif", raster, f"{UTM}+8228", *ORIGIN_AND_CELL_M)))
    assert feet.heights_m(0, 0, 20, 20).max() == pytest.approx(150.0 * 0.3048)
