"""Quadratic polynomials in row and column that approximate smooth values over a block of cells, fitted at a few positions."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal


def quadratic_fit(row: np.ndarray, col: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the matrix (6, k) that maps values at k positions to the coefficients of the fitted quadratic.

    ``row`` and ``col`` (k,) are the positions in a block of cells whose rows and columns are ``shape``.
    """
    y, x = row / max(shape[0] - 1, 1), col / max(shape[1] - 1, 1)
    return np.linalg.pinv(np.stack([np.ones_like(x), y, x, y * y, y * x, x * x], axis=-1))


@internal
def evaluate_quadratic(coefficients, y, x):
    """Return the value of a quadratic with ``coefficients`` (6,); ``y`` and ``x`` go from 0 to 1 over the rows and columns."""
    c = coefficients
    return c[0] + y * (c[1] + y * c[3] + x * c[4]) + x * (c[2] + x * c[5])
