"""Shadows of plain arrays of heights, in a flat world: no file, no level, no OpenGL."""

from __future__ import annotations

import numpy as np

from shadows.sweep.grid import CellSize, sunlit


def shadow(
    height_m: np.ndarray, cell_m: CellSize, azimuth_deg: float, altitude_deg: float, lines: int = 8, cores: int = 1
) -> np.ndarray:
    """Which nodes of a heightfield lie in shadow, cast or their own: bool (rows, cols), False where there is no ground.

    ``height_m`` (rows, cols), row 0 north, NaN where there is no ground; ``cell_m`` is the side of a cell, or its (row, column)
    sides, metres; the azimuth is clockwise from north, and the sun below the horizon leaves everything in shadow. More ``lines``
    are more exact: 8 are wrong at 1 node in 10,000 of mountains. Raises ``ValueError`` for heights that are no grid.
    """
    height_m = np.asarray(height_m, np.float32)
    if height_m.ndim != 2 or min(height_m.shape) < 2:
        raise ValueError(f"height_m has the shape {height_m.shape}; it must be (rows, cols), at least 2 x 2")
    there = np.isfinite(height_m)
    if altitude_deg <= 0.0:
        return there
    return there & ~sunlit(height_m, cell_m, azimuth_deg, altitude_deg, lines, cores)
