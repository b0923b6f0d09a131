"""Cache the heights of a grid's nodes in tiles: neighbouring windows, and the same window under another sun, share one read."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.grid_key import grid_key

TILE_NODES = 512
"""Side of a tile in nodes, half a block's. Tiles start at multiples of it, counted from the grid's origin."""

TILE_MARGIN_NODES = 8
"""Width in nodes of the margin that is read round each tile.

A map block with a small margin thus needs only the tiles within the block.
"""

Heights = tuple[np.ndarray, np.ndarray]
"""Heights float32, metres, NaN where the ground is missing; and the valid mask, bool."""

HeightsAndRim = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""Heights that include the rim nodes, the valid mask, and the mask of the rim nodes, bool; ``None`` for no rim nodes.

Rim nodes lie just beyond the raster. They cast shadows and are not visible (``Elevation.heights_with_rim``).
"""

_tiles: Cache[HeightsAndRim | None] = Cache("skugga.terrain.ground.height_tiles", "scene", 192 * MIB)


def tiled_heights(
    world: World,
    elevation: Elevation,
    grid: Grid,
    read: Callable[[int, int, int, int], HeightsAndRim],
    row0: int,
    col0: int,
    rows: int,
    cols: int,
    includes_rim: bool,
) -> Heights:
    """Return the heights and the valid mask of a window of a grid's nodes, assembled from cached tiles.

    ``read(row0, col0, rows, cols)`` reads the heights of a tile that is not cached. ``includes_rim`` is whether the result includes
    the heights of rim nodes, which lie beyond the raster and only cast shadows. Otherwise these are NaN.
    """
    owner = grid_key(world, elevation, grid)
    height, valid = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.bool_)
    for row, top, bottom in _tile_ranges(row0, rows):
        for col, left, right in _tile_ranges(col0, cols):
            first_row, first_col = row * TILE_NODES - TILE_MARGIN_NODES, col * TILE_NODES - TILE_MARGIN_NODES
            target = slice(top - row0, bottom - row0), slice(left - col0, right - col0)
            tile = _tiles.get(owner, row, col)
            if isinstance(tile, Missing):
                values = read(first_row, first_col, TILE_NODES + 2 * TILE_MARGIN_NODES, TILE_NODES + 2 * TILE_MARGIN_NODES)
                tile = values if np.isfinite(values[0]).any() else None
                _tiles.put(owner, row, col, value=tile)
            if tile is None:
                height[target], valid[target] = np.nan, False
            else:
                source = slice(top - first_row, bottom - first_row), slice(left - first_col, right - first_col)
                height[target], valid[target] = tile[0][source], tile[1][source]
                if not includes_rim and tile[2] is not None:
                    height[target][tile[2][source]] = np.nan
    return height, valid


def _tile_ranges(first: int, count: int) -> list[tuple[int, int, int]]:
    """Return the fewest tiles along an axis that, with their margins, hold all nodes of a window.

    Each tile is its number and the range [start, stop) of the nodes that are copied from it.
    """
    end = first + count
    low = (first + TILE_MARGIN_NODES) // TILE_NODES
    high = max((end - 1 - TILE_MARGIN_NODES) // TILE_NODES, low)
    return [(n, first if n == low else n * TILE_NODES, end if n == high else (n + 1) * TILE_NODES) for n in range(low, high + 1)]
