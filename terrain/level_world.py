"""Place the ground of a level on the earth: its CRS and the anchor at the centre of the level's bounds."""

from __future__ import annotations

import numpy as np
from pyproj import CRS
from pyproj.exceptions import ProjError

from skugga.terrain.errors import LevelError, Problem, SourceError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, is_longitude_latitude, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.level import LoadedLevel

ROUND_TRIP_TOLERANCE_DEG = 0.05
"""Tolerance of a round trip into a CRS and back, in degrees. Datums differ by some hundred metres."""


def world_of_level(loaded: LoadedLevel, elevation: Elevation) -> World:
    """Return the world that a level's ground lies in, with its anchor at the centre of the level's bounds.

    Raises ``LevelError`` for bounds that do not fit the raster. Raises ``SourceError`` if PROJ cannot transform the raster's CRS
    into longitude and latitude and back.
    """
    try:
        return _world_at_level_centre(loaded, elevation)
    except ProjError:
        problem = f"PROJ cannot transform its CRS '{elevation.crs.name}' into longitude and latitude and back"
        raise SourceError(elevation.name, problem, "Use a raster with a CRS that PROJ can transform") from None


def _survives_round_trip(crs: CRS, lon: float, lat: float) -> bool:
    """Return whether a position is unchanged after a transformation into a CRS and back.

    For a few CRSs PROJ applies the prime meridian in one direction only.
    """
    if is_longitude_latitude(crs):
        return True
    projected = transformer(LONGITUDE_LATITUDE, crs).transform(lon, lat)
    restored = transformer(crs, LONGITUDE_LATITUDE).transform(*projected)
    lon_error = (restored[0] - lon + 180.0) % 360.0 - 180.0
    return bool(max(abs(lon_error) * np.cos(np.radians(lat)), abs(restored[1] - lat)) < ROUND_TRIP_TOLERANCE_DEG)


def _world_at_level_centre(loaded: LoadedLevel, elevation: Elevation) -> World:
    """Return the result of ``world_of_level``. Raises also ``ProjError`` if PROJ has no transformation of the raster's CRS."""
    crs, bounds = elevation.crs, loaded.level.terrain.bounds
    x, y = (float(v) for v in elevation.xy((elevation.rows - 1) / 2, (elevation.cols - 1) / 2))
    unit = float(crs.axis_info[0].unit_conversion_factor or 1.0) if crs.axis_info else 1.0
    if elevation.flat:
        if bounds is not None:
            degrees = Problem("bounds in degrees do not apply to an engineering CRS")
            raise LevelError(f"{loaded.path}: terrain.bounds", degrees, "Remove the bounds")
        return World(crs, True, x, y, metres_per_unit=unit)
    metres = 1.0 if crs.is_geographic else unit
    if bounds is not None:
        lon, lat = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
        x, y = transformer(LONGITUDE_LATITUDE, crs).transform(lon, lat)
        cell = elevation.cell_of(x, y)
        is_on_raster = -0.5 <= cell[0] <= elevation.rows - 0.5 and -0.5 <= cell[1] <= elevation.cols - 0.5
        if not is_on_raster:
            raise LevelError(f"{loaded.path}: terrain.bounds", bounds, "bounds whose centre lies on the raster")
    else:
        lon, lat = (x, y) if is_longitude_latitude(crs) else transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
    if not (np.isfinite([lon, lat]).all() and _survives_round_trip(crs, float(lon), float(lat))):
        problem = f"PROJ cannot transform its CRS '{crs.name}' into longitude and latitude and back"
        raise SourceError(elevation.name, problem, "Use a raster with a CRS that PROJ can transform")
    return World(crs, False, float(x), float(y), float(lon), float(np.clip(lat, -90, 90)), metres)
