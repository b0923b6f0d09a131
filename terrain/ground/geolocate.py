"""Positions that people write: degrees and metres above the ground, or metres on a made ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.terrain.errors import LevelError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, transformer
from skugga.terrain.ground.elevation import Elevation


@dataclass(frozen=True, eq=False)
class Geolocator:
    """Finds places of a level: on the globe (longitude, latitude) in degrees, in a flat world (east, north) in metres
    from the anchor.
    """

    world: World
    elevation: Elevation

    def xy(self, at: tuple[float, float]) -> tuple[float, float]:
        """Coordinates in the elevation's CRS."""
        if self.world.flat:
            scale = 1.0 / self.world.metres_per_unit
            return self.world.anchor_x + at[0] * scale, self.world.anchor_y + at[1] * scale
        x, y = transformer(LONGITUDE_LATITUDE, self.elevation.crs).transform(*at)
        return float(x), float(y)

    def ground_m(self, at: tuple[float, float]) -> float:
        """The ground's height at a place, metres; NaN off its data."""
        x, y = self.xy(at)
        return float(self.elevation.ground_m(x, y)) if np.isfinite([x, y]).all() else np.nan

    def at_height(self, at: tuple[float, float], height_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Earth-fixed point (3,) at a place and a height above the datum, and the vertical there."""
        x, y = self.xy(at)
        point, up = self.world.ground(self.elevation.crs, np.float64(x), np.float64(y))
        return point + height_m * up, up

    @property
    def extent(self) -> str:
        """The terrain's bounds, as positions are written."""
        bounds = np.array(self.elevation.bounds)
        if self.world.flat:
            bounds = (bounds - np.tile([self.world.anchor_x, self.world.anchor_y], 2)) * self.world.metres_per_unit
        return bounds_text(bounds, self.elevation.crs)

    def above_ground(self, position: tuple[float, float, float], where: str) -> tuple[np.ndarray, np.ndarray]:
        """Earth-fixed point (3,) at a height above the ground at a place, and the vertical there.

        Raises ``LevelError``, naming ``where``, off the ground's data.
        """
        ground_m = self.ground_m(position[:2])
        if not np.isfinite(ground_m):
            raise LevelError(where, position, "a position on the terrain's data")
        return self.at_height(position[:2], ground_m + position[2])


def bounds_text(bounds: np.ndarray | tuple[float, ...], crs: CRS) -> str:
    """West, south, east, north for a person: degrees where there are any."""
    if not crs.is_engineering:
        west, south, east, north = bounds
        bounds = transformer(crs, LONGITUDE_LATITUDE).transform_bounds(west, south, east, north, densify_pts=21)
    return ", ".join(f"{v:.5f}" if not crs.is_engineering else f"{v:.2f}" for v in bounds)
