"""Sky view factors of all nodes of a grid, in the definitions that tools confuse under one name.

Horizons are summed azimuth by azimuth, so no more than one azimuth is in memory. With h the horizon angle, at least 0 where the
definition is one of level ground, and means over the azimuths:

- ``solid_angle``: 1 - mean sin h, the visible share of the upper hemisphere's solid angle (K. Zaksek, K. Ostir and Z. Kokalj 2011,
  "Sky-view factor as a relief visualization technique"). RVT, GRASS and xarray-spatial compute this one.
- ``cosine``: mean cos2 h, the share of the light of a uniform sky that reaches a level plane (T. R. Oke 1981).
- ``tilted``: the same for the ground's own plane, whose horizon is the greatest of the terrain's, the plane's own and the level one
  (J. Dozier and J. Frew 1990, equation 7b). HORAYZON and topocalc compute this one.
- ``openness``: the mean zenith angle of the horizon, degrees, which exceeds 90 on ridges (R. Yokoyama et al. 2002).
- ``negative_openness``: the same of the ground turned upside down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, SkyViewKind, evenly_spaced_azimuths_deg
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.march import NO_GROUND_TANGENT
from skugga.shadows.horizons.scan import AzimuthHorizons, horizons_towards
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.heightfield.slopes import node_slopes

HALF_PI = np.float32(np.pi / 2.0)


def sky_view_factor(grid: HorizonGrid, kind: SkyViewKind, azimuths: int = DEFAULT_AZIMUTHS) -> np.ndarray:
    """Return the sky view factor of all nodes, float32 (rows, cols); NaN without ground.

    ``kind`` is the definition (see the module). ``azimuths`` is the number of evenly spaced azimuths. Where no ground lies towards
    an azimuth the horizon is level.
    """
    known = np.isfinite(grid.eye_heights_m)
    if kind == "negative_openness":
        grid = upside_down(grid)
    sums = SkyViewSums(grid, kind)
    for horizons in horizons_towards(grid, evenly_spaced_azimuths_deg(azimuths)):
        sums.add(horizons)
    return np.where(known, sums.factor(azimuths), np.float32(np.nan))


class SkyViewSums:
    """The sum of the terms of a sky view factor over azimuths, for all nodes of a grid.

    Horizons come orientation by orientation. They are added in the order of the turned grid, and the sum is turned once.
    """

    def __init__(self, grid: HorizonGrid, kind: SkyViewKind) -> None:
        self._kind, self._total = kind, np.zeros(grid.eye_heights_m.shape, np.float32)
        self._slopes = ground_slopes(grid) if kind == "tilted" else None
        self._orientation: GridOrientation | None = None
        self._sum = np.empty((0, 0), np.float32)
        self._turned_slopes: tuple[np.ndarray, ...] = ()

    def add(self, horizons: AzimuthHorizons) -> None:
        """Add the terms of one azimuth."""
        if horizons.orientation != self._orientation:
            self._flush()
            self._orientation = horizons.orientation
            self._sum = np.zeros(horizons.tangent.shape, np.float32)
            if self._slopes is not None:
                self._turned_slopes = tuple(
                    np.ascontiguousarray(horizons.orientation.sun_aligned_view(slope)) for slope in self._slopes
                )
        azimuth = np.radians(horizons.azimuth_deg)
        direction = np.float32(np.sin(azimuth)), np.float32(np.cos(azimuth))
        if self._kind == "tilted":
            run_in_chunks(len(self._sum), _add_tilted, horizons.tangent, *self._turned_slopes, *direction, self._sum)
        else:
            run_in_chunks(len(self._sum), _TERMS[self._kind], horizons.tangent, self._sum)

    def factor(self, azimuths: int) -> np.ndarray:
        """Return the sky view factor, float32 (rows, cols), after all of a number of azimuths."""
        self._flush()
        factor: np.ndarray = self._total / np.float32(azimuths)
        if self._slopes is not None:
            east, north = self._slopes
            factor /= np.sqrt(np.float32(1.0) + east**2 + north**2)
        return np.degrees(factor) if self._kind in ("openness", "negative_openness") else factor

    def _flush(self) -> None:
        """Add the sum of the current orientation to the total."""
        if self._orientation is not None:
            self._total += self._orientation.grid_order_view(self._sum)
        self._orientation = None


def upside_down(grid: HorizonGrid) -> HorizonGrid:
    """Return a grid, its eyes and the ground beyond it turned upside down."""
    return replace(
        grid,
        height_m=-grid.height_m,
        curvature_per_m=-grid.curvature_per_m,
        eye_height_m=None if grid.eye_height_m is None else -grid.eye_height_m,
        far=tuple(replace(part, height_m=-part.height_m) for part in grid.far),
    )


def ground_slopes(grid: HorizonGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the rise of the ground to the east and to the north at the eyes, float32 (eye rows, eye cols) each.

    The differences are central, and one-sided beside ground that is missing; 0 for a node without neighbours.
    """
    height_m = grid.shown_height_m
    per_node = np.ones(len(height_m))
    slopes = node_slopes(height_m, per_node, per_node)[grid.eyes].astype(np.float32)
    right, down = slopes[..., 0], slopes[..., 1]
    # The gradient in cells, (down, right), becomes one in metres: each coordinate of a cell depends on east and on north.
    cells_of = np.linalg.inv(grid.east_north_of_cell_m)
    east = down * np.float32(cells_of[0, 0]) + right * np.float32(cells_of[1, 0])
    north = down * np.float32(cells_of[0, 1]) + right * np.float32(cells_of[1, 1])
    return east, north


