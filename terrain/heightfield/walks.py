"""What walks along rays over a heightfield share: the drop by curvature, maxima of tiles, and the way from square to square.

Walks skip tiles that lie below the ray (maximum mipmaps: Tevs, Ihrke and Seidel 2008). They enter one square of the grid after the
other (J. Amanatides and A. Woo 1987, *A Fast Voxel Traversal Algorithm for Ray Tracing*).
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

ALONG_GRID_SLOPE = 1e-10
"""Rows per column (or columns per row) of lines that count as parallel to the grid: 0.00001 cells in 100,000."""


def curvature_drop_m(distance_m: np.ndarray, curvature_per_m: float) -> np.ndarray:
    """Return how far level ground lies below the horizontal plane of an eye, metres.

    ``distance_m`` is the distance from the eye, and ``curvature_per_m`` is 1 over the earth's radius R, 0 in a flat world. The drop
    is d^2 / 2R, the first term of the series of R (1 - cos(d / R)): too large by 16 mm in 100 km. It is the correction for
    curvature in levelling (C. D. Ghilani and P. R. Wolf, *Elementary Surveying*), without that for refraction.
    """
    return 0.5 * curvature_per_m * distance_m * distance_m


loop_curvature_drop_m = internal(curvature_drop_m)
"""``curvature_drop_m`` for compiled loops."""


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


@internal
def shares_per_node(rows, cols):
    """Return the shares of a piece of a line in which it passes one row and one column; inf along rows or columns.

    The piece passes ``rows`` rows and ``cols`` columns; the shares have their signs. A piece within ``ALONG_GRID_SLOPE`` of the
    grid's direction counts as parallel to it. Otherwise one that starts on a row, and leaves it by less than its rounding error,
    would cross that row anew at every step.
    """
    least = ALONG_GRID_SLOPE * max(abs(rows), abs(cols))
    return 1.0 / rows if abs(rows) > least else np.inf, 1.0 / cols if abs(cols) > least else np.inf


@internal
def exit_share(r0, per_row, c0, per_col, top, left, side_quads, min_share):
    """Return the position on a piece of a line, as a share of its length, at which it leaves a square of the grid.

    The piece starts at row ``r0`` and column ``c0``. It passes one row in the share ``per_row`` of its length and one column in
    ``per_col`` (``shares_per_node``). The square has its first corner at ``top`` and ``left``, and a side of ``side_quads`` quads.
    The result is at least ``min_share``.
    """
    share = np.inf
    if per_row < np.inf:
        share = ((top + side_quads if per_row > 0.0 else top) - r0) * per_row
    if per_col < np.inf:
        share = min(share, ((left + side_quads if per_col > 0.0 else left) - c0) * per_col)
    return max(share, min_share)
