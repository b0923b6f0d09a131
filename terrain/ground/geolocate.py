"""Convert positions as users write them: degrees and metres above the ground, or metres in a flat world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.terrain.errors import LevelError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, transformer
from skugga.terrain.ground.elevation import Elevation


@dataclass(frozen=True, eq=False)
class Geolocator:
    """Locates positions on a level's ground.

    Positions are (longitude, latitude) in degrees on the globe, and (east, north) in metres from the anchor in a flat world.

    Attributes
    ----------
    world
        The level's world.
    elevation
        The level's raster of heights.
    """

    world: World
    elevation: Elevation

    def xy(self, position: tuple[float, float]) -> tuple[float, float]:
        """Return the coordinates of a position in the elevation's CRS."""
        if self.world.is_flat:
            scale = 1.0 / self.world.metres_per_unit
            return self.world.anchor_x + position[0] * scale, self.world.anchor_y + position[1] * scale
        x, y = transformer(LONGITUDE_LATITUDE, self.elevation.crs).transform(*position)
        return float(x), float(y)

    def ground_m(self, position: tuple[float, float]) -> float:
        """Return the ground's height at a position, metres; NaN where the ground has no data."""
        x, y = self.xy(position)
        return float(self.elevation.ground_m(x, y)) if np.isfinite([x, y]).all() else np.nan

    def point_at_height(self, position: tuple[float, float], height_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the earth-fixed point (3,) at a position and a height above the datum, and the unit up vector there."""
        x, y = self.xy(position)
        point, up = self.world.points_at_zero_height(self.elevation.crs, np.float64(x), np.float64(y))
        return point + height_m * up, up

    @property
    def extent_text(self) -> str:
        """The terrain's bounds as text, in the units of positions."""
        bounds = np.array(self.elevation.bounds)
        if self.world.is_flat:
            bounds = (bounds - np.tile([self.world.anchor_x, self.world.anchor_y], 2)) * self.world.metres_per_unit
        return bounds_text(bounds, self.elevation.crs)

    def point_above_ground(self, position: tuple[float, float, float], name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the earth-fixed point (3,) at a position and a height above the ground, and the unit up vector there.

        Raises ``LevelError``, whose message names the parameter ``name``, where the ground has no data.
        """
        ground_m = self.ground_m(position[:2])
        if not np.isfinite(ground_m):
            raise LevelError(name, position, "a position on the terrain's data")
        return self.point_at_height(position[:2], ground_m + position[2])


def bounds_text(bounds: np.ndarray | tuple[float, ...], crs: CRS) -> str:
    """Return west, south, east and north as text: in degrees where the CRS is on the globe."""
    if not crs.is_engineering:
        west, south, east, north = bounds
        bounds = transformer(crs, LONGITUDE_LATITUDE).transform_bounds(west, south, east, north, densify_pts=21)
    return ", ".join(f"{v:.5f}" if not crs.is_engineering else f"{v:.2f}" for v in bounds)
