"""The sun's shadows of upright columns (``skugga.terrain.ground.columns``), by one ray per column.

Over smooth ground the shadow between two rays can be interpolated. At walls it cannot: a ray either meets a column or passes beside
it. So each column has its own ray, from the middle of its top. The ray is followed towards the sun over the sun-aligned grid
(``skugga.shadows.sweep.lines``), row by row. Over a cell the ray is lowest where it enters. There its height is compared with the
cell's flat top. A ray that touches a corner or runs along a border meets the cell.

**Bands.** For ``BAND_CELLS`` rows at a time, a ray is compared with the highest column of each block of cells that it passes. It
skips blocks that lie below it. The search ends where no column ahead is higher than the ray.

**A curved earth.** A ray has one t and one ray height (``skugga.shadows.sweep.lines``). Four cubics in t hold along each border
between rows of cells. They give the column at which ground of a reference height lies, the shift of this column per metre of
height, the ray height of height 0, and the ray height per metre of height. The ray's column and height above sea level follow from
them. Nothing is interpolated between rays. In a flat world the results are exact to the rounding of float64.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.sweep.points import evaluate_cubic
from skugga.shadows.sweep.position_cubics import LATTICE_SIZE, MAX_BEND_CELLS, bent_rays_error, beyond_crs_error
from skugga.shadows.sweep.rays import SunRays, rays_at
from skugga.terrain.casters.caster_types import PATCH_QUADS, Casters
from skugga.terrain.compiled import compiled, internal, map_on_cores
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.ground.columns import ColumnIndices, Columns
from skugga.terrain.scene import Scene

BAND_CELLS = 16
"""Maximum number of rows that a ray skips at once, and the side of the blocks of cells whose highest column is stored."""

CORNER_TOLERANCE_CELLS = 1e-6
"""Tolerance in cells: a ray that passes a corner within this distance meets all columns at the corner."""

HEIGHT_TOLERANCE_M = 1e-6
"""Metres by which a column must be higher than a ray to block it. The tolerance covers the float64 rounding of equal heights."""

NO_COLUMN = np.float32(-1e30)
"""Height of a cell without a column, metres: lower than any ray."""

POINTS_PER_CHUNK = 2**15
"""Number of points that a thread processes at a time."""


class SunAlignedColumns(NamedTuple):
    """Upright columns (n, m) on a sun-aligned grid (rotated and mirrored so that the sun stands before row 0).

    The cubics (n + 1, 4) are functions of t, the position across the sun's rays. One holds along the border before each row, and
    the last one along the border after the last row.

    Attributes
    ----------
    height
        float32 (n, m), metres: the tops; ``NO_COLUMN`` where a cell has none.
    block_max
        float32 (n / BAND_CELLS, m / BAND_CELLS), rounded up, metres: the highest top of each block of cells.
    max_ahead
        float32 (n + 1,), metres: the highest top in all rows between a border and the sun.
    column_of_t
        (n + 1, 4): the column of the grid at which a ray crosses the border, if it is there at ``reference_height_m``.
    column_per_metre
        (n + 1, 4): the shift of this column per metre of height.
    ray_height_at_zero
        (n + 1, 4), metres: the ray height of height 0.
    ray_height_per_metre
        (n + 1, 4): the change of the ray height per metre of height.
    reference_height_m
        Metres: the reference height of ``column_of_t``.
    cell_size
        Size of a cell, in cells of the finest level of detail.
    """

    height: np.ndarray
    block_max: np.ndarray
    max_ahead: np.ndarray
    column_of_t: np.ndarray
    column_per_metre: np.ndarray
    ray_height_at_zero: np.ndarray
    ray_height_per_metre: np.ndarray
    reference_height_m: float
    cell_size: float


@dataclass(frozen=True, eq=False)
class ColumnGround:
    """The columns of one level of detail, turned towards the sun.

    Attributes
    ----------
    lod
        Level of detail: a cell is 2**lod cells of full detail wide.
    row0, col0
        Row and column of the first cell on the grid of this level of detail, before turning.
    shape
        Rows and columns before turning.
    columns
        The sun-aligned columns.
    """

    lod: int
    row0: int
    col0: int
    shape: tuple[int, int]
    columns: SunAlignedColumns


@dataclass(frozen=True, eq=False)
class ColumnSweep:
    """The input of a sweep over columns: the ground, and the points of a buffer.

    All pixels that show one column share one point.

    Attributes
    ----------
    rays
        The sun's rays over the grid.
    grounds
        The ground by level of detail, the finest first.
    point_index
        int (rows, cols): the point that each pixel shows; -1 without one.
    row
        (n,): rows of the points on the sun-aligned grid of the finest ground.
    t
        (n,): positions of the points across the sun's rays, in cells.
    height_m
        (n,), metres: heights of the points.
    ray_height_m
        (n,), metres: ray heights of the points; NaN for tops of columns, which are computed from the ground.
    """

    rays: SunRays
    grounds: list[ColumnGround]
    point_index: np.ndarray
    row: np.ndarray
    t: np.ndarray
    height_m: np.ndarray
    ray_height_m: np.ndarray

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return sum(ground.columns.height.nbytes for ground in self.grounds) + 32 * self.row.size

    def obstruction_height_m(self, needs_height: bool, cores: int) -> np.ndarray:
        """Return by how many metres columns rise above the rays from a buffer's pixels (rows, cols) to the sun.

        A value over 0 means that a column blocks the ray. If ``needs_height``, the value is the largest height of a column above
        the ray, in metres. Otherwise only its sign is meaningful, and the search is faster. ``cores`` is the number of threads.
        """
        ray_heights = self.ray_height_m.copy()
        on_columns = np.flatnonzero(np.isnan(ray_heights))
        ray_heights[on_columns] = _ray_heights(
            self.grounds[0].columns, self.row[on_columns], self.t[on_columns], self.height_m[on_columns]
        )
        above = np.zeros(len(self.row))

        def sweep_chunk(first: int) -> None:
            part = slice(first, first + POINTS_PER_CHUNK)
            for ground in self.grounds:
                row = self._sun_aligned_rows_on(ground, self.row[part])
                _follow_rays(
                    ground.columns, row, self.t[part] / ground.columns.cell_size, ray_heights[part], needs_height, above[part]
                )

        map_on_cores(sweep_chunk, range(0, len(above), POINTS_PER_CHUNK), cores)
        return np.append(above, 0.0)[self.point_index]

    def _sun_aligned_rows_on(self, ground: ColumnGround, row: np.ndarray) -> np.ndarray:
        """Convert rows (n,) on the sun-aligned grid of the finest ground to those of another level of detail."""
        finest, orientation = self.grounds[0], self.rays.orientation
        if ground is finest:
            return row
        ends = np.array([0.0, 1.0])
        end_row, end_col = orientation.from_sun_aligned(ends, ends, *finest.shape)
        side = 2.0**ground.lod
        coarse_row, coarse_col = ((end_row + finest.row0 + 0.5) / side - 0.5, (end_col + finest.col0 + 0.5) / side - 0.5)
        sun_aligned_ends, _ = orientation.to_sun_aligned(coarse_row - ground.row0, coarse_col - ground.col0, *ground.shape)
        return sun_aligned_ends[0] + row * (sun_aligned_ends[1] - sun_aligned_ends[0])


def column_sweep(buffer: GeometryBuffer, scene: Scene, casters: Casters) -> ColumnSweep:
    """Return the input of a sweep for a map's block whose ground is columns.

    Raises ``UnsupportedError`` if the sun's rays bend too much across the block.
    """
    placed = buffer.columns
    assert placed is not None
    window = placed.window
    rows, cols = window.height_m.shape
    rays = rays_at(scene, window.columns.grid, window.row0 + (rows - 1) / 2, window.col0 + (cols - 1) / 2)
    windows: dict[int, list[tuple[int, int, np.ndarray]]] = {0: [(window.row0, window.col0, window.height_m)]}
    for patch in casters.casting_patches:
        row0, col0 = patch.row * PATCH_QUADS, patch.col * PATCH_QUADS
        height_m, _ = window.columns.coarser(patch.lod).heights(row0, col0, PATCH_QUADS, PATCH_QUADS)
        windows.setdefault(patch.lod, []).append((row0, col0, height_m))
    grounds = [_column_ground(rays, window.columns, lod, windows[lod]) for lod in sorted(windows)]
    point_index, pixel = _number_points(buffer, placed, window.height_m.size)
    t, ray_height_m = rays.ray_coordinates(buffer.position_frame_m, buffer.frame, pixel)
    on_columns = buffer.surface_kind.ravel()[pixel] == RELIEF
    ray_height_m[on_columns] = np.nan
    row, col = placed.row.ravel()[pixel] + float(window.row0), placed.col.ravel()[pixel] + float(window.col0)
    row[~on_columns], col[~on_columns] = rays.rows_and_columns(buffer.position_frame_m, buffer.frame, pixel[~on_columns])
    sun_aligned_row, _ = rays.orientation.to_sun_aligned(row - grounds[0].row0, col - grounds[0].col0, *grounds[0].shape)
    height_m = buffer.height_m.ravel()[pixel].astype(np.float64)
    return ColumnSweep(rays, grounds, point_index, sun_aligned_row, t, height_m, ray_height_m)


def _number_points(buffer: GeometryBuffer, column_indices: ColumnIndices, column_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Number the points that pixels show, and return each pixel's number (rows, cols), and one flat pixel index per point (n,).

    Pixels that show the same column share one point. Each pixel that shows anything else has its own point. A pixel without a
    surface has the number -1. ``column_count`` is the number of columns.
    """
    valid, ground = buffer.valid.ravel(), (buffer.valid & (buffer.surface_kind == RELIEF)).ravel()
    key = np.full(valid.size, -1, np.int64)
    cell = column_indices.row.astype(np.int64) * column_indices.window.height_m.shape[1] + column_indices.col
    key[ground] = cell.ravel()[ground]
    other_pixels = np.flatnonzero(valid & ~ground)
    key[other_pixels] = column_count + np.arange(len(other_pixels))
    pixel_of_key = np.full(column_count + len(other_pixels) + 1, -1, np.int64)  # the last one stands for pixels that show nothing
    pixel_of_key[key] = np.arange(key.size)
    pixel_of_key[-1] = -1
    used_keys = np.flatnonzero(pixel_of_key >= 0)
    number = np.full(len(pixel_of_key), -1, np.int64)
    number[used_keys] = np.arange(len(used_keys))
    return number[key].reshape(buffer.valid.shape), pixel_of_key[used_keys]


