"""The line sweep: how high the sun's rays pass over every node of a grid, in time linear in its nodes.

**Space.** The grid is turned and mirrored (``shadows.sweep.grid``) so that the sun stands before row 0 and a ray, followed away
from the sun, moves by 0 to 1 columns to the right per row. A node's *level* is its coordinate along light space's second axis
("up": at right angles to the rays, in the vertical plane of the sun). Along a ray the level is constant, so a point sees the sun
exactly if nothing on the way to it has a higher level: no slopes, no distances, and a curved earth bends the nodes, not the rays.

**Lines.** Rays seen from above are lines, ``lines`` of them per column. Line number k of cell j stands at ``t = j + k / lines``
and crosses row i at a column that is a cubic in t: t and a shift, were it not that meridians converge. Each line carries the
highest level that it has met. Between two rows it crosses the sides and the diagonals of the quads; there, and on the rows, the
surface's level along the line has its kinks, and between them it is linear, so that a line's maximum over the very triangles
that are drawn is exact.

**Nodes.** A node lies between two lines. What shades it from beyond the row before it is interpolated between their maxima: the
maximum over a continuous surface is continuous from line to line, so the error falls with the square of their distance. But for
its tips, which are nodes: the highest one between two lines is remembered and interpolated to and from, or else the nodes in its
wake would lose it at azimuths that nearly go from node to node. What shades a node from the row before it, where errors would count
most, is exact on its own line.

All lines of one number k cross a row at nearly the same place of their cells, so whole runs of them are worked on at once with
the machine's vector instructions; nothing is gathered, nothing branches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shadows.sweep.points import cubic, see_points
from terrain.compiled import compiled

NO_GROUND_LEVEL = np.float32(-1e30)
"""Level of a line that has met nothing: a number, not infinity, so that it can be interpolated."""

RUN = 512
"""Lines of a run, at most."""

STRAIGHT = 0.01
"""How far places in a run may be from changing linearly: run by run, they are interpolated between its ends."""


class TurnedGrid(NamedTuple):
    """A turned grid (n, m) between two columns of border (``shadows.sweep.grid.bordered``), with its lines' places.

    ``level`` float32 are the nodes' levels, NaN where there is no ground. ``place`` (n, 4) float64 are the cubics that take t to a
    row's columns, ``at`` (n, 4) those that take columns to t. ``mirrored``: quads are cut from (i, j) to (i + 1, j + 1), else from
    (i, j + 1) to (i + 1, j).
    """

    level: np.ndarray
    place: np.ndarray
    at: np.ndarray
    mirrored: bool


class Strip(NamedTuple):
    """Some lines, so many to a column, and what they have met before a row.

    ``held`` (lines, cells) float32 is of the cells from ``first_cell`` on; ``peaks`` (2, lines, cells) float32 are the highest
    nodes met between each line and the next, and where there. A strip owns what stands from the start of its second cell to the
    end of its last but two.
    """

    lines: int
    first_cell: int
    held: np.ndarray
    peaks: np.ndarray


@compiled
def sweep_rows(sheet, strip, first, last, shade, lit, points):
    """Take a strip of lines from before row ``first`` of a sheet to before row ``last``, and see to what lies on the way.

    Of the nodes of rows (first, last] are written, where these are not empty, ``shade`` (n, m) float32, the level that a node must
    reach to see the sun, and ``lit`` (n, m) bool. ``points`` are the strip's points besides nodes (``StripPoints``).
    """
    level, place, at, mirrored = sheet
    lines, first_cell, held, peaks = strip
    begins = points.begins
    nodes = shade.size > 0 or lit.size > 0
    for i in range(first, last):
        if nodes:
            _nodes(level, place, at, lines, mirrored, first_cell, held, peaks, shade, lit, i)
            _remember(level, place, at, lines, first_cell, peaks, i)
        if begins[i] < begins[i + 1]:
            see_points(sheet, strip, i, points)
        for k in range(lines):
            _advance(level, place, lines, mirrored, first_cell, held[k], k, i)


@compiled
def _run_along(p, low, high, times):
    """How many places from ``low`` to ``high`` a run may have, so that ``times`` their cubic is straight over it."""
    bend = times * max(abs(2.0 * p[2] + 6.0 * p[3] * low), abs(2.0 * p[2] + 6.0 * p[3] * high))
    return RUN if bend * RUN * RUN <= 8.0 * STRAIGHT else max(int(np.sqrt(8.0 * STRAIGHT / bend)), 2)


@compiled
def _class_of(place, i, t, j):
    """Of a line: the column left of it less its cell, and whether it crosses the next column before the next row."""
    x = cubic(place[i], t)
    c = int(np.floor(x))
    return 2 * (c - j) + (1 if cubic(place[i + 1], t) > c + 1 else 0)


@compiled
def _advance(level, place, lines, mirrored, first_cell, held, k, i):
    """Take the lines of number ``k`` from before row ``i`` to before row ``i + 1``."""
    cells, cols = held.size, level.shape[1]
    share = k / lines
    run = _run_along(place[i], first_cell, first_cell + cells, 1)
    start = 0
    while start < cells:
        end = min(start + run, cells)
        kind = _class_of(place, i, first_cell + start + share, first_cell + start)
        if _class_of(place, i, first_cell + end - 1 + share, first_cell + end - 1) != kind:
            low, high = start, end - 1  # kind holds at low, not at high
            while high - low > 1:
                middle = (low + high) // 2
                if _class_of(place, i, first_cell + middle + share, first_cell + middle) == kind:
                    low = middle
                else:
                    high = middle
            end = high
        crosses = kind % 2 == 1
        shift = (kind - kind % 2) // 2 + first_cell  # column left of the line, less its place in ``held``
        begin = max(start, -shift)
        last = min(end, cols - (2 if crosses else 1) - shift)
        if begin < last:
            t0, t1 = first_cell + begin + share, first_cell + last - 1 + share
            f0, f1 = cubic(place[i], t0) - (begin + shift), cubic(place[i], t1) - (last - 1 + shift)
            s0, s1 = cubic(place[i + 1], t0) - (begin + shift) - f0, cubic(place[i + 1], t1) - (last - 1 + shift) - f1
            above, below = level[i, begin + shift :], level[i + 1, begin + shift :]
            _meet(above, below, held[begin:last], f0, f1, s0, s1, crosses, mirrored)
        start = end


@compiled
def _meet(above, below, held, f0, f1, s0, s1, crosses, mirrored):
    """What a run of lines meets from a row on and before the next one.

    Their places in their cells go from ``f0`` to ``f1``, their ways aside till the next row from ``s0`` to ``s1``.
    """
    count = held.size
    nw, ne, sw, se = above[:count], above[1 : count + 1], below[:count], below[1 : count + 1]
    if mirrored and not crosses:
        v0, v1 = f0 / max(1.0 - s0, 1e-9), f1 / max(1.0 - s1, 1e-9)
        _two(nw, ne, nw, se, held, f0, f1, min(v0, 1.0), min(v1, 1.0))
    elif mirrored:
        _two(nw, ne, ne, se, held, f0, f1, (1.0 - f0) / s0, (1.0 - f1) / s1)
    else:
        d0, d1 = (1.0 - f0) / (1.0 + s0), (1.0 - f1) / (1.0 + s1)
        _two(nw, ne, ne, sw, held, f0, f1, min(d0, 1.0), min(d1, 1.0))
        if crosses:
            far0, far1 = (2.0 - f0) / (1.0 + s0), (2.0 - f1) / (1.0 + s1)
            _two(se, ne, se, above[2 : count + 2], held, 1.0 - (1.0 - f0) / s0, 1.0 - (1.0 - f1) / s1, 1.0 - far0, 1.0 - far1)


@compiled
def _two(a, b, c, d, held, p0, p1, q0, q1):
    """Raise a run of lines to what lies between two pairs of nodes: at shares from ``p0`` to ``p1`` of the way from a to b, and
    from ``q0`` to ``q1`` from c to d. Written so that it compiles to vector instructions (32-bit counts convert to float32).
    """
    count = held.size
    per = 1.0 / max(count - 1, 1)
    p, dp = np.float32(p0), np.float32((p1 - p0) * per)
    q, dq = np.float32(q0), np.float32((q1 - q0) * per)
    for n in range(count):
        x = np.float32(np.int32(n))
        one = a[n] + (p + dp * x) * (b[n] - a[n])
        other = c[n] + (q + dq * x) * (d[n] - c[n])
        highest = held[n]
        highest = one if one > highest else highest
        held[n] = other if other > highest else highest


@compiled
def _nodes(level, place, at, lines, mirrored, first_cell, held, peaks, shade, lit, i):
    """The nodes of row ``i + 1``: what shades them from row ``i`` on, exactly, and from before, between the lines."""
    cols, cells = level.shape[1], held.shape[1]
    here = at[i + 1]
    first = _first_from(place[i + 1], here, first_cell + 1, cols)
    last = _first_from(place[i + 1], here, first_cell + cells - 2, cols)
    run = _run_along(here, first, last, lines)
    while first < last:
        end, number = _run_of_nodes(here, first, min(first + run, last), lines)
        count = end - first
        cell, k = number // lines - first_cell, number % lines
        left = held[k, cell : cell + count]
        right = held[k + 1, cell : cell + count] if k + 1 < lines else held[0, cell + 1 : cell + 1 + count]
        peak, peak_at = peaks[0, k, cell : cell + count], peaks[1, k, cell : cell + count]
        e0, e1 = cubic(here, first) * lines - number, cubic(here, end - 1) * lines - number - lines * (count - 1)
        s0, s1 = first - cubic(place[i], cubic(here, first)), end - 1 - cubic(place[i], cubic(here, end - 1))
        seen = _see(level[i], level[i + 1], first, left, right, peak, peak_at, (e0, e1), (s0, s1), mirrored)
        if shade.size:
            shade[i + 1, first:end] = seen
        if lit.size:
            _sees(seen, level[i + 1, first:end], lit[i + 1, first:end])
        first = end


@compiled
def _remember(level, place, at, lines, first_cell, peaks, i):
    """Raise the peaks between the lines to the nodes of row ``i``."""
    cols, cells = level.shape[1], peaks.shape[2]
    here = at[i]
    first = _first_from(place[i], here, first_cell + 1, cols)
    last = _first_from(place[i], here, first_cell + cells - 2, cols)
    run = _run_along(here, first, last, lines)
    while first < last:
        end, number = _run_of_nodes(here, first, min(first + run, last), lines)
        count = end - first
        cell, k = number // lines - first_cell, number % lines
        e0, e1 = cubic(here, first) * lines - number, cubic(here, end - 1) * lines - number - lines * (count - 1)
        _raise_peaks(level[i, first:end], (e0, e1), peaks[0, k, cell : cell + count], peaks[1, k, cell : cell + count])
        first = end


@compiled
def _raise_peaks(level, between, peak, peak_at):
    """Remember nodes that stand higher between their lines than what was remembered there."""
    per = 1.0 / max(level.size - 1, 1)
    e, de = np.float32(between[0]), np.float32((between[1] - between[0]) * per)
    for n in range(level.size):
        higher = level[n] > peak[n]
        peak_at[n] = e + de * np.float32(np.int32(n)) if higher else peak_at[n]
        peak[n] = level[n] if higher else peak[n]


@compiled
def _sees(seen, level, lit):
    for n in range(lit.size):
        lit[n] = not seen[n] > level[n]


@compiled
def _run_of_nodes(at, first, last, lines):
    """Where the run of nodes from ``first`` ends whose left lines have one number, and the first one's left line."""
    number = int(np.floor(cubic(at, first) * lines))
    if int(np.floor(cubic(at, last - 1) * lines)) - lines * (last - 1 - first) == number:
        return last, number
    low, high = first, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        if int(np.floor(cubic(at, middle) * lines)) - lines * (middle - first) == number:
            low = middle
        else:
            high = middle
    return high, number


