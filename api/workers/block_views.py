"""Blocks of tile matrices as views."""

from __future__ import annotations

from morecantile import tms as matrix_sets

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView, tile_grid


@cached("process", MIB, size_of=lambda _: 512)
def grid_of_zoom(matrix_set: str, zoom: int) -> Grid:
    """Return the grid of a tile matrix, by the name of its set. It is cached: making a set by its name takes milliseconds."""
    return tile_grid(matrix_sets.get(matrix_set), zoom)


def block_of_grid(grid: Grid, x: int, y: int) -> MapView:
    """Return the view of block (x, y) of a tile matrix's grid: its pixels are the matrix's own."""
    return MapView(grid, float(y * BLOCK_PX), float(x * BLOCK_PX), 1.0, 1.0, BLOCK_PX, BLOCK_PX)