def _column_ground(rays: SunRays, columns: Columns, lod: int, windows: list[tuple[int, int, np.ndarray]]) -> ColumnGround:
    """Return the columns of one level of detail, from windows of heights.

    A window is its first row, its first column, and its heights (rows, cols) in metres. Cells outside of all windows have no
    column.
    """
    row0, col0 = min(row for row, _, _ in windows), min(col for _, col, _ in windows)
    rows = max(row + height_m.shape[0] for row, _, height_m in windows) - row0
    cols = max(col + height_m.shape[1] for _, col, height_m in windows) - col0
    heights = np.full((rows, cols), NO_COLUMN, np.float32)
    for row, col, height_m in windows:
        window = slice(row - row0, row - row0 + height_m.shape[0]), slice(col - col0, col - col0 + height_m.shape[1])
        heights[window] = np.where(np.isfinite(height_m), height_m, NO_COLUMN)
    sun_aligned = np.ascontiguousarray(rays.orientation.sun_aligned_view(heights))
    grid, side = columns.coarser(lod).grid, 2.0**lod

    def along_rays(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        row, col = rays.orientation.from_sun_aligned(i, j, rows, cols)
        point, up = rays.scene.world.points_at_zero_height(grid.crs, grid.x(col + col0), grid.y(row + row0))
        light, upwards = rays.light.points_from_earth(point), up @ rays.light.light_from_earth.T
        t, t_rise = (
            (light[..., 0] - rays.right_origin_m) / (rays.right_m_per_cell * side),
            upwards[..., 0] / (rays.right_m_per_cell * side),
        )
        return np.stack([
            t + rays.mean_height_m * t_rise, t_rise, light[..., 1] - rays.up_origin_m, upwards[..., 1],
        ])  # fmt: skip

    column_of_t, column_per_metre, ray_height_at_zero, ray_height_per_metre = _border_cubics(
        along_rays, sun_aligned.shape[0], sun_aligned.shape[1], grid.crs.name
    )
    padded = np.pad(sun_aligned, [(0, -size % BAND_CELLS) for size in sun_aligned.shape], constant_values=NO_COLUMN)
    block_max = padded.reshape(padded.shape[0] // BAND_CELLS, BAND_CELLS, -1, BAND_CELLS).max(axis=(1, 3))
    max_ahead = np.concatenate([[NO_COLUMN], np.maximum.accumulate(sun_aligned.max(axis=1))]).astype(np.float32)
    sun_aligned_columns = SunAlignedColumns(
        sun_aligned,
        block_max,
        max_ahead,
        column_of_t,
        column_per_metre,
        ray_height_at_zero,
        ray_height_per_metre,
        rays.mean_height_m,
        side,
    )
    return ColumnGround(lod, row0, col0, (rows, cols), sun_aligned_columns)


def _border_cubics(
    along_rays: Callable[[np.ndarray, np.ndarray], np.ndarray], rows: int, cols: int, crs_name: str
) -> Iterator[np.ndarray]:
    """Fit cubics in t along each border between rows of a sun-aligned grid: (rows + 1, 4) for each of four quantities.

    t is the position across the sun's rays, in cells. At sun-aligned rows and columns, ``along_rays`` returns t, its change per
    metre of height, and two more values. The four quantities are the column, its shift per metre of height, and the two values.
    Raises ``UnsupportedError`` if cubics cannot approximate the column. The message names the CRS ``crs_name``.
    """
    from scipy.interpolate import make_interp_spline

    i = np.unique(np.linspace(0, rows, min(rows + 1, LATTICE_SIZE)).round())
    j = np.linspace(-0.5, cols - 0.5, min(cols + 1, LATTICE_SIZE))
    t, t_rise, *other_values = along_rays(*np.meshgrid(i - 0.5, j, indexing="ij"))
    if not np.isfinite(t).all():
        raise beyond_crs_error(crs_name)
    if not (np.diff(t, axis=1) > 0.0).all():
        raise bent_rays_error(crs_name)
    degree, row_degree = min(3, len(j) - 1), min(3, len(i) - 1)
    cubics = np.zeros((2 + len(other_values), len(i), 4))
    for n in range(len(i)):
        column_of_t = np.polynomial.Polynomial.fit(t[n], j, degree)
        per_line = [j, -t_rise[n] * column_of_t.deriv()(t[n]), *(values[n] for values in other_values)]
        for coefficients, values in zip(cubics, per_line, strict=True):
            coefficients[n, : degree + 1] = _fitted_coefficients(t[n], values, degree)
    row_cubics = [make_interp_spline(i, coefficients, k=row_degree)(np.arange(rows + 1)) for coefficients in cubics]
    checked = np.unique(np.linspace(0, rows, 4 * LATTICE_SIZE).round()).astype(int)
    columns = np.linspace(-0.5, cols - 0.5, 4 * LATTICE_SIZE)
    exact, *_ = along_rays(*np.meshgrid(checked - 0.5, columns, indexing="ij"))
    fitted = np.stack(
        [np.polynomial.polynomial.polyval(values, row_cubics[0][n]) for n, values in zip(checked, exact, strict=True)]
    )
    if not np.abs(fitted - columns).max() <= MAX_BEND_CELLS:
        raise bent_rays_error(crs_name)
    return iter(row_cubics)


def _fitted_coefficients(t: np.ndarray, values: np.ndarray, degree: int) -> np.ndarray:
    """Return the coefficients (degree + 1,), constant term first, of a polynomial in t fitted to values.

    ``values`` (k,) are those at the positions ``t`` (k,).
    """
    coefficients = np.polynomial.Polynomial.fit(t, values, degree).convert().coef
    return np.pad(coefficients, (0, degree + 1 - len(coefficients)))


@compiled
def _ray_heights(columns, row, t, height):
    """Return the ray heights (n,), metres, of points over ``SunAlignedColumns``.

    ``row`` (n,) are the points' fractional sun-aligned rows, ``t`` (n,) their positions across the rays in cells of these columns,
    and ``height`` (n,) their heights, metres.
    """
    out = np.empty(row.size)
    borders = len(columns.ray_height_at_zero)
    for n in range(row.size):
        b = min(max(int(np.floor(row[n] + 0.5)), 0), borders - 2)
        share = row[n] + 0.5 - b
        low = evaluate_cubic(columns.ray_height_at_zero[b], t[n]) + height[n] * evaluate_cubic(
            columns.ray_height_per_metre[b], t[n]
        )
        high = evaluate_cubic(columns.ray_height_at_zero[b + 1], t[n]) + height[n] * evaluate_cubic(
            columns.ray_height_per_metre[b + 1], t[n]
        )
        out[n] = low + share * (high - low)
    return out


@compiled
def _follow_rays(columns, row, t, ray_heights, needs_height, above_m):
    """Raise ``above_m`` (n,) to the largest height, metres, of columns above the rays from points to the sun.

    ``columns`` are ``SunAlignedColumns``. ``row`` (n,) are the points' fractional sun-aligned rows, ``t`` (n,) their positions
    across the rays in cells of these columns, and ``ray_heights`` (n,) their ray heights, metres. Unless ``needs_height``, a point
    whose value is over 0 is skipped, because its ray is blocked already.
    """
    for n in range(row.size):
        if needs_height or above_m[n] <= 0.0:
            above_m[n] = _highest_above(columns, row[n], t[n], ray_heights[n], needs_height, above_m[n])


@internal
def _border_crossing(columns, b, t, ray_height):
    """Return the fractional column and the height, metres, at which a ray crosses the border before row ``b``.

    ``columns`` are ``SunAlignedColumns``. The ray has the position ``t`` across the rays, in cells, and the ray height
    ``ray_height``, metres. Border ``b`` is in [0, n], for n rows.
    """
    height = (ray_height - evaluate_cubic(columns.ray_height_at_zero[b], t)) / evaluate_cubic(columns.ray_height_per_metre[b], t)
    return evaluate_cubic(columns.column_of_t[b], t) + (height - columns.reference_height_m) * evaluate_cubic(
        columns.column_per_metre[b], t
    ), height


@internal
def _highest_above(columns, row, t, ray_height, needs_height, above_m):
    """Return the maximum of ``above_m`` and of the heights, metres, of ``SunAlignedColumns`` above a ray from a point to the sun.

    The point lies on the fractional sun-aligned row ``row``. Its ray has the position ``t`` across the rays, in cells, and the ray
    height ``ray_height``, metres. Unless ``needs_height``, the search ends at the first column that exceeds ``above_m``.
    ``columns`` are ``SunAlignedColumns``.
    """
    heights = columns.height
    n, m = heights.shape
    i = min(int(np.ceil(row - 0.5 - CORNER_TOLERANCE_CELLS)), n - 1)
    if i < 0:
        return above_m
    x1, h1 = _border_crossing(columns, i + 1, t, ray_height)
    share = i + 0.5 - row
    if share > 0.0:  # starts within the row
        x0, h0 = _border_crossing(columns, i, t, ray_height)
        x1, h1 = x1 + share * (x0 - x1), h1 + share * (h0 - h1)
    while i >= 0:
        min_height = h1 + above_m + HEIGHT_TOLERANCE_M  # the height that a column must exceed
        if columns.max_ahead[i + 1] <= min_height:
            return above_m
        if (i + 1) % BAND_CELLS == 0:
            far = i + 1 - BAND_CELLS
            x0, h0 = _border_crossing(columns, far, t, ray_height)
            first, last = int(np.floor(min(x0, x1) - 0.5)) // BAND_CELLS, int(np.floor(max(x0, x1) + 1.5)) // BAND_CELLS
            if last < 0:
                return above_m
            is_clear = True
            for block in range(max(first, 0), min(last, columns.block_max.shape[1] - 1) + 1):
                is_clear = is_clear and columns.block_max[i // BAND_CELLS, block] <= min_height
            if is_clear:
                i, x1, h1 = far - 1, x0, h0
                continue
        x0, h0 = _border_crossing(columns, i, t, ray_height)
        first, last = (
            int(np.floor(min(x0, x1) + 0.5 - CORNER_TOLERANCE_CELLS)),
            int(np.floor(max(x0, x1) + 0.5 + CORNER_TOLERANCE_CELLS)),
        )
        for c in range(max(first, 0), min(last, m - 1) + 1):
            height = np.float64(heights[i, c])
            if height <= h1 + above_m + HEIGHT_TOLERANCE_M:
                continue
            enters = min(max(x1, c - 0.5), c + 0.5)  # where the ray enters the cell
            entry_height = (
                h1 + (x1 - enters) / (x1 - x0) * (h0 - h1) if abs(x1 - enters) > CORNER_TOLERANCE_CELLS and x1 != x0 else h1
            )
            if height > entry_height + above_m + HEIGHT_TOLERANCE_M:
                above_m = height - entry_height
                if not needs_height:
                    return above_m
        i, x1, h1 = i - 1, x0, h0
    return above_m
