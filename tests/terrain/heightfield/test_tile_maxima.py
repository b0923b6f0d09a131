"""Maxima of tiles: each is that of its nodes, borders included."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.heightfield.walks import write_tile_max


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_tile_maxima_are_those_of_their_nodes(rows: int, cols: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    height_m = rng.normal(0.0, 100.0, (rows, cols)).astype(np.float32)
    height_m[rng.random((rows, cols)) < 0.3] = np.nan
    out = np.empty((-(-rows // 8), -(-cols // 8)), np.float32)
    write_tile_max(height_m, out, 8)
    for tile_row, tile_col in np.ndindex(*out.shape):
        tile = height_m[8 * tile_row : 8 * tile_row + 9, 8 * tile_col : 8 * tile_col + 9]
        assert out[tile_row, tile_col] == np.max(tile, where=np.isfinite(tile), initial=-np.inf)
