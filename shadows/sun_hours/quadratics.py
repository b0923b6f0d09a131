"""Quadratics that approximate smooth values over a block's cells, from values at a few positions. Partly compiled."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal


def quadratic_fit(row: np.ndarray, col: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the matrix (6, k) that maps values at positions (k,) of cells (n, m) to the coefficients of their quadratic."""
    y, x = row / max(shape[0] - 1, 1), col / max(shape[1] - 1, 1)
    return np.linalg.pinv(np.stack([np.ones_like(x), y, x, y * y, y * x, x * x], axis=-1))


@internal
def quadratic(c, y, x):
    """Return the value of a quadratic (6,) at shares of the way down and right over the cells."""
    return c[0] + y * (c[1] + y * c[3] + x * c[4]) + x * (c[2] + x * c[5])
