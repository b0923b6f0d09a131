"""A receiving plane of any tilt, and what it sees of the sky and of its horizon over a horizon profile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.irradiation.sky import HORIZON_BAND_DEG
from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import paged_relief
from skugga.terrain.scene import Scene


@dataclass(frozen=True)
class TiltedPlane:
    """A plane that receives light.

    Attributes
    ----------
    tilt_deg
        Tilt from the level plane, 0 to 180: 90 is a wall, and 180 faces down.
    azimuth_deg
        Azimuth that the plane faces, clockwise from true north.
    """

    tilt_deg: float
    azimuth_deg: float

    def cosine_towards(self, azimuth_deg: np.ndarray, altitude_deg: np.ndarray) -> np.ndarray:
        """Return the cosines (n,) of the angles of incidence of directions (n,); 0 for directions behind the plane."""
        tilt, altitude = np.radians(self.tilt_deg), np.radians(altitude_deg)
        cosine = np.sin(tilt) * np.cos(altitude) * self._facing(azimuth_deg) + np.cos(tilt) * np.sin(altitude)
        return np.maximum(cosine, 0.0)

    def sky_view(self, azimuth_deg: np.ndarray, horizon_deg: np.ndarray) -> float:
        """Return the share of the light of a uniform sky that reaches the plane over a horizon, 0 to 1.

        The azimuths (n,) are evenly spaced, and ``horizon_deg`` (n,) are the horizon angles there. The light of an azimuth between
        the altitudes a and b is the integral of the cosine of incidence over the solid angle. Its lower bound is the greatest of
        the horizon, the plane itself and the level, as in equation 7b of J. Dozier and J. Frew (1990). Of a plane that faces
        downwards the plane itself is the upper bound.
        """
        tilt, facing = np.radians(self.tilt_deg), self._facing(azimuth_deg)
        outward, upward = np.sin(tilt) * facing, np.cos(tilt)
        low = np.maximum(np.radians(horizon_deg), 0.0)
        high = np.full_like(low, np.pi / 2.0)
        if self.tilt_deg <= 90.0:
            low = np.maximum(low, np.arctan2(-outward, upward))
        else:
            high = np.arctan2(outward, -upward)
        light = _light_below(high, outward, upward) - _light_below(low, outward, upward)
        return float(2.0 * np.mean(np.where(high > low, light, 0.0)))

    def horizon_band(self, azimuth_deg: np.ndarray, horizon_deg: np.ndarray) -> float:
        """Return the factor of the light of the horizon's band on a vertical plane that reaches this one.

        It is the sine of the tilt over an open horizon. The azimuths (n,) are evenly spaced. The horizon hides the band, of
        ``HORIZON_BAND_DEG``, from below. Each azimuth counts by the cosine of its angle with that of the plane.
        """
        share = np.tan(np.radians(horizon_deg)) / np.tan(np.radians(HORIZON_BAND_DEG))
        weight = np.maximum(self._facing(azimuth_deg), 0.0)
        return float(np.sin(np.radians(self.tilt_deg)) * np.pi * np.mean(weight * (1.0 - np.clip(share, 0.0, 1.0))))

    def _facing(self, azimuth_deg: np.ndarray) -> np.ndarray:
        """Return the cosines (n,) of the angles between azimuths (n,) and that of the plane."""
        return np.cos(np.radians(np.asarray(azimuth_deg) - self.azimuth_deg))


def ground_plane(scene: Scene, place: PointPlace) -> TiltedPlane:
    """Return the plane of the ground's own slope at a place.

    Its slope is that between the ground one cell before and one cell after the place, or on one side beside missing ground. Columns
    with flat tops are level.
    """
    ground = paged_relief(scene)
    if ground.has_columns:
        return TiltedPlane(0.0, 180.0)
    row, col = place.row + np.array([-1.0, 1.0, 0.0, 0.0]), place.col + np.array([0.0, 0.0, -1.0, 1.0])
    height_m, _ = ground.ground_at(row, col)
    opposite_m = 2.0 * place.ground_m - height_m[[1, 0, 3, 2]]
    height_m = np.where(np.isfinite(height_m), height_m, np.where(np.isfinite(opposite_m), opposite_m, place.ground_m))
    foot, up = scene.world.points_at_zero_height(ground.grid.crs, ground.grid.x(col), ground.grid.y(row))
    points = place.in_enu(foot + height_m[:, None] * up)
    normal = np.cross(points[1] - points[0], points[3] - points[2])
    normal *= np.sign(normal[2])
    tilt_deg = float(np.degrees(np.arctan2(np.hypot(normal[0], normal[1]), normal[2])))
    return TiltedPlane(tilt_deg, float(np.degrees(np.arctan2(normal[0], normal[1])) % 360.0))


def _light_below(altitude: np.ndarray, outward: np.ndarray, upward: float) -> np.ndarray:
    """Return the integrals (n,) of the cosine of incidence times the cosine of the altitude, from the level to altitudes (n,).

    Altitudes are radians. ``outward`` (n,) and ``upward`` are the components of the plane's normal towards the azimuths and up.
    """
    return outward * (altitude / 2.0 + np.sin(2.0 * altitude) / 4.0) + upward * np.sin(altitude) ** 2 / 2.0
