"""Azimuth and altitude of the sun at a point, relative to the horizontal plane and the north direction at the point.

The earth-fixed direction to the sun is the same for all points of a level. Refraction is computed at the level's anchor
(``skugga.terrain.geo.sun``), so that results for points agree with shadow masks.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.sun import azimuth_and_altitude
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.geo.world import World
from skugga.terrain.scene import Scene


def sun_directions(world: World, utc_s: np.ndarray) -> np.ndarray:
    """Return earth-fixed unit vectors (n, 3) towards the apparent (refracted) sun, at times ``utc_s`` (n,).

    Times are UTC seconds since 1970.

    Raises ``InputError`` for worlds other than the earth, and for years outside of the sun's ephemeris.
    """
    if world.off_earth_reason is not None:
        raise InputError(
            "time", Problem(f"a time does not define the sun here, since {world.off_earth_reason}"), "Use azimuth and altitude"
        )
    return _sun_directions_on_earth(world, np.asarray(utc_s, np.float64))


def sun_samples(world: World, begin_s: float, end_s: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return UTC seconds (n,) in even steps and at the end of a time span, and the unit vectors (n, 3) towards the sun.

    The span lasts from ``begin_s`` to ``end_s``, UTC seconds since 1970, and a step ``step_s`` seconds. The vectors are
    earth-fixed. The last results are cached, since all points of a level share them. Raises the errors of ``sun_directions``.
    """
    if world.off_earth_reason is not None:
        sun_directions(world, np.zeros(0))
    return _cached_samples(world, begin_s, end_s, step_s)


@cached("process", 16 * MIB)
def _cached_samples(world: World, begin_s: float, end_s: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and directions of ``sun_samples``.

    The arguments are those of ``sun_samples``.
    """
    utc_s = np.append(np.arange(begin_s, end_s, step_s), end_s)
    return utc_s, _sun_directions_on_earth(world, utc_s)


def sun_angles_at(place: PointPlace, to_sun_earth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the azimuths and the altitudes, (n,) degrees each, of directions at a place.

    ``to_sun_earth`` (n, 3) are the directions, earth-fixed unit vectors.
    """
    east, north, up = (to_sun_earth @ place.earth_from_enu).T
    return np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arctan2(up, np.hypot(east, north)))


def scene_sun_at(scene: Scene, place: PointPlace) -> tuple[float, float] | None:
    """Return azimuth and altitude in degrees of the scene's own sun at a place; ``None`` without a sun."""
    return None if scene.sun is None else azimuth_and_altitude(scene.sun.to_sun_earth, place.earth_from_enu)


def _sun_directions_on_earth(world: World, utc_s: np.ndarray) -> np.ndarray:
    """Return the directions of ``sun_directions``.

    The times ``utc_s`` (n,) are UTC seconds since 1970.
    """
    times = np.rint(np.asarray(utc_s) * 1e6).astype(np.int64).astype("datetime64[us]")
    path = sun_path(times, world.anchor_lon_deg, world.anchor_lat_deg)
    azimuth, altitude = np.radians(path.azimuth_deg), np.radians(path.altitude_deg)
    enu = np.stack([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)], axis=-1)
    return enu @ world.earth_from_anchor.T
