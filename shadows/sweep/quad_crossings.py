"""Raise the maxima of sweep lines to the ground at their crossings with the sides and diagonals of quads.

``skugga.shadows.sweep.lines`` describes the algorithm. The loops process runs of adjacent lines with vector instructions.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal

NO_GROUND_RAY_HEIGHT = np.float32(-1e30)
"""Ray height of a line that has met nothing: finite, not -infinity, so that it can be interpolated."""

ON_NODE_SHARES = 0.0, 0.0
"""Shares of the way from a node to the next one, for the first and the last of adjacent lines that all cross the row at a node."""


@internal
def raise_line_maxima(above, below, cuts, column, line_max, cell, count, f0, f1, s0, s1, crosses):
    """Raise the maxima of ``count`` adjacent lines to the ground on a row, and between it and the next row.

    The first line lies between ``column`` of the row and the next column. Its maximum is ``line_max[cell]``, which is changed in
    place. ``f0`` and ``f1`` are the positions of the first and the last line between their columns, in [0, 1). ``s0`` and ``s1``
    are their shifts to the right until the next row, in columns. ``crosses`` tells whether the lines cross a column on the way.
    """
    if f0 == 0.0 and f1 == 0.0:  # on nodes: a missing right neighbour has no effect
        raise_to_segments(above, column, column, above, column, line_max, cell, count, ON_NODE_SHARES, ON_NODE_SHARES)
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
    second quad. Quads lie between the ground rows ``above`` and ``below``, from ``column`` on. ``line_max`` holds the maxima, from
    ``cell`` on for ``count`` lines. ``row``, ``rising``, ``side`` and ``far`` are the shares of the way along these at which the
    first and the last line cross them.
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
def raise_to_segments(row, a, b, other_row, c, line_max, cell, count, p, q):
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
