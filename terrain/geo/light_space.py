"""The light space of the sun: coordinates along the axes right, up and away from the sun, in metres. Float64.

The origin is the anchor, the centre of the level's bounds, so one light space serves all views of a level. The axes follow from the
sun's azimuth and altitude at the anchor, not from a cross product with a reference direction. Right is horizontal. Up leans from
the zenith away from the sun. Both are defined for every sun, the zenith included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.geo.sun import Sun, direction_enu
from skugga.terrain.geo.world import LocalFrame, World


@dataclass(frozen=True, eq=False)
class LightSpace:
    """The transformation ``point_light = light_from_earth @ (point_earth - origin_earth_m)``.

    Attributes
    ----------
    light_from_earth
        (3, 3), rotation to the axes x right, y up and z away from the sun.
    origin_earth_m
        (3,), the earth-fixed origin in metres.
    altitude_deg
        The sun's altitude at the anchor in degrees.
    """

    light_from_earth: np.ndarray
    origin_earth_m: np.ndarray
    altitude_deg: float

    def transform_from_frame(self, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation (3, 3) and translation (3,) from a frame to light space, in metres."""
        rotation = self.light_from_earth @ frame.frame_from_earth.T
        return rotation, self.light_from_earth @ (frame.origin_earth_m - self.origin_earth_m)

    def points_from_earth(self, point_earth: np.ndarray) -> np.ndarray:
        """Return the light-space points (..., 3) of earth-fixed points."""
        return (point_earth - self.origin_earth_m) @ self.light_from_earth.T

    def horizontal_sunward_m(self, point_light: np.ndarray) -> np.ndarray:
        """Return how far light-space points (..., 3) lie towards the sun in the anchor's horizontal plane, in metres."""
        altitude = np.radians(self.altitude_deg)
        return -np.cos(altitude) * point_light[..., 2] - np.sin(altitude) * point_light[..., 1]


def light_space(world: World, sun: Sun) -> LightSpace:
    """Return the light space of a sun, with its origin at the world's anchor."""
    azimuth = np.radians(sun.azimuth_deg)
    right = np.array([-np.cos(azimuth), np.sin(azimuth), 0.0])
    up = -direction_enu(sun.azimuth_deg, sun.altitude_deg - 90.0)
    away_from_sun = -direction_enu(sun.azimuth_deg, sun.altitude_deg)
    return LightSpace(np.array([right, up, away_from_sun]) @ world.earth_from_anchor.T, world.anchor_earth_m, sun.altitude_deg)


def light_bounds(
    position_frame_m: np.ndarray, valid: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum (3,) and the maximum (3,) light-space coordinates of valid points of a frame, in metres.

    Points have the shape (rows, cols, 3), their valid mask ``valid`` the shape (rows, cols). ``rotation`` (3, 3) and
    ``translation`` (3,) lead from the frame to light space (``LightSpace.transform_from_frame``). Without valid points the result
    is (inf, -inf).
    """
    ends = np.empty((len(valid), 2, 3))
    run_in_chunks(len(valid), _bounds, position_frame_m, valid, rotation, translation, ends)
    return ends[:, 0].min(axis=0, initial=np.inf), ends[:, 1].max(axis=0, initial=-np.inf)


@compiled
def _bounds(first, last, position, valid, rotation, translation, row_bounds):
    """Write the minima and maxima of the valid points of the rows [first, last) into ``row_bounds`` (rows, 2, 3)."""
    for i in range(first, last):
        out = row_bounds[i]
        out[0] = np.inf
        out[1] = -np.inf
        for j in range(position.shape[1]):
            if not valid[i, j]:
                continue
            p = position[i, j]
            for k in range(3):
                v = rotation[k, 0] * p[0] + rotation[k, 1] * p[1] + rotation[k, 2] * p[2] + translation[k]
                if v < out[0, k]:
                    out[0, k] = v
                if v > out[1, k]:
                    out[1, k] = v
