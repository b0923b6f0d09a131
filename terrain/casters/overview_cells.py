"""Locate the cells of a raster's overview, in light space and on a map grid. A cell has the highest ground of many raster cells."""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import WGS84, World, epsg_of, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.scene import Scene

CELL_MARGIN_WIDTHS = 1.5
"""Maximum distance of an overview cell's ground from the cell's centre, in widths of a cell, with a margin."""


@cached("light", 256 * MIB)
def overview_light_space(scene: Scene) -> tuple[np.ndarray, float]:
    """Return the highest ground of each of the overview's cells, and the radius of a cell's ground with a margin, metres.

    The ground is a point in light space (rows, cols, 3) above the cell's centre, NaN in holes.
    """
    point, up = _overview_on_earth(scene.world, scene.elevation)
    assert scene.light_space is not None
    top = point + up * scene.elevation.overview.max_heights_m[..., None]
    return scene.light_space.points_from_earth(top), _overview_cell_m(scene) * CELL_MARGIN_WIDTHS


@cached("scene", 256 * MIB)
def _overview_on_earth(world: World, elevation: Elevation) -> tuple[np.ndarray, np.ndarray]:
    """Return the points at height 0 of the centres of the overview's cells, and the unit up vectors there.

    Both are (rows, cols, 3), earth-fixed; the points are metres.
    """
    return world.points_at_zero_height(elevation.crs, *_overview_xy(elevation))


def _overview_xy(elevation: Elevation) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates x and y (rows, cols), in the raster's CRS, of the centres of the overview's cells."""
    overview = elevation.overview
    rows, cols = overview.mean_heights_m.shape
    factor = 2**overview.lod
    col, row = np.meshgrid((np.arange(cols) + 0.5) * factor - 0.5, (np.arange(rows) + 0.5) * factor - 0.5)
    return elevation.xy(row, col)


def _overview_cell_m(scene: Scene) -> float:
    """Return the side of the overview's cells on the ground, metres."""
    return scene.elevation.cell_size_m(scene.world.metres_per_unit) * 2**scene.elevation.overview.lod


@cached("scene", 256 * MIB)
def overview_on_grid(world: World, elevation: Elevation, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and half widths of the overview's cells on a map grid, each float64 (rows, cols), in nodes.

    Rows and columns are those of the cells' centres. Half widths include a margin. Columns are continuous across the antimeridian.
    """
    x, y = _overview_xy(elevation)
    if grid.crs != elevation.crs:
        x, y = transformer(elevation.crs, grid.crs).transform(x, y)
    row, col = grid.row(np.asarray(y)), grid.col(np.asarray(x))
    period = columns_per_turn(grid)
    if period is not None and np.isfinite(col).all():
        col = np.unwrap(np.unwrap(col, period=period, axis=1), period=period, axis=0)
    size = np.zeros_like(row)
    with np.errstate(invalid="ignore"):
        for values in (row, col):
            for axis in (0, 1):
                if values.shape[axis] > 1:
                    size = np.fmax(size, np.abs(np.gradient(values, axis=axis)))
    return row, col, size + 1.0


def columns_per_turn(grid: Grid) -> float | None:
    """Return the number of a grid's columns round the earth; ``None`` in a CRS whose maps do not close round the earth."""
    if grid.crs.is_geographic:
        return 360.0 / grid.step
    return 2.0 * np.pi * WGS84.a / grid.step if epsg_of(grid.crs) == 3857 else None
