"""Bound the rises of the facets of a grid mesh, by their support function.

A facet's rise is the pair of its height differences from column to column and from row to row. Shadow casters are culled by these
bounds (``skugga.terrain.casters.caster_culling``).
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.ground.extremes import update_ranges

RISE_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
"""Directions (column, row) of the support function. The support in a direction is the maximum of the rises' projections on it."""


def rise_support(height_m: np.ndarray) -> np.ndarray:
    """Return the support (8,) in ``RISE_DIRECTIONS`` of the rises of the facets of a grid mesh, metres; 0 without facets.

    ``height_m`` (rows, cols) holds the heights of the mesh's nodes. The result holds for either diagonal along which a quad may be
    cut into facets. A facet has one side of its quad along a row and one along a column, and all four such pairs count.
    """
    rise_extremes, out = np.empty((len(RISE_DIRECTIONS), height_m.shape[1]), np.float32), np.empty(len(RISE_DIRECTIONS))
    gather_rises(np.ascontiguousarray(height_m, np.float32), 0, rise_extremes)
    write_rise_support(rise_extremes, out)
    return out


# The next loops compile to SIMD instructions, because each uses few arrays. NaN is an unknown height.


@compiled
def gather_rises(height_m, halo, rise_extremes):
    """Write the extremes of the rises of a grid mesh's facets to ``rise_extremes``, float32 (8, cols), for each column of nodes.

    The rows are maximum and minimum of four quantities: the rise a from column to column, the rise b from row to row, a + b and
    a - b. The first and last ``halo`` columns of ``height_m`` are skipped. Sums are float32, as heights are. Rounding keeps their
    order, so the largest rounded sum is the rounded largest sum.
    """
    rows, cols = height_m.shape[0], rise_extremes.shape[1]
    right, next_right, down = np.empty(cols - 1, np.float32), np.empty(cols - 1, np.float32), np.empty(cols, np.float32)
    max_right, min_right = np.empty(cols - 1, np.float32), np.empty(cols - 1, np.float32)
    max_down, min_down = np.empty(cols - 1, np.float32), np.empty(cols - 1, np.float32)
    for k in range(0, len(rise_extremes), 2):
        rise_extremes[k], rise_extremes[k + 1] = -np.inf, np.inf
    for i in range(rows):
        row_m = height_m[i, halo : halo + cols]
        _differences(row_m[1:], row_m[:-1], next_right)
        update_ranges(next_right, rise_extremes[1, : cols - 1], rise_extremes[0, : cols - 1])
        if i > 0:
            _differences(row_m, height_m[i - 1, halo : halo + cols], down)
            update_ranges(down, rise_extremes[3], rise_extremes[2])
            _fmax(right, next_right, max_right)
            _fmin(right, next_right, min_right)
            _fmax(down[:-1], down[1:], max_down)
            _fmin(down[:-1], down[1:], min_down)
            _widen_by_sums(max_right, max_down, min_right, min_down, rise_extremes[5, : cols - 1], rise_extremes[4, : cols - 1])
            _widen_by_differences(
                max_right, max_down, min_right, min_down, rise_extremes[7, : cols - 1], rise_extremes[6, : cols - 1]
            )
        right, next_right = next_right, right


@compiled
def write_rise_support(rise_extremes, out):
    """Write the support (8,) in ``RISE_DIRECTIONS`` from the ``rise_extremes`` (8, cols) of ``gather_rises``; 0 without facets.

    No facet lies beyond the last column of nodes. Of that column only the rises from row to row count.
    """
    for k in range(0, len(rise_extremes), 2):
        count = rise_extremes.shape[1] if k == 2 else rise_extremes.shape[1] - 1
        max_rise, min_rise = np.float32(-np.inf), np.float32(np.inf)
        for j in range(count):
            max_rise = rise_extremes[k, j] if rise_extremes[k, j] > max_rise else max_rise
            min_rise = rise_extremes[k + 1, j] if rise_extremes[k + 1, j] < min_rise else min_rise
        out[k], out[k + 1] = max_rise if np.isfinite(max_rise) else 0.0, -min_rise if np.isfinite(min_rise) else 0.0


@internal
def count_missing(height_m, missing):
    """Add 1 to each element of ``missing`` (cols,) where the height is missing (not finite), in place."""
    for j in range(missing.size):
        missing[j] += np.int32(0) if np.isfinite(height_m[j]) else np.int32(1)


@internal
def _differences(a, b, out):
    """Write the differences ``a`` - ``b`` (n,) to ``out``."""
    for j in range(out.size):
        out[j] = a[j] - b[j]


@internal
def _fmax(a, b, out):
    """Write the larger values of ``a`` and ``b`` (n,) to ``out``. A NaN does not count unless both are NaN."""
    for j in range(out.size):
        out[j] = a[j] if (a[j] > b[j]) | np.isnan(b[j]) else b[j]


@internal
def _fmin(a, b, out):
    """Write the smaller values of ``a`` and ``b`` (n,) to ``out``. A NaN does not count unless both are NaN."""
    for j in range(out.size):
        out[j] = a[j] if (a[j] < b[j]) | np.isnan(b[j]) else b[j]


@internal
def _widen_by_sums(max_a, max_b, min_a, min_b, minimum, maximum):
    """Extend the range from ``minimum`` to ``maximum`` of each element (n,) to include all sums of a and b, in place.

    a lies between ``min_a`` and ``max_a``, b between ``min_b`` and ``max_b``. Sums that are NaN change no range.
    """
    for j in range(minimum.size):
        high, low = max_a[j] + max_b[j], min_a[j] + min_b[j]
        maximum[j] = high if high > maximum[j] else maximum[j]
        minimum[j] = low if low < minimum[j] else minimum[j]


@internal
def _widen_by_differences(max_a, max_b, min_a, min_b, minimum, maximum):
    """Extend the range from ``minimum`` to ``maximum`` of each element (n,) to include all differences a - b, in place.

    The other parameters are those of ``_widen_by_sums``.
    """
    for j in range(minimum.size):
        high, low = max_a[j] - min_b[j], min_a[j] - max_b[j]
        maximum[j] = high if high > maximum[j] else maximum[j]
        minimum[j] = low if low < minimum[j] else minimum[j]
