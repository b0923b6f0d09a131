"""Evaluate the line sweep at single points: on the ground between nodes, and above the ground on meshes and trees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal

COLUMN_TOLERANCE = 1e-9
"""Tolerance in cells within which a position counts as lying on a column of the grid.

Under suns along the axes and diagonals of the grid all lines run along columns or diagonals, except for rounding. Without the
tolerance, rounding would decide at random which of the two adjacent quads such a line crosses.
"""


class StripPoints(NamedTuple):
    """Points between nodes or above the ground, and which of them lie in a strip of lines.

    A point has a column on the grid and a position t across the lines. The two agree only at the height for which the lines were
    computed, since higher ground is shifted sideways. For points of the ground the column is decisive, so that they lie over their
    own triangles.

    Attributes
    ----------
    row_starts
        int64 (rows + 1,): for each row i, the position in ``indices`` of the first point in the rows (i, i + 1].
    indices
        int32 (k,): indices of the strip's points in the other arrays, sorted by the pair of grid rows between which they lie.
    row, col, t
        float64 (n,): positions on the sun-aligned grid, and across the lines in cells; columns do not count the left border.
    ray_height
        float64 (n,), metres: the points' ray heights; NaN for points on the ground, which have the ground's.
    ray_height_rounding_m
        Metres by which the ground's ray height must exceed a point's to shade it.
    lit
        bool (n,), output: False if the highest ray height towards the sun exceeds the point's by more than
        ``ray_height_rounding_m``.
    above_m
        float32 (n,), output: metres by which the highest ray height towards the sun exceeds the point's.
    """

    row_starts: np.ndarray
    indices: np.ndarray
    row: np.ndarray
    col: np.ndarray
    t: np.ndarray
    ray_height: np.ndarray
    ray_height_rounding_m: float
    lit: np.ndarray
    above_m: np.ndarray


def empty_strip_points(rows: int) -> StripPoints:
    """Return an empty set of points, for a grid with ``rows`` rows."""
    none, indices = np.zeros(0), np.zeros(0, np.int32)
    return StripPoints(
        np.zeros(rows + 1, np.int64), indices, none, none, none, none, 0.0, np.zeros(0, np.bool_), np.zeros(0, np.float32)
    )


@compiled
def write_row_intervals(first, last, row, rows, out):
    """Write to ``out`` (n,) int, for each point, the grid row i of the interval of rows (i, i + 1] in which it lies.

    ``row`` (n,) are the points' fractional rows. Only the points with indices in [``first``, ``last``) are written. The grid has
    ``rows`` rows.
    """
    for n in range(first, last):
        out[n] = min(max(np.int32(np.ceil(row[n])) - 1, 0), rows - 2)


@compiled
def select_strip_points(t, interval, rows, start, stop):
    """Return ``row_starts`` and ``indices`` of ``StripPoints`` for the points whose t lies in [``start``, ``stop``).

    ``t`` (n,) is that of ``SweepPoints``. ``interval`` (n,) holds for each point i of the rows (i, i + 1] that contain it. The grid
    has ``rows`` rows.
    """
    row_starts = np.empty(rows + 1, np.int64)
    row_starts[:] = 0
    for n in range(t.size):
        if start <= t[n] < stop:
            row_starts[interval[n] + 1] += 1
    for i in range(rows):
        row_starts[i + 1] += row_starts[i]
    filled = row_starts[:-1].copy()
    indices = np.empty(row_starts[rows], np.int32)
    for n in range(t.size):
        if start <= t[n] < stop:
            indices[filled[interval[n]]] = n
            filled[interval[n]] += 1
    return row_starts, indices


@internal
def evaluate_points(sun_aligned_grid, strip, i, points):
    """Compute whether the points in the rows (``i``, ``i + 1``] of a ``SunAlignedGrid`` see the sun.

    ``strip`` is a ``LineStrip``, whose maxima must include all ground before row ``i``, and none after it. ``points`` are
    ``StripPoints``. The results go to ``points.lit`` and ``points.above_m``.
    """
    ray_height, column_of_t, t_of_column, is_cut_nw_se = sun_aligned_grid
    lines, first_cell, line_max, _ = strip
    row_starts, indices, row, col, t, points_ray_height, rounding, lit, above_m = points
    first, last = row_starts[i], row_starts[i + 1]
    cols = ray_height.shape[1]
    above, below = ray_height[i], ray_height[i + 1]
    column_of_t_above, column_of_t_below, t_of_column_above = (
        row_cubic(column_of_t, i),
        row_cubic(column_of_t, i + 1),
        row_cubic(t_of_column, i),
    )
    for m in range(first, last):
        n = indices[m]
        end, ray_t = row[n] - i, t[n]
        x = snap_to_column(evaluate_cubic(column_of_t_above, ray_t))
        s = snap_to_column(evaluate_cubic(column_of_t_below, ray_t)) - x
        if np.isnan(points_ray_height[n]):  # on the ground: use the column, to stay over its own triangle
            x = snap_to_column((col[n] + 1.0) - s * end)  # after the left border
            ray_t = evaluate_cubic(t_of_column_above, x)
        c = int(np.floor(x))
        f = x - c
        line_position = snap_to_column(ray_t * lines)
        number = int(np.floor(line_position))
        cell, k = number // lines - first_cell, number % lines
        left = line_max[k, cell]
        right = line_max[k + 1, cell] if k + 1 < lines else line_max[0, cell + 1]
        w = line_position - number
        highest = (1.0 - w) * left + w * right
        point_ray_height = points_ray_height[n]
        if np.isnan(point_ray_height):
            point_ray_height = ground_at(above, below, c, f + s * end, end, is_cut_nw_se, i)
        if 0 <= c and c + 1 < cols:
            highest = _max_with_segment(highest, above[c], above[c + 1], f)
            if is_cut_along(is_cut_nw_se, i, c, False) and (1.0 - f) / (1.0 + s) < end:
                highest = _max_with_segment(highest, above[c + 1], below[c], (1.0 - f) / (1.0 + s))
            if f + s <= 1.0:
                if is_cut_along(is_cut_nw_se, i, c, True) and f < end * (1.0 - s):
                    highest = _max_with_segment(highest, above[c], below[c + 1], f / (1.0 - s))
            elif (1.0 - f) / s < end:
                highest = _max_with_segment(highest, above[c + 1], below[c + 1], (1.0 - f) / s)
                if c + 2 < cols and is_cut_along(is_cut_nw_se, i, c + 1, False) and (2.0 - f) / (1.0 + s) < end:
                    highest = _max_with_segment(highest, above[c + 2], below[c + 1], (2.0 - f) / (1.0 + s))
        above_m[n] = highest - point_ray_height
        lit[n] = not highest > point_ray_height + rounding


@internal
def row_cubic(cubics, i):
    """Return the four coefficients of row ``i``'s cubic as a tuple, constant term first.

    ``cubics`` (rows, 4) holds those of all rows.
    """
    return cubics[i, 0], cubics[i, 1], cubics[i, 2], cubics[i, 3]


@internal
def evaluate_cubic(coefficients, x):
    """Return the value of a cubic (4,), constant term first, at ``x``."""
    return coefficients[0] + x * (coefficients[1] + x * (coefficients[2] + x * coefficients[3]))


@internal
def snap_to_column(x):
    """Return a column coordinate, snapped to the nearest column within ``COLUMN_TOLERANCE``."""
    column = np.rint(x)
    return column if abs(x - column) < COLUMN_TOLERANCE else x


@internal
def _max_with_segment(highest, a, b, share):
    """Return the maximum of ``highest`` and the ray height at ``share`` of the way from that of node ``a`` to that of node ``b``.

    All are in metres. If the ray height is NaN (no ground), return ``highest``.
    """
    value = np.float64(a)
    if share > 0.0:  # otherwise b may be NaN
        value += share * (np.float64(b) - value)
    return value if value > highest else highest


@internal
def is_cut_along(is_cut_nw_se, i, c, is_falling):
    """Return whether quad (``i``, ``c``) may be cut into triangles along one of its diagonals.

    It is the falling diagonal (upper left to lower right) if ``is_falling``, and the rising one otherwise. If ``is_cut_nw_se``
    (``SunAlignedGrid``) is empty, the diagonal is unknown and both are possible.
    """
    return is_cut_nw_se.size == 0 or is_cut_nw_se[i, c] == is_falling


@internal
def ground_at(above, below, c, u, v, is_cut_nw_se, i):
    """Interpolate the value of two rows ``u`` columns to the right of column ``c`` and ``v`` rows, in [0, 1], below row ``i``.

    ``above`` and ``below`` (m,) hold the values (for example ray heights) of the nodes of rows ``i`` and ``i + 1``.
    ``is_cut_nw_se`` are the diagonals of ``SunAlignedGrid``. The result is NaN without ground.
    """
    c += int(np.floor(u))
    u -= np.floor(u)
    if c < 0 or c + 1 >= len(above):
        return np.nan
    nw, ne, sw, se = np.float64(above[c]), np.float64(above[c + 1]), np.float64(below[c]), np.float64(below[c + 1])
    falling = nw + u * (ne - nw) + v * (se - ne) if u > v else nw + v * (sw - nw) + u * (se - sw)
    rising = nw + u * (ne - nw) + v * (sw - nw) if u + v < 1.0 else se + (1.0 - u) * (sw - se) + (1.0 - v) * (ne - se)
    if is_cut_nw_se.size:
        return falling if is_cut_nw_se[i, c] else rising
    return falling if falling > rising or np.isnan(rising) else rising  # if a corner is missing, use the other diagonal
