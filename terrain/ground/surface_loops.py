"""Compiled loops of ``Surface``: interpolate nodes between exact nodes by cubics, and refine heights and valid masks.

Exact nodes are the nodes whose positions are computed exactly (``skugga.terrain.ground.surface``).
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

AXIS_STRIP_ROWS = 64
"""Rows that ``write_axis_coordinates`` processes at a time, so that a column-major array is written as fast as others."""

COLUMN_BLOCK_SIZE = 8
"""Columns written at a time into a column-major array."""


@compiled
def refine_heights(height, row0, col0, rows, cols):
    """Return heights (rows, cols) float32 on the refined grid, which has twice as many nodes per side.

    Its nodes are those of the coarser grid, the centres of their quads, and the midpoints of the quads' sides. ``row0`` and
    ``col0``, each 0 or 1, are the first refined row and column. Quads are cut along their higher diagonals
    (``skugga.terrain.ground.sheet``).
    """
    out = np.empty((rows, cols), np.float32)
    for i in range(rows):
        refine_row(height, row0 + i, col0, out[i])
    return out


@internal
def refine_row(height, row, col0, out):
    """Fill ``out`` with the heights of row ``row`` of the refined grid, from its column ``col0`` (0 or 1) on.

    ``height`` has the heights of the coarser grid. The loops compile to vector instructions.
    """
    above, below = height[row // 2], height[(row + 1) // 2]
    if col0 == 1:
        out[0] = _quad_middle(above[0], above[1], below[0], below[1]) if row % 2 else _middle(above[0], above[1])
    pairs = (out.size - col0) // 2
    at, last = out[col0 : col0 + 2 * pairs], col0 + 2 * pairs
    west, east = above[col0 : col0 + pairs], above[col0 + 1 : col0 + 1 + pairs]
    if row % 2:
        south_west, south_east = below[col0 : col0 + pairs], below[col0 + 1 : col0 + 1 + pairs]
        for j in range(pairs):
            at[2 * j] = _middle(west[j], south_west[j])
            at[2 * j + 1] = _quad_middle(west[j], east[j], south_west[j], south_east[j])
    else:
        for j in range(pairs):
            at[2 * j] = west[j]
            at[2 * j + 1] = _middle(west[j], east[j])
    if last < out.size:
        out[last] = _middle(above[col0 + pairs], below[col0 + pairs])


@internal
def _middle(a, b):
    """Return the mean of two heights, float32."""
    return np.float32(0.5 * (np.float64(a) + np.float64(b)))


@internal
def _quad_middle(west, east, south_west, south_east):
    """Return the height at the centre of a quad, on its higher diagonal.

    ``west`` and ``east`` are the heights of its northern corners, the others those of its southern ones.
    """
    falling = 0.5 * (np.float64(west) + np.float64(south_east))
    rising = 0.5 * (np.float64(east) + np.float64(south_west))
    return np.float32(rising if (rising > falling) | np.isnan(falling) else falling)


@compiled
def refine_valid(valid, row0, col0, rows, cols):
    """Return the valid mask (rows, cols) of the nodes of ``refine_heights``.

    A midpoint of a side is valid if both ends of the side are, a centre if both ends of one of its quad's diagonals are.
    """
    out = np.empty((rows, cols), np.bool_)
    for i in range(rows):
        _refine_valid_row(valid[(row0 + i) // 2], valid[(row0 + i + 1) // 2], col0, out[i])
    return out


@internal
def _refine_valid_row(above, below, col0, out):
    """Write the valid mask of a row of the refined grid to ``out`` (cols,), from the refined column ``col0`` (0 or 1) on.

    ``above`` and ``below`` are the rows of the coarser grid's valid mask between which the row lies. They are the same row if the
    refined row lies on it.
    """
    if col0 == 1:
        out[0] = (above[0] & below[1]) | (above[1] & below[0])
    pairs = (out.size - col0) // 2
    at, last = out[col0 : col0 + 2 * pairs], col0 + 2 * pairs
    nw, ne = above[col0 : col0 + pairs], above[col0 + 1 : col0 + 1 + pairs]
    sw, se = below[col0 : col0 + pairs], below[col0 + 1 : col0 + 1 + pairs]
    for j in range(pairs):
        at[2 * j] = nw[j] & sw[j]
        at[2 * j + 1] = (nw[j] & se[j]) | (ne[j] & sw[j])
    if last < out.size:
        out[last] = above[col0 + pairs] & below[col0 + pairs]


@internal
def cubic_weights(t):
    """Return the weights of the nodes at -1, 0, 1 and 2 in cubic Lagrange interpolation at ``t`` in [0, 1)."""
    return (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


@compiled
def interpolate_nodes(exact, first_row, first_col, stride, row0, col0, rows, cols):
    """Return values (k, rows, cols) at a window's nodes, interpolated by cubics from those of exact nodes (m, n, k).

    Exact nodes are ``stride`` nodes apart. The first one has row ``first_row * stride`` and column ``first_col * stride``.
    (``row0``, ``col0``) is the window's first node on the grid. Sums are in a fixed order, so that results are bit-identical in all
    windows.
    """
    components = exact.shape[2]
    out = np.empty((components, rows, cols))
    row_values = np.empty(exact.shape[1])
    weights = np.empty((4, stride))  # for the nodes between two exact ones
    for n in range(stride):
        weights[0, n], weights[1, n], weights[2, n], weights[3, n] = cubic_weights(n / stride)
    for i in range(rows):
        exact_index = (row0 + i) // stride
        m, fraction = exact_index - first_row, (row0 + i - exact_index * stride) / stride
        for k in range(components):
            _interpolate_row(exact[:, :, k], m, fraction, row_values)
            for exact_index in range(col0 // stride, (col0 + cols - 1) // stride + 1):
                n, at = exact_index - first_col, exact_index * stride - col0
                begin, end = max(at, 0), min(at + stride, cols)
                _interpolate_between(row_values, n - 1, weights, begin - at, out[k, i, begin:end])
                if begin == at:  # an exact column: zero weights must not carry a neighbour's NaN
                    out[k, i, at] = row_values[n]
    return out


@compiled
def write_axis_coordinates(
    base, slope, first_row, first_col, stride, row0, col0, rows, cols, height, refined, flat, start, row_stride, col_stride
):
    """Write the coordinates (rows, cols) of nodes at their heights into an array.

    ``flat``, ``start``, ``row_stride`` and ``col_stride`` are the array's memory, and its offset and strides in values. ``base``
    (m, n) are the coordinates of exact nodes at height 0, and ``slope`` (m, n) their change per metre of height. The parameters
    from ``first_row`` to ``cols`` are those of ``interpolate_nodes``, whose order the sums follow. ``height`` has the heights of
    the nodes or, if ``refined``, those of the coarser grid.
    """
    refined_heights = np.empty(cols, np.float32)
    bases, slopes = np.empty(base.shape[1]), np.empty(base.shape[1])
    tops = np.empty((AXIS_STRIP_ROWS, cols), np.float32)
    weights = np.empty((4, stride))
    for n in range(stride):
        weights[0, n], weights[1, n], weights[2, n], weights[3, n] = cubic_weights(n / stride)
    for top in range(0, rows, AXIS_STRIP_ROWS):
        count = min(AXIS_STRIP_ROWS, rows - top)
        for i in range(count):
            exact_row = (row0 + top + i) // stride
            m, fraction = exact_row - first_row, (row0 + top + i - exact_row * stride) / stride
            _interpolate_row(base, m, fraction, bases)
            _interpolate_row(slope, m, fraction, slopes)
            if refined:
                refine_row(height, row0 % 2 + top + i, col0 % 2, refined_heights)
            heights, row_tops = refined_heights if refined else height[top + i], tops[i]
            for first in range(col0 // stride * stride, col0 + cols, stride):
                n = first // stride - first_col
                begin, end = max(first, col0) - first, min(first + stride, col0 + cols) - first
                at = first + begin - col0
                _write_node_coordinates(bases, slopes, n - 1, weights, begin, heights, at, row_tops, end - begin)
                if begin == 0:  # an exact column: zero weights must not carry a neighbour's NaN
                    row_tops[at] = bases[n] + np.float64(heights[at]) * slopes[n]
        if abs(col_stride) == 1:
            for i in range(count):
                _write_contiguous(tops[i], flat, start + (top + i) * row_stride, col_stride)
        else:
            _write_columns(tops, count, flat, start + top * row_stride, row_stride, col_stride)


@internal
def _interpolate_row(exact, m, fraction, out):
    """Interpolate a row's values at the exact columns, ``out`` (n,), between the values of exact rows ``exact`` (k, n).

    The row lies at the fraction ``fraction`` of the way from exact row ``m`` to the next one.
    """
    w = cubic_weights(fraction)
    for n in range(out.size):
        if w[1] == 1.0:  # an exact row
            out[n] = exact[m, n]
        else:
            out[n] = w[0] * exact[m - 1, n] + w[1] * exact[m, n] + w[2] * exact[m + 1, n] + w[3] * exact[m + 2, n]


# The next loops are written so that they compile to vector instructions: slices have known lengths, and rows are contiguous.


@internal
def _interpolate_between(values, n, weights, first, out):
    """Write the values of a row's nodes between the exact columns ``n`` + 1 and ``n`` + 2 to ``out``.

    The first node is the ``first``-th after exact column ``n`` + 1. ``values`` are those at the exact columns. ``weights`` (4,
    stride) are the ``cubic_weights`` of the nodes between two exact columns.
    """
    a, b, c, d = values[n], values[n + 1], values[n + 2], values[n + 3]
    w0, w1 = weights[0][first : first + out.size], weights[1][first : first + out.size]
    w2, w3 = weights[2][first : first + out.size], weights[3][first : first + out.size]
    for j in range(out.size):
        out[j] = w0[j] * a + w1[j] * b + w2[j] * c + w3[j] * d


@internal
def _write_node_coordinates(bases, slopes, n, weights, first, height, first_window_col, out, count):
    """Write the coordinates of ``count`` nodes of a row, at their heights, between the exact columns ``n`` + 1 and ``n`` + 2.

    The first node is the ``first``-th after exact column ``n`` + 1, in column ``first_window_col`` of the window. ``bases`` and
    ``slopes`` are the coordinates at height 0 and their change per metre of height, at the exact columns. ``weights`` is that of
    ``_interpolate_between``. ``height`` and ``out`` (cols,) are those of the row in the window.
    """
    a, b, c, d = bases[n], bases[n + 1], bases[n + 2], bases[n + 3]
    e, f, g, h = slopes[n], slopes[n + 1], slopes[n + 2], slopes[n + 3]
    for j in range(count):
        k, m = np.uintp(first + j), np.uintp(first_window_col + j)  # slices would take longer than so short a loop
        w0, w1, w2, w3 = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
        base = w0 * a + w1 * b + w2 * c + w3 * d
        slope = w0 * e + w1 * f + w2 * g + w3 * h
        out[m] = base + np.float64(height[m]) * slope


@compiled
def interpolate_columns(exact, first_col, stride, col0, cols):
    """Return values (m, cols) of ``cols`` columns from ``col0`` on, interpolated by cubics from those of exact columns (m, n).

    Exact columns are ``stride`` columns apart; the first one is column ``first_col * stride``.
    """
    out = np.empty((exact.shape[0], cols))
    for j in range(cols):
        exact_col = (col0 + j) // stride
        w = cubic_weights((col0 + j - exact_col * stride) / stride)
        n = exact_col - first_col
        for m in range(exact.shape[0]):
            if w[1] == 1.0:
                out[m, j] = exact[m, n]
            else:
                out[m, j] = w[0] * exact[m, n - 1] + w[1] * exact[m, n] + w[2] * exact[m, n + 1] + w[3] * exact[m, n + 2]
    return out


@internal
def interpolate_row_between(exact, m, fraction, out):
    """Interpolate a row (cols,) by cubics, at the fraction ``fraction`` of the way from exact row ``m`` to the next exact row."""
    current = exact[m]
    if fraction == 0.0:  # an exact row
        for j in range(out.size):
            out[j] = current[j]
    else:
        w0, w1, w2, w3 = cubic_weights(fraction)
        previous, next_row, second_next = exact[m - 1], exact[m + 1], exact[m + 2]
        for j in range(out.size):
            out[j] = w0 * previous[j] + w1 * current[j] + w2 * next_row[j] + w3 * second_next[j]


@internal
def add_heights(base, slope, height, out):
    """Compute coordinates (cols,) of nodes at their heights from those at height 0 and their change per metre of height."""
    for j in range(height.size):
        out[j] = base[j] + np.float64(height[j]) * slope[j]


@internal
def _write_contiguous(values, flat, start, step):
    """Write values into consecutive elements of an array, from ``start`` forwards (``step`` 1) or backwards (-1)."""
    count = values.size
    if step == 1:
        target = flat[start : start + count]
        for n in range(count):
            target[n] = values[n]
    else:
        target = flat[start - count + 1 : start + 1]
        for n in range(count):
            target[count - 1 - n] = values[n]


@internal
def _write_columns(values, count, flat, start, row_stride, col_stride):
    """Write the first ``count`` rows of values into a column-major array, in blocks that fill whole cache lines.

    ``flat`` is the array's memory, ``start`` the index of its first value there, and ``row_stride`` and ``col_stride`` are the
    distances of neighbouring rows and columns there.
    """
    for first in range(0, values.shape[1], COLUMN_BLOCK_SIZE):
        last = min(first + COLUMN_BLOCK_SIZE, values.shape[1])
        for i in range(count):
            at = start + i * row_stride + first * col_stride
            for j in range(first, last):
                flat[np.uintp(at)] = values[np.uintp(i), np.uintp(j)]
                at += col_stride


@compiled
def window_points(exact, first_row, first_col, stride, row0, col0, height):
    """Return frame points (rows, cols, 3): the ground at height 0 plus the height along the up vector there.

    ``exact`` (m, n, 6) holds points at height 0 and up vectors of exact nodes, and ``height`` (rows, cols) the heights. The other
    parameters are those of ``interpolate_nodes``.
    """
    rows, cols = height.shape
    verticals = interpolate_nodes(exact, first_row, first_col, stride, row0, col0, rows, cols)
    out = np.empty((rows, cols, 3))
    for i in range(rows):
        for j in range(cols):
            h = np.float64(height[i, j])
            for k in range(3):
                out[i, j, k] = verticals[k, i, j] + h * verticals[k + 3, i, j]
    return out


@compiled
def write_node_points(first, last, exact, first_row, first_col, stride, row, col, height, out):
    """Write the frame points of the nodes [first, last) of a list into ``out`` (n, 3).

    ``row``, ``col`` and ``height`` (n,) are the nodes' rows and columns on the grid, and their heights. The other parameters are
    those of ``window_points``. Sums have the same order as there, so the results are bit-identical.
    """
    for n in range(first, last):
        m, w = row[n] // stride, cubic_weights((row[n] - row[n] // stride * stride) / stride)
        p, v = col[n] // stride, cubic_weights((col[n] - col[n] // stride * stride) / stride)
        m, p = m - first_row, p - first_col
        for k in range(3):
            ground = _interpolate_node(exact, m, p, w, v, k)
            out[n, k] = ground + np.float64(height[n]) * _interpolate_node(exact, m, p, w, v, k + 3)


@internal
def _interpolate_node(exact, row, col, row_weights, col_weights, component):
    """Interpolate the value ``exact[..., component]`` of a node between exact nodes (m, n, k), with cubics.

    The node lies between the exact rows ``row`` and ``row + 1``, and between the exact columns ``col`` and ``col + 1``, as indices
    into ``exact``. ``row_weights`` (4,) are those of the exact rows ``row - 1`` to ``row + 2`` (``cubic_weights``), and
    ``col_weights`` (4,) those of the exact columns ``col - 1`` to ``col + 2``.
    """
    if col_weights[1] == 1.0:
        return _interpolate_column(exact, row, col, row_weights, component)
    return (
        col_weights[0] * _interpolate_column(exact, row, col - 1, row_weights, component)
        + col_weights[1] * _interpolate_column(exact, row, col, row_weights, component)
        + col_weights[2] * _interpolate_column(exact, row, col + 1, row_weights, component)
        + col_weights[3] * _interpolate_column(exact, row, col + 2, row_weights, component)
    )


@internal
def _interpolate_column(exact, row, col, row_weights, component):
    """Interpolate the value ``exact[..., component]`` in the exact column ``col``, as ``_interpolate_node`` does."""
    if row_weights[1] == 1.0:
        return exact[row, col, component]
    return (
        row_weights[0] * exact[row - 1, col, component] + row_weights[1] * exact[row, col, component]
        + row_weights[2] * exact[row + 1, col, component] + row_weights[3] * exact[row + 2, col, component]
    )  # fmt: skip
