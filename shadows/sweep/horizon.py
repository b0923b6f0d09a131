"""The horizon towards one azimuth, for all suns at that azimuth: the upper convex hull of the ground along each line.

The horizon of a point is where its tangent touches that hull (Timonen and Westerholm 2010, *Scalable Height Field Self-Shadowing*).
The hull of a line is a stack of vertices. A new vertex first pops all vertices that would lie below the new hull, and is then
pushed. Each vertex is pushed and popped at most once, so the work is linear in the number of nodes.

A position has two coordinates in the vertical plane of the sun, relative to a reference direction. Its *ray height* is measured at
right angles to this direction, its distance *towards* the sun along it. The horizon is the angle above the reference direction.
Lines, positions and sun-aligned grids are those of ``skugga.shadows.sweep.lines``. Ground near a point is treated exactly, on the
point's own line. The horizon by all other ground is interpolated between the two lines beside the point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.sweep.grid import HIGHER_DIAGONALS, CellSize, flat_world_grid, sun_aligned_linear_values
from skugga.shadows.sweep.points import evaluate_cubic, ground_at, is_cut_along
from skugga.terrain.compiled import compiled, internal, map_on_cores

NO_HORIZON_TANGENT = -1e30
"""Tangent of the horizon angle without any ground: finite, not -infinity, so that it can be interpolated."""

STRIP_LINES = 256
"""Lines that a thread processes at a time."""

STRIP_NODES = 2**21
"""Approximate number of nodes of a whole grid that are processed at a time."""


class HorizonGrid(NamedTuple):
    """A sun-aligned grid (n, m) with border columns, rotated and mirrored so that the sun stands before row 0.

    Attributes
    ----------
    ray_height
        float32 (n, m), metres: the nodes' ray heights; NaN without ground.
    sunward_m
        float32 (n, m), metres: the nodes' distances towards the sun.
    column_of_t
        float64 (n, 4): for each row, the cubic that gives the column at t, the position across the lines in cells.
    is_cut_nw_se
        The diagonals along which quads are cut into triangles, as in ``skugga.shadows.sweep.lines.SunAlignedGrid``.
    """

    ray_height: np.ndarray
    sunward_m: np.ndarray
    column_of_t: np.ndarray
    is_cut_nw_se: np.ndarray


class HorizonQuery(NamedTuple):
    """Points (k,) whose horizon is computed.

    Attributes
    ----------
    line_starts
        int64 (lines + 1,): for each line, where the points between it and the next line begin in ``order``.
    order
        int64 (k,): the indices of the points, sorted by the line to their left, then by row.
    row_before
        int64 (k,): the last grid row before each point, on the sun's side.
    position
        float64 (k, 2), metres: each point's ray height and distance towards the sun.
    line_tangents
        float64 (k, 2), output: the tangent of the horizon angle on the line to the left of each point, and on the next line.
    """

    line_starts: np.ndarray
    order: np.ndarray
    row_before: np.ndarray
    position: np.ndarray
    line_tangents: np.ndarray


def horizon_deg(height_m: np.ndarray, cell_m: CellSize, azimuth_deg: float, lines: int = 4, cores: int = 1) -> np.ndarray:
    """Return the horizon angle towards an azimuth at the nodes of a heightfield in a flat world.

    The sun is visible from a node above this altitude. The ground extends beyond the outermost nodes by one cell, as in
    ``skugga.shadows.sweep.grid.sunlit_nodes``.

    Parameters
    ----------
    height_m
        (rows, cols) metres, row 0 north; NaN without ground.
    cell_m
        Size of a cell in metres, or its sides along a column and along a row.
    azimuth_deg
        Azimuth, degrees clockwise from north.
    lines
        Sweep lines per column of the grid: more are more accurate and slower.
    cores
        Number of threads.

    Returns
    -------
    np.ndarray
        float64 (rows, cols), degrees: -90 if no ground lies in this direction; NaN at nodes without ground.
    """
    height_m = np.pad(height_m, 1, mode="edge")
    orientation, row_m, col_m, column_of_t, t_of_column = flat_world_grid(height_m.shape, cell_m, azimuth_deg)
    azimuth = np.radians(azimuth_deg)
    ray_height = sun_aligned_linear_values(height_m, orientation, 1.0, 0.0, 0.0, cores)
    sunward_m = sun_aligned_linear_values(height_m, orientation, 0.0, -np.cos(azimuth) * row_m, np.sin(azimuth) * col_m, cores)
    section = HorizonGrid(ray_height, sunward_m, column_of_t, HIGHER_DIAGONALS)
    n, m = ray_height.shape
    out = np.full((n, m), NO_HORIZON_TANGENT)
    low, high = float(t_of_column[:, 0].min()) + 1.0, float(t_of_column[:, 0].max()) + m
    for start in np.arange(np.floor(low), high + 1.0, max(STRIP_NODES // n, 1)):
        i, j, t = _nodes_between(column_of_t, t_of_column, start, start + max(STRIP_NODES // n, 1), m)
        out[i, j] = horizon_tangents(section, lines, i.astype(float), t, ray_height[i, j], sunward_m[i, j], cores)
    out[~np.isfinite(ray_height)] = np.nan
    return orientation.grid_order_view(np.degrees(np.arctan(out[:, 1:-1])))[1:-1, 1:-1]


def horizon_tangents(
    horizon_grid: HorizonGrid,
    lines: int,
    row: np.ndarray,
    t: np.ndarray,
    point_ray_height: np.ndarray,
    point_sunward_m: np.ndarray,
    cores: int = 1,
) -> np.ndarray:
    """Return the tangent of the horizon angle above the reference direction, seen from points: (k,).

    ``row`` and ``t`` (k,) are the points' positions on the sun-aligned grid and across its lines. ``point_ray_height`` and
    ``point_sunward_m`` (k,), metres, are their coordinates in the vertical plane of the sun. If a ray height is NaN, the point lies
    on the ground, which gives both coordinates. The tangent is ``NO_HORIZON_TANGENT`` if no ground lies towards the sun.
    ``horizon_grid`` holds the ground, and ``lines`` is the number of lines per cell.
    """
    ray_height, sunward_m, column_of_t, is_cut_nw_se = horizon_grid
    if not len(row) or len(ray_height) < 2:
        return np.full(len(row), NO_HORIZON_TANGENT)  # no row precedes a single row
    row_before = np.clip(np.ceil(row).astype(np.int64) - 1, 0, len(ray_height) - 2)
    line = np.floor(t * lines).astype(np.int64)
    first, count = int(line.min()), int(np.ptp(line)) + 1
    _, by_row = _counting_sort(row_before, len(ray_height))
    line_starts, order = _counting_sort(line[by_row] - first, count)
    order = by_row[order]
    position = np.stack([point_ray_height, point_sunward_m], axis=1)
    near, line_tangents = np.full(len(row), NO_HORIZON_TANGENT), np.full((len(row), 2), NO_HORIZON_TANGENT)
    _write_near_tangents(ray_height, sunward_m, column_of_t, is_cut_nw_se, row_before, row, t, position, near)
    query = HorizonQuery(line_starts, order, row_before, position, line_tangents)

    def walk_strip(start: int) -> None:
        _walk_lines(horizon_grid, lines, first, start, min(start + STRIP_LINES, count), query)

    map_on_cores(walk_strip, range(0, count, STRIP_LINES), cores)
    w = t * lines - line
    return np.maximum(near, (1.0 - w) * line_tangents[:, 0] + w * line_tangents[:, 1])


@compiled
def _counting_sort(key, count):
    """Sort integer keys (n,) in [0, ``count``) by a stable counting sort.

    The result is the start of each key's group in the sorted order, (``count`` + 1,), and the indices of the keys in sorted order,
    (n,).
    """
    group_starts = np.zeros(count + 1, np.int64)
    for value in key:
        group_starts[value + 1] += 1
    for n in range(count):
        group_starts[n + 1] += group_starts[n]
    following, order = group_starts.copy(), np.empty(len(key), np.int64)
    for n in range(len(key)):
        order[following[key[n]]] = n
        following[key[n]] += 1
    return group_starts, order


@compiled
def _nodes_between(column_of_t, t_of_column, low, high, cols):
    """Return sun-aligned rows, sun-aligned columns and t of the nodes with t in [``low``, ``high``), (k,) each.

    t is the position across the lines, in cells. ``column_of_t`` and ``t_of_column`` (rows, 4) are the cubics of
    ``SunAlignedGrid``. ``cols`` is the number of columns with the two border columns, which are left out.
    """
    rows = len(column_of_t)
    ends = np.empty((rows, 2), np.int64)
    total = 0
    for i in range(rows):
        for side in range(2):
            t = high if side else low
            column = min(max(int(np.ceil(evaluate_cubic(column_of_t[i], t))), 1), cols - 1)
            while column > 1 and evaluate_cubic(t_of_column[i], column - 1) >= t:
                column -= 1
            while column < cols - 1 and evaluate_cubic(t_of_column[i], column) < t:
                column += 1
            ends[i, side] = column
        total += ends[i, 1] - ends[i, 0]
    row, col, t_of = np.empty(total, np.int64), np.empty(total, np.int64), np.empty(total)
    n = 0
    for i in range(rows):
        for j in range(ends[i, 0], ends[i, 1]):
            row[n], col[n], t_of[n] = i, j, evaluate_cubic(t_of_column[i], j)
            n += 1
    return row, col, t_of


@compiled
def _walk_lines(horizon_grid, lines, first, start, stop, query):
    """Follow the lines from the sun on, and write the horizon's tangent on each line for the points on both sides of it.

    ``lines`` of them cross each cell. Lines are numbered from that with t = ``first`` / ``lines`` on, which has the number 0. Those
    with the numbers ``start`` to ``stop``, both included, are followed. ``query`` (``HorizonQuery``) holds the points. For the
    points between two adjacent lines, both lines give a tangent (``HorizonQuery.line_tangents``, changed in place).
    ``horizon_grid`` is a ``HorizonGrid``.
    """
    ray_height, sunward_m, column_of_t, is_cut_nw_se = horizon_grid
    line_starts, order, row_before, position, line_tangents = query
    rows, cols = ray_height.shape
    hull = np.empty((4 * rows, 2))  # a line has at most four vertices per row
    for number in range(start, stop + 1):
        t = (first + number) / lines
        size = 0
        right_of, right_end = (line_starts[number], line_starts[number + 1]) if number < stop else (0, 0)
        left_of, left_end = (line_starts[number - 1], line_starts[number]) if number > start else (0, 0)
        x = evaluate_cubic(column_of_t[0], t)
        for i in range(rows - 1):
            while right_of < right_end and row_before[order[right_of]] == i:
                line_tangents[order[right_of], 0] = _tangent_to_hull(hull, size, position[order[right_of]])
                right_of += 1
            while left_of < left_end and row_before[order[left_of]] == i:
                line_tangents[order[left_of], 1] = _tangent_to_hull(hull, size, position[order[left_of]])
                left_of += 1
            if right_of == right_end and left_of == left_end:
                break
            next_x = evaluate_cubic(column_of_t[i + 1], t)
            s, c = next_x - x, int(np.floor(x))
            f = x - c
            x = next_x
            if c < 0 or c + 1 >= cols:
                continue
            size = _push_onto_hull(hull, size, ray_height, sunward_m, i, c, i, c + 1, f)
            rising = (1.0 - f) / (1.0 + s)
            falling = f / (1.0 - s) if f + s <= 1.0 and s < 1.0 else np.inf
            if falling < rising and is_cut_along(is_cut_nw_se, i, c, True):  # in the order of crossing
                size = _push_onto_hull(hull, size, ray_height, sunward_m, i, c, i + 1, c + 1, falling)
            if is_cut_along(is_cut_nw_se, i, c, False):
                size = _push_onto_hull(hull, size, ray_height, sunward_m, i, c + 1, i + 1, c, rising)
            if rising <= falling <= 1.0 and is_cut_along(is_cut_nw_se, i, c, True):
                size = _push_onto_hull(hull, size, ray_height, sunward_m, i, c, i + 1, c + 1, falling)
            if f + s > 1.0:
                size = _push_onto_hull(hull, size, ray_height, sunward_m, i, c + 1, i + 1, c + 1, (1.0 - f) / s)
                if c + 2 < cols and is_cut_along(is_cut_nw_se, i, c + 1, False):
                    size = _push_onto_hull(hull, size, ray_height, sunward_m, i, c + 2, i + 1, c + 1, (2.0 - f) / (1.0 + s))


@internal
def _push_onto_hull(hull, size, ray_height, sunward_m, i, j, k, l, share):
    """Push a position on the segment from node (``i``, ``j``) to node (``k``, ``l``) onto a hull, and return the hull's size.

    The position is at ``share`` of the way. ``ray_height`` and ``sunward_m`` (n, m) are the nodes' ray heights and distances
    towards the sun, metres. ``hull`` holds a ray height and a distance towards the sun for each vertex, metres. ``size`` is the
    number of its vertices before the call.
    """
    u = ray_height[i, j] + share * (np.float64(ray_height[k, l]) - ray_height[i, j])
    if not np.isfinite(u):
        return size
    d = sunward_m[i, j] + share * (np.float64(sunward_m[k, l]) - sunward_m[i, j])
    while size > 0 and d >= hull[size - 1, 1]:  # by rounding alone: a line leads away from the sun
        if u <= hull[size - 1, 0]:
            return size
        size -= 1
    while size > 1:
        a, b = hull[size - 2], hull[size - 1]
        if (b[0] - u) * (a[1] - d) > (a[0] - u) * (b[1] - d):
            break
        size -= 1
    hull[size, 0], hull[size, 1] = u, d
    return size + 1


@internal
def _tangent_to_hull(hull, size, point):
    """Return the largest slope from a point to a vertex of a hull: that of the tangent from the point.

    ``point`` (2,) and the first ``size`` rows of ``hull`` (k, 2) are ray heights and distances towards the sun, metres. The result
    is ``NO_HORIZON_TANGENT`` if no vertex lies towards the sun. From the top of the stack down, the slopes grow up to the point of
    contact. The search ends there.
    """
    best = NO_HORIZON_TANGENT
    for n in range(size - 1, -1, -1):
        distance = hull[n, 1] - point[1]
        if distance <= 0.0:
            continue
        slope = (hull[n, 0] - point[0]) / distance
        if slope < best:
            break
        best = slope
    return best


@compiled
def _write_near_tangents(ray_height, sunward_m, column_of_t, is_cut_nw_se, row_before, row, t, position, near_tangents):
    """Write the largest slope from each point to the ground between it and the row before it, to ``near_tangents`` (k,).

    The first four parameters are the fields of ``HorizonGrid``. ``row_before`` (k,) is the last grid row before each point, on the
    sun's side. ``row`` and ``t`` (k,) are the points' positions on the sun-aligned grid and across its lines. ``position`` (k, 2)
    holds their ray heights and distances towards the sun, metres. Points whose ray height is NaN receive the coordinates of the
    ground at their place there.
    """
    cols = ray_height.shape[1]
    for n in range(len(row)):
        i = row_before[n]
        x = evaluate_cubic(column_of_t[i], t[n])
        s = evaluate_cubic(column_of_t[i + 1], t[n]) - x
        c = int(np.floor(x))
        f, end = x - c, row[n] - i
        if np.isnan(position[n, 0]):
            position[n, 0] = ground_at(ray_height[i], ray_height[i + 1], c, f + s * end, end, is_cut_nw_se, i)
            position[n, 1] = ground_at(sunward_m[i], sunward_m[i + 1], c, f + s * end, end, is_cut_nw_se, i)
        if c < 0 or c + 1 >= cols:
            continue
        end -= 1e-6  # ground within a millionth of a cell is the point itself
        best = _max_slope(NO_HORIZON_TANGENT, position[n], ray_height, sunward_m, i, c, i, c + 1, f)
        if is_cut_along(is_cut_nw_se, i, c, False) and (1.0 - f) / (1.0 + s) < end:
            best = _max_slope(best, position[n], ray_height, sunward_m, i, c + 1, i + 1, c, (1.0 - f) / (1.0 + s))
        if f + s <= 1.0:
            if is_cut_along(is_cut_nw_se, i, c, True) and f < end * (1.0 - s):
                best = _max_slope(best, position[n], ray_height, sunward_m, i, c, i + 1, c + 1, f / (1.0 - s))
        elif (1.0 - f) / s < end:
            best = _max_slope(best, position[n], ray_height, sunward_m, i, c + 1, i + 1, c + 1, (1.0 - f) / s)
            if c + 2 < cols and is_cut_along(is_cut_nw_se, i, c + 1, False) and (2.0 - f) / (1.0 + s) < end:
                best = _max_slope(best, position[n], ray_height, sunward_m, i, c + 2, i + 1, c + 1, (2.0 - f) / (1.0 + s))
        near_tangents[n] = best


@internal
def _max_slope(best, point, ray_height, sunward_m, i, j, k, l, share):
    """Return the larger of ``best`` and the slope from a point to ground on the segment from node (``i``, ``j``) to (``k``, ``l``).

    The ground lies at ``share`` of the way. ``point`` (2,) is a ray height and a distance towards the sun, metres. ``ray_height``
    and ``sunward_m`` (n, m) are those of the nodes.
    """
    u = ray_height[i, j] + share * (np.float64(ray_height[k, l]) - ray_height[i, j])
    d = sunward_m[i, j] + share * (np.float64(sunward_m[k, l]) - sunward_m[i, j])
    if not d > point[1]:
        return best
    slope = (u - point[0]) / (d - point[1])
    return slope if slope > best else best
