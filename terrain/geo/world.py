"""The earth-fixed space, its local frames, and the positions of map coordinates in them. All in float64.

- On the globe, earth-fixed coordinates are geocentric metres on the WGS 84 ellipsoid (EPSG:4978). The earth's curvature is thus
  part of every vertex.
- On another celestial body they are geocentric on its own ellipsoid.
- In a flat world (an engineering CRS) they are east, north and up in metres from the anchor, the centre of the level's bounds.

Heights above sea level count as heights above the ellipsoid. The slope of the geoid, below 0.1 m per km, is far below the accuracy
of any raster's heights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pyproj import CRS, Geod, Transformer

from skugga.terrain.cache import MIB, IdentityKey, cached
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.axes import Axes, Bounds, axes_of

WGS84 = Geod(ellps="WGS84")
LONGITUDE_LATITUDE = CRS.from_user_input("OGC:CRS84")

FRAME_SPACING_DEG = 0.25
"""Spacing of the origins of local frames on the globe, in degrees of latitude.

A frame's points lie within about 20 km of its origin, where a float32 step is 1 to 2 mm.
"""

EARTH_RADIUS_M = 6_371_000.0

EARTH_SEMI_MAJOR_M, EARTH_SEMI_MAJOR_TOLERANCE_SHARE = 6_375_000.0, 0.005
"""PROJ takes an ellipsoid for the earth's if its semi-major axis differs by less than this share (``Ellipsoid::guessBodyName``)."""

FRAME_SPACING_M = 16384.0
"""Spacing of the origins of local frames in a flat world."""

TRANSFORMER_BYTES = 2**16
"""Approximate size of a PROJ transformation in memory."""


def _identity_key(*crss: CRS) -> tuple[IdentityKey, ...]:
    """Return a cache key that compares CRSs by identity.

    Hashing a CRS by value serialises it, which takes longer than most cached computations.
    """
    return tuple(map(IdentityKey, crss))


class AxesTransformer:
    """A transformation between CRSs whose axes do not all run east and north (``skugga.terrain.geo.axes``).

    It takes and returns x to the east and y to the north, as ``pyproj`` does for other CRSs.
    """

    def __init__(self, gdal_transformer: Transformer, source: Axes, target: Axes) -> None:
        self._stored, self._source, self._target = gdal_transformer, source, target

    def transform(self, x: float | np.ndarray, y: float | np.ndarray) -> tuple[Any, Any]:
        """Transform x and y from the source CRS to the target CRS. Points outside of the target's area become infinite."""
        first, second = self._stored.transform(*self._source.gdal_coordinates(x, y))
        return self._target.xy(first, second)

    def transform_bounds(self, left: float, bottom: float, right: float, top: float, densify_pts: int = 21) -> Bounds:
        """Transform bounds (west, south, east, north) from the source CRS to the target CRS, as ``pyproj`` does."""
        source_bounds = self._source.gdal_bounds((left, bottom, right, top))
        return self._target.bounds_xy(self._stored.transform_bounds(*source_bounds, densify_pts=densify_pts))


@cached("process", 8 * MIB, key=_identity_key, size_of=lambda _: TRANSFORMER_BYTES)
def transformer(source: CRS, target: CRS) -> Transformer | AxesTransformer:
    """Return a cached transformation between two CRSs, with x to the east and y to the north, and angles in degrees.

    ``LONGITUDE_LATITUDE`` stands for longitude and latitude on the celestial body of the other CRS. Raises ``ProjError`` if no
    transformation exists.
    """
    if source is LONGITUDE_LATITUDE:
        source = longitude_latitude_of(target)
    elif target is LONGITUDE_LATITUDE:
        target = longitude_latitude_of(source)
    stored = Transformer.from_crs(source, target, always_xy=True)
    axes = axes_of(source), axes_of(target)
    return stored if axes[0].are_standard and axes[1].are_standard else AxesTransformer(stored, *axes)


@cached("process", MIB, key=_identity_key, size_of=lambda _: 256)
def ellipsoid_of(crs: CRS) -> Geod:
    """Return the ellipsoid of a CRS's ground: WGS 84, or that of another celestial body."""
    crs_ellipsoid = crs.ellipsoid
    if crs_ellipsoid is None or abs(crs_ellipsoid.semi_major_metre / EARTH_SEMI_MAJOR_M - 1.0) < EARTH_SEMI_MAJOR_TOLERANCE_SHARE:
        return WGS84
    return Geod(a=crs_ellipsoid.semi_major_metre, b=crs_ellipsoid.semi_minor_metre)


def is_on_earth(crs: CRS) -> bool:
    """Return whether a CRS is one of the earth, not of another celestial body."""
    return ellipsoid_of(crs) is WGS84


