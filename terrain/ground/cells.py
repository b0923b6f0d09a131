"""Look up the raster cell under a position, for ground that is drawn as blocks (a flat top for each cell).

Positions are (fractional) rows and columns, with whole numbers at the cells' centres.

A position on the border of several cells belongs to the highest of them, so no compass direction is preferred.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

BORDER_TOLERANCE_CELLS = 1e-6
"""Tolerance in cells: a position at most this far from a border of cells counts as on the border."""


@internal
def highest_cell(height, row, col):
    """Return row and column of the cell that contains a position, or (-1, -1) if that cell has no height.

    On a border it returns the highest of the cells that meet there. ``height`` is (rows, cols), NaN where a cell has no height.
    """
    best_row, best_col = -1, -1
    if not (np.isfinite(row) and np.isfinite(col)):
        return best_row, best_col
    for r in range(int(np.floor(row + 0.5 - BORDER_TOLERANCE_CELLS)), int(np.floor(row + 0.5 + BORDER_TOLERANCE_CELLS)) + 1):
        for c in range(int(np.floor(col + 0.5 - BORDER_TOLERANCE_CELLS)), int(np.floor(col + 0.5 + BORDER_TOLERANCE_CELLS)) + 1):
            if 0 <= r < height.shape[0] and 0 <= c < height.shape[1] and np.isfinite(height[r, c]):
                if best_row < 0 or height[r, c] > height[best_row, best_col]:
                    best_row, best_col = r, c
    return best_row, best_col


@compiled
def cell_heights(values, cell_valid, row, col):
    """Return heights (n, m) float32 and the valid mask (n, m) of the cells under positions ``row``, ``col`` (n, m).

    Heights are NaN where no cell has one. ``values`` (rows, cols) are the cells' heights, ``cell_valid`` is their valid mask.
    """
    out = np.full(row.shape, np.nan, np.float32)
    valid = np.zeros(row.shape, np.bool_)
    for i in range(row.shape[0]):
        for j in range(row.shape[1]):
            r, c = highest_cell(values, row[i, j], col[i, j])
            if r >= 0:
                out[i, j], valid[i, j] = values[r, c], cell_valid[r, c]
    return out, valid
