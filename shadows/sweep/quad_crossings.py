"""Raise the maxima of sweep lines to the ground at their crossings with the sides and diagonals of quads.

``skugga.shadows.sweep.lines`` describes the algorithm. The loops process runs of adjacent lines with vector instructions.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal

NO_GROUND_RAY_HEIGHT = np.float32(-1e30)
"""Ray height of a line that has met nothing: finite, not -infinity, so that it can be interpolated."""

ON_NODE_SHARES = 0.0, 0.0
"""Shares of the way from a node to the next one, for the first and the last of adjacent lines that all cross a row at a node."""


@internal
def raise_line_maxima(above, below, cuts, column, line_max, cell, count, f0, f1, s0, s1, crosses):
    """Raise the maximum ray heights of adjacent lines to the ground on a row, and between it and the next row.

    Line n, in [0, ``count``), starts on the row ``above`` between the columns ``column + n`` and ``column + n + 1``. Its maximum
    ray height is ``line_max[cell + n]``, metres, which is changed in place.

    ``above`` and ``below`` (m,) are the ray heights, metres, of the nodes of the row and of the next one. ``cuts`` (bool, by
    column) is True for a quad that is cut along its falling diagonal (upper left to lower right). It is empty where each quad is
    cut along its higher diagonal. ``f0`` and ``f1`` are the positions of the first and the last line between their columns, in [0,
    1). ``s0`` and ``s1`` are their shifts to the right until the next row, in columns. ``crosses`` tells whether the lines cross
    column ``column + n + 1`` on the way.
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
    """Return the first of ``count`` evenly spaced values and the step from one to the next, float32.

    ``ends`` is a pair: the first and the last value.
    """
    return np.float32(ends[0]), np.float32((ends[1] - ends[0]) / max(count - 1, 1))


# The next loops are written so that they compile to vector instructions. Counts have 32 bits, as they convert to float32. A
# comparison with a missing value (NaN) is false, so the value has no effect. Runs of lines are short. So slicing a row, which
# counts references, would take as long as the work itself. Unsigned indices cannot be negative, so the compiler omits a test.


@internal
def _cross_one_quad(above, below, column, line_max, cell, count, row, rising, falling):
    """Raise the maximum ray heights of ``count`` adjacent lines, each of which crosses one quad, to the ground in this quad.

    Line n, in [0, ``count``), crosses the quad between the columns ``column + n`` and ``column + n + 1``. Its maximum ray height is
    ``line_max[cell + n]``, metres, which is changed in place. ``above`` and ``below`` (m,) are the ray heights, metres, of the
    nodes on the two grid rows that bound the quads.

    A line is compared with the ground at three crossings: with the quad's upper side, with its rising diagonal (lower left to upper
    right), and with its falling diagonal (upper left to lower right). ``row``, ``rising`` and ``falling`` tell where, in this
    order. Each is a pair of shares in [0, 1], for the first and for the last line; the lines between have evenly spaced shares. The
    shares count along the upper side from its left end, and along a diagonal from its upper end.
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
    """Raise the maximum ray heights of ``count`` adjacent lines, each of which crosses two quads, to the ground in these quads.

    Line n, in [0, ``count``), crosses the quad between the columns ``column + n`` and ``column + n + 1``, and then the next quad to
    the right. Its maximum ray height is ``line_max[cell + n]``, metres, which is changed in place. ``above`` and ``below`` (m,) are
    the ray heights, metres, of the nodes on the two grid rows that bound the quads.

    A line is compared with the ground at four crossings: with the upper side of the first quad (``row``), with its rising diagonal
    (lower left to upper right, ``rising``), with the side that both quads share (``side``), and with the rising diagonal of the
    second quad (``far``). Each of the four parameters is a pair of shares in [0, 1], for the first and for the last line; the lines
    between have evenly spaced shares. The shares count along the upper side from its left end, and along the others from their
    upper ends.
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
    """Raise maximum ray heights as ``_cross_one_quad`` does, but compare only the diagonal along which the quad is cut.

    Line n has the maximum ray height ``line_max[n]``, metres, which is changed in place. It crosses the quad between the columns n
    and n + 1 of ``above`` and ``below``, the ray heights of the nodes on the quads' two grid rows, metres. ``cuts[n]`` is True if
    this quad is cut into triangles along its falling diagonal. ``row``, ``rising`` and ``falling`` are those of
    ``_cross_one_quad``.
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
    """Raise maximum ray heights as ``_cross_two_quads`` does, but compare only diagonals along which quads are cut into triangles.

    Line n has the maximum ray height ``line_max[n]``, metres, which is changed in place. It crosses the quads from column n to n +
    1 and from n + 1 to n + 2 of ``above`` and ``below``, the ray heights of the nodes on the quads' two grid rows, metres.
    ``cuts[n]`` is True if the quad to the right of column n is cut along its falling diagonal. ``row``, ``rising``, ``side`` and
    ``far`` are those of ``_cross_two_quads``.
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
    """Raise ``count`` ray heights to the ground on two segments each, which start at the same node.

    The ray heights are ``line_max[cell]`` and the following ones, metres, which are changed in place. ``row`` and ``other_row``
    (m,) are the ray heights of the nodes of two grid rows, metres. For ray height n, in [0, ``count``), both segments start at
    column ``a + n`` of ``row``. The first one ends at column ``b + n`` of ``row``, the second one at column ``c + n`` of
    ``other_row``. The pairs ``p`` and ``q`` tell where on the first and the second segment the ground is compared, as shares of the
    way in [0, 1], for the first and for the last ray height. The ray heights between have evenly spaced shares.
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
