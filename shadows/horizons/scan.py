"""Horizons of all eyes of a grid towards many azimuths, one azimuth at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from skugga.shadows.horizons.far import FarHorizons, raise_by_far_ground
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.march import NO_HORIZON
from skugga.shadows.horizons.turned import directions_by_orientation, march_eyes, rays_of, turned_eyes, turned_ground
from skugga.shadows.sweep.orientation import GridOrientation


@dataclass(frozen=True, eq=False)
class AzimuthHorizons:
    """The horizons of all eyes towards one azimuth.

    Attributes
    ----------
    number
        Index of the azimuth.
    azimuth_deg
        Azimuth, clockwise from north.
    orientation
        How the grid was turned.
    tangent
        float32 (n, m) in the order of the turned eyes: tangents of the horizon angles. Below ``NO_GROUND_TANGENT`` there is no
        ground. The next azimuth overwrites it.
    """

    number: int
    azimuth_deg: float
    orientation: GridOrientation
    tangent: np.ndarray


def horizons_towards(grid: HorizonGrid, azimuth_deg: Iterable[float]) -> Iterator[AzimuthHorizons]:
    """Yield the horizons of a grid's eyes towards azimuths, ordered by the orientation of the grid and not by azimuth.

    The ground of one orientation is prepared once and serves all of its azimuths.
    """
    level_m = _mean_height_m(grid.height_m)
    for orientation, directions in directions_by_orientation(grid.east_north_of_cell_m, azimuth_deg).items():
        ground = turned_ground(grid.height_m, level_m, orientation)
        eyes = turned_eyes(grid, level_m, orientation)
        far = FarHorizons.of_grid(grid, eyes, level_m, orientation)
        tangent = np.empty(eyes.height_m.shape, np.float32)
        for direction in directions:
            rays = rays_of(len(ground.height_m), direction.columns_per_row, direction.metres_per_row, grid.curvature_per_m)
            tangent.fill(NO_HORIZON)
            march_eyes(ground, rays, eyes.height_m, eyes.first_node, tangent)
            raise_by_far_ground(far, eyes, direction, grid.curvature_per_m, tangent)
            yield AzimuthHorizons(direction.number, direction.azimuth_deg, orientation, tangent[:, : eyes.cols])


def horizon_angles_deg(grid: HorizonGrid, azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the horizon angles of all eyes, float32 (azimuths, eye rows, eye cols), in degrees.

    They are -90 where no ground lies towards an azimuth, and NaN for eyes that do not exist.
    """
    eye_height_m = grid.eye_heights_m
    angles = np.empty((len(azimuth_deg), *eye_height_m.shape), np.float32)
    for horizons in horizons_towards(grid, azimuth_deg):
        band = angles[horizons.number]
        np.degrees(np.arctan(horizons.orientation.grid_order_view(horizons.tangent), out=band), out=band)
    angles[:, ~np.isfinite(eye_height_m)] = np.nan
    return angles


def _mean_height_m(height_m: np.ndarray) -> np.float32:
    """Return the mean of the known heights: float32 heights above it lose no precision in high mountains."""
    known = np.isfinite(height_m)
    return np.float32(np.mean(height_m[known], dtype=np.float64)) if known.any() else np.float32(0.0)
