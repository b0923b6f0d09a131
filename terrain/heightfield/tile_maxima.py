"""Maximum heights of the tiles of a heightfield: rays skip tiles below them (Tevs, Ihrke and Seidel 2008, maximum mipmaps)."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled


@compiled
def write_tile_max(height_m, tile_max_m, tile_quads):
    """Write the maximum height of each square tile of ``tile_quads`` quads a side to ``tile_max_m``; -inf without ground.

    ``height_m`` (rows, cols) are the heights of the nodes. A node on the border of two tiles counts for both.
    """
    rows, cols = height_m.shape
    for a in range(tile_max_m.shape[0]):
        for b in range(tile_max_m.shape[1]):
            highest = np.float32(-np.inf)
            for i in range(a * tile_quads, min(a * tile_quads + tile_quads + 1, rows)):
                for j in range(b * tile_quads, min(b * tile_quads + tile_quads + 1, cols)):
                    if height_m[i, j] > highest:
                        highest = height_m[i, j]
            tile_max_m[a, b] = highest