@compiled
def _add_solid_angle(first, last, tangent, out):
    """Add 1 - sin h of rows [first, last) to ``out``; ``tangent`` is that of h, which counts from 0 on."""
    for row in range(first, last):
        for col in range(out.shape[1]):
            rise = max(tangent[row, col], np.float32(0.0))
            out[row, col] += np.float32(1.0) - rise / np.sqrt(np.float32(1.0) + rise * rise)


@compiled
def _add_cosine(first, last, tangent, out):
    """Add cos2 h of rows [first, last) to ``out``; ``tangent`` is that of h, which counts from 0 on."""
    for row in range(first, last):
        for col in range(out.shape[1]):
            rise = max(tangent[row, col], np.float32(0.0))
            out[row, col] += np.float32(1.0) / (np.float32(1.0) + rise * rise)


@compiled
def _add_zenith_angle(first, last, tangent, out):
    """Add the zenith angle of the horizon, radians, of rows [first, last) to ``out``; without ground it is level."""
    for row in range(first, last):
        for col in range(out.shape[1]):
            rise = tangent[row, col]
            out[row, col] += HALF_PI - arctan(rise if rise > NO_GROUND_TANGENT else np.float32(0.0))


@compiled
def _add_tilted(first, last, tangent, east, north, sine, cosine, out):
    """Add the terms of the ground's own plane of rows [first, last) to ``out``.

    ``east`` and ``north`` are its slopes; ``sine`` and ``cosine`` are those of the azimuth. The terms are those of Dozier and Frew
    (1990), equation 7b, over the normal's upward component.
    """
    for row in range(first, last):
        for col in range(out.shape[1]):
            own = east[row, col] * sine + north[row, col] * cosine
            rise = max(max(tangent[row, col], own), np.float32(0.0))
            cosine_2 = np.float32(1.0) / (np.float32(1.0) + rise * rise)
            out[row, col] += cosine_2 - own * (HALF_PI - arctan(rise) - rise * cosine_2)


@internal
def arctan(x):
    """Return the arc tangent to 2e-8 radians, without a call that would keep loops from vector instructions.

    The series is that of M. Abramowitz and I. A. Stegun 1964, *Handbook of Mathematical Functions*, 4.4.49.
    """
    size = abs(x)
    is_steep = size > np.float32(1.0)
    y = np.float32(1.0) / size if is_steep else size
    z = y * y
    series = np.float32(-0.0161657367) + z * np.float32(0.0028662257)
    series = np.float32(0.0429096138) + z * series
    series = np.float32(-0.0752896400) + z * series
    series = np.float32(0.1065626393) + z * series
    series = np.float32(-0.1420889944) + z * series
    series = np.float32(0.1999355085) + z * series
    series = np.float32(-0.3333314528) + z * series
    angle = y * (np.float32(1.0) + z * series)
    angle = HALF_PI - angle if is_steep else angle
    return angle if x >= np.float32(0.0) else -angle


_TERMS: dict[SkyViewKind, Callable[..., None]] = {
    "solid_angle": _add_solid_angle, "cosine": _add_cosine, "openness": _add_zenith_angle, "negative_openness": _add_zenith_angle,
}  # fmt: skip
"""Loops that add the terms of one azimuth, by the kind of sky view factor; that of the tilted plane takes more arguments."""
