"""The products ``sky_view`` and ``horizon``: options, form of their rasters, colours, and what is refused."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from affine import Affine

import skugga
from skugga.api.products import MAP_PRODUCTS, PRODUCTS, RASTER_PRODUCTS
from skugga.api.products.horizon import STORED_NODATA
from skugga.api.products.sky_view import TILE_AZIMUTHS
from skugga.api.raster_file import MAX_TILE_BYTES, TILE_SIDE_CELLS, tile_side_cells
from skugga.shadows.horizons.azimuths import SKY_VIEW_KINDS, SkyViewKind
from skugga.terrain.errors import InputError

CELL_M = 30.0
TRANSFORM = Affine(CELL_M, 0.0, 500e3, 0.0, -CELL_M, 5_200e3)
SKY_VIEW, HORIZON = PRODUCTS["sky_view"], PRODUCTS["horizon"]


@pytest.fixture
def wall_level():
    """A plain of 21 x 25 cells with a wall of 60 m in the column 15, and no ground in the column 0."""
    heights = np.zeros((21, 25))
    heights[:, 15] = 60.0
    heights[:, 0] = np.nan
    with skugga.open_heights(heights, TRANSFORM, "EPSG:32633") as level:
        yield level


def test_stored_horizons_are_rounded_and_not_negative(wall_level):
    angle_deg = wall_level.compute("horizon", azimuths=8, dtype="float32")
    stored = wall_level.compute("horizon", azimuths=8)
    assert angle_deg.dtype == np.float32 and stored.dtype == np.uint16 and stored.shape == angle_deg.shape == (21, 25, 8)
    valid = np.isfinite(angle_deg)
    np.testing.assert_array_equal(stored == STORED_NODATA, ~valid)
    assert valid[:, 1:].all() and not valid[:, 0].any()
    np.testing.assert_allclose(stored[valid] * 0.01, np.maximum(angle_deg[valid], 0.0), atol=0.00501)
    assert angle_deg[10, 15].min() < 0.0, "the top of the wall looks down"
    assert abs(angle_deg[0, 5, 0]) < 0.01, "the ground extends by a cell beyond the first row"


def test_bands_are_azimuths_clockwise_from_north(wall_level):
    """The wall lies ten cells to the east: 60 m in 300 m. UTM's north is true north within 0.01 degrees here."""
    horizons = wall_level.horizons(8)
    assert horizons.shape == (8, 21, 25)
    np.testing.assert_allclose(horizons[2, 10, 5], np.degrees(np.arctan2(60.0, 300.0)), atol=0.02)
    np.testing.assert_allclose(horizons[[1, 3], 10, 5], np.degrees(np.arctan2(60.0, 300.0 * np.sqrt(2.0))), atol=0.02)
    assert np.abs(horizons[[0, 4], 10, 5]).max() < 0.05
    np.testing.assert_array_equal(np.moveaxis(wall_level.compute("horizon", azimuths=8, dtype="float32"), -1, 0), horizons)


@pytest.mark.parametrize("kind", SKY_VIEW_KINDS)
def test_sky_view_of_a_level_equals_that_of_its_array(kind):
    row, col = np.mgrid[:40, :50]
    heights = 60.0 * np.sin(row / 7.0) * np.cos(col / 5.0)  # without holes, which a level fills and an array does not
    expected = skugga.sky_view(heights, CELL_M, kind=kind, azimuths=16)
    with skugga.open_heights(heights, TRANSFORM, "EPSG:32633") as level:
        values = level.sky_view(kind, azimuths=16)
        np.testing.assert_array_equal(values, level.compute("sky_view", kind=kind, azimuths=16))
    error, tolerance = np.abs(values - expected), 0.02 if "openness" in kind else 2e-4
    assert np.nanpercentile(error, 95) < tolerance and np.nanmax(error) < 20 * tolerance, "ground far away may round otherwise"


@pytest.mark.parametrize("product", ["sky_view", "horizon"])
def test_a_part_of_the_cells_equals_the_whole(wall_level, product):
    part = np.s_[3:9, 5:20]
    np.testing.assert_allclose(
        wall_level.compute(product, cells=part), wall_level.compute(product)[part], rtol=1e-6, atol=1.0 * (product == "horizon")
    )


def test_one_cell_sees_the_whole_sky():
    with skugga.open_heights(np.array([[100.0]]), TRANSFORM, "EPSG:32633") as level:
        assert level.sky_view().tolist() == [[1.0]] and level.sky_view("openness") == pytest.approx(90.0, abs=1e-3)
        assert level.compute("horizon").tolist() == [[[0] * 72]]
        assert np.abs(level.horizons()).max() < 1e-3, "the ground extends by a cell around the only one"


