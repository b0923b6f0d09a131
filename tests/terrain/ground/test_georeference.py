"""Georeferencing of rasters: accept valid CRSs and extents, and reject impossible ones with an explanation."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
import rasterio.control
import rasterio.rpc
from affine import Affine

from skugga.terrain.errors import SourceError
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.georeference import checked_crs
from skugga.terrain.ground.imagery import Imagery
from skugga.terrain.trees.canopy import Canopy
from tests.rasters import ENGINEERING, write_geotiff

UTM, DEGREES = (500e3, 5200e3, 30.0), (12.5, 47.2, 3e-4)


def checked_crs_of_raster(folder, crs, place, **options):
    """Return the CRS that is read from a raster file. ``place`` is its west, its north and the side of its cells."""
    path = write_geotiff(folder / "dem.tif", np.ones((40, 50), np.float32), crs, *place, **options)
    with rasterio.open(path) as dataset:
        return checked_crs("dem.tif", dataset)


@pytest.mark.parametrize(
    ("crs", "place"),
    [
        ("EPSG:32633", UTM), ("EPSG:4326", DEGREES), ("EPSG:4326", (179.9, 10.0, 0.01)), ("EPSG:4326", (359.9, 10.0, 0.01)),
        ("EPSG:4326", (-180.5, 90.5, 1.0)), (ENGINEERING, (0.0, 0.0, 0.01)), ("EPSG:3857", (10.0, 40.0, 1.0)),
        ("EPSG:32633", (500e3, 47.0, 0.01)), ("EPSG:2994", (0.0, 80.0, 0.5)),
    ],
)  # fmt: skip
def test_valid_georeference_is_accepted(tmp_path, crs, place):
    assert checked_crs_of_raster(tmp_path, crs, place).is_geographic is (crs == "EPSG:4326")


@pytest.mark.parametrize(
    ("crs", "place", "words"),
    [
        ("EPSG:4326", UTM, ("x from 500000 to 501500", "y from 5198800 to 5200000", "WGS 84", "degrees", "UTM")),
        ("EPSG:4326", (1000.0, 80.0, 1.0), ("x from 1000 to 1050", "degrees")),
        ("EPSG:4326", (10.0, 100.0, 0.1), ("y from 96 to 100", "-90 to 90")),
        ("EPSG:32633", DEGREES, ("x from 12.5 to 12.515", "0.0003 (metre)", "UTM zone 33N", "EPSG:4326")),
        ("EPSG:3857", DEGREES, ("Pseudo-Mercator", "EPSG:4326")),
        ("EPSG:2994", DEGREES, ("(foot)", "EPSG:4326")),
        (None, UTM, ("no coordinate reference system", "-a_srs EPSG:CODE")),
        (None, DEGREES, ("no coordinate reference system", "may be degrees: EPSG:4326")),
        ("EPSG:4978", UTM, ("projected, geographic or engineering",)),
    ],
)
def test_invalid_georeference_is_rejected_with_details(tmp_path, crs, place, words):
    with pytest.raises(SourceError) as caught:
        checked_crs_of_raster(tmp_path, crs, place)
    message = str(caught.value)
    assert message.startswith("dem.tif: ") and "\n" not in message
    for word in words:
        assert word in message


def test_cells_without_a_size_or_position_are_rejected(tmp_path):
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), pytest.raises(SourceError, match="not georeferenced"):
        checked_crs_of_raster(tmp_path, "EPSG:32633", UTM, transform=Affine.identity())
    with pytest.raises(SourceError, match="cells of a size above 0"):
        checked_crs_of_raster(tmp_path, "EPSG:32633", UTM, transform=Affine(0, 0, 5e5, 0, 0, 5e6))


GCPS = [rasterio.control.GroundControlPoint(row, col, 12.5 + col * 3e-4, 47.2 - row * 3e-4) for row in (0, 40) for col in (0, 50)]
RPCS = rasterio.rpc.RPC(
    height_off=0.0, height_scale=500.0, lat_off=47.2, lat_scale=0.01, long_off=12.5, long_scale=0.01, line_off=20.0,
    line_scale=20.0, samp_off=25.0, samp_scale=25.0,
    line_num_coeff=[0.0, 0.0, -1.0] + [0.0] * 17, line_den_coeff=[1.0] + [0.0] * 19,
    samp_num_coeff=[0.0, 1.0] + [0.0] * 18, samp_den_coeff=[1.0] + [0.0] * 19,
)  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"gcps": GCPS, "crs": "EPSG:4326"}, "4 ground control points and no geotransform"),
        ({"rpcs": RPCS}, "rational polynomials (RPCs) and no geotransform"),
    ],
)
@pytest.mark.parametrize("reader", [Elevation, Canopy, Imagery])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_gcps_or_rpcs_alone_need_warping(tmp_path, keys, words, reader):
    path = tmp_path / "scene.tif"
    with rasterio.open(path, "w", driver="GTiff", width=50, height=40, count=3, dtype="uint8", **keys) as dataset:
        dataset.write(np.ones((3, 40, 50), np.uint8))
    with pytest.raises(SourceError) as caught:
        reader(str(path))
    message = str(caught.value)
    assert words in message and f"-t_srs EPSG:CODE {path} OUT.tif" in message and "\n" not in message
    assert ("gdalwarp -rpc " if "rpcs" in keys else "gdalwarp -t_srs") in message
