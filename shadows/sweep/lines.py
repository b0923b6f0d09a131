"""The line sweep: compute the shadow height at every node of a grid, in time linear in its nodes.

**Space.** ``skugga.shadows.sweep.grid`` turns and mirrors the grid: the sun stands before row 0, and a ray that leaves the sun
moves by 0 to 1 columns to the right per row. The *ray height* of a node is its coordinate along light space's up axis: at right
angles to the rays, in the vertical plane of the sun. It is constant along a ray. The *shadow height* of a node is the ray height
above which it would see the sun. So a point sees the sun exactly if nothing between it and the sun has a higher ray height. No
slopes and no distances are needed. On the round earth rays remain straight, and the ray heights of the nodes follow the curvature.

**Lines.** Seen from above, rays are lines, ``lines`` of them per column. Line number k of cell j has ``t = j + k / lines``. It
crosses row i at a column that is a cubic in t; without the convergence of meridians it would be t plus a shift. Each line carries
the highest ray height that it has met. Between two rows it crosses the sides and the diagonals of quads. The surface's ray height
along the line has its kinks at these crossings and on the rows, and is linear between them. So the maximum of a line over the drawn
triangles is exact. A quad is cut into two triangles along the higher of its diagonals (``skugga.terrain.ground.sheet``). Both
diagonals can therefore be tested, since the lower one lies below the surface. Decimated ground of a perspective view is the
exception: there ``is_cut_nw_se`` states the diagonal of each quad.

**Nodes.** A node lies between two lines. Shade from beyond the row before the node is interpolated between the maxima of the two
lines. The maximum over a continuous surface is continuous from line to line, so the error falls with the square of the lines'
distance. Peaks, which are nodes, are the exception: the lines on either side miss them. So the highest node between two lines is
stored with its position, and the interpolation goes to it and from it. Otherwise the nodes behind it would lose its shadow at
azimuths that run almost from node to node. Shade from the row before the node, where errors would count most, is exact on the
node's own line.

**Vectorisation.** All lines of one number k cross a row at nearly the same position within their cells. A *run* is the lines of one
number k in adjacent cells. It is processed at once with vector instructions, without gathers and branches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.sweep.points import evaluate_cubic, evaluate_points, row_cubic, snap_to_column
from skugga.terrain.compiled import compiled, internal

NO_GROUND_RAY_HEIGHT = np.float32(-1e30)
"""Ray height of a line that has met nothing: finite, not -infinity, so that it can be interpolated."""

NO_CUTS = np.zeros(0, np.bool_)
"""Diagonals of a row of quads that are all cut along the higher one."""

MAX_RUN_LINES = 512
"""Maximum number of lines in a run (lines of one number in adjacent cells, which are processed at once)."""

ON_NODE_SHARES = 0.0, 0.0
"""Shares of the way from a node to the next one, for the first and the last of adjacent lines that all cross the row at a node."""

LINEARITY_TOLERANCE = 0.01
"""Tolerance in cells for positions in a run of adjacent lines, which are interpolated linearly between its first and last line."""


class TurnedGrid(NamedTuple):
    """A turned grid (n, m) including two border columns (``skugga.shadows.sweep.grid.allocate_bordered_grid``), with the positions
    of its lines.

    The grid is rotated and mirrored so that the sun stands before row 0. A position across the lines is t, in cells.

    Attributes
    ----------
    ray_height
        float32 (n, m), metres: the ray heights of the nodes; NaN without ground.
    column_of_t
        float64 (n, 4): for each row, the cubic that gives the column at t.
    t_of_column
        float64 (n, 4): for each row, the cubic that gives t at a column.
    is_cut_nw_se
        bool (n - 1, m - 1): True if a quad is cut from (i, j) to (i + 1, j + 1), False if from (i, j + 1) to (i + 1, j). Empty
        where each quad is cut along its higher diagonal.
    """

    ray_height: np.ndarray
    column_of_t: np.ndarray
    t_of_column: np.ndarray
    is_cut_nw_se: np.ndarray


class LineStrip(NamedTuple):
    """A strip of adjacent sweep lines, and the maximum ray heights along them as far as one row of the grid.

    A strip evaluates nodes and points from the start of its second cell to the end of its last cell but two.

    Attributes
    ----------
    lines
        Lines per cell.
    first_cell
        Cell of the first column of ``line_max``.
    line_max
        float32 (lines, cells), metres: the highest ray height along each line so far.
    peaks
        float32 (2, lines, cells): the ray height in metres of the highest node between each line and the next, and the node's
        position between the two lines, in [0, 1].
    """

    lines: int
    first_cell: int
    line_max: np.ndarray
    peaks: np.ndarray


@compiled
def sweep_rows(turned_grid, strip, first, last, shadow_ray_heights, lit, points):
    """Advance a strip of lines over the rows [``first``, ``last``) of a grid, and evaluate nodes and points.

    The nodes of the rows (``first``, ``last``] are evaluated into those of two output arrays that are not empty.
    ``shadow_ray_heights`` (n, m) float32 receives the ray height in metres above which a node sees the sun. ``lit`` (n, m) bool
    receives whether it does. ``points`` are the strip's other points (``StripPoints``).
    """
    ray_height, column_of_t, t_of_column, is_cut_nw_se = turned_grid
    lines, first_cell, line_max, peaks = strip
    row_starts = points.row_starts
    nodes = shadow_ray_heights.size > 0 or lit.size > 0
    for i in range(first, last):
        cuts = is_cut_nw_se[i] if is_cut_nw_se.size else NO_CUTS
        if nodes:
            _evaluate_nodes(
                ray_height, column_of_t, t_of_column, lines, cuts, first_cell, line_max, peaks, shadow_ray_heights, lit, i
            )
            _update_peaks(ray_height, column_of_t, t_of_column, lines, first_cell, peaks, i)
        if row_starts[i] < row_starts[i + 1]:
            evaluate_points(turned_grid, strip, i, points)
        for k in range(lines):
            _advance_lines(
                ray_height[i],
                ray_height[i + 1],
                row_cubic(column_of_t, i),
                row_cubic(column_of_t, i + 1),
                lines,
                cuts,
                first_cell,
                line_max[k],
                k,
            )


@internal
def _max_run_length(p, low, high, times):
    """Return the maximum number of adjacent lines or nodes whose positions a straight line interpolates between both ends.

    The positions are ``times`` the cubic ``p`` (4,) on the interval from ``low`` to ``high``. The tolerance is
    ``LINEARITY_TOLERANCE``.
    """
    bend = times * max(abs(2.0 * p[2] + 6.0 * p[3] * low), abs(2.0 * p[2] + 6.0 * p[3] * high))
    return (
        MAX_RUN_LINES
        if bend * MAX_RUN_LINES * MAX_RUN_LINES <= 8.0 * LINEARITY_TOLERANCE
        else max(int(np.sqrt(8.0 * LINEARITY_TOLERANCE / bend)), 2)
    )


@internal
def _crossing_class(cubic_above, cubic_below, t, j):
    """Return a number that tells which quads the line at ``t``, in cell ``j``, crosses between a row and the next one.

    It is 2 (c - j), where c is the grid column to the left of the line on the first row. It is larger by 1 if the line crosses
    column c + 1 before the next row. Adjacent lines with equal numbers cross quads in the same way.
    """
    x = snap_to_column(evaluate_cubic(cubic_above, t))
    c = int(np.floor(x))
    return 2 * (c - j) + (1 if snap_to_column(evaluate_cubic(cubic_below, t)) > c + 1 else 0)


@internal
def _advance_lines(above, below, cubic_above, cubic_below, lines, cuts, first_cell, line_max, k):
    """Raise the maxima of the lines of number ``k`` to the ground from a row to just before the next row.

    ``above`` and ``below`` (m,) are the ray heights of the two rows. ``cubic_above`` and ``cubic_below`` give a line's column on
    them. ``line_max`` (cells,) holds the maxima and is changed in place.
    """
    cells, cols = line_max.size, above.size
    share = k / lines
    run = _max_run_length(cubic_above, first_cell, first_cell + cells, np.int64(1))
    start = 0
    while start < cells:
        end = min(start + run, cells)
        crossing_class = _crossing_class(cubic_above, cubic_below, first_cell + start + share, first_cell + start)
        if _crossing_class(cubic_above, cubic_below, first_cell + end - 1 + share, first_cell + end - 1) != crossing_class:
            low, high = start, end - 1  # lines up to ``low`` have the same class, the line at ``high`` has another
            while high - low > 1:
                middle = (low + high) // 2
                if _crossing_class(cubic_above, cubic_below, first_cell + middle + share, first_cell + middle) == crossing_class:
                    low = middle
                else:
                    high = middle
            end = high
        crosses = crossing_class % 2 == 1
        shift = (crossing_class - crossing_class % 2) // 2 + first_cell  # column left of the line, less its index in ``line_max``
        begin = max(start, -shift)
        last = min(end, cols - (2 if crosses else 1) - shift)
        if begin < last:
            t0, t1 = first_cell + begin + share, first_cell + last - 1 + share
            f0, f1 = (
                snap_to_column(evaluate_cubic(cubic_above, t0)) - (begin + shift),
                snap_to_column(evaluate_cubic(cubic_above, t1)) - (last - 1 + shift),
            )
            s0, s1 = (
                snap_to_column(evaluate_cubic(cubic_below, t0)) - (begin + shift) - f0,
                snap_to_column(evaluate_cubic(cubic_below, t1)) - (last - 1 + shift) - f1,
            )
            _raise_line_maxima(above, below, cuts, begin + shift, line_max, begin, last - begin, f0, f1, s0, s1, crosses)
        start = end


@internal
def _raise_line_maxima(above, below, cuts, column, line_max, cell, count, f0, f1, s0, s1, crosses):
    """Raise the maxima of ``count`` adjacent lines to the ground on a row, and between it and the next row.

    The first line lies between ``column`` of the row and the next column. Its maximum is ``line_max[cell]``, which is changed in
    place. ``f0`` and ``f1`` are the positions of the first and the last line between their columns, in [0, 1). ``s0`` and ``s1``
    are their shifts to the right until the next row, in columns. ``crosses`` tells whether the lines cross a column on the way.
    """
    if f0 == 0.0 and f1 == 0.0:  # on nodes: a missing right neighbour has no effect
        _raise_to_segments(above, column, column, above, column, line_max, cell, count, ON_NODE_SHARES, ON_NODE_SHARES)
    row, rising = (f0, f1), (min((1.0 - f0) / (1.0 + s0), 1.0), min((1.0 - f1) / (1.0 + s1), 1.0))
    if crosses:
        side, far = ((1.0 - f0) / s0, (1.0 - f1) / s1), ((2.0 - f0) / (1.0 + s0), (2.0 - f1) / (1.0 + s1))
        if cuts.size:
            _cross_two_cut_quads(
                above[column:], below[column:], cuts[column:], line_max[cell : cell + count], row, rising, side, far
            )
        else:
            _cross_two_quads(above, below, column, line_max, cell, count, row, rising, side, far)
    else:
        falling = min(f0 / max(1.0 - s0, 1e-9), 1.0), min(f1 / max(1.0 - s1, 1e-9), 1.0)
        if cuts.size:
            _cross_one_cut_quad(above[column:], below[column:], cuts[column:], line_max[cell : cell + count], row, rising, falling)
        else:
            _cross_one_quad(above, below, column, line_max, cell, count, row, rising, falling)


@internal
def _even_steps(ends, count):
    """Return the first of ``count`` even steps between two ends, and the step size, as float32."""
    return np.float32(ends[0]), np.float32((ends[1] - ends[0]) / max(count - 1, 1))


# The next loops are written so that they compile to vector instructions. Counts have 32 bits, as they convert to float32. A
# comparison with a missing value (NaN) is false, so the value has no effect. Runs of lines are short. So slicing a row, which
# counts references, would take as long as the work itself. Unsigned indices cannot be negative, so the compiler omits a test.


@internal
def _cross_one_quad(above, below, column, line_max, cell, count, row, rising, falling):
    """Raise the maxima of adjacent lines that cross one quad each to the ground on its upper side and on both of its diagonals.

    ``above`` and ``below`` (m,) are the ray heights of the quads' two rows. ``row``, ``rising`` and ``falling`` are shares of the
    way along the upper side and the diagonals, at which the first and the last line cross them.
    """
    p, dp = _even_steps(row, count)
    q, dq = _even_steps(rising, count)
    r, dr = _even_steps(falling, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        left, right, line = np.uintp(column + n), np.uintp(column + 1 + n), np.uintp(cell + n)
        on_row = above[left] + (p + dp * x) * (above[right] - above[left])
        on_rising = above[right] + (q + dq * x) * (below[left] - above[right])
        on_falling = above[left] + (r + dr * x) * (below[right] - above[left])
        highest = line_max[line]
        highest = on_row if on_row > highest else highest
        highest = on_rising if on_rising > highest else highest
        line_max[line] = on_falling if on_falling > highest else highest


@internal
def _cross_two_quads(above, below, column, line_max, cell, count, row, rising, side, far):
    """Raise the maxima of adjacent lines that cross two quads each to the ground on the quads' edges and diagonals.

    A line crosses the upper side of the first quad, its rising diagonal, the side between the quads, and the rising diagonal of the
    second quad. ``row``, ``rising``, ``side`` and ``far`` are the shares of the way along these at which the first and the last
    line cross them.
    """
    p, dp = _even_steps(row, count)
    q, dq = _even_steps(rising, count)
    r, dr = _even_steps(side, count)
    s, ds = _even_steps(far, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        left, right, far_right = np.uintp(column + n), np.uintp(column + 1 + n), np.uintp(column + 2 + n)
        line = np.uintp(cell + n)
        on_row = above[left] + (p + dp * x) * (above[right] - above[left])
        on_rising = above[right] + (q + dq * x) * (below[left] - above[right])
        on_side = above[right] + (r + dr * x) * (below[right] - above[right])
        on_far_rising = above[far_right] + (s + ds * x) * (below[right] - above[far_right])
        highest = line_max[line]
        highest = on_row if on_row > highest else highest
        highest = on_rising if on_rising > highest else highest
        highest = on_side if on_side > highest else highest
        line_max[line] = on_far_rising if on_far_rising > highest else highest


@internal
def _cross_one_cut_quad(above, below, cuts, line_max, row, rising, falling):
    """Raise maxima as ``_cross_one_quad`` does, but use only the diagonal along which a quad is cut into triangles.

    ``cuts`` (bool) is True for a falling diagonal. All arrays start at the first of the lines.
    """
    count = line_max.size
    p, dp = _even_steps(row, count)
    q, dq = _even_steps(rising, count)
    r, dr = _even_steps(falling, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        on_row = above[n] + (p + dp * x) * (above[n + 1] - above[n])
        falling_height = above[n] + (r + dr * x) * (below[n + 1] - above[n])
        rising_height = above[n + 1] + (q + dq * x) * (below[n] - above[n + 1])
        on_diagonal = falling_height if cuts[n] else rising_height
        highest = line_max[n]
        highest = on_row if on_row > highest else highest
        line_max[n] = on_diagonal if on_diagonal > highest else highest


@internal
def _cross_two_cut_quads(above, below, cuts, line_max, row, rising, side, far):
    """Raise maxima as ``_cross_two_quads`` does, but use only the diagonal along which a quad is cut into triangles.

    ``cuts`` (bool) is True for a falling diagonal. All arrays start at the first of the lines.
    """
    count = line_max.size
    p, dp = _even_steps(row, count)
    q, dq = _even_steps(rising, count)
    r, dr = _even_steps(side, count)
    s, ds = _even_steps(far, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        on_row = above[n] + (p + dp * x) * (above[n + 1] - above[n])
        on_rising = NO_GROUND_RAY_HEIGHT if cuts[n] else above[n + 1] + (q + dq * x) * (below[n] - above[n + 1])
        on_side = above[n + 1] + (r + dr * x) * (below[n + 1] - above[n + 1])
        on_far_rising = NO_GROUND_RAY_HEIGHT if cuts[n + 1] else above[n + 2] + (s + ds * x) * (below[n + 1] - above[n + 2])
        highest = line_max[n]
        highest = on_row if on_row > highest else highest
        highest = on_rising if on_rising > highest else highest
        highest = on_side if on_side > highest else highest
        line_max[n] = on_far_rising if on_far_rising > highest else highest


@internal
def _raise_to_segments(row, a, b, other_row, c, line_max, cell, count, p, q):
    """Raise ``count`` ray heights from ``line_max[cell]`` on to the ground on two segments between nodes.

    For the first ray height both segments start at column ``a`` of ``row``. The first segment ends at column ``b`` of ``row``, the
    second one at column ``c`` of ``other_row``. For each further ray height all columns move on by one. ``p`` and ``q`` are the
    shares of the way along the two segments, for the first and the last ray height.
    """
    p0, dp = _even_steps(p, count)
    q0, dq = _even_steps(q, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        line = np.uintp(cell + n)
        start_height = row[np.uintp(a + n)]
        on_first = start_height + (p0 + dp * x) * (row[np.uintp(b + n)] - start_height)
        on_second = start_height + (q0 + dq * x) * (other_row[np.uintp(c + n)] - start_height)
        highest = line_max[line]
        highest = on_first if on_first > highest else highest
        line_max[line] = on_second if on_second > highest else highest


@internal
def _evaluate_nodes(ray_height, column_of_t, t_of_column, lines, cuts, first_cell, line_max, peaks, shadow_ray_heights, lit, i):
    """Compute the shadow heights of the nodes of row ``i + 1``, and write them to ``shadow_ray_heights`` and ``lit``.

    Ground between row ``i`` and the nodes is compared exactly, on each node's own ray. The maxima over the ground on the sun's side
    of row ``i`` are interpolated between the two lines beside a node.
    """
    cols, cells = ray_height.shape[1], line_max.shape[1]
    t_of_column_below, column_of_t_above, column_of_t_below = (
        row_cubic(t_of_column, i + 1),
        row_cubic(column_of_t, i),
        row_cubic(column_of_t, i + 1),
    )
    first = _first_column_at(column_of_t_below, t_of_column_below, first_cell + 1, cols)
    last = _first_column_at(column_of_t_below, t_of_column_below, first_cell + cells - 2, cols)
    run = _max_run_length(t_of_column_below, first, last, lines)
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
def _update_peaks(ray_height, column_of_t, t_of_column, lines, first_cell, peaks, i):
    """Update the peaks (the highest node between each line and the next) with the nodes of row ``i``."""
    cols, cells = ray_height.shape[1], peaks.shape[2]
    row_t_of_column, row_column_of_t, row = row_cubic(t_of_column, i), row_cubic(column_of_t, i), ray_height[i]
    first = _first_column_at(row_column_of_t, row_t_of_column, first_cell + 1, cols)
    last = _first_column_at(row_column_of_t, row_t_of_column, first_cell + cells - 2, cols)
    run = _max_run_length(row_t_of_column, first, last, lines)
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

    A peak is the highest node between a line and the next one. The nodes lie to the right of the lines of number ``k``, from
    ``cell`` on. ``between`` holds the positions of the first and the last node between their lines, in [0, 1].
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
    i = np.uintp(i)
    for n in range(count):
        shadow_ray_heights[i, np.uintp(first + n)] = node_shadow_heights[n]


@internal
def _write_lit(node_shadow_heights, row, lit, i, first, count):
    i = np.uintp(i)
    for n in range(count):
        column = np.uintp(first + n)
        lit[i, column] = not node_shadow_heights[n] > row[column]


@internal
def _line_position(t_of_column, column, lines):
    """Return the position of the node in ``column`` of a row, counted in lines from t = 0; a whole number on a line."""
    return snap_to_column(evaluate_cubic(t_of_column, np.float64(column)) * lines)


@internal
def _column_shift(column_of_t, t_of_column, column):
    """Return by how many columns a node's ray is farther to the left on the row before."""
    return column - snap_to_column(evaluate_cubic(column_of_t, evaluate_cubic(t_of_column, np.float64(column))))


