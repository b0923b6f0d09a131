"""Blocks of tiles as render processes draw them."""

from __future__ import annotations

from morecantile import tms as matrix_sets

from skugga.api.layers import LAYERS
from skugga.api.workers.block_tiles import NOT_ASKED, PicturedBlock
from skugga.shadows.ground_pictures import ShownMap, shown_map
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView, tile_grid
from skugga.terrain.scene import Scene


@cached("process", MIB, size_of=lambda _: 512)
def grid_of_zoom(matrix_set: str, zoom: int) -> Grid:
    """The grid of a tile matrix, by the name of its set. Kept: a set that is got by its name is a copy, made in milliseconds."""
    return tile_grid(matrix_sets.get(matrix_set), zoom)


def block_of_grid(grid: Grid, x: int, y: int) -> MapView:
    """The view of block (x, y) of a tile matrix's grid: its pixels are the matrix's own."""
    return MapView(grid, float(y * BLOCK_PX), float(x * BLOCK_PX), 1.0, 1.0, BLOCK_PX, BLOCK_PX)


def drawn_block(scene: Scene, view: MapView, plan: Plan, layer: str) -> tuple[PicturedBlock, Frame | ShownMap]:
    """A block drawn for a layer by a plan, and what drew it. Raises ``SkuggaError``."""
    shown = render_frame(scene, view, plan) if LAYERS[layer].of_points else shown_map(scene, view, plan)
    visibility = shown.visibility if isinstance(shown, Frame) else NOT_ASKED
    return PicturedBlock(shown.color, shown.opacity, shown.there, visibility), shown
