"""A position on a level's ground, and the eye (the point for which sun is computed) at or above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Geod
from pyproj.exceptions import ProjError

from skugga.shadows.point.relief_pages import PagedRelief, paged_relief
from skugga.shadows.point.terms import MAX_EYE_HEIGHT_M
from skugga.terrain.errors import InputError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer
from skugga.terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class PointPlace:
    """An eye above a level's ground.

    Attributes
    ----------
    x, y
        Coordinates in the CRS of the ground's grid.
    lon_deg, lat_deg
        Longitude and latitude in degrees; ``None`` in a flat world.
    row, col
        Fractional row and column on the ground's grid.
    ground_m, height_m
        Height of the ground, and height of the eye above the ground, metres.
    ellipsoid
        Ellipsoid to which heights, longitudes and latitudes refer.
    eye_earth_m
        float64 (3,) metres: earth-fixed position of the eye.
    earth_from_enu
        Rotation (3, 3) from local east, north, up to earth-fixed axes.
    """

    x: float
    y: float
    lon_deg: float | None
    lat_deg: float | None
    row: float
    col: float
    ground_m: float
    height_m: float
    ellipsoid: Geod
    eye_earth_m: np.ndarray
    earth_from_enu: np.ndarray

    @property
    def eye_elevation_m(self) -> float:
        """Height of the eye, metres."""
        return self.ground_m + self.height_m

    def in_enu(self, point_earth_m: np.ndarray) -> np.ndarray:
        """Return earth-fixed points (n, 3) as metres east, north and up from the eye."""
        return (point_earth_m - self.eye_earth_m) @ self.earth_from_enu


POINT_PARAMETER = "point"
"""The name of the parameter in error messages about coordinates."""


MAX_COORDINATE = 1e9
"""Upper bound of coordinates. It equals that of bounds, since rows and columns of nodes are integers."""


def place_at(scene: Scene, coordinates: tuple[float, float], crs: CRS | None = None, height_m: float = 0.0) -> PointPlace:
    """Return the place at coordinates, on the ground or above it.

    The ground is the one that casts shadows: the triangles, or the tops of columns, of ``skugga.terrain.ground``.

    Parameters
    ----------
    scene
        The scene.
    coordinates
        Longitude and latitude in degrees. In a flat world, metres east and north of its centre. With ``crs``, x and y in that CRS.
    crs
        The CRS of ``coordinates``; ``None``: the default above.
    height_m
        Height of the eye above the ground, metres.

    Raises
    ------
    InputError
        The coordinates are off the level's data, or the height is below 0 or above ``MAX_EYE_HEIGHT_M``.
    """
    if not 0.0 <= height_m <= MAX_EYE_HEIGHT_M:
        raise InputError("height", height_m, f"0 to {MAX_EYE_HEIGHT_M:.0f} metres above the ground")
    ground = paged_relief(scene)
    x, y = _grid_coordinates(scene, ground, coordinates, crs)
    allowed = _allowed_places_text(scene, coordinates, crs)
    if not max(abs(x), abs(y)) <= MAX_COORDINATE:
        raise InputError(POINT_PARAMETER, f"{coordinates[0]:.10g},{coordinates[1]:.10g}", allowed)
    row, col = (float(v) for v in ground.node_of(x, y))
    ground_m, has_ground = ground.ground_at(row, col)
    if not has_ground or not np.isfinite(ground_m):  # the nearest node is outside of the raster or in a hole
        ground_m = float(scene.elevation.ground_m(*_raster_coordinates(scene, ground, x, y)))
        has_ground = bool(np.isfinite(ground_m))
    if not has_ground:
        raise InputError(POINT_PARAMETER, f"{coordinates[0]:.10g},{coordinates[1]:.10g}", allowed)
    foot, up = scene.world.points_at_zero_height(ground.grid.crs, np.float64(x), np.float64(y))
    lon = lat = None
    if not scene.world.is_flat:
        lon, lat = (float(v) for v in scene.world.lon_lat(ground.grid.crs, np.float64(x), np.float64(y)))
        lon = (lon + 180.0) % 360.0 - 180.0
    axes = scene.world.earth_from_enu(foot, up, lon or 0.0)
    eye = foot + (ground_m + height_m) * up
    return PointPlace(float(x), float(y), lon, lat, row, col, ground_m, height_m, scene.world.ellipsoid, eye, axes)


def _grid_coordinates(scene: Scene, ground: PagedRelief, coordinates: tuple[float, float], crs: CRS | None) -> tuple[float, float]:
    """Return coordinates in the CRS of the ground's grid."""
    if scene.world.is_flat and crs is None:
        return scene.geolocator.xy(coordinates)
    if crs is not None:
        east, north = axes_of(crs).xy(*coordinates)
        coordinates = float(east), float(north)
    if crs == ground.grid.crs:
        return coordinates
    try:
        x, y = transformer(crs or LONGITUDE_LATITUDE, ground.grid.crs).transform(*coordinates)
    except ProjError:
        return np.nan, np.nan
    return float(x), float(y)


def _raster_coordinates(scene: Scene, ground: PagedRelief, x: float, y: float) -> tuple[float, float]:
    """Convert coordinates in the grid's CRS to the CRS of the raster."""
    if ground.grid.crs == scene.elevation.crs:
        return x, y
    return transformer(ground.grid.crs, scene.elevation.crs).transform(x, y)


def _allowed_places_text(scene: Scene, coordinates: tuple[float, float], crs: CRS | None) -> str:
    """Return the allowed coordinates as a phrase for an error message.

    If ``coordinates`` lies within the level's bounds, the phrase states that the raster has no height there.
    """
    if scene.world.is_flat or scene.bounds_lon_lat is None:
        return "a place on the level's data"
    west, south, east, north = scene.bounds_lon_lat
    bounds = f"longitudes {west:.4f} to {east:.4f}, latitudes {south:.4f} to {north:.4f}"
    is_within = (
        crs is None
        and south <= coordinates[1] <= north
        and any(west <= coordinates[0] + shift_deg <= east for shift_deg in (-360.0, 0.0, 360.0))
    )
    if is_within:
        return f"a cell with a height: within the level's bounds ({bounds}) its raster has none there"
    return f"a place on the level's data: {bounds}"
