"""The horizon of single cells towards the sun at a moment, by walks over the ground that casts shadows. Compiled loops.

A walk follows a line of sight from a node towards the sun. It goes row by row of the grid, or column by column if the line is
closer to a row. The line is compared with the ground where it crosses rows, columns and the diagonals of quads. Along the line the
surface has its kinks there, as in the line sweep (``skugga.shadows.sweep.lines``). So the horizon is that of the triangles that
cast shadows. Both diagonals of a quad are tested, since the lower one lies below the surface and has no effect. Whole tiles are
skipped if their highest node stays below the horizon found so far. A walk ends where the line rises above all ground. The earth is
round: a level line of sight rises above the ground with the square of its length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.sun_hours.quadratics import evaluate_quadratic, quadratic_fit
from skugga.shadows.sun_hours.suns import WindowSun, block_sample_positions
from skugga.shadows.sweep.ground_windows import patch_windows
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.casters.caster_types import Patch
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.bare_nodes import BareNodes
from skugga.terrain.geo.world import EARTH_RADIUS_M, World
from skugga.terrain.ground.surface import NodeHeights
from skugga.terrain.heightfield.walks import loop_curvature_drop_m, write_tile_max
from skugga.terrain.scene import Scene

TILE_QUADS, BLOCK_QUADS = 8, 64
"""Quads along a side of the tiles, and of the blocks of tiles, that a walk skips at once."""

EARTH_CURVATURE_PER_M = 1.0 / EARTH_RADIUS_M
"""The earth's curvature. Hours of sun are those of levels on the earth only."""

SEARCH_TANGENT, SEARCH_FACTOR = 0.02, 1.0
"""Limits of the search for a horizon below the sun: a tangent, and a multiple of the sun's change of tangent in the time step.

A horizon that is lower than the sun by more than their sum is not searched.
"""

TRACK_TIMES = 3
"""Number of moments of a time step at which the sun's direction is exact. A parabola through them gives all other moments."""


class WalkedGround(NamedTuple):
    """Heights of k grids, one for each level of detail, the finest first, in shared arrays.

    Attributes
    ----------
    height_m
        float32, metres: the heights of all grids, one grid after the other.
    tile_max_m
        float32, metres: the maximum heights of the tiles and of the blocks of all grids.
    grid_layouts
        int64 (k, 8): for each grid, the index of its first height in ``height_m`` and of its first tile in ``tile_max_m``; its
        first row and column; its number of rows and of columns; the distance of its nodes, in nodes of the finest grid; and the
        index of its first block in ``tile_max_m``.
    grid_max_m
        (k,), metres: the maximum height of each grid.
    """

    height_m: np.ndarray
    tile_max_m: np.ndarray
    grid_layouts: np.ndarray
    grid_max_m: np.ndarray


class SunTrack(NamedTuple):
    """The direction to the sun over a block of cells between two moments.

    The cells are in the order of a sun-aligned grid, which is rotated and mirrored so that the sun stands before row 0.

    Attributes
    ----------
    begin_minutes, end_minutes
        The two moments, minutes.
    direction_coefficients
        (3, TRACK_TIMES, 6): coefficients of quadratics over the cells, at the two moments and midway between them. They give rows
        per metre towards the sun, columns per metre towards the sun, and the tangent of the sun's altitude.
    grid_from_sun_aligned
        int64 (2, 3): affine map from sun-aligned positions to rows and to columns of the grid. Each row holds an offset, a step per
        sun-aligned row and a step per sun-aligned column.
    last_index
        (2,): index of the last sun-aligned row and of the last sun-aligned column, at least 1.
    """

    begin_minutes: float
    end_minutes: float
    direction_coefficients: np.ndarray
    grid_from_sun_aligned: np.ndarray
    last_index: np.ndarray


