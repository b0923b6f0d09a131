"""The sun: one earth-fixed direction for the whole earth at a time.

Azimuth and altitude at a position follow from this direction and the position's own axes. The direction includes refraction, which
is computed once: at the anchor, the centre of the level's bounds. Angles from a user are apparent angles at the anchor.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np

from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.level.parts import SunSpec

SUN_RADIUS_DEG = 0.265
"""Half of the sun's apparent diameter: 0.262 in July, 0.271 in January."""


@dataclass(frozen=True, eq=False)
class Sun:
    """The sun's position.

    Attributes
    ----------
    azimuth_deg, altitude_deg
        The apparent angles at the anchor (the centre of the level's bounds), in degrees.
    to_sun_earth
        (3,), the earth-fixed unit vector towards the sun.
    time
        The time, or ``None`` for a sun given by angles.
    refraction_deg
        Refraction at the anchor in degrees, which is included in ``altitude_deg``; 0 for angles from a user.
    """

    azimuth_deg: float
    altitude_deg: float
    to_sun_earth: np.ndarray
    time: datetime | None = None
    refraction_deg: float = 0.0

    def in_frame(self, frame: LocalFrame) -> np.ndarray:
        """Return the unit vector (3,) towards the sun in a frame."""
        return frame.directions_from_earth(self.to_sun_earth)

    def without_refraction(self, world: World) -> Sun:
        """Return the sun's geometric position, as without an atmosphere."""
        if self.refraction_deg == 0.0:
            return self
        altitude = self.altitude_deg - self.refraction_deg
        return Sun(self.azimuth_deg, altitude, world.earth_from_anchor @ direction_enu(self.azimuth_deg, altitude), self.time)


def sun_of(spec: SunSpec, world: World) -> Sun:
    """Return the sun that a level file or a request specifies by a time or by angles.

    A time needs a position on the earth. For a time in a flat world or on another celestial body it raises ``InputError``.
    """
    lift = 0.0
    if spec.time is None:
        assert spec.azimuth is not None and spec.altitude is not None
        azimuth, altitude = spec.azimuth % 360.0, spec.altitude
    elif world.off_earth_reason is not None:
        no_sun = Problem(f"'{spec.time.isoformat()}' does not define the sun here, since {world.off_earth_reason}")
        raise InputError("time", no_sun, "Give azimuth and altitude")
    else:
        azimuth, altitude, lift = apparent_sun_position(spec.time, world.anchor_lon_deg, world.anchor_lat_deg)
    to_sun = world.earth_from_anchor @ direction_enu(azimuth, altitude)
    return Sun(azimuth, altitude, to_sun, spec.time, lift)


def apparent_sun_position(time: datetime, lon_deg: float, lat_deg: float) -> tuple[float, float, float]:
    """Return the sun's apparent azimuth and altitude, and the refraction that the altitude includes, in degrees."""
    path = sun_path([time], lon_deg, lat_deg)
    return float(path.azimuth_deg[0]), float(path.altitude_deg[0]), float(path.refraction_deg[0])


def direction_enu(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
    """Return the unit vector (east, north, up) towards an azimuth (clockwise from north) and altitude."""
    azimuth, altitude = np.radians(azimuth_deg), np.radians(altitude_deg)
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def azimuth_and_altitude(to_sun_earth: np.ndarray, earth_from_enu: np.ndarray) -> tuple[float, float]:
    """Return the azimuth and altitude in degrees of an earth-fixed direction, seen from one position.

    The columns of ``earth_from_enu`` (3, 3) are the position's east, north and up vectors.
    """
    east, north, up = earth_from_enu.T @ to_sun_earth
    return float(np.degrees(np.arctan2(east, north))) % 360.0, float(np.degrees(np.arctan2(up, np.hypot(east, north))))
