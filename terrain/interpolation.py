"""Interpolation of arrays: smoothstep and bilinear look-ups.

Imports no numba. ``skugga.terrain.interpolation_loops`` has the functions for compiled loops.
"""

from __future__ import annotations

import numpy as np


def smoothstep(share: np.ndarray | float) -> np.ndarray:
    """Return the smoothstep 3 s^2 - 2 s^3 of each value s of ``share``, which is clamped to [0, 1] first."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


def bilinear(values: np.ndarray, row: np.ndarray, col: np.ndarray, layer: np.ndarray | None = None) -> np.ndarray:
    """Interpolate bilinearly between the cells of a grid.

    Parameters
    ----------
    values
        A grid (rows, cols), or one per layer (layers, rows, cols).
    row, col
        Fractional rows and columns (n,), from 0 to the index of the last cell.
    layer
        The number (n,) of each point's layer, if ``values`` has layers.

    Returns
    -------
    numpy.ndarray
        Values (n,) float64.
    """
    rows, cols = values.shape[-2:]
    r0, c0 = np.minimum(row.astype(int), max(rows - 2, 0)), np.minimum(col.astype(int), max(cols - 2, 0))
    r1, c1 = np.minimum(r0 + 1, rows - 1), np.minimum(c0 + 1, cols - 1)
    grids = () if layer is None else (layer,)
    corners = (values[(*grids, *corner)] for corner in ((r0, c0), (r0, c1), (r1, c0), (r1, c1)))
    north_west, north_east, south_west, south_east = corners
    row_fraction, col_fraction = row - r0, col - c0
    north = north_west * (1.0 - col_fraction) + north_east * col_fraction
    south = south_west * (1.0 - col_fraction) + south_east * col_fraction
    return np.asarray(north * (1.0 - row_fraction) + south * row_fraction, np.float64)
