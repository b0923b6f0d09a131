"""The tops of crowns as a raster of heights, for algorithms that know heights alone.

A crown is the body that the outline of the tree's side view describes when it turns about the stem: the mean of the outline's two
sides. Gaps between leaves count as leaves, and the space below a crown as part of it.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, TREE_VARIANTS, foliage

PROFILE_STEPS = 32
"""Steps of a profile from the stem to the crown's edge."""


@cached("process", MIB)
def crown_profiles() -> np.ndarray:
    """Return the heights of the crowns' tops, float32 (variants, ``PROFILE_STEPS``), as shares of the trees' heights.

    The steps lie at even distances from the stem, from 0 to half of the picture's width.
    """
    alpha = foliage().mip_levels[0][..., 3]
    profiles = []
    for variant in range(len(TREE_VARIANTS)):
        is_leaf = alpha[2 * variant] >= ALPHA_THRESHOLD * 255
        rows, cols = is_leaf.shape
        top = np.where(is_leaf.any(axis=0), 1.0 - is_leaf.argmax(axis=0) / rows, 0.0)
        both_sides = (top[: cols // 2][::-1] + top[cols // 2 :]) / 2.0
        profiles.append(both_sides.reshape(PROFILE_STEPS, -1).mean(axis=1))
    return np.array(profiles, np.float32)


@compiled
def raise_to_crowns(heights, row, col, radius, base_height, height, variant, profiles, cell_rows_cols):
    """Raise ``heights`` (rows, cols) float32, metres, to the tops of the crowns of n trees.

    ``row`` and ``col`` (n,) are the stems on the grid, ``radius`` (n,) half the width of the trees in metres. ``base_height`` and
    ``height`` (n,) are the height of the foot and that of the tree, metres. ``variant`` (n,) selects the row of ``profiles``
    (``crown_profiles``). ``cell_rows_cols`` (2, 2) has the steps east and north, in metres, of the next row and the next column.
    """
    rows, cols = heights.shape
    steps = profiles.shape[1]
    row_m = np.sqrt(cell_rows_cols[0, 0] ** 2 + cell_rows_cols[1, 0] ** 2)
    col_m = np.sqrt(cell_rows_cols[0, 1] ** 2 + cell_rows_cols[1, 1] ** 2)
    sine = abs(cell_rows_cols[0, 0] * cell_rows_cols[1, 1] - cell_rows_cols[0, 1] * cell_rows_cols[1, 0]) / (row_m * col_m)
    for n in range(len(row)):
        down, right = radius[n] / (row_m * sine), radius[n] / (col_m * sine)
        for i in range(max(int(np.ceil(row[n] - down)), 0), min(int(np.floor(row[n] + down)) + 1, rows)):
            for j in range(max(int(np.ceil(col[n] - right)), 0), min(int(np.floor(col[n] + right)) + 1, cols)):
                east = cell_rows_cols[0, 0] * (i - row[n]) + cell_rows_cols[0, 1] * (j - col[n])
                north = cell_rows_cols[1, 0] * (i - row[n]) + cell_rows_cols[1, 1] * (j - col[n])
                share = np.sqrt(east * east + north * north) / radius[n]
                if share < 1.0:
                    top = base_height[n] + height[n] * profiles[variant[n], int(share * steps)]
                    heights[i, j] = max(heights[i, j], np.float32(top))
