"""One sun for the whole earth: for a time there is one earth-fixed direction to it.

Azimuth and altitude at a place follow from the place's own axes. Refraction is added once, at the level's anchor;
angles given by a user are apparent, at the anchor.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np

from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.level.parts import SunSpec

SUN_RADIUS_DEG = 0.265
"""Half the sun's apparent diameter: 0.262 in July, 0.271 in January."""


@dataclass(frozen=True, eq=False)
class Sun:
    """The sun: angles at the anchor and the earth-fixed unit vector towards it.

    ``lift_deg`` is by how much refraction raises it there, which is part of ``altitude_deg``; 0 for angles that a user gave.
    """

    azimuth_deg: float
    altitude_deg: float
    to_sun_earth: np.ndarray
    time: datetime | None = None
    lift_deg: float = 0.0

    def in_frame(self, frame: LocalFrame) -> np.ndarray:
        """The unit vector (3,) towards it in a frame."""
        return frame.directions_from_earth(self.to_sun_earth)

    def without_refraction(self, world: World) -> Sun:
        """The sun as it would be seen without an atmosphere."""
        if self.lift_deg == 0.0:
            return self
        altitude = self.altitude_deg - self.lift_deg
        return Sun(self.azimuth_deg, altitude, world.earth_from_anchor @ direction_enu(self.azimuth_deg, altitude), self.time)


def sun_of(spec: SunSpec, world: World) -> Sun:
    """The sun of a level or a query. Raises ``InputError``.

    A time needs a place on the earth: in a flat world, and on another celestial body, only angles have a meaning.
    """
    lift = 0.0
    if spec.time is None:
        assert spec.azimuth is not None and spec.altitude is not None
        azimuth, altitude = spec.azimuth % 360.0, spec.altitude
    elif world.off_earth is not None:
        raise InputError("time", spec.time.isoformat(), f"azimuth and altitude: {world.off_earth}")
    else:
        azimuth, altitude, lift = apparent_position(spec.time, world.anchor_lon_deg, world.anchor_lat_deg)
    to_sun = world.earth_from_anchor @ direction_enu(azimuth, altitude)
    return Sun(azimuth, altitude, to_sun, spec.time, lift)


def apparent_position(time: datetime, lon_deg: float, lat_deg: float) -> tuple[float, float, float]:
    """Apparent azimuth and altitude, and how much of the altitude is refraction, in degrees, by ``sun_path``."""
    path = sun_path([time], lon_deg, lat_deg)
    return float(path.azimuth_deg[0]), float(path.altitude_deg[0]), float(path.lift_deg[0])


def direction_enu(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
    """Unit vector east, north, up towards an azimuth (clockwise from north) and altitude."""
    azimuth, altitude = np.radians(azimuth_deg), np.radians(altitude_deg)
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def position_at(to_sun_earth: np.ndarray, earth_from_enu: np.ndarray) -> tuple[float, float]:
    """Azimuth and altitude in degrees of an earth-fixed direction, seen with the axes of one place."""
    east, north, up = earth_from_enu.T @ to_sun_earth
    return float(np.degrees(np.arctan2(east, north))) % 360.0, float(np.degrees(np.arctan2(up, np.hypot(east, north))))