@pytest.mark.parametrize(
    ("product", "options", "name", "text"),
    [
        ("horizon", {"azimuths": 100_000}, "azimuths", "360"),
        ("horizon", {"azimuths": 7}, "azimuths", "8"),
        ("horizon", {"dtype": "int16"}, "dtype", "'uint16' or 'float32'"),
        ("horizon", {"radius": 500.0}, "radius", "rays go to the end of the data"),
        ("horizon", {"kind": "cosine"}, "kind", "Use one of azimuths, dtype"),
        ("sky_view", {"azimuths": 100_000}, "azimuths", "360"),
        ("sky_view", {"kind": "svf"}, "kind", "'solid_angle'"),
        ("sky_view", {"transmissivity": 1.5}, "transmissivity", "1"),
        ("sky_view", {"radius": 500.0}, "radius", "rays go to the end of the data"),
    ],
)
def test_wrong_options_are_one_line_with_a_remedy(product: str, options: dict[str, Any], name: str, text: str):
    with pytest.raises(InputError) as error:
        PRODUCTS[product].options_of(options)
    assert str(error.value).startswith(f"{name}: ") and text in str(error.value) and "\n" not in str(error.value)


def test_horizons_that_do_not_fit_into_memory_are_refused(wall_level):
    """A band for each azimuth counts: the same cells as one band are fewer than a billion bytes."""
    with pytest.raises(skugga.SkuggaError, match=r"resolution: .* GB"):
        wall_level.horizons(360, resolution=0.01)


def test_horizons_are_files_only():
    assert "horizon" in RASTER_PRODUCTS and "horizon" not in MAP_PRODUCTS and "sky_view" in MAP_PRODUCTS
    assert "depth" not in RASTER_PRODUCTS, "depth is of single views"


def test_options_decide_bands_type_and_scale():
    few, many = (HORIZON.profile(HORIZON.options_of(options)) for options in ({"azimuths": 8, "dtype": "float32"}, {}))
    assert (few.dtype, few.bands, few.scale) == ("float32", 8, 1.0) and np.isnan(few.nodata)
    assert (many.dtype, many.bands, many.scale, many.nodata) == ("uint16", 72, 0.01, STORED_NODATA)
    assert many.band_names[1] == "horizon angle towards 5 degrees" and len(many.band_names) == 72


def test_tiles_of_many_bands_are_small():
    for azimuths in (8, 72, 360):
        profile = HORIZON.profile(HORIZON.options_of({"azimuths": azimuths}))
        assert tile_side_cells(profile) ** 2 * azimuths * 2 <= MAX_TILE_BYTES
    assert tile_side_cells(SKY_VIEW.profile(SKY_VIEW.options())) == TILE_SIDE_CELLS


@pytest.mark.parametrize("kind", SKY_VIEW_KINDS)
def test_the_legend_is_of_the_kind(kind):
    assert SKY_VIEW.color_scale is not None
    options = SKY_VIEW.options_of({"kind": kind})
    scale = SKY_VIEW.color_scale(options, None)  # type: ignore[arg-type]
    description, unit = SKY_VIEW.description_and_unit(options)
    assert (scale.low, scale.high) == ((60.0, 120.0) if unit == "degrees" else (0.0, 1.0))
    assert (unit == "degrees") == ("openness" in kind) == ("degrees" in scale.title)
    assert scale.ticks[0][0] == scale.low and scale.ticks[-1][0] == scale.high
    assert description.lower().startswith(scale.title.lower().split(" ")[0])


def test_all_kinds_have_titles_of_their_own():
    assert SKY_VIEW.color_scale is not None and set(get_args(SkyViewKind)) == set(SKY_VIEW_KINDS)
    all_options = [SKY_VIEW.options_of({"kind": kind}) for kind in SKY_VIEW_KINDS]
    titles = {SKY_VIEW.color_scale(options, None).title for options in all_options}  # type: ignore[arg-type]
    assert len(titles) == len(SKY_VIEW_KINDS)


def test_tiles_have_fewer_azimuths_than_files():
    assert SKY_VIEW.options.UNSERVED == {"azimuths": TILE_AZIMUTHS}
    assert SKY_VIEW.options_of({"azimuths": TILE_AZIMUTHS, "kind": "cosine"}).query() == "kind=cosine"
