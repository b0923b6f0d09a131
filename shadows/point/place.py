"""A position on a level's ground, and the eye (the point for which sun is computed) at or above it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyproj import CRS, Geod
from pyproj.exceptions import ProjError

from skugga.shadows.point.relief_pages import PagedRelief, paged_relief
from skugga.shadows.point.terms import MAX_EYE_HEIGHT_M
from skugga.terrain.errors import InputError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, transformer
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
    world
        The world, to whose ellipsoid heights, longitudes and latitudes refer.
    foot_earth_m, up_earth
        float64 (3,): earth-fixed position below the eye at height 0, metres, and the unit vector upwards.
    """

    x: float
    y: float
    lon_deg: float | None
    lat_deg: float | None
    row: float
    col: float
    ground_m: float
    height_m: float
    world: World
    foot_earth_m: np.ndarray
    up_earth: np.ndarray

    @property
    def ellipsoid(self) -> Geod:
        """Ellipsoid to which heights, longitudes and latitudes refer."""
        return self.world.ellipsoid

    @property
    def eye_earth_m(self) -> np.ndarray:
        """Earth-fixed position (3,) of the eye, metres."""
        return self.foot_earth_m + self.eye_elevation_m * self.up_earth

    @cached_property
    def earth_from_enu(self) -> np.ndarray:
        """Rotation (3, 3) from local east, north, up to earth-fixed axes."""
        return self.world.earth_from_enu(self.foot_earth_m, self.up_earth, self.lon_deg or 0.0)

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
    (place,) = places_at(scene, np.array([coordinates], np.float64), crs, np.array([height_m]))
    return place


def places_at(
    scene: Scene, coordinates: np.ndarray, crs: CRS | None = None, height_m: np.ndarray | float = 0.0
) -> list[PointPlace]:
    """Return the places at many coordinates, as ``place_at`` does.

    Parameters
    ----------
    scene
        The scene.
    coordinates
        float64 (n, 2): coordinates as in ``place_at``.
    crs
        The CRS of ``coordinates``; ``None``: the default of ``place_at``.
    height_m
        Heights of the eyes above the ground, metres, (n,) or one for all.

    Raises
    ------
    InputError
        As ``place_at``. It names the first place that is wrong.
    """
    count = len(coordinates)
    heights = np.broadcast_to(np.asarray(height_m, np.float64), (count,))
    for n in np.flatnonzero(~((heights >= 0.0) & (heights <= MAX_EYE_HEIGHT_M)))[:1]:
        value = float(heights[n]) if count == 1 else f"{heights[n]:g}{_position_text(n, count)}"
        raise InputError("height", value, f"0 to {MAX_EYE_HEIGHT_M:.0f} metres above the ground")
    ground = paged_relief(scene)
    x, y = _grid_coordinates(scene, ground, coordinates, crs)
    on_map = np.flatnonzero((np.abs(x) <= MAX_COORDINATE) & (np.abs(y) <= MAX_COORDINATE))
    row, col, ground_m = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    row[on_map], col[on_map] = ground.node_of(x[on_map], y[on_map])
    ground_m[on_map], has_ground = ground.ground_at(row[on_map], col[on_map])
    # At the others the nearest node is outside of the raster or in a hole.
    bare = on_map[~(has_ground & np.isfinite(ground_m[on_map]))]
    if len(bare):
        ground_m[bare] = scene.elevation.ground_m(*_raster_coordinates(scene, ground, x[bare], y[bare]))
    for n in np.flatnonzero(~np.isfinite(ground_m))[:1]:
        allowed = _allowed_places_text(scene, (float(coordinates[n, 0]), float(coordinates[n, 1])), crs)
        value = f"{coordinates[n, 0]:.10g},{coordinates[n, 1]:.10g}{_position_text(n, count)}"
        raise InputError(POINT_PARAMETER, value, allowed)
    foot, up = scene.world.points_at_zero_height(ground.grid.crs, x, y)
    lon_lat: list[tuple[float | None, float | None]] = [(None, None)] * count
    if not scene.world.is_flat:
        lon, lat = scene.world.lon_lat(ground.grid.crs, x, y)
        lon_lat = list(zip(((lon + 180.0) % 360.0 - 180.0).tolist(), lat.tolist(), strict=True))
    return [
        PointPlace(*xy, *position, *node, *eye, scene.world, foot[n], up[n])
        for n, (xy, position, node, eye) in enumerate(
            zip(
                zip(x.tolist(), y.tolist(), strict=True), lon_lat, zip(row.tolist(), col.tolist(), strict=True),
                zip(ground_m.tolist(), heights.tolist(), strict=True), strict=True,
            )
        )
    ]  # fmt: skip


def _position_text(n: int, count: int) -> str:
    """Return which of ``count`` points the one with index ``n`` is, for a message; nothing for a single point."""
    return "" if count == 1 else f" (point {n + 1} of {count})"


def _grid_coordinates(scene: Scene, ground: PagedRelief, coordinates: np.ndarray, crs: CRS | None) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (n, 2) as x and y (n,) in the CRS of the ground's grid. Where this fails they are not finite."""
    x, y = coordinates[:, 0], coordinates[:, 1]
    if scene.world.is_flat and crs is None:
        units_per_metre = 1.0 / scene.world.metres_per_unit
        return scene.world.anchor_x + x * units_per_metre, scene.world.anchor_y + y * units_per_metre
    if crs is not None:
        x, y = axes_of(crs).xy(x, y)
    if crs == ground.grid.crs:
        return x, y
    try:
        return transformer(crs or LONGITUDE_LATITUDE, ground.grid.crs).transform(x, y)
    except ProjError:
        return np.full(len(x), np.nan), np.full(len(x), np.nan)


def _raster_coordinates(scene: Scene, ground: PagedRelief, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
