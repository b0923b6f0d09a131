"""Which ground a sweep over a map's block reads, and where its lines run."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shadows.sweep.grid import fitted_cubics
from shadows.sweep.rays import patch_windows
from terrain.casters.reach import PATCH_QUADS, Patch

Q = PATCH_QUADS


@given(st.sets(st.tuples(st.integers(-3, 4), st.integers(-3, 4)), max_size=30))
def testpatch_windows_patches_cover_themselves_once_and_nothing_else(patches):
    covered: list[tuple[int, int]] = []
    for row, col, rows, cols in patch_windows([Patch(0, *place) for place in patches]):
        assert row % Q == col % Q == 0 and (rows - 1) % Q == (cols - 1) % Q == 0
        covered += [(row // Q + i, col // Q + j) for i in range(rows // Q) for j in range(cols // Q)]
    assert sorted(covered) == sorted(patches)


def test_fitted_cubics_go_through_cubics():
    x = np.sort(np.random.default_rng(5).uniform(900.0, 3000.0, (6, 17)), axis=1)
    factors = np.random.default_rng(6).normal(size=(6, 4)) * (1.0, 1e-1, 1e-5, 1e-9)
    y = np.stack([np.polynomial.polynomial.polyval(*pair) for pair in zip(x, factors, strict=True)])
    found = fitted_cubics(x, y)
    assert np.allclose(found, factors, rtol=1e-6, atol=1e-12)
    assert np.allclose(fitted_cubics(x[:, :2], y[:, :2])[:, 2:], 0.0)  # a line through two points