@cached("process", MIB, key=_identity_key, size_of=lambda _: TRANSFORMER_BYTES)
def longitude_latitude_of(crs: CRS) -> CRS:
    """Return the CRS of longitude (east) and latitude in degrees on a CRS's celestial body."""
    if is_on_earth(crs) or crs.geodetic_crs is None:
        return LONGITUDE_LATITUDE
    geodetic = crs.geodetic_crs.to_json_dict()
    axes = [
        {"name": name, "abbreviation": name[:3], "direction": direction, "unit": "degree"}
        for name, direction in (("Longitude", "east"), ("Latitude", "north"))
    ]
    datum = {key: geodetic[key] for key in ("datum", "datum_ensemble") if key in geodetic}
    return CRS.from_json_dict(
        {"type": "GeographicCRS", "name": geodetic["name"], **datum, "coordinate_system": {"subtype": "ellipsoidal", "axis": axes}}
    )


@cached("process", MIB, key=_identity_key, size_of=lambda _: 256)
def epsg_of(crs: CRS) -> int | None:
    """Return a CRS's EPSG code, or ``None``. Cached, since a search without result takes PROJ 0.2 s."""
    return crs.to_epsg()


def is_longitude_latitude(crs: CRS) -> bool:
    """Return whether x and y of a CRS are longitudes and latitudes of WGS 84."""
    return crs == LONGITUDE_LATITUDE or epsg_of(crs) == 4326


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """A local metric east-north-up frame: ``point_frame = frame_from_earth @ (point_earth - origin_earth_m)``.

    Methods take and return vectors (..., 3); points are in metres.

    Attributes
    ----------
    key
        Index (east, north) of the frame's origin in the lattice of origins.
    origin_earth_m
        (3,), the earth-fixed origin in metres.
    frame_from_earth
        (3, 3), the rotation from earth-fixed axes to the frame's.
    """

    key: tuple[int, int]
    origin_earth_m: np.ndarray
    frame_from_earth: np.ndarray

    def points_from_earth(self, point_earth_m: np.ndarray) -> np.ndarray:
        """Return the frame points of earth-fixed points."""
        return (point_earth_m - self.origin_earth_m) @ self.frame_from_earth.T

    def points_to_earth(self, point_frame_m: np.ndarray) -> np.ndarray:
        """Return the earth-fixed points of frame points."""
        return point_frame_m @ self.frame_from_earth + self.origin_earth_m

    def directions_from_earth(self, direction_earth: np.ndarray) -> np.ndarray:
        """Return the frame directions of earth-fixed directions."""
        return direction_earth @ self.frame_from_earth.T

    def directions_to_earth(self, direction_frame: np.ndarray) -> np.ndarray:
        """Return the earth-fixed directions of frame directions."""
        return direction_frame @ self.frame_from_earth


