"""The line sweep: compute the shadow height at every node of a grid, in time linear in its nodes.

**Space.** ``skugga.shadows.sweep.orientation`` turns and mirrors the grid: the sun stands before row 0, and a ray that leaves the
sun moves by 0 to 1 columns to the right per row. The *ray height* of a node is its coordinate along light space's up axis: at right
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

from skugga.shadows.sweep.line_runs import max_run_length
from skugga.shadows.sweep.node_shadows import evaluate_nodes, update_peaks
from skugga.shadows.sweep.points import evaluate_cubic, evaluate_points, row_cubic, snap_to_column
from skugga.shadows.sweep.quad_crossings import raise_line_maxima
from skugga.terrain.compiled import compiled, internal

NO_CUTS = np.zeros(0, np.bool_)
"""Diagonals of a row of quads that are all cut along the higher one."""


class SunAlignedGrid(NamedTuple):
    """A sun-aligned grid (n, m) with the positions of its lines.

    It includes two border columns (``skugga.shadows.sweep.grid.allocate_bordered_grid``). The grid is rotated and mirrored so that
    the sun stands before row 0. A position across the lines is t, in cells.

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
        Index of the cell of ``line_max[:, 0]``, in which t (the position across the lines) is in [first_cell, first_cell + 1).
    line_max
        float32 (lines, cells), metres: the highest ray height along each line so far, by number within the cell and by cell.
    peaks
        float32 (2, lines, cells): the ray height in metres of the highest node between each line and the next, and the node's
        position between the two lines, in [0, 1].
    """

    lines: int
    first_cell: int
    line_max: np.ndarray
    peaks: np.ndarray


@compiled
def sweep_rows(sun_aligned_grid, strip, first, last, shadow_ray_heights, lit, points):
    """Advance a strip of lines over the rows [``first``, ``last``) of a grid, and evaluate nodes and points.

    ``sun_aligned_grid`` is a ``SunAlignedGrid`` (n, m), ``strip`` a ``LineStrip``, whose arrays are changed in place. The nodes of
    the rows (``first``, ``last``] are evaluated into those of two output arrays that are not empty. ``shadow_ray_heights`` (n, m)
    float32 receives the ray height in metres above which a node sees the sun. ``lit`` (n, m) bool receives whether it does.
    ``points`` are the strip's other points (``StripPoints``).
    """
    ray_height, column_of_t, t_of_column, is_cut_nw_se = sun_aligned_grid
    lines, first_cell, line_max, peaks = strip
    row_starts = points.row_starts
    nodes = shadow_ray_heights.size > 0 or lit.size > 0
    for i in range(first, last):
        cuts = is_cut_nw_se[i] if is_cut_nw_se.size else NO_CUTS
        if nodes:
            evaluate_nodes(
                ray_height, column_of_t, t_of_column, lines, cuts, first_cell, line_max, peaks, shadow_ray_heights, lit, i
            )
            update_peaks(ray_height, column_of_t, t_of_column, lines, first_cell, peaks, i)
        if row_starts[i] < row_starts[i + 1]:
            evaluate_points(sun_aligned_grid, strip, i, points)
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
def _crossing_class(cubic_above, cubic_below, t, j):
    """Return a number that tells which quads the line at position ``t``, in cell ``j``, crosses between a row and the next one.

    ``cubic_above`` and ``cubic_below`` (4,) give the line's column on the first and on the next row as functions of t. The number
    is 2 (c - j), where c is the grid column to the left of the line on the first row. It is larger by 1 if the line crosses column
    c + 1 before the next row. Adjacent lines with equal numbers cross quads in the same way.
    """
    x = snap_to_column(evaluate_cubic(cubic_above, t))
    c = int(np.floor(x))
    return 2 * (c - j) + (1 if snap_to_column(evaluate_cubic(cubic_below, t)) > c + 1 else 0)


@internal
def _advance_lines(above, below, cubic_above, cubic_below, lines, cuts, first_cell, line_max, k):
    """Raise the maximum ray heights of the lines of number ``k`` to the ground from a row to just before the next row.

    Each cell has one line of number ``k``, in [0, ``lines``). ``above`` and ``below`` (m,) are the ray heights, metres, of the
    nodes of the two rows. ``cubic_above`` and ``cubic_below`` (4,) give a line's column on them as functions of t. ``cuts`` (bool,
    m - 1) is True for quads cut along their falling diagonals; it is empty where each quad is cut along its higher diagonal.
    ``line_max`` (cells,) holds the maxima, metres, from cell ``first_cell`` on, and is changed in place.
    """
    cells, cols = line_max.size, above.size
    share = k / lines
    run = max_run_length(cubic_above, first_cell, first_cell + cells, np.int64(1))
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
            raise_line_maxima(above, below, cuts, begin + shift, line_max, begin, last - begin, f0, f1, s0, s1, crosses)
        start = end
