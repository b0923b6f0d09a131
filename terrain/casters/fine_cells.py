"""Refine cells of a big raster's overview where single cells cover much ground.

The overview holds the highest ground of coarse cells. It shows which ground beside a block of a map can shade the block; no other
ground is read. Finer cells exclude more ground. So the time for a block does not depend on the size of the raster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.light_space import LightSpace
from skugga.terrain.geo.world import transformer
from skugga.terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class FineCells:
    """Finer cells (n,) into which some cells of an overview are divided.

    Attributes
    ----------
    row, col
        float64 (n,), rows and columns of the cells' centres on a map grid, in nodes.
    half_extent_nodes
        float64 (n,), half the cells' width on the grid, with a margin, in nodes.
    light_space_m
        float64 (n, 3), the cells' centres at the height of their highest ground, in light space, metres.
    width_m
        The width of a cell, metres.
    """

    row: np.ndarray
    col: np.ndarray
    half_extent_nodes: np.ndarray
    light_space_m: np.ndarray
    width_m: float


def fine_cells(
    scene: Scene,
    light: LightSpace,
    grid: Grid,
    parent_mask: np.ndarray,
    parent_extent: tuple[np.ndarray, np.ndarray],
    period_nodes: float | None,
) -> FineCells | None:
    """Return the finer cells within the overview's cells that the mask ``parent_mask`` (rows, cols) selects.

    Cells without ground are left out. The result is ``None`` if the overview has no finer cells.

    Parameters
    ----------
    scene, light
        The scene, and the sun's light space.
    grid
        The map grid on which the cells' positions are returned.
    parent_mask
        The mask of the overview's selected cells.
    parent_extent
        Columns (n,) of the selected cells' centres on the grid, and half their widths (n,), in nodes.
    period_nodes
        Columns of the grid round the earth: positions differ by a multiple of it on two turns. ``None`` on a grid that does not
        close. Columns of the result are those of the turn nearest to the parents' columns.
    """
    overview, elevation = scene.elevation.overview, scene.elevation
    if overview.fine_max_heights_m is None:
        return None
    ratio = 2 ** (overview.lod - overview.fine_lod)
    parent_row, parent_col = np.nonzero(parent_mask)
    down, right = (v.ravel() for v in np.mgrid[:ratio, :ratio])
    i, j = (parent_row[:, None] * ratio + down).ravel(), (parent_col[:, None] * ratio + right).ravel()
    high = overview.fine_max_heights_m[i, j]
    valid = np.isfinite(high)
    factor = 2**overview.fine_lod
    x, y = elevation.xy((i[valid] + 0.5) * factor - 0.5, (j[valid] + 0.5) * factor - 0.5)
    point, up = scene.world.points_at_zero_height(elevation.crs, x, y)
    if grid.crs != elevation.crs:
        x, y = transformer(elevation.crs, grid.crs).transform(x, y)
    col_above, half_above = (np.repeat(v, ratio * ratio)[valid] for v in parent_extent)
    row, col = np.asarray(grid.row(y)), np.asarray(grid.col(x))
    if period_nodes is not None:
        col = col + period_nodes * np.rint((col_above - col) / period_nodes)
    cell_m = elevation.cell_size_m(scene.world.metres_per_unit) * factor
    light_space_m = light.points_from_earth(point + up * high[valid, None])
    return FineCells(row, col, (half_above - 1.0) / ratio + 1.0, light_space_m, cell_m)
