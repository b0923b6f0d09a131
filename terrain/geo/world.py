"""The earth-fixed space, its local frames, and where a map's coordinates lie in them. All in float64.

On the globe, earth-fixed coordinates are geocentric metres on the WGS 84 ellipsoid (EPSG:4978), so the earth's
curvature bends every vertex without further ado. On another celestial body they are geocentric on its own ellipsoid. In a
flat world (an engineering CRS) they are east, north, up metres from the anchor. Heights above sea level are taken as heights
above the ellipsoid: the geoid's slope, under 0.1 m a kilometre, is far below what any raster's heights are good for.
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

FRAME_PITCH_DEG = 0.25
"""Spacing of frame origins on the globe: a frame's points lie within about 20 km, where a float32 step is 1 to 2 mm."""

EARTH_RADIUS_M = 6_371_000.0

EARTHS_AXIS_M, LIKE_EARTH = 6_375_000.0, 0.005
"""PROJ takes an ellipsoid for the earth's if its semi-major axis differs by less than this share (``Ellipsoid::guessBodyName``)."""

FRAME_PITCH_M = 16384.0
"""Spacing of frame origins in a flat world."""

TRANSFORMER_BYTES = 2**16
"""About what PROJ holds of a transformation."""


def _identity(*crss: CRS) -> tuple[IdentityKey, ...]:
    """CRSs as keys: they are written out to be hashed, which takes longer than most of what is looked up by them."""
    return tuple(map(IdentityKey, crss))


class AxesTransformer:
    """A transformation between CRSs, one of axes of its own (``skugga.terrain.geo.axes``): x to the east before y to the north."""

    def __init__(self, stored: Transformer, source: Axes, target: Axes) -> None:
        self._stored, self._source, self._target = stored, source, target

    def transform(self, x: float | np.ndarray, y: float | np.ndarray) -> tuple[Any, Any]:
        """x and y in the target of x and y in the source; infinite where there are none."""
        first, second = self._stored.transform(*self._source.stored(x, y))
        return self._target.xy(first, second)

    def transform_bounds(self, left: float, bottom: float, right: float, top: float, densify_pts: int = 21) -> Bounds:
        """West, south, east, north in the target of those in the source, as ``pyproj`` finds them."""
        stored = self._source.bounds_stored((left, bottom, right, top))
        return self._target.bounds_xy(self._stored.transform_bounds(*stored, densify_pts=densify_pts))


@cached("process", 8 * MIB, key=_identity, size_of=lambda _: TRANSFORMER_BYTES)
def transformer(source: CRS, target: CRS) -> Transformer | AxesTransformer:
    """A cached coordinate transformation, x to the east before y to the north, in degrees where they are angles.

    ``LONGITUDE_LATITUDE`` are those of the celestial body of the other CRS. Raises ``ProjError`` where there is none.
    """
    if source is LONGITUDE_LATITUDE:
        source = longitude_latitude_of(target)
    elif target is LONGITUDE_LATITUDE:
        target = longitude_latitude_of(source)
    stored = Transformer.from_crs(source, target, always_xy=True)
    axes = axes_of(source), axes_of(target)
    return stored if axes[0].are_standard and axes[1].are_standard else AxesTransformer(stored, *axes)


@cached("process", MIB, key=_identity, size_of=lambda _: 256)
def ellipsoid_of(crs: CRS) -> Geod:
    """The ellipsoid on which a CRS's ground is computed: WGS 84, or that of another celestial body."""
    own = crs.ellipsoid
    if own is None or abs(own.semi_major_metre / EARTHS_AXIS_M - 1.0) < LIKE_EARTH:
        return WGS84
    return Geod(a=own.semi_major_metre, b=own.semi_minor_metre)


def is_on_earth(crs: CRS) -> bool:
    """Whether a CRS is one of the earth, and not of another celestial body."""
    return ellipsoid_of(crs) is WGS84