def walked_ground(scene: Scene, nodes: BareNodes, patches: tuple[Patch, ...]) -> WalkedGround:
    """Return the heights of a block and of patches of ground beside it, with the maxima of their tiles."""
    view, block = nodes.view, nodes.surface
    windows: dict[int, list[NodeHeights]] = {0: [block]}
    for lod in sorted({patch.lod for patch in patches}):
        surface = scene.surface(view.grid.coarser(lod))
        patches_of_lod = [patch for patch in patches if patch.lod == lod]
        windows.setdefault(lod, []).extend(
            surface.height_window(*window, includes_rim=True) for window in patch_windows(patches_of_lod)
        )
    spans = {lod: _bounding_window(windows_of_detail) for lod, windows_of_detail in windows.items()}
    sizes = [rows * cols for _, _, rows, cols in spans.values()]
    counts = [
        [-(-(rows - 1) // side) * -(-(cols - 1) // side) for side in (TILE_QUADS, BLOCK_QUADS)]
        for _, _, rows, cols in spans.values()
    ]
    height, tile_max = np.full(sum(sizes), np.nan, np.float32), np.empty(int(np.sum(counts)), np.float32)
    origin, grid_max = np.zeros((len(spans), 8), np.int64), np.empty(len(spans))
    begin = tile_begin = 0
    for n, (lod, (row0, col0, rows, cols)) in enumerate(spans.items()):
        grid, block_begin = height[begin : begin + rows * cols].reshape(rows, cols), tile_begin + counts[n][0]
        for window in windows[lod]:
            _copy_heights(window, grid[window.row0 - row0 :, window.col0 - col0 :])
        tops, block_tops = tile_max[tile_begin:block_begin], tile_max[block_begin : block_begin + counts[n][1]]
        write_tile_max(grid, tops.reshape(-1, -(-(cols - 1) // TILE_QUADS)), TILE_QUADS)
        write_tile_max(grid, block_tops.reshape(-1, -(-(cols - 1) // BLOCK_QUADS)), BLOCK_QUADS)
        grid_max[n] = block_tops.max(initial=-np.inf)
        origin[n] = begin, tile_begin, row0, col0, rows, cols, 2**lod, block_begin
        begin, tile_begin = begin + sizes[n], block_begin + counts[n][1]
    return WalkedGround(height, tile_max, origin, grid_max)


def _bounding_window(windows: list[NodeHeights]) -> tuple[int, int, int, int]:
    """Return the bounding rectangle of windows: its first row and column, and its number of rows and of columns."""
    row0, col0 = min(w.row0 for w in windows), min(w.col0 for w in windows)
    return row0, col0, max(w.row0 + w.shape[0] for w in windows) - row0, max(w.col0 + w.shape[1] for w in windows) - col0


def _copy_heights(window: NodeHeights, out: np.ndarray) -> None:
    """Copy the heights of a window of nodes to the upper left corner of ``out``."""
    rows, cols = window.shape
    out[:rows, :cols] = window.height_m


def sun_track(
    day: WindowSun, nodes: BareNodes, world: World, orientation: GridOrientation, time_range_minutes: tuple[float, float]
) -> SunTrack:
    """Return the direction to the sun over a block's cells, in the order of a sun-aligned grid, between two moments.

    ``time_range_minutes`` holds the moments, minutes after the start of the day's window of time.
    """
    view = nodes.view
    row, col = (values.ravel() for values in block_sample_positions(view))
    steps = np.array([[0.0, 0.0], [-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    rows, cols = view.row0 + row + steps[:, :1], view.col0 + col + steps[:, 1:]
    point, up = world.points_at_zero_height(view.grid.crs, view.grid.x(cols), view.grid.y(rows))
    up, down, right = up[0], point[2] - point[1], point[4] - point[3]
    towards = np.empty((3, TRACK_TIMES, len(row)))
    for n, sun in enumerate(day.directions_at(np.linspace(*time_range_minutes, TRACK_TIMES))):
        rise = up @ sun
        flat = sun - rise[:, None] * up
        length = np.linalg.norm(flat, axis=1)
        a, b, c = (
            np.sum(first_axis * second_axis, axis=1) for first_axis, second_axis in ((down, down), (down, right), (right, right))
        )
        on_down, on_right = (np.sum(flat * axis, axis=1) / length for axis in (down, right))
        square = a * c - b * b
        towards[:, n] = (on_down * c - on_right * b) / square, (on_right * a - on_down * b) / square, rise / length
    i, j = orientation.to_sun_aligned(row, col, view.rows, view.cols)
    shape = (view.cols, view.rows) if orientation.axes_swapped else (view.rows, view.cols)
    sun_aligned = np.array([0, 1, 0]), np.array([0, 0, 1])
    first, after_row, after_col = np.stack(orientation.from_sun_aligned(*sun_aligned, view.rows, view.cols), axis=1)
    grid_from_sun_aligned = np.stack([first + (int(view.row0), int(view.col0)), after_row - first, after_col - first], axis=1)
    last_index = np.maximum(np.array(shape, np.float64) - 1.0, 1.0)
    return SunTrack(
        float(time_range_minutes[0]),
        float(time_range_minutes[1]),
        towards @ quadratic_fit(i, j, shape).T,
        grid_from_sun_aligned,
        last_index,
    )


@internal
def clearance_tangent(ground, track, i, j, eye_height_m, minutes):
    """Return the tangent of the sun's altitude less that of the horizon, and the change per minute of the sun's tangent.

    They hold at the moment ``minutes`` of ``track`` (``SunTrack``), for an eye ``eye_height_m`` metres above the node at row ``i``
    and column ``j`` of the sun-aligned grid. ``ground`` is a ``WalkedGround``.
    """
    affine, a = track.grid_from_sun_aligned, track.direction_coefficients
    row, col = affine[0, 0] + i * affine[0, 1] + j * affine[0, 2], affine[1, 0] + i * affine[1, 1] + j * affine[1, 2]
    y, x = i / track.last_index[0], j / track.last_index[1]
    span = track.end_minutes - track.begin_minutes
    u = (minutes - track.begin_minutes) / span
    w0, w1, w2 = 2.0 * (u - 0.5) * (u - 1.0), -4.0 * u * (u - 1.0), 2.0 * u * (u - 0.5)  # Lagrange weights of the three moments
    down = w0 * evaluate_quadratic(a[0, 0], y, x) + w1 * evaluate_quadratic(a[0, 1], y, x) + w2 * evaluate_quadratic(a[0, 2], y, x)
    right = w0 * evaluate_quadratic(a[1, 0], y, x) + w1 * evaluate_quadratic(a[1, 1], y, x) + w2 * evaluate_quadratic(a[1, 2], y, x)
    begin, middle, end = evaluate_quadratic(a[2, 0], y, x), evaluate_quadratic(a[2, 1], y, x), evaluate_quadratic(a[2, 2], y, x)
    rate = ((4.0 * u - 3.0) * begin + (4.0 - 8.0 * u) * middle + (4.0 * u - 1.0) * end) / span
    sun = w0 * begin + w1 * middle + w2 * end
    min_tangent = sun - SEARCH_FACTOR * abs(end - begin) - SEARCH_TANGENT
    return sun - horizon_tangent(ground, row, col, eye_height_m, down, right, min_tangent), rate


@compiled
def horizon_tangent(ground, row, col, eye_height_m, rows_per_metre, cols_per_metre, min_tangent):
    """Return the tangent of the horizon angle in one direction, or ``min_tangent`` if that is larger.

    The eye is ``eye_height_m`` metres above the node at ``row`` and ``col`` of the finest grid of ``ground`` (``WalkedGround``). A
    step of one metre in the direction leads ``rows_per_metre`` rows and ``cols_per_metre`` columns further on this grid.
    """
    height, tile_max, origin, grid_max = ground
    best = min_tangent
    swapped = abs(cols_per_metre) > abs(rows_per_metre)
    main_step, cross_step = (cols_per_metre, rows_per_metre) if swapped else (rows_per_metre, cols_per_metre)
    main_sign, cross_sign = (1 if main_step > 0.0 else -1), (1 if cross_step > 0.0 else -1)
    slope = abs(cross_step / main_step)
    per_rising, per_falling, per_side = 1.0 / (1.0 + slope), 1.0 / max(1.0 - slope, 1e-9), 1.0 / max(slope, 1e-9)
    eye_m = np.float64(height[int(origin[0, 0] + (row - origin[0, 2]) * origin[0, 5] + col - origin[0, 3])]) + eye_height_m
    for n in range(len(origin)):
        begin, tile_begin, row0, col0 = origin[n, 0], origin[n, 1], origin[n, 2], origin[n, 3]
        rows, cols, side = origin[n, 4], origin[n, 5], origin[n, 6]
        block_begin, tiles, blocks = origin[n, 7], -(-(cols - 1) // TILE_QUADS), -(-(cols - 1) // BLOCK_QUADS)
        # Positions are counted along the line and across it, mirrored where the line runs towards smaller indices.
        p, q = (
            main_sign * ((col / side - col0) if swapped else (row / side - row0)),
            cross_sign * ((row / side - row0) if swapped else (col / side - col0)),
        )
        count_p, count_q = (cols, rows) if swapped else (rows, cols)
        step_p, step_q = (1, cols) if swapped else (cols, 1)
        unit = side / abs(main_step)
        k = int(np.ceil(p))
        x = q + slope * (k - p)
        while True:
            far = (k - p) * unit
            index, next_index = main_sign * k, main_sign * (k + 1)
            if (next_index < 0 and main_sign < 0) or (next_index >= count_p and main_sign > 0):
                break
            c = int(np.floor(x))
            low, high = min(cross_sign * c, cross_sign * (c + 1)), max(cross_sign * c, cross_sign * (c + 1))
            if (low < 0 and cross_sign < 0) or (high >= count_q and cross_sign > 0):
                break
            outside = index < 0 or index >= count_p or next_index < 0 or next_index >= count_p or low < 0 or high >= count_q
            if best > 0.0 and eye_m + best * far + loop_curvature_drop_m(far, EARTH_CURVATURE_PER_M) > grid_max[n]:
                break
            if outside:
                k, x = k + 1, x + slope
                continue
            is_skipped, steps_left = False, 1
            for large in range(2):  # blocks, then tiles
                width, first, wide = (BLOCK_QUADS, block_begin, blocks) if large == 0 else (TILE_QUADS, tile_begin, tiles)
                a, b = min(index, next_index) // width, low // width
                steps_left = min((a + 1) * width, count_p - 1) - index if main_sign > 0 else index - a * width
                side_end = min((b + 1) * width, count_q - 1) if cross_sign > 0 else -b * width
                if slope * steps_left > side_end - x:
                    steps_left = int((side_end - x) * per_side)
                max_in_tile = np.float64(tile_max[first + (b * wide + a if swapped else a * wide + b)])
                lowest = best * far if best > 0.0 else best * (far + steps_left * unit)
                if steps_left >= 1 and not max_in_tile > eye_m + lowest + loop_curvature_drop_m(far, EARTH_CURVATURE_PER_M):
                    k, x, is_skipped = k + steps_left, x + slope * steps_left, True
                    break
            if is_skipped:
                continue
            for _ in range(max(steps_left, 1)):
                c = int(np.floor(x))
                f = x - c
                node = begin + main_sign * k * step_p + cross_sign * c * step_q
                to_p, to_q = main_sign * step_p, cross_sign * step_q
                far = (k - p) * unit
                nw, ne = np.float64(height[node]), np.float64(height[node + to_q])
                sw, se = np.float64(height[node + to_p]), np.float64(height[node + to_p + to_q])
                if far > 0.0:
                    best = _max_tangent(best, nw + f * (ne - nw) if f > 0.0 else nw, eye_m, far)
                    if f + slope <= 1.0 and slope < 1.0:
                        share = f * per_falling
                        best = _max_tangent(best, nw + share * (se - nw), eye_m, far + share * unit)
                share = (1.0 - f) * per_rising
                best = _max_tangent(best, ne + share * (sw - ne), eye_m, far + share * unit)
                if f + slope > 1.0:
                    share = (1.0 - f) * per_side
                    best = _max_tangent(best, ne + share * (se - ne), eye_m, far + share * unit)
                    next_q = cross_sign * (c + 2)
                    if 0 <= next_q < count_q:
                        share = (2.0 - f) * per_rising
                        next_height = np.float64(height[node + 2 * to_q])
                        best = _max_tangent(best, next_height + share * (se - next_height), eye_m, far + share * unit)
                k, x = k + 1, x + slope
        # The line ends on the last row or column of a grid.
        if (k > p) and 0 <= main_sign * k < count_p:
            c = int(np.floor(x))
            low, high = min(cross_sign * c, cross_sign * (c + 1)), max(cross_sign * c, cross_sign * (c + 1))
            if low >= 0 and high < count_q:
                node = begin + main_sign * k * step_p + cross_sign * c * step_q
                nw, ne = np.float64(height[node]), np.float64(height[node + cross_sign * step_q])
                best = _max_tangent(best, nw + (x - c) * (ne - nw), eye_m, (k - p) * unit)
    return best


@internal
def _max_tangent(best_tangent, height_m, eye_m, distance_m):
    """Return the larger of ``best_tangent`` and the tangent up to ground of height ``height_m`` at distance ``distance_m``.

    ``eye_m`` is the height of the eye, in metres above sea level like ``height_m``.
    """
    rise = height_m - eye_m - loop_curvature_drop_m(distance_m, EARTH_CURVATURE_PER_M)
    return rise / distance_m if rise > best_tangent * distance_m else best_tangent
