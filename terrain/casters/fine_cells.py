"""Refine cells of a big raster's overview where single cells cover much ground.

Finer cells exclude more ground beside a block that cannot shade it and need not be read. So a block costs the same on a raster of
any size.
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
    """Finer cells (n,) of some of an overview's cells.

    Attributes
    ----------
    row, col, half_extent
        float64 (n,), rows, columns and half extents on a grid, in nodes.
    light_space_m
        float64 (n, 3), the cells' centres at their highest ground, in light space, metres.
    width_m
        The width of a cell, metres.
    """

    row: np.ndarray
    col: np.ndarray
    half_extent: np.ndarray
    light_space_m: np.ndarray
    width_m: float


def fine_cells(
    scene: Scene,
    light: LightSpace,
    grid: Grid,
    parents: np.ndarray,
    parent_extent: tuple[np.ndarray, np.ndarray],
    period: float | None,
) -> FineCells | None:
    """Return the finer cells of the overview's cells that the mask ``parents`` (rows, cols) selects.

    ``parent_extent`` holds columns and half extents (n,) of the selected cells. Columns repeat after ``period``. ``None`` if the
    level has no finer cells.
    """
    overview, elevation = scene.elevation.overview, scene.elevation
    if overview.fine_high_m is None:
        return None
    ratio = 2 ** (overview.lod - overview.fine_lod)
    parent_row, parent_col = np.nonzero(parents)
    down, right = (v.ravel() for v in np.mgrid[:ratio, :ratio])
    i, j = (parent_row[:, None] * ratio + down).ravel(), (parent_col[:, None] * ratio + right).ravel()
    high = overview.fine_high_m[i, j]
    valid = np.isfinite(high)
    factor = 2**overview.fine_lod
    x, y = elevation.xy((i[valid] + 0.5) * factor - 0.5, (j[valid] + 0.5) * factor - 0.5)
    point, up = scene.world.ground(elevation.crs, x, y)
    if grid.crs != elevation.crs:
        x, y = transformer(elevation.crs, grid.crs).transform(x, y)
    col_above, half_above = (np.repeat(v, ratio * ratio)[valid] for v in parent_extent)
    row, col = np.asarray(grid.row(y)), np.asarray(grid.col(x))
    if period is not None:
        col = col + period * np.rint((col_above - col) / period)
    cell_m = elevation.cell_size_m(scene.world.metres_per_unit) * factor
    light_space_m = light.from_earth(point + up * high[valid, None])
    return FineCells(row, col, (half_above - 1.0) / ratio + 1.0, light_space_m, cell_m)
