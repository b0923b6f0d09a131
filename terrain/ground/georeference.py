"""Read a raster's CRS, and check that the raster's coordinates fit it."""

from __future__ import annotations

import numpy as np
import rasterio
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.errors import RasterioError

from skugga.terrain.errors import SourceError
from skugga.terrain.geo.axes import axes_of

MAX_LATITUDE_DEG = 91.0
"""Maximum latitude in degrees that counts as plausible: files overshoot the poles by up to a cell."""

MAX_LONGITUDE_DEG = 540.0

MAX_DEGREE_LIKE_CELL = 0.02
"""Cell size in CRS units below which coordinates in the range of degrees are probably degrees, not those of a projected CRS."""

MAX_CELL_M = 50_000.0
"""Maximum side of a cell in a projected CRS, metres: a thousand such cells reach round the earth."""

ASSIGN_CRS_HINT = "gdal_edit.py -a_srs EPSG:CODE FILE states it"


def check_geotransform(source: str, dataset: rasterio.DatasetReader) -> None:
    """Raise ``SourceError`` for a raster that control points, RPCs or coordinate arrays locate, instead of a geotransform.

    Such a raster needs warping first.
    """
    if not dataset.transform.is_identity:
        return
    points = len(dataset.gcps[0])
    locators = {
        f"{points} ground control points": (points, ""),
        "rational polynomials (RPCs)": (dataset.rpcs is not None, " -rpc"),
        "arrays of coordinates": (dataset.tags(ns="GEOLOCATION"), " -geoloc"),
    }
    for locator, (is_present, option) in locators.items():
        if is_present:
            advice = f"Give a raster with a geotransform ('gdalwarp{option} -t_srs EPSG:CODE {source} OUT.tif' makes one)"
            raise SourceError(source, f"it has {locator} and no geotransform", advice)


def check_cells(source: str, dataset: rasterio.DatasetReader) -> None:
    """Raise ``SourceError`` if the raster's geotransform gives its cells no finite coordinates or no size."""
    if not np.isfinite(tuple(dataset.transform)).all() or dataset.transform.determinant == 0:
        problem = f"its geotransform {tuple(dataset.transform)[:6]} gives cells no size or no position"
        raise SourceError(source, problem, "Give a raster with cells of a size above 0")


def checked_crs(source: str, dataset: rasterio.DatasetReader) -> CRS:
    """Return the horizontal CRS of an open raster, after checking that the raster's coordinates fit it.

    The vertical axis of the CRS is omitted. Raises ``SourceError`` if the raster has no CRS or no geotransform, or if its cells are
    too large. Also raises it if the coordinates are of another kind than the CRS: metres in a CRS in degrees, or degrees in a CRS
    in metres or feet.
    """
    check_geotransform(source, dataset)
    gt, (rows, cols) = dataset.transform, dataset.shape
    col, row = np.array([0, cols, 0, cols]), np.array([0, 0, rows, rows])
    x, y = gt.a * col + gt.b * row + gt.c, gt.d * col + gt.e * row + gt.f
    west, south, east, north = float(x.min()), float(y.min()), float(x.max()), float(y.max())
    looks_like_degrees = (
        -MAX_LONGITUDE_DEG <= west <= east <= MAX_LONGITUDE_DEG and -MAX_LATITUDE_DEG <= south <= north <= MAX_LATITUDE_DEG
    )
    has_small_cells = max(abs(gt.a), abs(gt.b), abs(gt.d), abs(gt.e)) < MAX_DEGREE_LIKE_CELL
    extent_text = f"x from {west:.7g} to {east:.7g} and y from {south:.7g} to {north:.7g}"
    if dataset.crs is None:
        guess = (
            "; its coordinates may be degrees: EPSG:4326" if looks_like_degrees and has_small_cells and not gt.is_identity else ""
        )
        raise SourceError(source, "it has no coordinate reference system", f"Give a raster with a CRS ({ASSIGN_CRS_HINT}{guess})")
    try:
        crs = CRS.from_user_input(dataset.crs.to_wkt())
    except (CRSError, RasterioError):
        raise SourceError(source, "PROJ does not know its CRS", "Give a raster with a CRS that PROJ knows") from None
    first_axis = crs.axis_info[0].name.lower() if crs.axis_info else ""
    if crs.is_geocentric or crs.type_name == "Vertical CRS" or not first_axis or "planetocentric" in first_axis:
        advice = "Give a raster in a projected, geographic or engineering CRS with geodetic latitudes"
        raise SourceError(source, f"its CRS {crs.name} is of an unsupported kind", advice)
    if gt.is_identity and not crs.is_engineering:
        raise SourceError(source, "it is not georeferenced", "Give a raster with a geotransform")
    check_cells(source, dataset)
    west, south, east, north = axes_of(crs).bounds_xy((west, south, east, north))
    if crs.is_geographic and not (max(-west, east) <= MAX_LONGITUDE_DEG and max(-south, north) <= MAX_LATITUDE_DEG):
        unit = crs.axis_info[0].unit_name
        expected_text = "degrees, latitudes from -90 to 90" if unit.startswith("degree") else f"coordinates in its unit, the {unit}"
        raise SourceError(
            source, f"its coordinates ({extent_text}) lie outside its CRS {crs.name}",
            f"Give {expected_text}, or state the CRS of these coordinates, such as a UTM zone for metres ({ASSIGN_CRS_HINT})",
        )  # fmt: skip
    if crs.is_projected and looks_like_degrees and has_small_cells:
        unit = crs.axis_info[0].unit_name
        raise SourceError(
            source,
            f"its coordinates ({extent_text}, cells of {abs(gt.a) + abs(gt.b):.3g} ({unit})) look like degrees, not {crs.name}",
            f"Give coordinates of that CRS, or state the CRS of these, such as EPSG:4326 ({ASSIGN_CRS_HINT})",
        )  # fmt: skip
    unit_m = float(crs.axis_info[0].unit_conversion_factor or 1.0)
    if crs.is_projected and (cell_m := float(np.sqrt(abs(gt.determinant))) * unit_m) > MAX_CELL_M:
        problem = f"its cells of {cell_m / 1000.0:.4g} km exceed the limit of {MAX_CELL_M / 1000.0:g} km in {crs.name}"
        raise SourceError(source, problem, "Check its geotransform and its CRS")
    return crs.to_2d() if len(crs.axis_info) == 3 else crs