@dataclass(frozen=True)
class World:
    """The space in which a level's ground lies: the earth, another celestial body, or a flat world.

    Attributes
    ----------
    crs
        The CRS of the elevation source.
    is_flat
        Whether the world is flat (an engineering CRS).
    anchor_x, anchor_y
        The anchor in ``crs``: the centre of the level's bounds. All lattices (frames, texels, map samples outside tile matrices)
        are counted from it.
    anchor_lon_deg, anchor_lat_deg
        The anchor's longitude and latitude; 0 in a flat world.
    metres_per_unit
        Metres per unit of ``crs``; 1 for a geographic CRS.
    """

    crs: CRS
    is_flat: bool
    anchor_x: float
    anchor_y: float
    anchor_lon_deg: float = 0.0
    anchor_lat_deg: float = 0.0
    metres_per_unit: float = 1.0

    def __hash__(self) -> int:
        return hash((self.is_flat, self.anchor_x, self.anchor_y, self.metres_per_unit))

    @cached_property
    def ellipsoid(self) -> Geod:
        """The ellipsoid of earth-fixed points: WGS 84, or that of another celestial body."""
        return ellipsoid_of(self.crs)

    @property
    def radius_m(self) -> float:
        """The mean radius of the earth, or of the celestial body, in metres."""
        if self.is_on_earth:
            return EARTH_RADIUS_M
        return float(2.0 * self.ellipsoid.a + self.ellipsoid.b) / 3.0

    @property
    def is_on_earth(self) -> bool:
        """Whether the ground is on the earth or in a flat world, not on another celestial body."""
        return self.is_flat or self.ellipsoid is WGS84

    @property
    def off_earth_reason(self) -> str | None:
        """The reason why the ground is not georeferenced on the earth; ``None`` on the earth. Dates and tiles need the earth."""
        if self.is_flat:
            return "an engineering CRS is not georeferenced"
        return None if self.is_on_earth else f"'{self.crs.name}' is not a CRS of the earth"

    def points_at_zero_height(self, crs: CRS, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return earth-fixed points (..., 3) at height 0, in metres, and the unit up vectors there, of map coordinates in ``crs``.

        Coordinates that cannot be transformed give NaN. A flat world raises ``UnsupportedError`` for any CRS but its own.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        if self.is_flat:
            if crs != self.crs:
                raise UnsupportedError("crs", crs.name, f"the level's engineering CRS '{self.crs.name}' cannot be transformed")
            east, north = (x - self.anchor_x) * self.metres_per_unit, (y - self.anchor_y) * self.metres_per_unit
            up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (*x.shape, 3))
            return np.stack([east, north, np.zeros_like(east)], axis=-1), up
        return geocentric(*self.lon_lat(crs, x, y), self.ellipsoid)

    def lon_lat(self, crs: CRS, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return longitude and latitude in degrees of map coordinates in ``crs``; NaN where they cannot be transformed.

        Coordinates that already are longitudes and latitudes of WGS 84 are returned unchanged, not wrapped.
        """
        if is_longitude_latitude(crs):
            return np.asarray(x, np.float64), np.asarray(y, np.float64)
        lon, lat = transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
        is_invalid = ~(np.isfinite(lon) & np.isfinite(lat))
        return np.where(is_invalid, np.nan, lon), np.where(is_invalid, np.nan, lat)

    def earth_from_enu(self, point_earth: np.ndarray, up_earth: np.ndarray, polar_lon_deg: float = 0.0) -> np.ndarray:
        """Return the rotation (3, 3) whose columns are east, north and up at an earth-fixed point.

        At a pole, where east is undefined, it uses the axes of the meridian ``polar_lon_deg``, by default Greenwich's.
        """
        if self.is_flat:
            return np.eye(3)
        east = np.array([-point_earth[1], point_earth[0], 0.0])
        length = np.hypot(east[0], east[1])
        east = east / length if length > 1e-6 else direction_east(polar_lon_deg)
        return np.column_stack([east, np.cross(up_earth, east), up_earth])

    @property
    def anchor_earth_m(self) -> np.ndarray:
        """The anchor at height 0, earth-fixed (3,), in metres."""
        return self._anchor[0]

    def anchor_from_frame(self, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation (3, 3) from a frame to the anchor's east-north-up axes, and its origin (3,) in them, in metres."""
        anchor_from_earth = self.earth_from_anchor.T
        return anchor_from_earth @ frame.frame_from_earth.T, anchor_from_earth @ (frame.origin_earth_m - self.anchor_earth_m)

    @property
    def earth_from_anchor(self) -> np.ndarray:
        """Rotation (3, 3) from the anchor's east-north-up axes to earth-fixed axes. At a pole it uses the anchor's longitude."""
        return self.earth_from_enu(*self._anchor, self.anchor_lon_deg)

    @property
    def _anchor(self) -> tuple[np.ndarray, np.ndarray]:
        """The anchor at height 0, earth-fixed (3,), in metres, and the unit up vector (3,) there."""
        if self.is_flat:
            return np.zeros(3), np.array([0.0, 0.0, 1.0])
        return geocentric(np.float64(self.anchor_lon_deg), np.float64(self.anchor_lat_deg), self.ellipsoid)

    def frame_near(self, crs: CRS, x: float, y: float) -> LocalFrame:
        """Return the local frame whose origin is nearest to a map position.

        Origins form a lattice that is counted from the anchor. Raises ``UnsupportedError`` for a position outside of the CRS's
        area.
        """
        if self.is_flat:
            point, _ = self.points_at_zero_height(crs, np.float64(x), np.float64(y))
            return self._flat_frame(point, FRAME_SPACING_M)
        lon, lat = (float(v) for v in self.lon_lat(crs, np.float64(x), np.float64(y)))
        if not np.isfinite(lon + lat):
            raise UnsupportedError("view", f"{x}, {y}", f"the point lies outside of the area of '{crs.name}'")
        return self._globe_frame(lon, lat, FRAME_SPACING_DEG)

    def frame_near_earth(self, point_earth_m: np.ndarray, spacing_share: float = 1.0) -> LocalFrame:
        """Return the local frame whose origin is nearest to an earth-fixed point (3,).

        Origins form a lattice whose spacing is ``spacing_share`` times that for maps (``FRAME_SPACING_DEG``, ``FRAME_SPACING_M``).
        """
        if self.is_flat:
            return self._flat_frame(point_earth_m, FRAME_SPACING_M * spacing_share)
        lon, lat, _ = geodetic(point_earth_m, self.ellipsoid)
        return self._globe_frame(float(lon), float(lat), FRAME_SPACING_DEG * spacing_share)

    def _flat_frame(self, point_m: np.ndarray, spacing_m: float) -> LocalFrame:
        """Return the frame of a flat world whose origin is nearest to a point (3,). Origins are ``spacing_m`` apart."""
        return _frame(self, int(np.rint(point_m[0] / spacing_m)), int(np.rint(point_m[1] / spacing_m)), spacing_m)

    def _globe_frame(self, lon: float, lat: float, spacing_deg: float) -> LocalFrame:
        """Return the frame on the globe whose origin is nearest to a position in degrees.

        ``spacing_deg`` is that of the latitudes.
        """
        delta_lon = (lon - self.anchor_lon_deg + 180.0) % 360.0 - 180.0
        i, j = delta_lon / (spacing_deg / self._cos_anchor_lat), (lat - self.anchor_lat_deg) / spacing_deg
        return _frame(self, int(np.rint(i)), int(np.rint(j)), spacing_deg)

    @property
    def _cos_anchor_lat(self) -> float:
        """Length of a degree of longitude at the anchor, in degrees of latitude."""
        return float(max(np.cos(np.radians(self.anchor_lat_deg)), 0.01))

    def map_position(self, crs: CRS, point_earth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x, y in a CRS and height in metres of earth-fixed points (..., 3).

        A flat world raises ``UnsupportedError`` for any CRS but its own.
        """
        if self.is_flat:
            if crs != self.crs:
                raise UnsupportedError("crs", crs.name, f"the level's engineering CRS '{self.crs.name}' cannot be transformed")
            scale = 1.0 / self.metres_per_unit
            return (
                point_earth_m[..., 0] * scale + self.anchor_x,
                point_earth_m[..., 1] * scale + self.anchor_y,
                point_earth_m[..., 2],
            )
        lon, lat, height = geodetic(point_earth_m, self.ellipsoid)
        if not is_longitude_latitude(crs):
            lon, lat = transformer(LONGITUDE_LATITUDE, crs).transform(lon, lat)
        return np.asarray(lon), np.asarray(lat), height

    def up_origin(self, frame: LocalFrame) -> np.ndarray:
        """Return the frame point (3,) from which "up" points away: the earth's centre, or a point far below a flat world."""
        return np.array([0.0, 0.0, -1e12]) if self.is_flat else frame.points_from_earth(np.zeros(3))

    @property
    def curvature(self) -> float:
        """Change of "up" per metre away from a frame's origin, in radians; 0 in a flat world."""
        return 0.0 if self.is_flat else 1.0 / self.radius_m


@cached("process", MIB)
def _frame(world: World, i: int, j: int, spacing: float) -> LocalFrame:
    """Return the frame whose origin has index (i, j) in a lattice of spacing ``spacing``, in degrees, or metres in a flat world.

    Cached, so that caches may compare frames by identity.
    """
    if world.is_flat:
        return LocalFrame((i, j), np.array([i * spacing, j * spacing, 0.0]), np.eye(3))
    lon = world.anchor_lon_deg + i * spacing / world._cos_anchor_lat
    origin, up = geocentric(np.float64(lon), np.float64(world.anchor_lat_deg + j * spacing), world.ellipsoid)
    return LocalFrame((i, j), origin, world.earth_from_enu(origin, up).T)


def direction_east(lon_deg: float) -> np.ndarray:
    """Return the earth-fixed unit vector (3,) towards the east on a meridian."""
    lon = np.radians(lon_deg)
    return np.array([-np.sin(lon), np.cos(lon), 0.0])


def geocentric(lon_deg: float | np.ndarray, lat_deg: float | np.ndarray, ellipsoid: Geod = WGS84) -> tuple[np.ndarray, np.ndarray]:
    """Return geocentric points (..., 3) in metres on an ellipsoid, and the unit normals there.

    Source: EPSG Guidance Note 7-2, section 4.1.1 (geographic/geocentric conversions). Latitudes beyond 90 degrees continue over the
    pole, so that an interpolation across it stays smooth.
    """
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    prime_vertical = ellipsoid.a / np.sqrt(1.0 - ellipsoid.es * np.sin(lat) ** 2)
    return up * np.stack([prime_vertical, prime_vertical, prime_vertical * (1.0 - ellipsoid.es)], axis=-1), up


def geodetic(point_earth_m: np.ndarray, ellipsoid: Geod = WGS84) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return longitude and latitude in degrees and ellipsoidal height in metres of geocentric points (..., 3).

    By PROJ (EPSG Guidance Note 7-2, section 4.1.1).
    """
    x, y, z = np.moveaxis(np.asarray(point_earth_m, np.float64), -1, 0)
    return _geodetic(ellipsoid.a, ellipsoid.b).transform(x, y, z)


@cached("process", MIB)
def _geodetic(a: float, b: float) -> Transformer:
    """Return PROJ's transformation from geocentric points to longitude, latitude and height.

    ``a`` and ``b`` are the semi-major and semi-minor axis of the ellipsoid, metres.
    """
    return Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=cart +a={a!r} +b={b!r} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
