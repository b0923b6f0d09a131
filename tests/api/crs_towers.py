"""A tower on a plain in any CRS, and the deviation of its shadow from geodesics."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
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
LON_LAT_CRS = CRS.from_user_input("OGC:CRS84")


def shadow_reach_m(lon: np.ndarray, lat: np.ndarray, azimuth: float, geod: Geod) -> float:
    """Return the largest distance between the tower's centre and its shadow's end along the ellipsoid ``geod``, in metres.

    The rays past the four corners of the tower's top meet the ellipsoid x^2 / a^2 + y^2 / a^2 + z^2 / b^2 = 1. On a small body the
    curved ground drops away under the shadow. Where a ray misses the ground, or it is night in a corner of the plain, the result is
    infinite. ``lon`` and ``lat`` (101, 101) are the places of the plain's cells in degrees.
    """
    to_earth = Transformer.from_pipeline(f"+proj=cart +a={geod.a!r} +b={geod.b!r}")
    axes_m, middle = np.array([geod.a, geod.a, geod.b]), SIDE // 2
    centre = lon[middle, middle], lat[middle, middle]
    sunward = _enu_axes(*centre).T @ _direction_enu(azimuth)
    if min(_enu_axes(lon[row, col], lat[row, col])[2] @ sunward for row in (0, -1) for col in (0, -1)) <= 0.0:
        return np.inf
    away, reach_m = -sunward / axes_m, 0.0
    for row, col in product((middle - HALF, middle + HALF), repeat=2):
        top = np.array(to_earth.transform(lon[row, col], lat[row, col], HEIGHT_M, radians=False)) / axes_m
        squared, half_linear, constant = away @ away, away @ top, top @ top - 1.0
        if half_linear**2 < squared * constant:
            return np.inf
        length_m = (-half_linear - np.sqrt(half_linear**2 - squared * constant)) / squared
        end_lon, end_lat, _ = to_earth.transform(*((top + length_m * away) * axes_m), radians=False, direction="INVERSE")
        reach_m = max(reach_m, geod.inv(*centre, end_lon, end_lat)[2])
    return reach_m


def _enu_axes(lon: float, lat: float) -> np.ndarray:
    """Return the unit vectors east, north and up of a place in geocentric axes (3, 3)."""
    lon, lat = np.radians(lon), np.radians(lat)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


def _direction_enu(azimuth: float) -> np.ndarray:
    """Return the unit vector (3,) to the sun in the axes east, north and up."""
    angle, altitude = np.radians(azimuth), np.radians(ALTITUDE_DEG)
    return np.array([np.sin(angle) * np.cos(altitude), np.cos(angle) * np.cos(altitude), np.sin(altitude)])


@dataclass(frozen=True)
class ShadowDeviation:
    """Deviation of a shadow from its expected place.

    Attributes
    ----------
    bearing_error_deg
        Deviation of the bearing in degrees.
    length_error_m
        Deviation of the length in metres.
    dark_rim_cells
        Number of cells of the raster's rim that are not lit.
    """

    bearing_error_deg: float
    length_error_m: float
    dark_rim_cells: int


def plain_with_tower() -> np.ndarray:
    """Return heights (101, 101) of a plain with a tower of 5 x 5 cells in its centre."""
    heights = np.zeros((SIDE, SIDE), np.float32)
    heights[SIDE // 2 - HALF : SIDE // 2 + HALF + 1, SIDE // 2 - HALF : SIDE // 2 + HALF + 1] = HEIGHT_M
    return heights


def write_plain(path: Path, crs: CRS, lon: float, lat: float, lon_lat_crs: CRS = LON_LAT_CRS, geod: Geod = WGS84) -> None:
    """Write the plain around a place as a VRT, with cells of about ``CELL_M``.

    The axes have GDAL's order and directions of the CRS. A GeoTIFF does not keep all of these axes.
    """
    to_crs = Transformer.from_crs(lon_lat_crs, crs, always_xy=True)
    x, y = to_crs.transform(lon, lat)
    step = 1e-4 * (100.0 if crs.is_projected else 0.1)
    x_y = np.array([x, x + step, x]), np.array([y, y, y + step])
    lons, lats = to_crs.transform(*x_y, direction="INVERSE")
    _, _, metres = geod.inv([lons[0]] * 2, [lats[0]] * 2, lons[1:], lats[1:])
    dx, dy = (step * CELL_M / length_m for length_m in metres)
    transform = Affine(dx, 0.0, x - SIDE / 2 * dx, 0.0, -dy, y + SIDE / 2 * dy)
    raster_path = path.with_suffix(".tif")
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(raster_path, "w", driver="GTiff", height=SIDE, width=SIDE, count=1, dtype="float32") as dataset,
    ):
        dataset.write(plain_with_tower(), 1)
    path.write_text(
        f"<VRTDataset rasterXSize='{SIDE}' rasterYSize='{SIDE}'><SRS>{escape(crs.to_wkt())}</SRS>"
        f"<GeoTransform>{', '.join(map(repr, transform.to_gdal()))}</GeoTransform><VRTRasterBand dataType='Float32' band='1'>"
        f"<SimpleSource><SourceFilename relativeToVRT='1'>{raster_path.name}</SourceFilename>"
        "<SourceBand>1</SourceBand></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )


def mask_of(source: Path, output: Path, azimuth: float, altitude: float = ALTITUDE_DEG) -> np.ndarray:
    """Return the mask on a raster's own cells."""
    scene = build_scene(load_level(source))
    try:
        write_shade(scene, raster_view(scene), "mask", [SunSpec(azimuth=azimuth, altitude=altitude)], [output])
    finally:
        scene.close()
    with rasterio.open(output) as output_dataset, rasterio.open(source) as source_dataset:
        assert output_dataset.shape == source_dataset.shape
        assert output_dataset.transform.almost_equals(source_dataset.transform, 1e-9)
        return output_dataset.read(1)


