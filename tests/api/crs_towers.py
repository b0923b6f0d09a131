"""A tower on a plain in any CRS, and the deviation of its shadow from geodesics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import CRS, Geod, Transformer
from rasterio.errors import NotGeoreferencedWarning

from skugga.api.products.mask import MASK_LIT, MASK_SHADOW
from skugga.api.raster_view import raster_view
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
from tests.products import write_shade

SIDE, HALF, HEIGHT_M, CELL_M = 101, 2, 60.0, 10.0
ALTITUDE_DEG = 15.0
AZIMUTHS_DEG = (20.0, 110.0, 200.0, 290.0)
WGS84 = Geod(ellps="WGS84")
PLACES = CRS.from_user_input("OGC:CRS84")


def shadow_length_m(radius_m: float) -> float:
    """Return the length of the tower's shadow along a sphere. On a small body the curved ground drops away under the
    shadow.
    """
    sine, top_m = np.sin(np.radians(ALTITUDE_DEG)), radius_m + HEIGHT_M
    way_m = top_m * sine - np.sqrt((top_m * sine) ** 2 - (top_m + radius_m) * HEIGHT_M)
    return float(radius_m * np.arcsin(way_m * np.cos(np.radians(ALTITUDE_DEG)) / radius_m))


@dataclass(frozen=True)
class Fall:
    """Deviation of a shadow from its expected place.

    Attributes
    ----------
    bearing_off_deg
        Deviation of the bearing in degrees.
    length_off_m
        Deviation of the length in metres.
    dark_rim
        Number of cells of the raster's rim that are not lit.
    """

    bearing_off_deg: float
    length_off_m: float
    dark_rim: int


def plain_with_tower() -> np.ndarray:
    """Return heights (101, 101) of a plain with a tower of 5 x 5 cells in its centre."""
    heights = np.zeros((SIDE, SIDE), np.float32)
    heights[SIDE // 2 - HALF : SIDE // 2 + HALF + 1, SIDE // 2 - HALF : SIDE // 2 + HALF + 1] = HEIGHT_M
    return heights


def write_plain(path: Path, crs: CRS, lon: float, lat: float, places: CRS = PLACES, geod: Geod = WGS84) -> None:
    """Write the plain around a place as a VRT, with cells of about ``CELL_M``.

    The axes have GDAL's order and directions of the CRS. A GeoTIFF does not keep all of these axes.
    """
    to_crs = Transformer.from_crs(places, crs, always_xy=True)
    x, y = to_crs.transform(lon, lat)
    step = 1e-4 * (100.0 if crs.is_projected else 0.1)
    away = np.array([x, x + step, x]), np.array([y, y, y + step])
    lons, lats = to_crs.transform(*away, direction="INVERSE")
    _, _, metres = geod.inv([lons[0]] * 2, [lats[0]] * 2, lons[1:], lats[1:])
    dx, dy = (step * CELL_M / each for each in metres)
    transform = Affine(dx, 0.0, x - SIDE / 2 * dx, 0.0, -dy, y + SIDE / 2 * dy)
    bare = path.with_suffix(".tif")
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(bare, "w", driver="GTiff", height=SIDE, width=SIDE, count=1, dtype="float32") as dataset,
    ):
        dataset.write(plain_with_tower(), 1)
    path.write_text(
        f"<VRTDataset rasterXSize='{SIDE}' rasterYSize='{SIDE}'><SRS>{escape(crs.to_wkt())}</SRS>"
        f"<GeoTransform>{', '.join(map(repr, transform.to_gdal()))}</GeoTransform><VRTRasterBand dataType='Float32' band='1'>"
        f"<SimpleSource><SourceFilename relativeToVRT='1'>{bare.name}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )


def mask_of(source: Path, output: Path, azimuth: float, altitude: float = ALTITUDE_DEG) -> np.ndarray:
    """Return the mask on a raster's own cells."""
    scene = build_scene(load_level(source))
    try:
        write_shade(scene, raster_view(scene), "mask", [SunSpec(azimuth=azimuth, altitude=altitude)], [output])
    finally:
        scene.close()
    with rasterio.open(output) as made, rasterio.open(source) as own:
        assert made.shape == own.shape
        assert made.transform.almost_equals(own.transform, 1e-9)
        return made.read(1)


def fall_of(mask: np.ndarray, source: Path, crs: CRS, azimuth: float, places: CRS = PLACES, geod: Geod = WGS84) -> Fall:
    """Return the deviation of the tower's shadow in a mask of the cells of a raster, in GDAL's order of the axes of a CRS."""
    with rasterio.open(source) as dataset:
        transform = dataset.transform
    row, col = np.mgrid[:SIDE, :SIDE]
    x, y = transform.a * (col + 0.5) + transform.c, transform.e * (row + 0.5) + transform.f
    lon, lat = Transformer.from_crs(crs, places, always_xy=True).transform(x, y)
    middle = SIDE // 2
    bearing, _, away = geod.inv(np.full(lon.shape, lon[middle, middle]), np.full(lon.shape, lat[middle, middle]), lon, lat)
    far = (mask == MASK_SHADOW) & (away > 4.0 * HALF * CELL_M)
    rim = np.ones(mask.shape, bool)
    rim[1:-1, 1:-1] = False
    length_m = shadow_length_m(geod.a)
    if not far.any():
        return Fall(180.0, length_m, int((mask[rim] != MASK_LIT).sum()))
    off = (bearing[far] - azimuth - 180.0 + 540.0) % 360.0 - 180.0
    length_off_m = float(away[far].max()) - length_m - HALF * CELL_M
    return Fall(float(np.average(off, weights=away[far])), length_off_m, int((mask[rim] != MASK_LIT).sum()))
