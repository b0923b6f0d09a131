"""The line sweep: compute the shadow level at every node of a grid, in time linear in its nodes.

**Space.** ``skugga.shadows.sweep.grid`` turns and mirrors the grid: the sun stands before row 0, and a ray that leaves the sun
moves by 0 to 1 columns to the right per row. The *level* of a node is its coordinate along light space's second axis ("up": at
right angles to the rays, in the vertical plane of the sun). The level is constant along a ray. So a point sees the sun exactly if
nothing between it and the sun has a higher level. No slopes and no distances are needed, and the earth's curvature bends the
nodes, not the rays.

**Lines.** Seen from above, rays are lines, ``lines`` of them per column. Line number k of cell j has ``t = j + k / lines``. It
crosses row i at a column that is a cubic in t; without the convergence of meridians it would be t plus a shift. Each line carries
the highest level that it has met. Between two rows it crosses the sides and the diagonals of quads. The surface's level along the
line has its kinks at these crossings and on the rows, and is linear between them. So the maximum of a line over the drawn
triangles is exact. A quad is cut along the higher of its diagonals (``skugga.terrain.ground.sheet``). Both diagonals can therefore
be tested, since the other one lies below the surface. Only for the decimated ground of a camera does each quad state its cut.

**Nodes.** A node lies between two lines. Shade from beyond the row before the node is interpolated between the maxima of the two
lines. The maximum over a continuous surface is continuous from line to line, so the error falls with the square of the lines'
distance. Peaks, which are nodes, are the exception: the lines on either side miss them. So the highest node between two lines is
stored with its position, and the interpolation goes to it and from it. Otherwise the nodes behind it would lose its shadow at
azimuths that run almost from node to node. Shade from the row before the node, where errors would count most, is exact on the
node's own line.

**Vectorisation.** All lines of one number k cross a row at nearly the same position within their cells. So whole runs of lines are
processed at once with vector instructions, without gathers and branches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.sweep.points import cubic, cubic_of, evaluate_points, snap_to_column
from skugga.terrain.compiled import compiled, internal

NO_GROUND_LEVEL = np.float32(-1e30)
"""Level of a line that has met nothing: finite, not -infinity, so that it can be interpolated."""

NO_CUTS = np.zeros(0, np.bool_)

RUN = 512
"""Maximum number of lines in a run."""

ON_NODE = 0.0, 0.0
"""Shares of the way to the next node, at both ends of a run of lines that passes over nodes."""

LINEARITY_TOLERANCE = 0.01
"""Tolerance in cells for the deviation of a run's positions from linear: a run interpolates them between its two ends."""


class TurnedGrid(NamedTuple):
    """A turned grid (n, m) between two border columns (``skugga.shadows.sweep.grid.bordered``), with the positions of its lines.

    Attributes
    ----------
    level
        float32 (n, m), metres: the levels of the nodes; NaN without ground.
    column_of_t
        float64 (n, 4): for each row, the cubic that gives the column at t.
    t_of_column
        float64 (n, 4): for each row, the cubic that gives t at a column.
    falls
        bool (n - 1, m - 1): True if a quad is cut from (i, j) to (i + 1, j + 1), False if from (i, j + 1) to (i + 1, j). Empty
        where each quad is cut along its higher diagonal.
    """

    level: np.ndarray
    column_of_t: np.ndarray
    t_of_column: np.ndarray
    falls: np.ndarray


class Strip(NamedTuple):
    """A strip of adjacent lines, and the levels that they have met before a row.

    A strip is responsible for nodes and points from the start of its second cell to the end of its last cell but two.

    Attributes
    ----------
    lines
        Lines per cell.
    first_cell
        Cell of the first column of ``line_max``.
    line_max
        float32 (lines, cells), metres: the highest level that each line has met.
    peaks
        float32 (2, lines, cells): the level of the highest node between each line and the next, and its share of the way between
        them.
    """

    lines: int
    first_cell: int
    line_max: np.ndarray
    peaks: np.ndarray


