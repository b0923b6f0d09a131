"""A cheap part of cache keys for a grid over a scene's ground."""

from __future__ import annotations

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation


class GridKey:
    """Stands for a grid over a scene's ground in cache keys: it is compared by identity, where a grid's CRS compares slowly."""


@cached("scene", MIB, size_of=lambda _: 512)
def grid_key(world: World, elevation: Elevation, grid: Grid) -> GridKey:
    """Return the key of a grid over a scene's ground: the same object each time, as long as the ground lives."""
    return GridKey()