@cached("process", MIB, key=_identity, size_of=lambda _: TRANSFORMER_BYTES)
def longitude_latitude_of(crs: CRS) -> CRS:
    """Longitude, to the east, and latitude in degrees on the celestial body of a CRS."""
    if is_on_earth(crs) or crs.geodetic_crs is None:
        return LONGITUDE_LATITUDE
    own = crs.geodetic_crs.to_json_dict()
    axes = [
        {"name": name, "abbreviation": name[:3], "direction": direction, "unit": "degree"}
        for name, direction in (("Longitude", "east"), ("Latitude", "north"))
    ]
    kept = {key: own[key] for key in ("datum", "datum_ensemble") if key in own}
    return CRS.from_json_dict(
        {"type": "GeographicCRS", "name": own["name"], **kept, "coordinate_system": {"subtype": "ellipsoidal", "axis": axes}}
    )


@cached("process", MIB, key=_identity, size_of=lambda _: 256)
def epsg_of(crs: CRS) -> int | None:
    """A CRS's EPSG code, if it has one: kept, since looking for one in vain takes PROJ 0.2 s."""
    return crs.to_epsg()


def is_longitude_latitude(crs: CRS) -> bool:
    """Whether x and y of a CRS are longitudes and latitudes of WGS 84."""
    return crs == LONGITUDE_LATITUDE or epsg_of(crs) == 4326


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """A local metric east-north-up frame: ``point_frame = frame_from_earth @ (point_earth - origin_earth_m)``.

    What the methods take and give are vectors (..., 3), points in metres.
    """

    key: tuple[int, int]
    origin_earth_m: np.ndarray
    frame_from_earth: np.ndarray

    def points_from_earth(self, point_earth_m: np.ndarray) -> np.ndarray:
        """Frame points of earth-fixed ones."""
        return (point_earth_m - self.origin_earth_m) @ self.frame_from_earth.T

    def points_to_earth(self, point_frame_m: np.ndarray) -> np.ndarray:
        """Earth-fixed points of the frame's."""
        return point_frame_m @ self.frame_from_earth + self.origin_earth_m

    def directions_from_earth(self, direction_earth: np.ndarray) -> np.ndarray:
        """Directions in the frame of earth-fixed ones."""
        return direction_earth @ self.frame_from_earth.T

    def directions_to_earth(self, direction_frame: np.ndarray) -> np.ndarray:
        """Earth-fixed directions of the frame's."""
        return direction_frame @ self.frame_from_earth


