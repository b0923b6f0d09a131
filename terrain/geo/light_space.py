"""Light space of the sun: right, up and away-from-the-sun metres, counted from the level's anchor. Float64.

The axes come from the sun's azimuth and altitude at the anchor, not from a cross product with a reference direction:
right is horizontal and up leans from the zenith towards the sun's foot point, which is defined for every sun, the
zenith included. Being counted from the anchor, one light space serves all views of a level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled, in_shares
from skugga.terrain.geo.sun import Sun, direction_enu
from skugga.terrain.geo.world import LocalFrame, World


@dataclass(frozen=True, eq=False)
class LightSpace:
    """``point_light = light_from_earth @ (point_earth - origin_earth_m)``; x right, y up, z away from the sun, metres."""

    light_from_earth: np.ndarray
    origin_earth_m: np.ndarray
    altitude_deg: float

    def from_frame(self, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and translation (3,) that take a frame's points to light space."""
        rotation = self.light_from_earth @ frame.frame_from_earth.T
        return rotation, self.light_from_earth @ (frame.origin_earth_m - self.origin_earth_m)

    def from_earth(self, point_earth: np.ndarray) -> np.ndarray:
        """Light-space points (..., 3) of earth-fixed ones."""
        return (point_earth - self.origin_earth_m) @ self.light_from_earth.T

    def towards_sun_m(self, point_light: np.ndarray) -> np.ndarray:
        """How far points (..., 3) lie towards the sun along the anchor's horizontal plane."""
        altitude = np.radians(self.altitude_deg)
        return -np.cos(altitude) * point_light[..., 2] - np.sin(altitude) * point_light[..., 1]


def light_space(world: World, sun: Sun) -> LightSpace:
    """The sun's light space."""
    azimuth = np.radians(sun.azimuth_deg)
    right = np.array([-np.cos(azimuth), np.sin(azimuth), 0.0])
    up = -direction_enu(sun.azimuth_deg, sun.altitude_deg - 90.0)
    away = -direction_enu(sun.azimuth_deg, sun.altitude_deg)
    return LightSpace(np.array([right, up, away]) @ world.earth_from_anchor.T, world.anchor_earth_m, sun.altitude_deg)


def light_bounds(
    position_frame_m: np.ndarray, there: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest light-space coordinates (3,) of the frame points (rows, cols, 3) that are ``there``.

    (inf, -inf) where none is.
    """
    ends = np.empty((len(there), 2, 3))
    in_shares(len(there), _bounds, position_frame_m, there, rotation, translation, ends)
    return ends[:, 0].min(axis=0, initial=np.inf), ends[:, 1].max(axis=0, initial=-np.inf)


@compiled
def _bounds(first, last, position, there, rotation, translation, ends):
    """Of each row."""
    for i in range(first, last):
        out = ends[i]
        out[0] = np.inf
        out[1] = -np.inf
        for j in range(position.shape[1]):
            if not there[i, j]:
                continue
            p = position[i, j]
            for k in range(3):
                v = rotation[k, 0] * p[0] + rotation[k, 1] * p[1] + rotation[k, 2] * p[2] + translation[k]
                if v < out[0, k]:
                    out[0, k] = v
                if v > out[1, k]:
                    out[1, k] = v
