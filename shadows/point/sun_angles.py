"""Where the sun stands at a point: the one direction that it has for all of a level, by the point's own axes.

Refraction is the anchor's, as everywhere (``skugga.terrain.geo.sun``), so that a point agrees with its level's masks.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun import position_at
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.geo.world import World
from skugga.terrain.scene import Scene


def sun_directions(world: World, utc_s: np.ndarray) -> np.ndarray:
    """Earth-fixed unit vectors (n, 3) towards the sun, refracted, at seconds since 1970, UTC.

    Raises ``InputError`` off the earth, and for years for which no sun is computed.
    """
    if world.off_earth is not None:
        raise InputError("time", "a time or a day", f"azimuth and altitude: {world.off_earth}")
    return _directions(world, np.asarray(utc_s, np.float64))


def sun_looks(world: World, begin_s: float, end_s: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (n,) from one moment to another, every so often and at the end, and the sun's directions (n, 3) then; the last ones
    are kept, since all points of a level share them. Raises as ``sun_directions``.
    """
    if world.off_earth is not None:
        sun_directions(world, np.zeros(0))
    return _looks(world, begin_s, end_s, step_s)


@cached("process", 16 * MIB)
def _looks(world: World, begin_s: float, end_s: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    utc_s = np.append(np.arange(begin_s, end_s, step_s), end_s)
    return utc_s, _directions(world, utc_s)


def angles_at(place: PointPlace, to_sun_earth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths and altitudes (n,) in degrees of directions (n, 3), by the axes of a place."""
    east, north, up = (to_sun_earth @ place.earth_from_enu).T
    return np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arctan2(up, np.hypot(east, north)))


def own_sun_at(scene: Scene, place: PointPlace) -> tuple[float, float] | None:
    """Azimuth and altitude in degrees of the scene's own sun at a place; ``None`` without a sun."""
    return None if scene.sun is None else position_at(scene.sun.to_sun_earth, place.earth_from_enu)


def _directions(world: World, utc_s: np.ndarray) -> np.ndarray:
    times = np.rint(np.asarray(utc_s) * 1e6).astype(np.int64).astype("datetime64[us]")
    path = sun_path(times, world.anchor_lon_deg, world.anchor_lat_deg)
    azimuth, altitude = np.radians(path.azimuth_deg), np.radians(path.altitude_deg)
    enu = np.stack([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)], axis=-1)
    return enu @ world.earth_from_anchor.T