@compiled
def sweep_rows(sheet, strip, first, last, shade, lit, points):
    """Advance a strip of lines from before row ``first`` of a grid to before row ``last``; evaluate nodes and points on the way.

    For the nodes of rows (first, last], write the arrays that are not empty: ``shade`` (n, m) float32, the level above which a node
    sees the sun, and ``lit`` (n, m) bool. ``points`` are the strip's points besides nodes (``StripPoints``).
    """
    level, column_of_t, t_of_column, falls = sheet
    lines, first_cell, line_max, peaks = strip
    begins = points.begins
    nodes = shade.size > 0 or lit.size > 0
    for i in range(first, last):
        cuts = falls[i] if falls.size else NO_CUTS
        if nodes:
            _evaluate_nodes(level, column_of_t, t_of_column, lines, cuts, first_cell, line_max, peaks, shade, lit, i)
            _update_peaks(level, column_of_t, t_of_column, lines, first_cell, peaks, i)
        if begins[i] < begins[i + 1]:
            evaluate_points(sheet, strip, i, points)
        for k in range(lines):
            _advance(
                level[i],
                level[i + 1],
                cubic_of(column_of_t, i),
                cubic_of(column_of_t, i + 1),
                lines,
                cuts,
                first_cell,
                line_max[k],
                k,
            )


@internal
def _run_along(p, low, high, times):
    """Return the maximum length of a run from ``low`` to ``high``: over it, ``times`` the cubic bends by ``LINEARITY_TOLERANCE`` at
    most.
    """
    bend = times * max(abs(2.0 * p[2] + 6.0 * p[3] * low), abs(2.0 * p[2] + 6.0 * p[3] * high))
    return RUN if bend * RUN * RUN <= 8.0 * LINEARITY_TOLERANCE else max(int(np.sqrt(8.0 * LINEARITY_TOLERANCE / bend)), 2)


@internal
def _class_of(here, further, t, j):
    """Return a line's class: 2 (c - j), plus 1 if it crosses column c + 1 before the next row; c is the column left of it."""
    x = snap_to_column(cubic(here, t))
    c = int(np.floor(x))
    return 2 * (c - j) + (1 if snap_to_column(cubic(further, t)) > c + 1 else 0)


@internal
def _advance(above, below, here, further, lines, cuts, first_cell, line_max, k):
    """Advance the lines of number ``k`` from before a row to before the next one; their cubics are ``here`` and ``further``."""
    cells, cols = line_max.size, above.size
    share = k / lines
    run = _run_along(here, first_cell, first_cell + cells, np.int64(1))
    start = 0
    while start < cells:
        end = min(start + run, cells)
        kind = _class_of(here, further, first_cell + start + share, first_cell + start)
        if _class_of(here, further, first_cell + end - 1 + share, first_cell + end - 1) != kind:
            low, high = start, end - 1  # kind holds at low, not at high
            while high - low > 1:
                middle = (low + high) // 2
                if _class_of(here, further, first_cell + middle + share, first_cell + middle) == kind:
                    low = middle
                else:
                    high = middle
            end = high
        crosses = kind % 2 == 1
        shift = (kind - kind % 2) // 2 + first_cell  # column left of the line, less its index in ``line_max``
        begin = max(start, -shift)
        last = min(end, cols - (2 if crosses else 1) - shift)
        if begin < last:
            t0, t1 = first_cell + begin + share, first_cell + last - 1 + share
            f0, f1 = snap_to_column(cubic(here, t0)) - (begin + shift), snap_to_column(cubic(here, t1)) - (last - 1 + shift)
            s0, s1 = (
                snap_to_column(cubic(further, t0)) - (begin + shift) - f0,
                snap_to_column(cubic(further, t1)) - (last - 1 + shift) - f1,
            )
            _raise_run(above, below, cuts, begin + shift, line_max, begin, last - begin, f0, f1, s0, s1, crosses)
        start = end


@internal
def _raise_run(above, below, cuts, column, line_max, cell, count, f0, f1, s0, s1, crosses):
    """Raise ``count`` lines to the levels that they meet from a row on and before the next one.

    The run starts at ``column`` of the row and at ``cell`` of ``line_max``. Within their cells the lines' positions go from ``f0``
    to ``f1``; their shifts until the next row go from ``s0`` to ``s1``.
    """
    if f0 == 0.0 and f1 == 0.0:  # on nodes: a missing right neighbour has no effect
        _raise_to_segments(above, column, column, above, column, line_max, cell, count, ON_NODE, ON_NODE)
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
def _steps(ends, count):
    """Return the first of ``count`` even steps between two ends, and the step size, as float32."""
    return np.float32(ends[0]), np.float32((ends[1] - ends[0]) / max(count - 1, 1))


