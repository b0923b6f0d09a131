"""Evaluate the nodes of a row: interpolate their shadow heights between sweep lines, and compare them with near ground.

``skugga.shadows.sweep.lines`` describes the algorithm.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.sweep.line_runs import MAX_RUN_LINES, max_run_length
from skugga.shadows.sweep.points import evaluate_cubic, row_cubic, snap_to_column
from skugga.shadows.sweep.quad_crossings import ON_NODE_SHARES, raise_to_segments
from skugga.terrain.compiled import internal


@internal
def evaluate_nodes(ray_height, column_of_t, t_of_column, lines, cuts, first_cell, line_max, peaks, shadow_ray_heights, lit, i):
    """Compute the shadow heights of the nodes of row ``i + 1``, and write them to ``shadow_ray_heights`` and ``lit``.

    Ground between row ``i`` and the nodes is compared exactly, on each node's own ray. The maxima over the ground on the sun's side
    of row ``i`` are interpolated between the two lines beside a node.

    ``ray_height``, ``column_of_t`` and ``t_of_column`` are fields of ``SunAlignedGrid``; ``lines``, ``first_cell``, ``line_max``
    and ``peaks`` are those of ``LineStrip``. ``cuts`` (bool) is True for the quads below row ``i`` that are cut along their falling
    diagonals; it is empty where each quad is cut along its higher diagonal. An empty output array, ``shadow_ray_heights`` or
    ``lit`` (n, m), is not written.
    """
    cols, cells = ray_height.shape[1], line_max.shape[1]
    t_of_column_below, column_of_t_above, column_of_t_below = (
        row_cubic(t_of_column, i + 1),
        row_cubic(column_of_t, i),
        row_cubic(column_of_t, i + 1),
    )
    first = _first_column_at(column_of_t_below, t_of_column_below, first_cell + 1, cols)
    last = _first_column_at(column_of_t_below, t_of_column_below, first_cell + cells - 2, cols)
    run = max_run_length(t_of_column_below, first, last, lines)
    above, below, node_shadow_heights = ray_height[i], ray_height[i + 1], np.empty(MAX_RUN_LINES, np.float32)
    while first < last:
        end, number = _run_end(t_of_column_below, first, min(first + run, last), lines)
        count = end - first
        cell, k = number // lines - first_cell, number % lines
        right, right_cell = (k + 1, cell) if k + 1 < lines else (0, cell + 1)
        e0, e1 = (
            _line_position(t_of_column_below, first, lines) - number,
            _line_position(t_of_column_below, end - 1, lines) - number - lines * (count - 1),
        )
        _interpolate_between_lines(line_max, k, cell, right, right_cell, peaks, (e0, e1), count, node_shadow_heights)
        _raise_to_near_ground(
            above,
            below,
            cuts,
            first,
            (
                _column_shift(column_of_t_above, t_of_column_below, first),
                _column_shift(column_of_t_above, t_of_column_below, end - 1),
            ),
            count,
            node_shadow_heights,
        )
        if shadow_ray_heights.size:
            _write_shadow_ray_heights(node_shadow_heights, shadow_ray_heights, i + 1, first, count)
        if lit.size:
            _write_lit(node_shadow_heights, below, lit, i + 1, first, count)
        first = end


@internal
def update_peaks(ray_height, column_of_t, t_of_column, lines, first_cell, peaks, i):
    """Update the peaks (the highest node between each line and the next) with the nodes of row ``i``.

    ``ray_height``, ``column_of_t`` and ``t_of_column`` are fields of ``SunAlignedGrid``; ``lines``, ``first_cell`` and ``peaks``
    are those of ``LineStrip``. ``peaks`` is changed in place.
    """
    cols, cells = ray_height.shape[1], peaks.shape[2]
    row_t_of_column, row_column_of_t, row = row_cubic(t_of_column, i), row_cubic(column_of_t, i), ray_height[i]
    first = _first_column_at(row_column_of_t, row_t_of_column, first_cell + 1, cols)
    last = _first_column_at(row_column_of_t, row_t_of_column, first_cell + cells - 2, cols)
    run = max_run_length(row_t_of_column, first, last, lines)
    while first < last:
        end, number = _run_end(row_t_of_column, first, min(first + run, last), lines)
        count = end - first
        cell, k = number // lines - first_cell, number % lines
        e0, e1 = (
            _line_position(row_t_of_column, first, lines) - number,
            _line_position(row_t_of_column, end - 1, lines) - number - lines * (count - 1),
        )
        _raise_peaks(row, first, (e0, e1), peaks, k, cell, count)
        first = end


@internal
def _raise_peaks(row, first, between, peaks, k, cell, count):
    """Store ``count`` nodes of a row, from column ``first`` on, as peaks where they are higher than the stored peak.

    A peak is the highest node between a line and the next one. ``row`` (m,) are the ray heights of the row's nodes, metres. Node n,
    in [0, ``count``), lies to the right of the line with number ``k`` in the cell with index ``cell + n`` in ``peaks``
    (``LineStrip.peaks``). ``between`` holds the positions of the first and the last node between their lines, in [0, 1].
    """
    per = 1.0 / max(count - 1, 1)
    e, de = np.float32(between[0]), np.float32((between[1] - between[0]) * per)
    k = np.uintp(k)
    for n in range(count):
        c, node_height = np.uintp(cell + n), row[np.uintp(first + n)]
        higher = node_height > peaks[0, k, c]
        peaks[1, k, c] = e + de * np.float32(np.int32(n)) if higher else peaks[1, k, c]
        peaks[0, k, c] = node_height if higher else peaks[0, k, c]


@internal
def _write_shadow_ray_heights(node_shadow_heights, shadow_ray_heights, i, first, count):
    """Copy the shadow heights of ``count`` nodes, metres, to row ``i`` of ``shadow_ray_heights``, from column ``first`` on.

    The first ``count`` values of ``node_shadow_heights`` are copied.
    """
    i = np.uintp(i)
    for n in range(count):
        shadow_ray_heights[i, np.uintp(first + n)] = node_shadow_heights[n]


@internal
def _write_lit(node_shadow_heights, row, lit, i, first, count):
    """Write whether ``count`` nodes are at least as high as their shadow heights to row ``i`` of ``lit``, from column ``first`` on.

    ``row`` (m,) are the ray heights of the nodes of row ``i``, metres. ``node_shadow_heights[0]`` belongs to column ``first``.
    """
    i = np.uintp(i)
    for n in range(count):
        column = np.uintp(first + n)
        lit[i, column] = not node_shadow_heights[n] > row[column]


@internal
def _line_position(t_of_column, column, lines):
    """Return the position of the node in ``column`` of a row, counted in lines from t = 0; a whole number on a line.

    ``t_of_column`` (4,) is the row's cubic, ``lines`` the number of lines per cell.
    """
    return snap_to_column(evaluate_cubic(t_of_column, np.float64(column)) * lines)


@internal
def _column_shift(column_of_t, t_of_column, column):
    """Return by how many columns the ray of the node in ``column`` of a row is farther to the left on the row before.

    ``column_of_t`` (4,) is the cubic of the row before, ``t_of_column`` (4,) that of the node's row.
    """
    return column - snap_to_column(evaluate_cubic(column_of_t, evaluate_cubic(t_of_column, np.float64(column))))


@internal
def _run_end(t_of_column, first, last, lines):
    """Return the column after the last node of a run, which starts at column ``first``, and the number of the line to its left.

    In a run, the lines to the left of the nodes have one number within their cells. The run ends at column ``last`` at the latest.
    The returned number is that of the line to the left of node ``first``, counted from t = 0. From each node to the next it is
    ``lines`` (lines per cell) larger. ``t_of_column`` (4,) is the row's cubic.
    """
    number = int(np.floor(_line_position(t_of_column, first, lines)))
    if int(np.floor(_line_position(t_of_column, last - 1, lines))) - lines * (last - 1 - first) == number:
        return last, number
    low, high = first, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        if int(np.floor(_line_position(t_of_column, middle, lines))) - lines * (middle - first) == number:
            low = middle
        else:
            high = middle
    return high, number


@internal
def _first_column_at(column_of_t, t_of_column, t, cols):
    """Return the first column of a row, without borders, whose t is at least ``t``.

    ``column_of_t`` and ``t_of_column`` (4,) are the row's cubics, ``cols`` the number of its columns with borders. The comparison
    uses ``t_of_column`` alone. So of two adjacent strips of lines exactly one evaluates each node.
    """
    column = min(max(int(np.ceil(evaluate_cubic(column_of_t, np.float64(t)))), 1), cols - 1)
    while column > 1 and evaluate_cubic(t_of_column, np.float64(column - 1)) >= t:
        column -= 1
    while column < cols - 1 and evaluate_cubic(t_of_column, np.float64(column)) < t:
        column += 1
    return column


@internal
def _interpolate_between_lines(line_max, k, cell, right, right_cell, peaks, between, count, out):
    """Interpolate the maxima of lines at ``count`` adjacent nodes, and write them to ``out`` (count,) float32, metres.

    These are the shadow heights of the nodes by all ground up to the row before them. The line to the left of node n, in [0,
    ``count``), is ``line_max[k, cell + n]``, the line to the right is ``line_max[right, right_cell + n]``. ``peaks`` are those of
    ``LineStrip``. Where the peak (the highest node between two lines) is higher, the interpolation leads over it. ``between`` holds
    the positions of the first and the last node between their lines, in [0, 1].
    """
    per = 1.0 / max(count - 1, 1)
    e, de = np.float32(between[0]), np.float32((between[1] - between[0]) * per)
    k, right = np.uintp(k), np.uintp(right)
    for n in range(count):
        c = np.uintp(cell + n)
        left_max, right_max = line_max[k, c], line_max[right, np.uintp(right_cell + n)]
        w = e + de * np.float32(np.int32(n))
        interpolated = (np.float32(1.0) - w) * left_max + w * right_max  # exact at w = 1, even if the left line has met no ground
        a, top = peaks[1, k, c], peaks[0, k, c]
        rising = w < a
        b = w / max(a, np.float32(1e-6)) if rising else (w - a) / max(np.float32(1.0) - a, np.float32(1e-6))
        b = min(max(b, np.float32(0.0)), np.float32(1.0))  # positions are accurate to ``LINEARITY_TOLERANCE`` only
        over_peak = (np.float32(1.0) - b) * (left_max if rising else top) + b * (top if rising else right_max)
        has_peak = top > (np.float32(1.0) - a) * left_max + a * right_max
        out[n] = over_peak if has_peak and over_peak > interpolated else interpolated


@internal
def _raise_to_near_ground(above, below, cuts, first, column_shifts, count, out):
    """Raise the shadow heights ``out`` of ``count`` nodes, from column ``first`` on, to the ground since the row before them.

    ``above`` and ``below`` (m,) are the ray heights, metres, of the nodes of that row and of the nodes' row. ``cuts`` (bool) is
    True for quads between the rows that are cut along their falling diagonals; it is empty where each quad is cut along its higher
    diagonal. ``column_shifts`` holds by how many columns the rays of the first and the last node are farther to the left on the row
    before.
    """
    start = np.int64(0)  # not a literal, for which ``raise_to_segments`` would be compiled again
    if max(column_shifts[0], column_shifts[1]) == 0.0:  # straight down: a missing left neighbour has no effect
        raise_to_segments(above, first, first, above, first, out, start, count, ON_NODE_SHARES, ON_NODE_SHARES)
        return
    if (
        min(column_shifts[0], column_shifts[1]) == 1.0
    ):  # along the quads' falling diagonals: a missing right neighbour has no effect
        raise_to_segments(above, first - 1, first - 1, above, first - 1, out, start, count, ON_NODE_SHARES, ON_NODE_SHARES)
    # Add the rising diagonal of the quad to the left: the falling one ends in the node itself.
    rising = column_shifts[0] / (1.0 + column_shifts[0]), column_shifts[1] / (1.0 + column_shifts[1])
    if cuts.size:
        left_of = np.empty(count, np.float32)
        for n in range(count):
            left_of[n] = np.float32(np.nan) if cuts[first - 1 + n] else below[first - 1 + n]
        raise_to_segments(above, first, first - 1, left_of, start, out, start, count, column_shifts, rising)
    else:
        raise_to_segments(above, first, first - 1, below, first - 1, out, start, count, column_shifts, rising)
