"""What a block's ground sees of the sky and of its horizon, for the light that does not come from the sun's direction."""

from __future__ import annotations

from typing import Literal

import numpy as np

from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, evenly_spaced_azimuths_deg
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.scan import AzimuthHorizons, horizons_towards
from skugga.shadows.horizons.sky_view import SkyViewSums
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import compiled, run_in_chunks

Plane = Literal["ground", "level"]
"""The planes on which light is measured: the ground's own slope, or level planes on it."""

HORIZON_BAND_DEG = 6.5
"""Height of the horizon's band (R. Perez et al. 1986, "An anisotropic hourly diffuse radiation model for sloping surfaces").

Terrain in front of the band hides it from below.
"""


def sky_of_grid(
    grid: HorizonGrid, plane: Plane, slopes: tuple[np.ndarray, np.ndarray], azimuths: int = DEFAULT_AZIMUTHS
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sky view factor and the factor of the horizon's band at a grid's eyes, float32 (rows, cols) each.

    The factor of the band is the sine of the plane's tilt where the horizon is open. ``slopes`` are the rises of the planes to the
    east and to the north.
    """
    sky_view = SkyViewSums(grid, "tilted" if plane == "ground" else "cosine")
    band = None if plane == "level" else _BandSums(slopes)
    for horizons in horizons_towards(grid, evenly_spaced_azimuths_deg(azimuths)):
        sky_view.add(horizons)
        if band is not None:
            band.add(horizons)
    factor = sky_view.factor(azimuths)
    return factor, np.zeros_like(factor) if band is None else band.factor(azimuths)


class _BandSums:
    """The sum of the light of the horizon's band over azimuths, for planes with slopes (rows, cols) to the east and north.

    A plane receives the light of an azimuth in proportion to its fall towards it.
    """

    def __init__(self, slopes: tuple[np.ndarray, np.ndarray]) -> None:
        self._slopes = slopes
        self._total = np.zeros(slopes[0].shape, np.float32)
        self._orientation: GridOrientation | None = None
        self._sum = np.empty((0, 0), np.float32)
        self._turned_slopes: tuple[np.ndarray, ...] = ()

    def add(self, horizons: AzimuthHorizons) -> None:
        """Add the light of one azimuth."""
        if horizons.orientation != self._orientation:
            self._flush()
            self._orientation = horizons.orientation
            self._sum = np.zeros(horizons.tangent.shape, np.float32)
            self._turned_slopes = tuple(
                np.ascontiguousarray(horizons.orientation.sun_aligned_view(slope)) for slope in self._slopes
            )
        azimuth = np.radians(horizons.azimuth_deg)
        per_tangent = np.float32(1.0 / np.tan(np.radians(HORIZON_BAND_DEG)))
        sine, cosine = np.float32(np.sin(azimuth)), np.float32(np.cos(azimuth))
        run_in_chunks(len(self._sum), _add_open_band, horizons.tangent, *self._turned_slopes, sine, cosine, per_tangent, self._sum)

    def factor(self, azimuths: int) -> np.ndarray:
        """Return the factor of the band after all of a number of azimuths, float32 (rows, cols)."""
        self._flush()
        east, north = self._slopes
        factor: np.ndarray = self._total * np.float32(np.pi / azimuths) / np.sqrt(np.float32(1.0) + east**2 + north**2)
        return factor

    def _flush(self) -> None:
        """Add the sum of the current orientation to the total."""
        if self._orientation is not None:
            self._total += self._orientation.grid_order_view(self._sum)
        self._orientation = None


@compiled
def _add_open_band(first, last, tangent, east, north, sine, cosine, per_tangent, out):
    """Add the fall of planes towards an azimuth, times the open share of the band, of rows [first, last) to ``out``.

    ``tangent`` is that of the horizon angle, ``per_tangent`` 1 over that of the band's height. ``sine`` and ``cosine`` are those of
    the azimuth.
    """
    for row in range(first, last):
        for col in range(out.shape[1]):
            fall = max(-(east[row, col] * sine + north[row, col] * cosine), np.float32(0.0))
            hidden = min(max(tangent[row, col] * per_tangent, np.float32(0.0)), np.float32(1.0))
            out[row, col] += fall * (np.float32(1.0) - hidden)
