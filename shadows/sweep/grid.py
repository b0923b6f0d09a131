"""Grids for the line sweep, and the sweep itself, which runs on several cores, each with a strip of lines.

The *sun-aligned grid* is a grid that is rotated and mirrored so that the sun stands before row 0. Lines are sun rays seen from
above. Their position across the rays is *t*, in cells. A cubic polynomial per row converts t to columns of the row, and one
converts back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.sweep.lines import LineStrip, SunAlignedGrid, sweep_rows
from skugga.shadows.sweep.orientation import GridOrientation, orientation_towards
from skugga.shadows.sweep.points import StripPoints, empty_strip_points, select_strip_points, write_row_intervals
from skugga.shadows.sweep.quad_crossings import NO_GROUND_RAY_HEIGHT
from skugga.terrain.compiled import compiled, map_on_cores, run_in_chunks
from skugga.terrain.scratch import scratch_array

STRIP_CELLS = 1024
"""Cells of a strip of lines: few enough that the strip's state and two rows of the grid fit into a core's cache."""

TURN_BAND_ROWS = 64
"""Rows of a grid that a thread copies to the sun-aligned grid at a time."""


CellSize = float | tuple[float, float]
"""Size of a cell in metres: one number, or its sides along a column and along a row."""

NO_RAY_HEIGHTS = np.zeros((0, 0), np.float32)
"""An empty grid of ray heights, for an output that is not needed."""

NO_MASK = np.zeros((0, 0), np.bool_)
"""An empty mask, for an output that is not needed."""

HIGHER_DIAGONALS = np.zeros((0, 0), np.bool_)
"""Value of ``SunAlignedGrid.is_cut_nw_se`` for a grid whose quads are all cut along their higher diagonals."""


@dataclass(frozen=True, eq=False)
class SweepPoints:
    """Points (n,) between nodes or above the ground, for which a sweep computes whether they see the sun.

    Attributes
    ----------
    row, col
        float64 (n,): positions on the sun-aligned grid; columns do not count the border.
    t
        float64 (n,): coordinates across the lines, in cells.
    ray_height
        float64 (n,), metres: ray heights; NaN for points on the ground, which have the ground's.
    ray_height_rounding_m
        Metres by which the ground's ray height must exceed a point's to shade it.
    """

    row: np.ndarray
    col: np.ndarray
    t: np.ndarray
    ray_height: np.ndarray
    ray_height_rounding_m: float


@dataclass(frozen=True, eq=False)
class LineState:
    """The highest ray height of the ground along each line of a sweep so far.

    A ray height is the coordinate at right angles to the sun's rays, in the vertical plane of the sun.

    Attributes
    ----------
    first_cell
        Index of the cell of ``line_max[:, 0]``, in which t (the position across the lines) is in [first_cell, first_cell + 1).
    line_max
        float32 (lines, cells), metres: the highest ray height along each line, by number within the cell and by cell.
    """

    first_cell: int
    line_max: np.ndarray

    def resampled(self, first_cell: int, cells: int, lines: int, coarser_cell_ratio: float) -> LineState:
        """Return the state for the lines of a finer grid, interpolated between the lines of this one.

        The finer grid has ``lines`` lines per cell. It starts at cell ``first_cell`` and has ``cells`` cells, each
        ``coarser_cell_ratio`` times smaller than a cell of this grid.
        """
        flat_max = self.line_max.T.ravel()
        position = ((first_cell + np.arange(cells * lines) / lines) / coarser_cell_ratio - self.first_cell) * self.line_max.shape[0]
        left = np.clip(np.floor(position).astype(np.int64), 0, flat_max.size - 2)
        share = np.clip(position - left, 0.0, 1.0)
        line_max = ((1.0 - share) * flat_max[left] + share * flat_max[left + 1]).astype(np.float32)
        return LineState(first_cell, np.ascontiguousarray(line_max.reshape(cells, lines).T))


ALL_ROWS = slice(None)
"""All rows of a grid."""

GridWindow = tuple[tuple[int, int], tuple[int, int]]
"""A window of a grid: its first row and the row after its last one, and the same of its columns."""


def allocate_bordered_grid(
    n: int, m: int, filled_rows: slice = ALL_ROWS, window_to_fill: GridWindow = ((0, 0), (0, 0))
) -> tuple[np.ndarray, np.ndarray]:
    """Allocate a float32 grid (n, m + 2) with border columns, and return it and its view (n, m) without them.

    The rows ``filled_rows`` are set to NaN (no ground), except for the window ``window_to_fill``. The caller fills in that window.
    It and all other rows are uninitialised. The left border remains NaN, so lines find no ground on it. Lines only leave the grid
    across the right border. ``close_border`` copies the last column there, so that the last nodes lie between two lines.
    """
    with_border = scratch_array((n, m + 2), np.float32)
    begin, end, _ = filled_rows.indices(n)
    (top, bottom), (left, right) = window_to_fill
    with_border[begin:top] = np.nan
    with_border[top:bottom, : left + 1] = np.nan
    with_border[top:bottom, right + 1 :] = np.nan
    with_border[max(begin, bottom) : end] = np.nan
    return with_border, with_border[:, 1:-1]


def close_border(with_border: np.ndarray, filled_rows: slice = ALL_ROWS) -> np.ndarray:
    """Copy the last column of a grid to its right border, in the rows ``filled_rows``, and return the grid."""
    with_border[filled_rows, -1] = with_border[filled_rows, -2]
    return with_border


def sweep_nodes(
    sun_aligned_grid: SunAlignedGrid,
    lines: int,
    t_range: tuple[float, float],
    entry_state: LineState | None = None,
    coarser_cell_ratio: float = 2.0,
    row_range: tuple[int, int] = (0, 0),
    col_range: tuple[int, int] | None = None,
    points: SweepPoints | None = None,
    shadow_ray_heights: np.ndarray = NO_RAY_HEIGHTS,
    cores: int = 1,
    first_ground_row: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sweep a sun-aligned grid, and compute which of its nodes and of other points see the sun.

    Only nodes and points whose t (position across the lines) lies in ``t_range`` are evaluated.

    Parameters
    ----------
    sun_aligned_grid
        The sun-aligned grid (n, m + 2), borders included.
    lines
        Lines per column.
    t_range
        Range of t to sweep, in cells.
    entry_state
        Maximum ray heights along the lines at the end of a coarser grid, which lies towards the sun; ``None``: no such grid.
    coarser_cell_ratio
        Cell size of the coarser grid, in cells of this one.
    row_range
        Nodes to evaluate: the sun-aligned rows [row_range[0], row_range[1]); none by default.
    col_range
        Nodes to evaluate: the columns [col_range[0], col_range[1]), not counting the border; all by default.
    points
        Other points to evaluate.
    shadow_ray_heights
        Output array float32 (n, m + 2), if not empty: the ray height in metres above which each evaluated node sees the sun.
    cores
        Number of threads.
    first_ground_row
        First row that may hold ground; the rows before it are skipped.

    Returns
    -------
    lit
        bool (n, m): whether nodes see the sun; undefined for nodes that are not evaluated, empty without ``row_range``.
    points_lit
        bool (k,): whether the points see the sun.
    points_above_m
        float32 (k,): metres by which the highest ray height between a point and the sun exceeds the point's own.
    """
    n, columns = sun_aligned_grid.ray_height.shape
    first, last = row_range
    lit = scratch_array((n, columns) if last > first else (0, 0), np.bool_)
    first_col, last_col = (0, columns - 2) if col_range is None else col_range
    lit[first:last, first_col + 1 : last_col + 1] = True  # a grid may be many times as large as the window
    points = points or SweepPoints(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), 0.0)
    points_lit, points_above_m = np.ones(len(points.row), np.bool_), np.zeros(len(points.row), np.float32)
    interval = np.empty(len(points.row), np.int32)
    run_in_chunks(len(interval), write_row_intervals, points.row, n, interval)
    end = max(last - 1, int(interval.max(initial=-1)) + 1)
    low, high = int(np.floor(t_range[0])), int(np.floor(t_range[1])) + 1

    def sweep_strip(start: int) -> None:
        stop = min(start + STRIP_CELLS, high)
        cells = stop - start + 3
        line_max = (
            np.full((lines, cells), NO_GROUND_RAY_HEIGHT, np.float32)
            if entry_state is None
            else entry_state.resampled(start - 1, cells, lines, coarser_cell_ratio).line_max
        )
        row_starts, indices = select_strip_points(points.t, interval, n, float(start), float(stop))
        strip_points = StripPoints(
            row_starts, indices, points.row, points.col, points.t, points.ray_height, points.ray_height_rounding_m, points_lit,
            points_above_m,
        )  # fmt: skip
        strip_state = LineStrip(lines, start - 1, line_max, initial_peaks(lines, cells))
        before = min(max(first - 1, 0) if last > first else min(first_ground_row, int(interval.min(initial=n))), end)
        sweep_rows(sun_aligned_grid, strip_state, min(first_ground_row, before), before, NO_RAY_HEIGHTS, NO_MASK, strip_points)
        sweep_rows(sun_aligned_grid, strip_state, before, end, shadow_ray_heights, lit, strip_points)

    map_on_cores(sweep_strip, range(low, high, STRIP_CELLS), cores)
    return lit[:, 1:-1], points_lit, points_above_m


