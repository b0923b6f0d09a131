"""Identify a grid over a scene's ground in cache keys, without comparing CRSs."""

from __future__ import annotations

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation


class GridKey:
    """An object that stands for a grid over a scene's ground in cache keys. It is compared by identity, which is fast."""


@cached("scene", MIB, size_of=lambda _: 512)
def grid_key(world: World, elevation: Elevation, grid: Grid) -> GridKey:
    """Return the key of a grid over a scene's ground: the same object each time while the ground is in memory."""
    return GridKey()
