"""What planes on a block's ground see of the sky and of its horizon, for the light that does not come from the sun's direction.

A plane sees, towards each azimuth, the sky above the terrain and above the level horizon that lies on its own side. So the factor
of the sky is that of J. Dozier and J. Frew (1990), equation 7b, for planes of any tilt: (1 + cos tilt) / 2 in the open.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, evenly_spaced_azimuths_deg
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.scan import AzimuthHorizons, horizons_towards
from skugga.shadows.horizons.sky_view import HALF_PI, arctan
from skugga.shadows.irradiation.planes import HORIZON_BAND_DEG, PlaneNormals
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import compiled, internal, run_in_chunks


def sky_of_grid(grid: HorizonGrid, normals: PlaneNormals, azimuths: int = DEFAULT_AZIMUTHS) -> tuple[np.ndarray, np.ndarray]:
    """Return the sky view factor and the factor of the horizon's band at a grid's eyes, float32 (rows, cols) each.

    ``normals`` are those of the planes at the eyes. The factor of the band is the sine of a plane's tilt where the horizon is open.
    """
    return sky_of_planes(grid, [normals], azimuths)[0]


def sky_of_planes(
    grid: HorizonGrid, planes: Sequence[PlaneNormals], azimuths: int = DEFAULT_AZIMUTHS
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the results of ``sky_of_grid`` for several planes at each eye, from the same horizons."""
    sums = [_SkySums(normals) for normals in planes]
    for horizons in horizons_towards(grid, evenly_spaced_azimuths_deg(azimuths)):
        for plane_sums in sums:
            plane_sums.add(horizons)
    return [plane_sums.factors(azimuths) for plane_sums in sums]


class _SkySums:
    """The sums of what planes see of the sky and of the horizon's band, over azimuths.

    Horizons come orientation by orientation. They are added in the order of the turned grid, and the sums are turned once.
    """

    def __init__(self, normals: PlaneNormals) -> None:
        self._normals = normals
        self._sky, self._band = (np.zeros(normals.up.shape, np.float32) for _ in range(2))
        self._orientation: GridOrientation | None = None
        self._turned_normals: tuple[np.ndarray, ...] = ()
        self._turned_sky: np.ndarray = np.empty((0, 0), np.float32)
        self._turned_band: np.ndarray = np.empty((0, 0), np.float32)

    def add(self, horizons: AzimuthHorizons) -> None:
        """Add what planes see towards one azimuth."""
        if horizons.orientation != self._orientation:
            self._flush()
            self._orientation = horizons.orientation
            self._turned_sky, self._turned_band = (np.zeros(horizons.tangent.shape, np.float32) for _ in range(2))
            self._turned_normals = tuple(
                np.ascontiguousarray(horizons.orientation.sun_aligned_view(component)) for component in self._normals.components
            )
        azimuth = np.radians(horizons.azimuth_deg)
        per_tangent = np.float32(1.0 / np.tan(np.radians(HORIZON_BAND_DEG)))
        sine, cosine = np.float32(np.sin(azimuth)), np.float32(np.cos(azimuth))
        run_in_chunks(
            len(self._turned_sky), _add_sky_and_band, horizons.tangent, *self._turned_normals, sine, cosine, per_tangent,
            self._turned_sky, self._turned_band,
        )  # fmt: skip

    def factors(self, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of the sky and of the band after all of a number of azimuths, float32 (rows, cols) each."""
        self._flush()
        return self._sky / np.float32(azimuths), self._band * np.float32(np.pi / azimuths)

    def _flush(self) -> None:
        """Add the sums of the current orientation to the totals."""
        if self._orientation is not None:
            self._sky += self._orientation.grid_order_view(self._turned_sky)
            self._band += self._orientation.grid_order_view(self._turned_band)
        self._orientation = None


@compiled
def _add_sky_and_band(first, last, tangent, east, north, up, sine, cosine, per_tangent, sky, band):
    """Add what planes of rows [first, last) see towards an azimuth of the sky and of the horizon's band.

    ``tangent`` is that of the horizon angle, ``per_tangent`` 1 over that of the band's height. ``east``, ``north`` and ``up`` are
    the planes' unit normals. ``sine`` and ``cosine`` are those of the azimuth.
    """
    for row in range(first, last):
        for col in range(sky.shape[1]):
            towards = east[row, col] * sine + north[row, col] * cosine
            upwards = up[row, col]
            horizon = max(tangent[row, col], np.float32(0.0))
            open_share = np.float32(1.0) - min(horizon * per_tangent, np.float32(1.0))
            band[row, col] += max(towards, np.float32(0.0)) * open_share
            if upwards > np.float32(0.0):  # the plane's own horizon hides the sky below it
                own = max(horizon, -towards / upwards)
                sky[row, col] += towards * HALF_PI + upwards - _light_below(own, towards, upwards)
            elif towards > np.float32(0.0):  # the plane hides the sky above it
                top = HALF_PI * towards
                if upwards < np.float32(0.0):
                    own = -towards / upwards
                    top = _light_below(max(own, horizon), towards, upwards)
                sky[row, col] += top - _light_below(horizon, towards, upwards)


@internal
def _light_below(tangent, towards, upwards):
    """Return the light from a uniform sky between the level and an elevation angle, towards one azimuth, on a plane.

    ``tangent`` is that of the angle h; ``towards`` and ``upwards`` are the components of the plane's normal. This is the integral
    of twice the cosine of incidence times cos h, towards (h + sin h cos h) + upwards sin2 h.
    """
    cosine_2 = np.float32(1.0) / (np.float32(1.0) + tangent * tangent)
    return towards * (arctan(tangent) + tangent * cosine_2) + upwards * (np.float32(1.0) - cosine_2)