def initial_peaks(lines: int, cells: int) -> np.ndarray:
    """Return the initial peaks (2, ``lines``, ``cells``) of a strip (``LineStrip.peaks``), before its lines pass any node.

    ``lines`` is the number of lines per cell.
    """
    peaks = np.zeros((2, lines, cells), np.float32)
    peaks[0] = NO_GROUND_RAY_HEIGHT
    return peaks


def sweep_to_state(
    sun_aligned_grid: SunAlignedGrid,
    lines: int,
    t_range: tuple[float, float],
    entry_state: LineState | None = None,
    coarser_cell_ratio: float = 2.0,
    first_ground_row: int = 0,
) -> LineState:
    """Sweep all rows of a sun-aligned grid, and return the highest ray height along each line.

    ``t_range`` is the range of positions across the lines, in cells, and ``lines`` the number of lines per cell. ``entry_state``
    and ``coarser_cell_ratio`` are those of ``sweep_nodes``. Rows before ``first_ground_row`` hold no ground and are skipped.
    """
    low, high = int(np.floor(t_range[0])) - 1, int(np.floor(t_range[1])) + 3
    state = LineState(low, np.full((lines, high - low), NO_GROUND_RAY_HEIGHT, np.float32))
    if entry_state is not None:
        state = entry_state.resampled(low, high - low, lines, coarser_cell_ratio)
    rows = len(sun_aligned_grid.ray_height)
    strip = LineStrip(lines, low, state.line_max, initial_peaks(lines, high - low))
    sweep_rows(
        sun_aligned_grid, strip, min(first_ground_row, rows - 1), rows - 1, NO_RAY_HEIGHTS, NO_MASK, empty_strip_points(rows)
    )
    return state


