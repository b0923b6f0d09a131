"""``skugga compute`` writes horizons and sky view factors as rasters that say what they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

import skugga
from tests.rasters import write_geotiff


@pytest.fixture
def raster(tmp_path: Path) -> Path:
    """File of a raster of hills with a hole."""
    row, col = np.mgrid[:90, :120].astype(np.float32)
    heights = 300 * np.sin(col / 9) * np.cos(row / 13)
    heights[20:30, 50:70] = np.nan
    return write_geotiff(tmp_path / "dem.tif", heights, "EPSG:32633", 500e3, 5200e3, 30.0, nodata=float("nan"))


def test_a_file_of_horizons_tells_azimuths_unit_and_scale(run, raster, tmp_path):
    out = tmp_path / "horizons.tif"
    assert run("compute", str(raster), "--product", "horizon", "--azimuths", "16", "-o", str(out)) == (0, "", "")
    with rasterio.open(out) as dataset, skugga.open_level(raster) as level:
        assert (dataset.count, set(dataset.dtypes), dataset.nodata) == (16, {"uint16"}, 65535)
        assert set(dataset.scales) == {0.01} and set(dataset.offsets) == {0.0} and set(dataset.units) == {"degrees"}
        assert dataset.descriptions[:2] == ("horizon angle towards 0 degrees", "horizon angle towards 22.5 degrees")
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        tags, stored = dataset.tags(), dataset.read(masked=True)
        horizons = level.horizons(16)
    assert tags["LAYER"] == "horizon" and tags["AZIMUTHS"] == "16" and tags["AZIMUTH_STEP_DEG"] == "22.5"
    assert (tags["AZIMUTH_FIRST_DEG"], tags["AZIMUTH_ORIGIN"], tags["AZIMUTH_SENSE"]) == ("0", "true north", "clockwise")
    assert (tags["UNIT"], tags["SCALE"]) == ("degrees", "0.01")
    np.testing.assert_array_equal(stored.mask, np.isnan(horizons))
    np.testing.assert_allclose((stored * 0.01).compressed(), np.maximum(horizons, 0.0)[~np.isnan(horizons)], atol=0.00501)
    assert np.nanmax(horizons) > 10.0


def test_horizons_are_written_as_degrees_on_request(run, raster, tmp_path):
    out = tmp_path / "horizons.tif"
    options = ("--azimuths", "8", "--dtype", "float32")
    assert run("compute", str(raster), "--product", "horizon", *options, "-o", str(out)) == (0, "", "")
    with rasterio.open(out) as dataset, skugga.open_level(raster) as level:
        assert set(dataset.dtypes) == {"float32"} and set(dataset.scales) == {1.0} and np.isnan(dataset.nodata)
        assert dataset.tags()["SCALE"] == "1"
        np.testing.assert_array_equal(dataset.read(), level.horizons(8))


@pytest.mark.parametrize(("kind", "unit"), [("solid_angle", "1"), ("openness", "degrees")])
def test_a_file_of_sky_view_tells_its_kind(run, raster, tmp_path, kind, unit):
    out = tmp_path / "sky.tif"
    assert run("compute", str(raster), "--product", "sky_view", "--kind", kind, "-o", str(out)) == (0, "", "")
    with rasterio.open(out) as dataset, skugga.open_level(raster) as level:
        assert (dataset.count, dataset.dtypes, dataset.units) == (1, ("float32",), (unit,)) and np.isnan(dataset.nodata)
        assert dataset.tags()["KIND"] == kind and dataset.tags()["AZIMUTHS"] == "72"
        np.testing.assert_array_equal(dataset.read(1), level.sky_view(kind))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--product", "horizon", "--azimuths", "100000"), ("--azimuths: '100000' is not allowed", "360")),
        (("--product", "horizon", "--kind", "cosine"), ("--kind", "sky_view, not of horizon")),
        (("--product", "sky_view", "--dtype", "float32"), ("--dtype", "horizon, not of sky_view")),
        (("--product", "sky_view", "--kind", "svf"), ("--kind: 'svf'", "'solid_angle'")),
        (("--product", "sky_view", "--radius", "500"), ("No such option: --radius",)),
        (("--product", "sky_view", "--algorithm", "sweep"), ("--algorithm", "no shadows")),
    ],
)
def test_wrong_options_are_one_line(run, raster, tmp_path, options, words):
    status, out, err = run("compute", str(raster), *options, "-o", str(tmp_path / "out.tif"))
    assert (status, out, err.count("\n")) == (2, "", 1) and all(word in err for word in words), err
    assert not (tmp_path / "out.tif").exists()
