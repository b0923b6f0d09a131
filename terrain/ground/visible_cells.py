"""Find the raster cells that a map view shows.

A picture or a window of a map shows some of a raster's cells. Tiles, and maps whose pixels coincide with those of tiles, count as
showing the whole raster. So a pixel that a tile and such a map share is drawn alike in both.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.geo.world import transformer
from skugga.terrain.ground.elevation import Elevation

EXTENT_SAMPLES_PER_SIDE = 17
"""Number of points along each side of a view that are transformed to the raster, to find the cells that the view shows."""

CellRange = tuple[tuple[float, float], tuple[float, float]]
"""First and last row, and first and last column, of a part of a raster: fractional, with whole numbers at cell centres."""


def is_block(view: MapView) -> bool:
    """Return whether a view is one of the world-fixed blocks that tiles are cut from."""
    return view.is_on_nodes and (view.rows, view.cols, view.row0 % BLOCK_PX, view.col0 % BLOCK_PX) == (BLOCK_PX, BLOCK_PX, 0.0, 0.0)


def full_cell_range(elevation: Elevation) -> CellRange:
    """Return the range of all cells of a raster."""
    return (-0.5, elevation.rows - 0.5), (-0.5, elevation.cols - 0.5)


def visible_cells(elevation: Elevation, view: MapView) -> CellRange | None:
    """Return the cells that a map view shows, with a margin of two pixels: ``None`` if it shows none.

    All cells are returned if the view's pixels coincide with those of tiles.
    """
    all_cells = full_cell_range(elevation)
    if view.is_on_nodes:
        return all_cells
    offsets = np.linspace(-0.5, 0.5, EXTENT_SAMPLES_PER_SIDE)
    rows, cols = (first + step * ((count - 1) / 2 + offsets * count) for first, step, count in _pixel_axes(view))
    x, y = np.meshgrid(view.grid.x(cols), view.grid.y(rows))
    if view.grid.crs != elevation.crs:
        x, y = transformer(view.grid.crs, elevation.crs).transform(x, y)
    if elevation.crs.is_geographic:
        middle = (elevation.bounds[0] + elevation.bounds[2]) / 2
        x = x + 360.0 * np.rint((middle - x) / 360.0)
    ranges = []
    for cells, (first, last) in zip(elevation.cell_of(x, y), all_cells, strict=True):
        if not np.isfinite(cells).all():
            return all_cells
        pixel = max(
            np.abs(np.diff(cells, axis=k)).max() * (EXTENT_SAMPLES_PER_SIDE - 1) / n for k, n in enumerate((view.rows, view.cols))
        )
        bend = max(np.abs(np.diff(cells, 2, axis=k)).max() for k in (0, 1))  # bound on how far the rim bends between samples
        margin = 1.0 + 2.0 * pixel + bend
        low, high = max(float(cells.min() - margin), first), min(float(cells.max() + margin), last)
        if low > high:
            return None
        ranges.append((low, high))
    return ranges[0], ranges[1]


def _pixel_axes(view: MapView) -> tuple[tuple[float, float, int], tuple[float, float, int]]:
    """Return the first node, the step in nodes and the number of pixels along a view's rows, and then along its columns."""
    return (view.row0, view.row_step, view.rows), (view.col0, view.col_step, view.cols)


def block_slices(cells: CellRange, block_side_cells: int, shape: tuple[int, int], margin_blocks: int = 0) -> tuple[slice, slice]:
    """Return the rows and columns, as slices, of the blocks that cover a range of cells, with a margin of ``margin_blocks`` blocks.

    ``shape`` is the number of rows and columns of blocks. A block is ``block_side_cells`` x ``block_side_cells`` cells.
    """
    rows, cols = (
        slice(
            min(max(int((first + 0.5) // block_side_cells) - margin_blocks, 0), count - 1),
            min(int((last + 0.5) // block_side_cells) + 1 + margin_blocks, count),
        )
        for (first, last), count in zip(cells, shape, strict=True)
    )
    return rows, cols