def shadow_deviation(
    mask: np.ndarray, source: Path, crs: CRS, azimuth: float, lon_lat_crs: CRS = LON_LAT_CRS, geod: Geod = WGS84
) -> ShadowDeviation:
    """Return how far the tower's shadow deviates from its expected bearing and length.

    ``mask`` classifies the cells of the raster ``source``. ``crs`` has its axes in GDAL's order.
    """
    with rasterio.open(source) as dataset:
        transform = dataset.transform
    row, col = np.mgrid[:SIDE, :SIDE]
    x, y = transform.a * (col + 0.5) + transform.c, transform.e * (row + 0.5) + transform.f
    lon, lat = Transformer.from_crs(crs, lon_lat_crs, always_xy=True).transform(x, y)
    middle = SIDE // 2
    bearing, _, distances_m = geod.inv(np.full(lon.shape, lon[middle, middle]), np.full(lon.shape, lat[middle, middle]), lon, lat)
    is_tower_shadow = (mask == MASK_SHADOW) & (distances_m > 4.0 * HALF * CELL_M)
    rim = np.ones(mask.shape, bool)
    rim[1:-1, 1:-1] = False
    reach_m = shadow_reach_m(lon, lat, azimuth, geod)
    if not is_tower_shadow.any():
        return ShadowDeviation(180.0, reach_m, int((mask[rim] != MASK_LIT).sum()))
    bearing_errors_deg = (bearing[is_tower_shadow] - azimuth - 180.0 + 540.0) % 360.0 - 180.0
    length_error_m = float(distances_m[is_tower_shadow].max()) - reach_m
    return ShadowDeviation(
        float(np.average(bearing_errors_deg, weights=distances_m[is_tower_shadow])),
        length_error_m,
        int((mask[rim] != MASK_LIT).sum()),
    )