def sunlit_nodes(
    height_m: np.ndarray, cell_m: CellSize, azimuth_deg: float, altitude_deg: float, lines: int = 8, cores: int = 1
) -> np.ndarray:
    """Return which nodes of a heightfield in a flat world see the sun.

    Quads are cut into triangles along their higher diagonals. The ground extends beyond the outermost nodes by one cell, at the
    heights of these nodes.

    Parameters
    ----------
    height_m
        (rows, cols) metres, row 0 north; NaN without ground.
    cell_m
        Size of a cell in metres, or its sides along a column and along a row.
    azimuth_deg
        Azimuth of the sun, degrees clockwise from north.
    altitude_deg
        Altitude of the sun, degrees.
    lines
        Sweep lines per column of the grid: more are more accurate and slower.
    cores
        Number of threads.

    Returns
    -------
    np.ndarray
        bool (rows, cols): True where the sun is visible.
    """
    height_m = np.pad(height_m, 1, mode="edge")
    orientation, row_m, col_m, column_of_t, t_of_column = flat_world_grid(height_m.shape, cell_m, azimuth_deg)
    azimuth, sine, cosine = np.radians(azimuth_deg), np.sin(np.radians(altitude_deg)), np.cos(np.radians(altitude_deg))
    ray_height = sun_aligned_linear_values(
        height_m, orientation, cosine, sine * np.cos(azimuth) * row_m, -sine * np.sin(azimuth) * col_m, cores
    )
    n, m = ray_height.shape
    sun_aligned_grid = SunAlignedGrid(ray_height, column_of_t, t_of_column, HIGHER_DIAGONALS)
    lit, _, _ = sweep_nodes(sun_aligned_grid, lines, (t_of_column[:, 0].min(), m), row_range=(0, n), cores=cores)
    return orientation.grid_order_view(lit)[1:-1, 1:-1]


