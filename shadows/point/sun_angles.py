"""Where the sun stands at a point: the one direction that it has for all of a level, by the point's own axes.

Refraction is the anchor's, as everywhere (``terrain.geo.sun``), so that a point agrees with its level's masks.
"""

from __future__ import annotations

import numpy as np

from shadows.point.place import PointPlace
from terrain.errors import InputError
from terrain.geo.sun import position_at
from terrain.scene import Scene


def sun_angles_at(scene: Scene, place: PointPlace, utc_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apparent azimuths and altitudes (n,) in degrees at seconds since 1970, UTC. Raises ``InputError`` in a flat world."""
    world = scene.world
    if world.flat:
        raise InputError("time", "a time or a day", "azimuth and altitude: an engineering CRS is not georeferenced")
    azimuth, altitude = _apparent(utc_s, world.anchor_lon_deg, world.anchor_lat_deg)
    azimuth, altitude = np.radians(azimuth), np.radians(altitude)
    enu = np.stack([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)], axis=-1)
    east, north, up = (enu @ world.earth_from_anchor.T @ place.earth_from_enu).T
    return np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arctan2(up, np.hypot(east, north)))


def sun_now_at(scene: Scene, place: PointPlace) -> tuple[float, float] | None:
    """Apparent azimuth and altitude in degrees of the scene's own sun at a place; ``None`` without a sun."""
    return None if scene.sun is None else position_at(scene.sun.to_sun_earth, place.earth_from_enu)


def _apparent(utc_s: np.ndarray, lon_deg: float, lat_deg: float) -> tuple[np.ndarray, np.ndarray]:
    import pandas
    from pvlib.solarposition import spa_python

    times = pandas.to_datetime(np.asarray(utc_s), unit="s", utc=True)
    found = spa_python(times, lat_deg, lon_deg, altitude=0, pressure=101325, temperature=12)
    return found["azimuth"].to_numpy() % 360.0, found["apparent_elevation"].to_numpy()
