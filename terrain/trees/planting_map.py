"""The map in which the positions of trees are computed before they are projected onto the ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from pyproj import CRS
from pyproj.crs import GeographicCRS, ProjectedCRS
from pyproj.crs.coordinate_operation import LambertAzimuthalEqualAreaConversion

from skugga.terrain.geo.world import World, longitude_latitude_of, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.trees.canopy import border_cells

MAX_OUTLINE_DISTANCE_M = 5e6
"""Maximum distance of the terrain's border from the anchor. A larger terrain has no outline in the equal-area map."""


@dataclass(frozen=True, eq=False)
class PlantingMap:
    """The map in which tree positions are computed before they are projected onto the ground.

    On the globe it is an equal-area map about the anchor, so that a density means the same everywhere. A flat world uses the CRS of
    its elevation.

    Attributes
    ----------
    world
        The level's world.
    elevation
        The level's elevation.
    exaggeration
        Factor by which the elevation's heights are exaggerated.
    """

    world: World
    elevation: Elevation
    exaggeration: float = 1.0

    @cached_property
    def crs(self) -> CRS:
        """The map's CRS."""
        if self.world.is_flat:
            return self.elevation.crs
        centre = LambertAzimuthalEqualAreaConversion(self.world.anchor_lat_deg, self.world.anchor_lon_deg)
        return ProjectedCRS(centre, name="equal-area map of the level", geodetic_crs=self._geodetic_crs)

    @property
    def _geodetic_crs(self) -> CRS:
        """Return the CRS of longitudes and latitudes on the level's celestial body."""
        return GeographicCRS() if self.world.is_on_earth else longitude_latitude_of(self.elevation.crs)

    @property
    def unit_m(self) -> float:
        """Unit of the map in metres."""
        return self.world.metres_per_unit if self.world.is_flat else 1.0

    @cached_property
    def outline(self) -> shapely.Polygon | None:
        """The terrain's outline in the map, with a small margin.

        ``None`` if the terrain covers too much of the globe (``MAX_OUTLINE_DISTANCE_M``).
        """
        cells = border_cells(*self.elevation.shape)
        x, y = transform_coordinates(self.elevation.crs, self.crs, *self.elevation.xy(*cells))
        if not self.world.is_flat and not (np.hypot(x, y) < MAX_OUTLINE_DISTANCE_M).all():
            return None
        border = shapely.Polygon(np.column_stack([x, y]))
        margin = 1e-3 * np.sqrt(border.area)  # more than the border bends between its points
        return border.buffer(margin) if border.is_valid else None

    def to_terrain_crs(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transform map coordinates to the elevation's CRS; NaN where its coordinates are undefined."""
        x, y = transform_coordinates(self.crs, self.elevation.crs, x, y)
        valid = np.isfinite(x) & np.isfinite(y)
        return np.where(valid, x, np.nan), np.where(valid, y, np.nan)


def transform_coordinates(source: CRS, target: CRS, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (n,) transformed from one CRS to another; infinite where the target is undefined."""
    return (x, y) if source == target else transformer(source, target).transform(x, y)