def flat_world_grid(
    shape: tuple[int, int], cell_m: CellSize, azimuth_deg: float
) -> tuple[GridOrientation, float, float, np.ndarray, np.ndarray]:
    """Return how a flat world's grid is turned towards the sun's azimuth, and the positions of its lines.

    ``shape`` is the grid's rows and columns. The result is the orientation, the sides of a cell along a column and along a row in
    metres, and the cubics ``column_of_t`` and ``t_of_column`` of ``position_cubics``. ``cell_m`` is the size of a cell in metres,
    one number or its sides along a column and along a row.
    """
    row_m, col_m = cell_m if isinstance(cell_m, tuple) else (cell_m, cell_m)
    towards = -np.cos(np.radians(azimuth_deg)) / row_m, np.sin(np.radians(azimuth_deg)) / col_m
    orientation = orientation_towards(*towards)
    main, cross = towards[::-1] if orientation.axes_swapped else towards
    n = shape[1] if orientation.axes_swapped else shape[0]
    shift, ones, zeros = np.arange(n) * abs(cross / main) + 1.0, np.ones(n), np.zeros(n)
    column_of_t, t_of_column = (np.stack([shift * sign, ones, zeros, zeros], axis=1) for sign in (1.0, -1.0))
    return orientation, row_m, col_m, column_of_t, t_of_column


def sun_aligned_linear_values(
    height: np.ndarray, orientation: GridOrientation, per_height: float, per_row: float, per_col: float, cores: int = 1
) -> np.ndarray:
    """Return values that are linear in the heights, rows and columns of a grid, as a sun-aligned grid with borders, float32.

    ``height`` (rows, cols) is in metres. The values grow by ``per_height`` per metre, ``per_row`` per row and ``per_col`` per
    column of the grid before turning.
    """
    rows, cols = height.shape
    with_border, inside = allocate_bordered_grid(*((cols, rows) if orientation.axes_swapped else (rows, cols)))
    target = orientation.grid_order_view(inside)  # the same memory, in the grid's own order

    def write_band(first: int) -> None:
        rows_of_band = slice(first, first + TURN_BAND_ROWS)
        _write_linear_values(height[rows_of_band], per_height, first * per_row, per_row, per_col, target[rows_of_band])

    map_on_cores(write_band, range(0, rows, TURN_BAND_ROWS), cores)
    return close_border(with_border)


@compiled
def _write_linear_values(height, per_height, start, per_row, per_col, out):
    """Write values that are linear in heights, rows and columns to ``out`` (rows, cols).

    ``height`` (rows, cols) is in metres. ``start`` is the value of height 0 at row 0 and column 0. The values grow by
    ``per_height`` per metre, ``per_row`` per row and ``per_col`` per column.
    """
    rows, cols = height.shape
    for c0 in range(0, cols, 64):  # in blocks, for the CPU cache: ``out`` may have the other memory order
        for r in range(rows):
            row_offset = start + r * per_row
            for c in range(c0, min(c0 + 64, cols)):
                out[r, c] = height[r, c] * per_height + (row_offset + np.int32(c) * per_col)
