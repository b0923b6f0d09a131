"""Traversal of a grid along a line, square by square (J. Amanatides and A. Woo 1987, "A Fast Voxel Traversal Algorithm")."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal


@internal
def exit_share(r0, per_row, c0, per_col, top, left, side_quads, min_share):
    """Return the position on a piece of a line, as a share of its length, at which it leaves a square of the grid.

    The piece starts at row ``r0`` and column ``c0``. It passes one row in the share ``per_row`` of its length and one column in
    ``per_col``; they are negative towards smaller rows and columns, and inf along them. The square has its first corner at ``top``
    and ``left``, and a side of ``side_quads`` quads. The result is at least ``min_share``.
    """
    share = np.inf
    if per_row < np.inf:
        share = ((top + side_quads if per_row > 0.0 else top) - r0) * per_row
    if per_col < np.inf:
        share = min(share, ((left + side_quads if per_col > 0.0 else left) - c0) * per_col)
    return max(share, min_share)
