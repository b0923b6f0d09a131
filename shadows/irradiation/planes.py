"""The planes on which irradiation is measured: the ground's own slope, level planes, and planes of a given tilt and azimuth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

MAX_TILT_DEG = 180.0
"""Tilt of a plane that faces down."""

MIN_SKY_VIEW = 1e-6
"""Sky view factor below which no share of it is told."""

HORIZON_BAND_DEG = 6.5
"""Height of the horizon's band (R. Perez et al. 1986, "An anisotropic hourly diffuse radiation model for sloping surfaces").

Terrain in front of the band hides it from below.
"""


@dataclass(frozen=True)
class TiltedPlane:
    """A plane on every cell.

    Attributes
    ----------
    tilt_deg
        Angle between the plane and a level one: 0 faces up, 90 is a wall, 180 faces down.
    azimuth_deg
        Azimuth that the plane faces, clockwise from true north.
    """

    tilt_deg: float
    azimuth_deg: float = 180.0

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


Plane = Literal["ground", "level"] | TiltedPlane
"""The ground's own slope, level planes on it, or planes of a tilt and an azimuth."""


@dataclass(frozen=True, eq=False)
class PlaneNormals:
    """Unit normals of the planes of a block's cells: their components to the east, to the north and up, float32 (rows, cols)."""

    east: np.ndarray
    north: np.ndarray
    up: np.ndarray

    @property
    def components(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The components to the east, to the north and up."""
        return self.east, self.north, self.up


LEVEL_PLANE = TiltedPlane(0.0)

_Factors = TypeVar("_Factors", float, np.ndarray)


def reflecting_share(sky_view: _Factors, level_sky_view: _Factors, level_sky_view_without_trees: _Factors) -> _Factors:
    """Return the share of the light that open level ground reflects which reaches planes from their surroundings.

    The surroundings fill what a plane does not see of the sky. They are open ground, less the share of its skylight that trees take
    from level ground here: none in the open, nearly all in a deep wood.

    Parameters
    ----------
    sky_view
        The planes' sky view factors, 0 to 1.
    level_sky_view, level_sky_view_without_trees
        Sky view factors of level planes at the same places, and those behind ground and buildings alone.
    """
    left_by_trees = level_sky_view / np.maximum(level_sky_view_without_trees, MIN_SKY_VIEW)
    return (1.0 - sky_view) * np.minimum(left_by_trees, 1.0)


def normals_of_slopes(east: np.ndarray, north: np.ndarray) -> PlaneNormals:
    """Return the normals of ground that rises by ``east`` and ``north`` per metre to the east and to the north, (rows, cols)."""
    up = np.float32(1.0) / np.sqrt(np.float32(1.0) + east**2 + north**2)
    return PlaneNormals(-east * up, -north * up, up)


def normals_of_plane(plane: TiltedPlane, shape: tuple[int, int]) -> PlaneNormals:
    """Return the normals of the same plane on all cells of a block (rows, cols)."""
    tilt, azimuth = np.radians(plane.tilt_deg), np.radians(plane.azimuth_deg)
    components = np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), np.cos(tilt)
    east, north, up = (np.full(shape, component, np.float32) for component in components)
    return PlaneNormals(east, north, up)


def normals_in_block_plane(normals: PlaneNormals, east_north_of_cell_m: np.ndarray, curvature_per_m: float) -> PlaneNormals:
    """Return the components of normals along east, north and up at a block's centre instead of those at their own cells.

    Verticals lean away from the centre with the distance, since the level falls by ``curvature_per_m``.
    """
    if curvature_per_m == 0.0:
        return normals
    rows, cols = normals.up.shape
    down, right = np.arange(rows) - (rows - 1) / 2.0, np.arange(cols) - (cols - 1) / 2.0
    lean_east, lean_north = (
        ((per_row * down)[:, None] + (per_col * right)[None, :]).astype(np.float32) * np.float32(curvature_per_m)
        for per_row, per_col in east_north_of_cell_m
    )
    return PlaneNormals(
        normals.east + normals.up * lean_east,
        normals.north + normals.up * lean_north,
        normals.up - normals.east * lean_east - normals.north * lean_north,
    )


def _light_below(altitude: np.ndarray, outward: np.ndarray, upward: float) -> np.ndarray:
    """Return the integrals (n,) of the cosine of incidence times the cosine of the altitude, from the level to altitudes (n,).

    Altitudes are radians. ``outward`` (n,) and ``upward`` are the components of the plane's normal towards the azimuths and up.
    """
    return outward * (altitude / 2.0 + np.sin(2.0 * altitude) / 4.0) + upward * np.sin(altitude) ** 2 / 2.0