@compiled
def _first_from(place, at, t, cols):
    """The first column of a row, borders apart, whose t is no less than one: by ``at`` alone, so that strips share all nodes."""
    column = min(max(int(np.ceil(cubic(place, t))), 1), cols - 1)
    while column > 1 and cubic(at, column - 1) >= t:
        column -= 1
    while column < cols - 1 and cubic(at, column) < t:
        column += 1
    return column


@compiled
def _see(above, here, first, left, right, peak, peak_at, between, aside, mirrored):
    """The level of the rays over a run of nodes from column ``first`` on: float32 (count,).

    ``between``: how far they stand between their lines, ``aside``: how far their rays come from the left, from first to last.
    """
    count = left.size
    out = np.empty(count, np.float32)
    per = 1.0 / max(count - 1, 1)
    e, de = np.float32(between[0]), np.float32((between[1] - between[0]) * per)
    for n in range(count):
        w = e + de * np.float32(np.int32(n))
        out[n] = (np.float32(1.0) - w) * left[n] + w * right[n]  # exact at w = 1 even where one has met nothing
        a, top = peak_at[n], peak[n]
        rising = w < a
        b = w / max(a, np.float32(1e-6)) if rising else (w - a) / max(np.float32(1.0) - a, np.float32(1e-6))
        b = min(max(b, np.float32(0.0)), np.float32(1.0))  # places are right to ``STRAIGHT``
        over = (np.float32(1.0) - b) * (left[n] if rising else top) + b * (top if rising else right[n])
        peaked = top > (np.float32(1.0) - a) * left[n] + a * right[n]
        out[n] = over if peaked and over > out[n] else out[n]
    behind, beside = above[first : first + count], above[first - 1 : first - 1 + count]
    if max(aside[0], aside[1]) < 1e-9:  # straight down: what may be missing to the left plays no part
        _two(behind, behind, behind, behind, out, 0.0, 0.0, 0.0, 0.0)
    elif mirrored:
        _two(behind, beside, behind, beside, out, aside[0], aside[1], aside[0], aside[1])
    else:  # and the diagonal of the quad to the left
        left_of = here[first - 1 : first - 1 + count]
        d0, d1 = aside[0] / (1.0 + aside[0]), aside[1] / (1.0 + aside[1])
        _two(behind, beside, behind, left_of, out, aside[0], aside[1], d0, d1)
    return out
