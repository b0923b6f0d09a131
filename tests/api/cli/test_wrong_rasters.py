"""Unusable rasters: every command prints one line with the reason and the remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from tests.rasters import write_geotiff

COMMANDS = {
    "render": ("-o", "out.png"),
    "shade": ("-o", "out.tif"),
    "compute": ("-o", "out.tif", "--product", "sky_view"),
    "sunhours": ("-o", "out.tif", "--date", "2024-03-21"),
    "point": ("--at", "12.5,47.2"),
    "select": ("--policy", "rules"),
    "compare": (),
    "validate": (),
    "init": (),
    "serve": (),
}

MESSAGE_PARTS_BY_RASTER = {
    "no_crs.tif": ("no coordinate reference system", "a raster with a CRS", "gdal_edit.py -a_srs"),
    "metres.tif": ("x from 500000 to 500600", "WGS 84", "degrees"),
    "degrees.tif": ("x from 12.5 to", "UTM zone 33N", "look like degrees"),
    "empty.tif": ("no height in any cell", "a raster with heights"),
    "complex.tif": ("complex64", "real numbers"),
    "text.tif": ("neither a level file nor a raster", "version: 1"),
    "nothing.tif": ("neither a level file nor a raster",),
    "cut.tif": ("neither a level file nor a raster",),
    "bytes.tif": ("not UTF-8 text", "a raster that GDAL reads"),
    "folder": ("folder is a folder", "Use a level file or a raster, such as inside.tif"),
    "missing.tif": ("no file missing.tif",),
    "missing": ("'missing' is not allowed", "jacksboro"),
}


@pytest.fixture
def unusable_rasters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with rasters that cannot be opened as a level for one reason each."""
    monkeypatch.chdir(tmp_path)
    heights = np.ones((20, 20), np.float32)
    utm, degrees = (500e3, 5200e3, 30.0), (12.5, 47.2, 3e-4)
    write_geotiff(tmp_path / "no_crs.tif", heights, None, *utm)  # type: ignore[arg-type]
    write_geotiff(tmp_path / "metres.tif", heights, "EPSG:4326", *utm)
    write_geotiff(tmp_path / "degrees.tif", heights, "EPSG:32633", *degrees)
    write_geotiff(tmp_path / "empty.tif", heights, "EPSG:32633", *utm, nodata=1.0)
    complex_raster = write_geotiff(tmp_path / "complex.tif", heights.astype(np.complex64), "EPSG:32633", *utm)
    (tmp_path / "text.tif").write_text("no raster")
    (tmp_path / "nothing.tif").write_bytes(b"")
    (tmp_path / "cut.tif").write_bytes(b"II*\0" + bytes(20))
    (tmp_path / "bytes.tif").write_bytes(bytes(range(128, 256)) * 9)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "inside.tif").write_bytes(complex_raster.read_bytes())
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unusable_raster_is_one_line(run, unusable_rasters, command):
    before = sorted(unusable_rasters.iterdir())
    for name, words in MESSAGE_PARTS_BY_RASTER.items():
        status, out, err = run(command, name, *COMMANDS[command])
        assert (status, out) == (2, "") and err.startswith("skugga: ") and err.count("\n") == 1, (name, err)
        for word in words:
            assert word in err, name
    assert sorted(unusable_rasters.iterdir()) == before


def test_nodata_that_covers_all_cells_is_refused(run, unusable_rasters):
    write_geotiff(unusable_rasters / "flat.tif", np.ones((20, 20), np.float32), "EPSG:32633", 500e3, 5200e3, 30.0)
    assert run("validate", "flat.tif")[0] == 0
    status, _, err = run("validate", "flat.tif", "--nodata", "1")
    assert status == 2 and "no height in any cell" in err


def test_a_single_row_is_a_map(gl, run, unusable_rasters):
    write_geotiff(unusable_rasters / "row.tif", np.ones((1, 20), np.float32), "EPSG:32633", 500e3, 5200e3, 30.0)
    assert run("shade", "row.tif", "--azimuth", "225", "--altitude", "30", "-o", "mask.tif") == (0, "", "")
    assert "20 x 1 cells" in run("validate", "row.tif")[1]


@pytest.mark.parametrize("is_column", [False, True], ids=["row", "column"])
def test_a_single_row_has_shadows_on_its_cells(gl, run, unusable_rasters, is_column):
    """The spike is 300 m high and the sun 44 degrees: the shadow of 310 m reaches the centres of 10 cells of 30 m."""
    heights = np.zeros((1, 60), np.float32)
    heights[0, 20] = 300.0
    write_geotiff(unusable_rasters / "row.tif", heights.T if is_column else heights, "EPSG:32633", 500e3, 5200e3, 30.0)
    azimuth = "0" if is_column else "270"
    assert run("shade", "row.tif", "--azimuth", azimuth, "--altitude", "44", "-o", "mask.tif") == (0, "", "")
    with rasterio.open("mask.tif") as dataset:
        mask = dataset.read(1).ravel()
    np.testing.assert_array_equal(mask, np.where((np.arange(60) > 20) & (np.arange(60) < 31), 0, 255))