# The next loops are written so that they compile to vector instructions: 32-bit counts convert to float32, and missing values
# (NaN) compare as lower. Runs are short: slicing a row, which counts references, would take as long as the work itself.
# Indices are unsigned, so that the compiler need not handle negative ones, which count from the end.


@internal
def _cross_one_quad(above, below, column, line_max, cell, count, row, rising, falling):
    """Raise a run of lines to the levels that they meet in one quad each: on its first row and on both of its diagonals."""
    p, dp = _steps(row, count)
    q, dq = _steps(rising, count)
    r, dr = _steps(falling, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        here, right, line = np.uintp(column + n), np.uintp(column + 1 + n), np.uintp(cell + n)
        one = above[here] + (p + dp * x) * (above[right] - above[here])
        two = above[right] + (q + dq * x) * (below[here] - above[right])
        three = above[here] + (r + dr * x) * (below[right] - above[here])
        highest = line_max[line]
        highest = one if one > highest else highest
        highest = two if two > highest else highest
        line_max[line] = three if three > highest else highest


@internal
def _cross_two_quads(above, below, column, line_max, cell, count, row, rising, side, far):
    """Raise a run of lines to the levels that they meet in two quads each.

    They are compared on the first row, on the rising diagonals of both quads, and on the side between the quads.
    """
    p, dp = _steps(row, count)
    q, dq = _steps(rising, count)
    r, dr = _steps(side, count)
    s, ds = _steps(far, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        here, right, beyond = np.uintp(column + n), np.uintp(column + 1 + n), np.uintp(column + 2 + n)
        line = np.uintp(cell + n)
        one = above[here] + (p + dp * x) * (above[right] - above[here])
        two = above[right] + (q + dq * x) * (below[here] - above[right])
        three = above[right] + (r + dr * x) * (below[right] - above[right])
        four = above[beyond] + (s + ds * x) * (below[right] - above[beyond])
        highest = line_max[line]
        highest = one if one > highest else highest
        highest = two if two > highest else highest
        highest = three if three > highest else highest
        line_max[line] = four if four > highest else highest


@internal
def _cross_one_cut_quad(above, below, cuts, line_max, row, rising, falling):
    """Do as ``_cross_one_quad``, but only on the diagonals along which the quads are cut."""
    count = line_max.size
    p, dp = _steps(row, count)
    q, dq = _steps(rising, count)
    r, dr = _steps(falling, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        one = above[n] + (p + dp * x) * (above[n + 1] - above[n])
        falls = above[n] + (r + dr * x) * (below[n + 1] - above[n])
        rises = above[n + 1] + (q + dq * x) * (below[n] - above[n + 1])
        other = falls if cuts[n] else rises
        highest = line_max[n]
        highest = one if one > highest else highest
        line_max[n] = other if other > highest else highest


@internal
def _cross_two_cut_quads(above, below, cuts, line_max, row, rising, side, far):
    """Do as ``_cross_two_quads``, but only on the diagonals along which the quads are cut."""
    count = line_max.size
    p, dp = _steps(row, count)
    q, dq = _steps(rising, count)
    r, dr = _steps(side, count)
    s, ds = _steps(far, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        one = above[n] + (p + dp * x) * (above[n + 1] - above[n])
        two = NO_GROUND_LEVEL if cuts[n] else above[n + 1] + (q + dq * x) * (below[n] - above[n + 1])
        three = above[n + 1] + (r + dr * x) * (below[n + 1] - above[n + 1])
        four = NO_GROUND_LEVEL if cuts[n + 1] else above[n + 2] + (s + ds * x) * (below[n + 1] - above[n + 2])
        highest = line_max[n]
        highest = one if one > highest else highest
        highest = two if two > highest else highest
        highest = three if three > highest else highest
        line_max[n] = four if four > highest else highest


@internal
def _raise_to_segments(row, a, b, other_row, c, line_max, cell, count, p, q):
    """Raise a run of levels to those on two segments between nodes.

    Both segments start in column ``a`` of a row. The first ends in column ``b`` of the same row and is sampled at shares ``p``. The
    second ends in column ``c`` of another row and is sampled at shares ``q``.
    """
    p0, dp = _steps(p, count)
    q0, dq = _steps(q, count)
    for n in range(count):
        x = np.float32(np.int32(n))
        line = np.uintp(cell + n)
        here = row[np.uintp(a + n)]
        one = here + (p0 + dp * x) * (row[np.uintp(b + n)] - here)
        other = here + (q0 + dq * x) * (other_row[np.uintp(c + n)] - here)
        highest = line_max[line]
        highest = one if one > highest else highest
        line_max[line] = other if other > highest else highest


@internal
def _evaluate_nodes(level, column_of_t, t_of_column, lines, cuts, first_cell, line_max, peaks, shade, lit, i):
    """Evaluate the nodes of row ``i + 1``.

    Shade from row ``i`` on is exact. Shade from before that row is interpolated between the lines.
    """
    cols, cells = level.shape[1], line_max.shape[1]
    here, before, further = cubic_of(t_of_column, i + 1), cubic_of(column_of_t, i), cubic_of(column_of_t, i + 1)
    first = _first_from(further, here, first_cell + 1, cols)
    last = _first_from(further, here, first_cell + cells - 2, cols)
    run = _run_along(here, first, last, lines)
    above, below, shade_levels = level[i], level[i + 1], np.empty(RUN, np.float32)
    while first < last:
        end, number = _run_of_nodes(here, first, min(first + run, last), lines)
        count = end - first
        cell, k = number // lines - first_cell, number % lines
        right, right_cell = (k + 1, cell) if k + 1 < lines else (0, cell + 1)
        e0, e1 = _line_of(here, first, lines) - number, _line_of(here, end - 1, lines) - number - lines * (count - 1)
        _interpolate_between_lines(line_max, k, cell, right, right_cell, peaks, (e0, e1), count, shade_levels)
        _raise_to_near_ground(
            above,
            below,
            cuts,
            first,
            (_column_shift(before, here, first), _column_shift(before, here, end - 1)),
            count,
            shade_levels,
        )
        if shade.size:
            _put_shade(shade_levels, shade, i + 1, first, count)
        if lit.size:
            _write_lit(shade_levels, below, lit, i + 1, first, count)
        first = end


@internal
def _update_peaks(level, column_of_t, t_of_column, lines, first_cell, peaks, i):
    """Raise the peaks between the lines to the nodes of row ``i``."""
    cols, cells = level.shape[1], peaks.shape[2]
    here, further, row = cubic_of(t_of_column, i), cubic_of(column_of_t, i), level[i]
    first = _first_from(further, here, first_cell + 1, cols)
    last = _first_from(further, here, first_cell + cells - 2, cols)
    run = _run_along(here, first, last, lines)
    while first < last:
        end, number = _run_of_nodes(here, first, min(first + run, last), lines)
        count = end - first
        cell, k = number // lines - first_cell, number % lines
        e0, e1 = _line_of(here, first, lines) - number, _line_of(here, end - 1, lines) - number - lines * (count - 1)
        _raise_peaks(row, first, (e0, e1), peaks, k, cell, count)
        first = end


@internal
def _raise_peaks(row, first, between, peaks, k, cell, count):
    """Store nodes that are higher than the stored peak between their lines."""
    per = 1.0 / max(count - 1, 1)
    e, de = np.float32(between[0]), np.float32((between[1] - between[0]) * per)
    k = np.uintp(k)
    for n in range(count):
        c, level = np.uintp(cell + n), row[np.uintp(first + n)]
        higher = level > peaks[0, k, c]
        peaks[1, k, c] = e + de * np.float32(np.int32(n)) if higher else peaks[1, k, c]
        peaks[0, k, c] = level if higher else peaks[0, k, c]


@internal
def _put_shade(shade_levels, shade, i, first, count):
    i = np.uintp(i)
    for n in range(count):
        shade[i, np.uintp(first + n)] = shade_levels[n]


@internal
def _write_lit(shade_levels, row, lit, i, first, count):
    i = np.uintp(i)
    for n in range(count):
        column = np.uintp(first + n)
        lit[i, column] = not shade_levels[n] > row[column]


@internal
def _line_of(t_of_column, column, lines):
    """Return the position of a row's node among the lines; a whole number if it lies on a line."""
    return snap_to_column(cubic(t_of_column, np.float64(column)) * lines)


@internal
def _column_shift(column_of_t, t_of_column, column):
    """Return how many columns to the left the ray over a node crosses the row before."""
    return column - snap_to_column(cubic(column_of_t, cubic(t_of_column, np.float64(column))))


@internal
def _run_of_nodes(t_of_column, first, last, lines):
    """Return the end of the run of nodes from ``first`` on whose left lines have one number, and the first node's left line."""
    number = int(np.floor(_line_of(t_of_column, first, lines)))
    if int(np.floor(_line_of(t_of_column, last - 1, lines))) - lines * (last - 1 - first) == number:
        return last, number
    low, high = first, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        if int(np.floor(_line_of(t_of_column, middle, lines))) - lines * (middle - first) == number:
            low = middle
        else:
            high = middle
    return high, number


@internal
def _first_from(column_of_t, t_of_column, t, cols):
    """Return the first column of a row, without borders, whose t is at least ``t``.

    The comparison uses ``t_of_column`` alone, so that adjacent strips divide all nodes between them.
    """
    column = min(max(int(np.ceil(cubic(column_of_t, np.float64(t)))), 1), cols - 1)
    while column > 1 and cubic(t_of_column, np.float64(column - 1)) >= t:
        column -= 1
    while column < cols - 1 and cubic(t_of_column, np.float64(column)) < t:
        column += 1
    return column


@internal
def _interpolate_between_lines(line_max, k, cell, right, right_cell, peaks, between, count, out):
    """Compute the shadow levels over a run of nodes as far as the row before them, into ``out`` (count,) float32.

    They are interpolated from the levels of the lines of number ``k`` from a ``cell`` on, of the lines to their right, and of the
    peaks between. ``between`` holds the shares of the first and the last node on the way between their lines.
    """
    per = 1.0 / max(count - 1, 1)
    e, de = np.float32(between[0]), np.float32((between[1] - between[0]) * per)
    k, right = np.uintp(k), np.uintp(right)
    for n in range(count):
        c = np.uintp(cell + n)
        left_held, right_held = line_max[k, c], line_max[right, np.uintp(right_cell + n)]
        w = e + de * np.float32(np.int32(n))
        met = (np.float32(1.0) - w) * left_held + w * right_held  # exact at w = 1 even where one line has met nothing
        a, top = peaks[1, k, c], peaks[0, k, c]
        rising = w < a
        b = w / max(a, np.float32(1e-6)) if rising else (w - a) / max(np.float32(1.0) - a, np.float32(1e-6))
        b = min(max(b, np.float32(0.0)), np.float32(1.0))  # positions are accurate to ``LINEARITY_TOLERANCE`` only
        over = (np.float32(1.0) - b) * (left_held if rising else top) + b * (top if rising else right_held)
        peaked = top > (np.float32(1.0) - a) * left_held + a * right_held
        out[n] = over if peaked and over > met else met


@internal
def _raise_to_near_ground(above, here, cuts, first, aside, count, out):
    """Raise the shadow levels over a run of nodes from column ``first`` on to the levels that their rays meet from the row before.

    ``aside`` holds how many columns to the left the rays of the first and the last node cross the row before.
    """
    start = np.int64(0)  # not a literal, for which ``_raise_to_segments`` would be compiled again
    if max(aside[0], aside[1]) == 0.0:  # straight down: a missing left neighbour has no effect
        _raise_to_segments(above, first, first, above, first, out, start, count, ON_NODE, ON_NODE)
        return
    if min(aside[0], aside[1]) == 1.0:  # along the quads' falling diagonals: a missing right neighbour has no effect
        _raise_to_segments(above, first - 1, first - 1, above, first - 1, out, start, count, ON_NODE, ON_NODE)
    # Add the rising diagonal of the quad to the left: the falling one ends in the node itself.
    rising = aside[0] / (1.0 + aside[0]), aside[1] / (1.0 + aside[1])
    if cuts.size:
        left_of = np.empty(count, np.float32)
        for n in range(count):
            left_of[n] = np.float32(np.nan) if cuts[first - 1 + n] else here[first - 1 + n]
        _raise_to_segments(above, first, first - 1, left_of, start, out, start, count, aside, rising)
    else:
        _raise_to_segments(above, first, first - 1, here, first - 1, out, start, count, aside, rising)
