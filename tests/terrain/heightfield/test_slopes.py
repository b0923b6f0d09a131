"""Slopes at nodes: planes in closed form, also at borders and beside holes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.heightfield.slopes import node_slopes

ROWS, COLS = 7, 9


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.integers(0, 2**32 - 1))
def test_slopes_of_a_plane_with_holes(right: float, down: float, seed: int) -> None:
    """Each node with a neighbour along an axis has the plane's slope there, whatever else is missing."""
    rng = np.random.default_rng(seed)
    col_spacing_m, row_spacing_m = rng.uniform(0.5, 30.0, ROWS), np.full(ROWS, 4.0)
    valid = rng.random((ROWS, COLS)) < 0.7
    height_m = right * np.arange(COLS) * col_spacing_m[:, None]  # rows of their own: slopes along rows only
    slopes = node_slopes(np.where(valid, height_m, np.nan), col_spacing_m, row_spacing_m)
    beside = np.pad(valid, ((0, 0), (1, 1)))
    has_neighbour = valid & (beside[:, :-2] | beside[:, 2:])
    assert slopes[..., 0] == pytest.approx(np.where(has_neighbour, right, 0.0), abs=1e-9)
    height_m = np.repeat(down * 4.0 * np.arange(ROWS)[:, None], COLS, axis=1)
    slopes = node_slopes(np.where(valid, height_m, np.nan), col_spacing_m, row_spacing_m)
    below = np.pad(valid, ((1, 1), (0, 0)))
    assert slopes[..., 1] == pytest.approx(np.where(valid & (below[:-2] | below[2:]), down, 0.0), abs=1e-9)


def test_slopes_are_central_between_two_neighbours() -> None:
    height_m = np.array([[0.0, 1.0, 4.0]])
    assert node_slopes(height_m, np.ones(1), np.ones(1))[0, :, 0].tolist() == [1.0, 2.0, 3.0]