@dataclass(frozen=True)
class World:
    """The space a level lives in.

    ``crs`` is the elevation source's. The anchor is the centre of the level's bounds: everything that lies on a lattice
    (frames, texels, map samples outside tile matrices) is counted from it.
    """

    crs: CRS
    flat: bool
    anchor_x: float
    anchor_y: float
    anchor_lon_deg: float = 0.0
    anchor_lat_deg: float = 0.0
    metres_per_unit: float = 1.0

    def __hash__(self) -> int:
        return hash((self.flat, self.anchor_x, self.anchor_y, self.metres_per_unit))

    @cached_property
    def ellipsoid(self) -> Geod:
        """The ellipsoid that earth-fixed points are counted from: WGS 84, or that of another celestial body."""
        return ellipsoid_of(self.crs)

    @property
    def radius_m(self) -> float:
        """The mean radius of the earth, or of the celestial body, metres."""
        if self.on_earth:
            return EARTH_RADIUS_M
        return float(2.0 * self.ellipsoid.a + self.ellipsoid.b) / 3.0

    @property
    def on_earth(self) -> bool:
        """Whether it is the earth, or ground that lies nowhere; and not another celestial body."""
        return self.flat or self.ellipsoid is WGS84

    @property
    def off_earth(self) -> str | None:
        """Why it is no ground of the earth, where times have suns and tiles lie; ``None`` on the earth."""
        if self.flat:
            return "an engineering CRS is not georeferenced"
        return None if self.on_earth else f"'{self.crs.name}' is not a CRS of the earth"

    def ground(self, crs: CRS, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Earth-fixed points (..., 3) of height 0 and the unit vectors up there, for map coordinates in ``crs``.

        Raises ``UnsupportedError`` where a flat world is asked for in another CRS. Coordinates that the CRS cannot
        transform give NaN.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        if self.flat:
            if crs != self.crs:
                raise UnsupportedError("crs", crs.name, f"the level's engineering CRS '{self.crs.name}' cannot be transformed")
            east, north = (x - self.anchor_x) * self.metres_per_unit, (y - self.anchor_y) * self.metres_per_unit
            up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (*x.shape, 3))
            return np.stack([east, north, np.zeros_like(east)], axis=-1), up
        return geocentric(*self.lon_lat(crs, x, y), self.ellipsoid)

    def lon_lat(self, crs: CRS, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Longitude and latitude in degrees; NaN where the CRS has none. Longitudes of WGS 84 pass through unwrapped."""
        if is_longitude_latitude(crs):
            return np.asarray(x, np.float64), np.asarray(y, np.float64)
        lon, lat = transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
        bad = ~(np.isfinite(lon) & np.isfinite(lat))
        return np.where(bad, np.nan, lon), np.where(bad, np.nan, lat)

    def earth_from_enu(self, point_earth: np.ndarray, up_earth: np.ndarray, polar_lon_deg: float = 0.0) -> np.ndarray:
        """Rotation (3, 3) whose columns are east, north and up at a point, earth-fixed.

        At a pole, where east is undefined, the axes of a meridian are taken: Greenwich's, unless another one is given.
        """
        if self.flat:
            return np.eye(3)
        east = np.array([-point_earth[1], point_earth[0], 0.0])
        length = np.hypot(east[0], east[1])
        east = east / length if length > 1e-6 else direction_east(polar_lon_deg)
        return np.column_stack([east, np.cross(up_earth, east), up_earth])

    @property
    def anchor_earth_m(self) -> np.ndarray:
        """The anchor at height 0, earth-fixed."""
        return self._anchor[0]

    def anchor_from_frame(self, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) from a frame to the anchor's east-north-up axes, and the frame's origin (3,) there, metres."""
        anchor_from_earth = self.earth_from_anchor.T
        return anchor_from_earth @ frame.frame_from_earth.T, anchor_from_earth @ (frame.origin_earth_m - self.anchor_earth_m)

    @property
    def earth_from_anchor(self) -> np.ndarray:
        """Rotation from the anchor's east-north-up axes to earth-fixed ones; at a pole those of the anchor's longitude."""
        return self.earth_from_enu(*self._anchor, self.anchor_lon_deg)

    @property
    def _anchor(self) -> tuple[np.ndarray, np.ndarray]:
        if self.flat:
            return np.zeros(3), np.array([0.0, 0.0, 1.0])
        return geocentric(np.float64(self.anchor_lon_deg), np.float64(self.anchor_lat_deg), self.ellipsoid)

    def frame_near(self, crs: CRS, x: float, y: float) -> LocalFrame:
        """The frame of the lattice whose origin is nearest to a map coordinate. The lattice is counted from the anchor."""
        if self.flat:
            point, _ = self.ground(crs, np.float64(x), np.float64(y))
            return self._flat_frame(point, FRAME_PITCH_M)
        lon, lat = (float(v) for v in self.lon_lat(crs, np.float64(x), np.float64(y)))
        if not np.isfinite(lon + lat):
            raise UnsupportedError("view", f"{x}, {y}", f"outside of the area of '{crs.name}'")
        return self._globe_frame(lon, lat, FRAME_PITCH_DEG)

    def frame_near_earth(self, point_earth_m: np.ndarray, pitch_share: float = 1.0) -> LocalFrame:
        """The frame nearest to an earth-fixed point, of a lattice whose pitch is a share of the maps'."""
        if self.flat:
            return self._flat_frame(point_earth_m, FRAME_PITCH_M * pitch_share)
        lon, lat, _ = geodetic(point_earth_m, self.ellipsoid)
        return self._globe_frame(float(lon), float(lat), FRAME_PITCH_DEG * pitch_share)

    def _flat_frame(self, point_m: np.ndarray, pitch_m: float) -> LocalFrame:
        return _frame(self, int(np.rint(point_m[0] / pitch_m)), int(np.rint(point_m[1] / pitch_m)), pitch_m)

    def _globe_frame(self, lon: float, lat: float, pitch_deg: float) -> LocalFrame:
        away = (lon - self.anchor_lon_deg + 180.0) % 360.0 - 180.0
        i, j = away / (pitch_deg / self._narrowing), (lat - self.anchor_lat_deg) / pitch_deg
        return _frame(self, int(np.rint(i)), int(np.rint(j)), pitch_deg)

    @property
    def _narrowing(self) -> float:
        """Length of a degree of longitude at the anchor, in degrees of latitude."""
        return float(max(np.cos(np.radians(self.anchor_lat_deg)), 0.01))

    def map_position(self, crs: CRS, point_earth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y in a CRS and height in metres of earth-fixed points (..., 3). Raises ``UnsupportedError`` as ``ground``."""
        if self.flat:
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

    def up_from(self, frame: LocalFrame) -> np.ndarray:
        """The frame point (3,) that "up" points away from: the earth's centre, or one far below a flat world."""
        return np.array([0.0, 0.0, -1e12]) if self.flat else frame.points_from_earth(np.zeros(3))

    @property
    def curvature(self) -> float:
        """How much "up" leans per metre away from a frame's origin: 0 in a flat world."""
        return 0.0 if self.flat else 1.0 / self.radius_m


@cached("process", MIB)
def _frame(world: World, i: int, j: int, pitch: float) -> LocalFrame:
    """A frame of the lattice; kept, so that what is made for a frame can be kept by it."""
    if world.flat:
        return LocalFrame((i, j), np.array([i * pitch, j * pitch, 0.0]), np.eye(3))
    lon = world.anchor_lon_deg + i * pitch / world._narrowing
    origin, up = geocentric(np.float64(lon), np.float64(world.anchor_lat_deg + j * pitch), world.ellipsoid)
    return LocalFrame((i, j), origin, world.earth_from_enu(origin, up).T)


def direction_east(lon_deg: float) -> np.ndarray:
    """Unit vector (3,) towards the east on a meridian, earth-fixed."""
    lon = np.radians(lon_deg)
    return np.array([-np.sin(lon), np.cos(lon), 0.0])


def geocentric(lon_deg: float | np.ndarray, lat_deg: float | np.ndarray, ellipsoid: Geod = WGS84) -> tuple[np.ndarray, np.ndarray]:
    """Geocentric points (..., 3) in metres on an ellipsoid and the unit normals there.

    Source: EPSG Guidance Note 7-2, section 4.1.1 (geographic/geocentric conversions). Latitudes beyond 90 degrees
    continue over the pole, so that an interpolation across it stays smooth.
    """
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    prime_vertical = ellipsoid.a / np.sqrt(1.0 - ellipsoid.es * np.sin(lat) ** 2)
    return up * np.stack([prime_vertical, prime_vertical, prime_vertical * (1.0 - ellipsoid.es)], axis=-1), up


def geodetic(point_earth_m: np.ndarray, ellipsoid: Geod = WGS84) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longitude and latitude in degrees and ellipsoidal height in metres of geocentric points (..., 3).

    By PROJ (EPSG Guidance Note 7-2, section 4.1.1).
    """
    x, y, z = np.moveaxis(np.asarray(point_earth_m, np.float64), -1, 0)
    return _geodetic(ellipsoid.a, ellipsoid.b).transform(x, y, z)


@cached("process", MIB)
def _geodetic(a: float, b: float) -> Transformer:
    return Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=cart +a={a!r} +b={b!r} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
