"""Make map views of blocks (squares of ``BLOCK_PX`` pixels) in a tile matrix set."""

from __future__ import annotations

from morecantile import tms as matrix_sets

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView, tile_grid


@cached("process", MIB, size_of=lambda _: 512)
def grid_of_zoom(matrix_set: str, zoom: int) -> Grid:
    """Return the pixel grid of a zoom of a tile matrix set. ``matrix_set`` is its name.

    The result is cached, since constructing a tile matrix set takes milliseconds.
    """
    return tile_grid(matrix_sets.get(matrix_set), zoom)


def block_of_grid(grid: Grid, x: int, y: int) -> MapView:
    """Return the map view of the block in column ``x`` and row ``y`` of a tile matrix's grid, at the grid's own pixels.

    ``x`` and ``y`` are counted in blocks from the top left corner of the tile matrix.
    """
    return MapView(grid, float(y * BLOCK_PX), float(x * BLOCK_PX), 1.0, 1.0, BLOCK_PX, BLOCK_PX)
