"""Slopes of the ground at the nodes of a heightfield."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled


@compiled
def node_slopes(height, col_spacing_m, row_spacing_m):
    """Return the slopes (rows, cols, 2) of a heightfield, in metres per metre: towards higher columns, and towards higher rows.

    Differences are central, and one-sided beside holes and at borders.
    """
    rows, cols = height.shape
    out = np.empty((rows, cols, 2))
    for r in range(rows):
        for c in range(cols):
            out[r, c, 0], out[r, c, 1] = 0.0, 0.0
            if not np.isfinite(height[r, c]):
                continue
            west = 1 if c > 0 and np.isfinite(height[r, c - 1]) else 0
            east = 1 if c < cols - 1 and np.isfinite(height[r, c + 1]) else 0
            north = 1 if r > 0 and np.isfinite(height[r - 1, c]) else 0
            south = 1 if r < rows - 1 and np.isfinite(height[r + 1, c]) else 0
            if west + east > 0:
                out[r, c, 0] = (height[r, c + east] - height[r, c - west]) / (col_spacing_m[r] * (west + east))
            if north + south > 0:
                out[r, c, 1] = (height[r + south, c] - height[r - north, c]) / (row_spacing_m[r] * (north + south))
    return out
