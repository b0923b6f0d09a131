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
LON_LAT_CRS = CRS.from_user_input("OGC:CRS84")


def shadow_length_m(radius_m: float) -> float:
    """Return the length of the tower's shadow along a sphere.

    On a small body the curved ground drops away under the shadow. Where the ray past the tower's top misses the ground, the shadow
    has no end, and the length is infinite.
    """
    sin_altitude, top_m = np.sin(np.radians(ALTITUDE_DEG)), radius_m + HEIGHT_M
    if (top_m * sin_altitude) ** 2 < (top_m + radius_m) * HEIGHT_M:
        return np.inf
    ray_length_m = top_m * sin_altitude - np.sqrt((top_m * sin_altitude) ** 2 - (top_m + radius_m) * HEIGHT_M)
    return float(radius_m * np.arcsin(ray_length_m * np.cos(np.radians(ALTITUDE_DEG)) / radius_m))


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
    length_m = shadow_length_m(geod.a)
    if not is_tower_shadow.any():
        return ShadowDeviation(180.0, length_m, int((mask[rim] != MASK_LIT).sum()))
    bearing_errors_deg = (bearing[is_tower_shadow] - azimuth - 180.0 + 540.0) % 360.0 - 180.0
    length_error_m = float(distances_m[is_tower_shadow].max()) - length_m - HALF * CELL_M
    return ShadowDeviation(
        float(np.average(bearing_errors_deg, weights=distances_m[is_tower_shadow])),
        length_error_m,
        int((mask[rim] != MASK_LIT).sum()),
    )
