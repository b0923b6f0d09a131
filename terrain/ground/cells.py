"""The cells of a raster as they are: which one a place lies in.

A place on a border belongs to the highest of the cells that meet there: so no side of the compass is preferred.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

ON_BORDER = 1e-6
"""How near to a border of cells, in cells, a place lies on it."""


@internal
def highest_cell(height, row, col):
    """Row and column of the cell that a place lies in, the highest of those that meet there; (-1, -1) where none has a height."""
    best_row, best_col = -1, -1
    if not (np.isfinite(row) and np.isfinite(col)):
        return best_row, best_col
    for r in range(int(np.floor(row + 0.5 - ON_BORDER)), int(np.floor(row + 0.5 + ON_BORDER)) + 1):
        for c in range(int(np.floor(col + 0.5 - ON_BORDER)), int(np.floor(col + 0.5 + ON_BORDER)) + 1):
            if 0 <= r < height.shape[0] and 0 <= c < height.shape[1] and np.isfinite(height[r, c]):
                if best_row < 0 or height[r, c] > height[best_row, best_col]:
                    best_row, best_col = r, c
    return best_row, best_col


@compiled
def cell_heights(values, valid, row, col):
    """Heights float32 of the cells of a window at places (n, m), NaN where there is none; and whether they are valid."""
    out = np.full(row.shape, np.nan, np.float32)
    there = np.zeros(row.shape, np.bool_)
    for i in range(row.shape[0]):
        for j in range(row.shape[1]):
            r, c = highest_cell(values, row[i, j], col[i, j])
            if r >= 0:
                out[i, j], there[i, j] = values[r, c], valid[r, c]
    return out, there
