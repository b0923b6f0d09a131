"""Where the whole raster of a level lies in pixels of a view, and whether a block contains all of it."""

from __future__ import annotations

import numpy as np

from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import transformer
from skugga.terrain.scene import Scene

RIM_TOLERANCE_PX = 1e-6
"""Tolerance in pixels for the test whether a block contains the whole raster."""

RIM_SAMPLES = 33
"""Number of rows, and of columns, of positions of a raster that are projected to find its extent on another grid."""


def holds_all_ground(scene: Scene, view: MapView) -> bool:
    """Return whether a block contains the whole raster of its level, so that no ground lies beside it."""
    (top, bottom), (left, right) = ground_extent(scene, view)
    rows, cols = (
        (-0.5 - RIM_TOLERANCE_PX, view.rows - 0.5 + RIM_TOLERANCE_PX),
        (-0.5 - RIM_TOLERANCE_PX, view.cols - 0.5 + RIM_TOLERANCE_PX),
    )
    return bool(top >= rows[0] and bottom <= rows[1] and left >= cols[0] and right <= cols[1])


def ground_extent(scene: Scene, view: MapView) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the minimum and maximum row, and the minimum and maximum column, of a level's raster in pixels of a view.

    They are counted from the centre of the view's first pixel.

    The limits are infinite where PROJ cannot transform them.
    """
    elevation, grid = scene.elevation, view.grid
    rows, cols = (np.linspace(-0.5, count - 0.5, RIM_SAMPLES) for count in (elevation.rows, elevation.cols))
    x, y = elevation.xy(*np.meshgrid(rows, cols, indexing="ij"))
    if grid.crs != elevation.crs:
        x, y = transformer(elevation.crs, grid.crs).transform(x, y)
    row, col = (grid.row(y) - view.row0) / view.row_step, (grid.col(x) - view.col0) / view.col_step
    if not (np.isfinite(row).all() and np.isfinite(col).all()):
        return (-np.inf, np.inf), (-np.inf, np.inf)
    if grid.crs.is_geographic:  # shift by multiples of 360 degrees, as near to the view as possible
        period = 360.0 / (grid.step * view.col_step)
        if np.ptp(col) > period * (1.0 - 1.0 / RIM_SAMPLES):
            return (float(row.min()), float(row.max())), (-np.inf, np.inf)
        col = col + period * np.rint(((view.cols - 1) / 2 - (col.min() + col.max()) / 2) / period)
    return (float(row.min()), float(row.max())), (float(col.min()), float(col.max()))