@internal
def _run_end(t_of_column, first, last, lines):
    """Return the end of the adjacent nodes in [``first``, ``last``) with lines of one number to their left, and that line.

    The line is that to the left of node ``first``, counted from t = 0. From each node to the next it is ``lines`` farther right.
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

    The comparison uses ``t_of_column`` alone. So of two adjacent strips of lines exactly one evaluates each node.
    """
    column = min(max(int(np.ceil(evaluate_cubic(column_of_t, np.float64(t)))), 1), cols - 1)
    while column > 1 and evaluate_cubic(t_of_column, np.float64(column - 1)) >= t:
        column -= 1
    while column < cols - 1 and evaluate_cubic(t_of_column, np.float64(column)) < t:
        column += 1
    return column


@internal
def _interpolate_between_lines(line_max, k, cell, right, right_cell, peaks, between, count, out):
    """Interpolate the maxima of lines at ``count`` adjacent nodes, and write them to ``out`` (count,) float32.

    These are the shadow heights of the nodes by all ground up to the row before them. The lines to the left of the nodes have
    number ``k`` and start at ``cell``. Those to the right have number ``right`` and start at ``right_cell``. Where the peak (the
    highest node between two lines) is higher, the interpolation leads over it. ``between`` holds the positions of the first and the
    last node between their lines, in [0, 1].
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

    ``above`` and ``below`` (m,) are the ray heights of that row and of the nodes' row. ``column_shifts`` holds by how many columns
    the rays of the first and the last node are farther to the left on the row before.
    """
    start = np.int64(0)  # not a literal, for which ``_raise_to_segments`` would be compiled again
    if max(column_shifts[0], column_shifts[1]) == 0.0:  # straight down: a missing left neighbour has no effect
        _raise_to_segments(above, first, first, above, first, out, start, count, ON_NODE_SHARES, ON_NODE_SHARES)
        return
    if (
        min(column_shifts[0], column_shifts[1]) == 1.0
    ):  # along the quads' falling diagonals: a missing right neighbour has no effect
        _raise_to_segments(above, first - 1, first - 1, above, first - 1, out, start, count, ON_NODE_SHARES, ON_NODE_SHARES)
    # Add the rising diagonal of the quad to the left: the falling one ends in the node itself.
    rising = column_shifts[0] / (1.0 + column_shifts[0]), column_shifts[1] / (1.0 + column_shifts[1])
    if cuts.size:
        left_of = np.empty(count, np.float32)
        for n in range(count):
            left_of[n] = np.float32(np.nan) if cuts[first - 1 + n] else below[first - 1 + n]
        _raise_to_segments(above, first, first - 1, left_of, start, out, start, count, column_shifts, rising)
    else:
        _raise_to_segments(above, first, first - 1, below, first - 1, out, start, count, column_shifts, rising)
