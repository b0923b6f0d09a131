"""The sun's shadows of upright columns (``skugga.terrain.ground.columns``): every ray is followed over the cells that it passes.

What lines share of a smooth ground they do not share of walls: a ray meets a column, or passes beside it by a hair's breadth. So
each column has a ray of its own, from the middle of its top. It is followed towards the sun over the turned grid
(``skugga.shadows.sweep.lines``), row by row: over a cell it is lowest where it comes in, and there it is held against the cell's
flat top. What it passes at a corner or along a border it meets, as a ray that meets an edge is stopped.

**Bands.** ``BAND_CELLS`` rows at a time a ray is held against the highest column of each block of cells that it passes. Blocks that
lie below it are passed over at once, and where no higher column lies ahead it has reached the sun.

**A bent earth.** A ray is what has one t and one level (``skugga.shadows.sweep.lines``). Along each border between rows its column
and its height above sea level follow from cubics in t: of the column, of how far aside the vertical leads, of the level of height
0, and of what a metre of height adds to it. Nothing is put between lines, so the answers are those of the columns themselves, in a
flat world to the rounding of float64.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.sweep.grid import BENT_CELLS, LATTICE, bent_rays_error, beyond_crs_error
from skugga.shadows.sweep.points import cubic
from skugga.shadows.sweep.rays import SunRays, rays_over
from skugga.terrain.casters.reach import PATCH_QUADS, Casters
from skugga.terrain.compiled import compiled, internal, on_cores
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.ground.columns import Columns, PlacedOnColumns
from skugga.terrain.scene import Scene

BAND_CELLS = 16
"""Rows that are passed over at once, and side of the blocks of cells whose highest column is known."""

ON_CORNER = 1e-6
"""How near to a corner, in cells, a ray meets all columns that it is one of."""

TOUCHING_M = 1e-6
"""What is higher than a ray by less does not stop it: what float64 makes of tops of one height."""

NO_COLUMN = np.float32(-1e30)

POINTS_AT_A_TIME = 2**15


class TurnedColumns(NamedTuple):
    """Columns (n, m) of a turned grid: ``height`` float32, ``NO_COLUMN`` where there is none, the highest of each block (``tops``),
    and of all rows before a border (``ahead`` (n + 1,)).

    Along the border before each row, and behind the last one, cubics (n + 1, 4) in t: the column (``place``) of ground that is
    ``middle`` metres high, and how far aside (``lean``) a metre more leads; the level of height 0 (``zero``), and what a metre
    adds to it (``rise``). t counts cells that are ``side`` times those of the points.
    """

    height: np.ndarray
    tops: np.ndarray
    ahead: np.ndarray
    place: np.ndarray
    lean: np.ndarray
    zero: np.ndarray
    rise: np.ndarray
    middle: float
    side: float


@dataclass(frozen=True, eq=False)
class ColumnGround:
    """The columns of a detail towards the sun, their shape and first cell before they are turned, and their cubics for what lies
    towards the sun: ``along`` and ``along_rise`` (n + 1, 4), as ``zero`` and ``rise`` are for levels.
    """

    detail: int
    row0: int
    col0: int
    shape: tuple[int, int]
    columns: TurnedColumns
    along: np.ndarray
    along_rise: np.ndarray

    def tilted(self, angle: float) -> TurnedColumns:
        """The columns under a sun that stands higher by an angle, radians."""
        cosine, sine = np.cos(angle), np.sin(angle)
        return self.columns._replace(
            zero=cosine * self.columns.zero - sine * self.along, rise=cosine * self.columns.rise - sine * self.along_rise
        )


@dataclass(frozen=True, eq=False)
class ColumnSweep:
    """What a sweep over columns goes by: the ground, the finest first; and of a buffer's points, each column once, their turned
    rows there (n,), t, heights, and levels and metres towards the sun. A column's level (NaN) is that of its top. ``number`` is of
    the point that each of the buffer's pixels (rows, cols) shows, -1 without any.
    """

    rays: SunRays
    grounds: list[ColumnGround]
    number: np.ndarray
    row: np.ndarray
    t: np.ndarray
    height_m: np.ndarray
    level_m: np.ndarray
    towards_m: np.ndarray

    @property
    def nbytes(self) -> int:
        """Bytes of what it holds."""
        return sum(ground.columns.height.nbytes for ground in self.grounds) + 40 * self.row.size

    def above_m(self, angle: float, measured: bool, cores: int) -> np.ndarray:
        """How far columns rise above the rays from a buffer's pixels (rows, cols) to a sun that stands higher by an angle, radians:
        over 0 where any does; where ``measured``, by how much the highest one does.
        """
        grounds = [ground.tilted(angle) for ground in self.grounds]
        own = np.cos(angle) * self.level_m - np.sin(angle) * self.towards_m
        on_columns = np.flatnonzero(np.isnan(own))
        own[on_columns] = _own_levels(grounds[0], self.row[on_columns], self.t[on_columns], self.height_m[on_columns])
        out = np.zeros(len(self.row))

        def some(first: int) -> None:
            part = slice(first, first + POINTS_AT_A_TIME)
            for ground, turned in zip(self.grounds, grounds, strict=True):
                row = self._rows_on(ground, self.row[part])
                _follow(turned, row, self.t[part] / turned.side, own[part], measured, out[part])

        on_cores(some, range(0, len(out), POINTS_AT_A_TIME), cores)
        return np.append(out, 0.0)[self.number]

    def _rows_on(self, ground: ColumnGround, row: np.ndarray) -> np.ndarray:
        """Turned rows of the finest ground on another one."""
        finest, turn = self.grounds[0], self.rays.turn
        if ground is finest:
            return row
        ends = np.array([0.0, 1.0])
        own_row, own_col = turn.origin(ends, ends, *finest.shape)
        side = 2.0**ground.detail
        there_row, there_col = ((own_row + finest.row0 + 0.5) / side - 0.5, (own_col + finest.col0 + 0.5) / side - 0.5)
        on, _ = turn.onto(there_row - ground.row0, there_col - ground.col0, *ground.shape)
        return on[0] + row * (on[1] - on[0])


def column_sweep(buffer: GeometryBuffer, scene: Scene, casters: Casters) -> ColumnSweep:
    """The sweep for a map's block of columns. Raises ``UnsupportedError`` where the sun's rays are too bent."""
    placed = buffer.columns
    assert placed is not None
    window = placed.window
    rows, cols = window.height_m.shape
    rays = rays_over(scene, window.columns.grid, window.row0 + (rows - 1) / 2, window.col0 + (cols - 1) / 2)
    windows: dict[int, list[tuple[int, int, np.ndarray]]] = {0: [(window.row0, window.col0, window.height_m)]}
    for patch in casters.casting:
        row0, col0 = patch.row * PATCH_QUADS, patch.col * PATCH_QUADS
        height_m, _ = window.columns.coarser(patch.level).heights(row0, col0, PATCH_QUADS, PATCH_QUADS)
        windows.setdefault(patch.level, []).append((row0, col0, height_m))
    grounds = [_ground(rays, window.columns, detail, windows[detail]) for detail in sorted(windows)]
    number, pixel = _numbered(buffer, placed, window.height_m.size)
    t, level_m, towards_m = rays.t_level_towards(buffer.position_frame_m, buffer.frame, pixel)
    on_columns = buffer.kind.ravel()[pixel] == RELIEF
    level_m[on_columns] = np.nan
    row, col = placed.row.ravel()[pixel] + float(window.row0), placed.col.ravel()[pixel] + float(window.col0)
    row[~on_columns], col[~on_columns] = rays.rows_and_columns(buffer.position_frame_m, buffer.frame, pixel[~on_columns])
    turned_row, _ = rays.turn.onto(row - grounds[0].row0, col - grounds[0].col0, *grounds[0].shape)
    height_m = buffer.height_m.ravel()[pixel].astype(np.float64)
    return ColumnSweep(rays, grounds, number, turned_row, t, height_m, level_m, towards_m)


def _numbered(buffer: GeometryBuffer, placed: PlacedOnColumns, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (rows, cols) of the points that pixels show, one for each column of so many and for each pixel with anything else;
    and a pixel that shows each, flat (n,).
    """
    there, ground = buffer.there.ravel(), (buffer.there & (buffer.kind == RELIEF)).ravel()
    key = np.full(there.size, -1, np.int64)
    cell = placed.row.astype(np.int64) * placed.window.height_m.shape[1] + placed.col
    key[ground] = cell.ravel()[ground]
    others = np.flatnonzero(there & ~ground)
    key[others] = cells + np.arange(len(others))
    shown = np.full(cells + len(others) + 1, -1, np.int64)  # the last one is of pixels that show nothing
    shown[key] = np.arange(key.size)
    shown[-1] = -1
    used = np.flatnonzero(shown >= 0)
    number = np.full(len(shown), -1, np.int64)
    number[used] = np.arange(len(used))
    return number[key].reshape(buffer.there.shape), shown[used]


def _ground(rays: SunRays, columns: Columns, detail: int, windows: list[tuple[int, int, np.ndarray]]) -> ColumnGround:
    """One ground over windows of heights; where there is none, there is no column."""
    row0, col0 = min(row for row, _, _ in windows), min(col for _, col, _ in windows)
    rows = max(row + height_m.shape[0] for row, _, height_m in windows) - row0
    cols = max(col + height_m.shape[1] for _, col, height_m in windows) - col0
    heights = np.full((rows, cols), NO_COLUMN, np.float32)
    for row, col, height_m in windows:
        here = slice(row - row0, row - row0 + height_m.shape[0]), slice(col - col0, col - col0 + height_m.shape[1])
        heights[here] = np.where(np.isfinite(height_m), height_m, NO_COLUMN)
    turned = np.ascontiguousarray(rays.turn.turned(heights))
    grid, side = columns.coarser(detail).grid, 2.0**detail

    def along_rays(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        row, col = rays.turn.origin(i, j, rows, cols)
        point, up = rays.scene.world.ground(grid.crs, grid.x(col + col0), grid.y(row + row0))
        light, upwards = rays.light.from_earth(point), up @ rays.light.light_from_earth.T
        t, t_rise = (light[..., 0] - rays.right_m) / (rays.cell_m * side), upwards[..., 0] / (rays.cell_m * side)
        return np.stack([
            t + rays.height_m * t_rise, t_rise, light[..., 1] - rays.level_m, upwards[..., 1], -light[..., 2], -upwards[..., 2],
        ])  # fmt: skip

    place, lean, zero, rise, along, along_rise = _border_cubics(along_rays, turned.shape[0], turned.shape[1], grid.crs.name)
    padded = np.pad(turned, [(0, -size % BAND_CELLS) for size in turned.shape], constant_values=NO_COLUMN)
    tops = padded.reshape(padded.shape[0] // BAND_CELLS, BAND_CELLS, -1, BAND_CELLS).max(axis=(1, 3))
    ahead = np.concatenate([[NO_COLUMN], np.maximum.accumulate(turned.max(axis=1))]).astype(np.float32)
    found = TurnedColumns(turned, tops, ahead, place, lean, zero, rise, rays.height_m, side)
    return ColumnGround(detail, row0, col0, (rows, cols), found, along, along_rise)


def _border_cubics(
    along_rays: Callable[[np.ndarray, np.ndarray], np.ndarray], rows: int, cols: int, crs_name: str
) -> Iterator[np.ndarray]:
    """Cubics in t (rows + 1, 4) along the borders of a turned grid's rows: the column, how far it moves aside with a metre of
    height, and four more values, of ``along_rays``: t, what a metre adds to it, and the four, at turned rows and columns.

    Raises ``UnsupportedError``, which names the grid's CRS, where cubics cannot follow it.
    """
    from scipy.interpolate import make_interp_spline

    i = np.unique(np.linspace(0, rows, min(rows + 1, LATTICE)).round())
    j = np.linspace(-0.5, cols - 0.5, min(cols + 1, LATTICE))
    t, t_rise, *others = along_rays(*np.meshgrid(i - 0.5, j, indexing="ij"))
    if not np.isfinite(t).all():
        raise beyond_crs_error(crs_name)
    if not (np.diff(t, axis=1) > 0.0).all():
        raise bent_rays_error(crs_name)
    degree, along = min(3, len(j) - 1), min(3, len(i) - 1)
    cubics = np.zeros((2 + len(others), len(i), 4))
    for n in range(len(i)):
        place = np.polynomial.Polynomial.fit(t[n], j, degree)
        per_line = [j, -t_rise[n] * place.deriv()(t[n]), *(values[n] for values in others)]
        for found, values in zip(cubics, per_line, strict=True):
            found[n, : degree + 1] = _coefficients(t[n], values, degree)
    whole = [make_interp_spline(i, found, k=along)(np.arange(rows + 1)) for found in cubics]
    checked = np.unique(np.linspace(0, rows, 4 * LATTICE).round()).astype(int)
    columns = np.linspace(-0.5, cols - 0.5, 4 * LATTICE)
    exact, *_ = along_rays(*np.meshgrid(checked - 0.5, columns, indexing="ij"))
    fitted = np.stack([np.polynomial.polynomial.polyval(values, whole[0][n]) for n, values in zip(checked, exact, strict=True)])
    if not np.abs(fitted - columns).max() <= BENT_CELLS:
        raise bent_rays_error(crs_name)
    return iter(whole)


def _coefficients(t: np.ndarray, values: np.ndarray, degree: int) -> np.ndarray:
    """Those (degree + 1,) of a polynomial in t through values."""
    found = np.polynomial.Polynomial.fit(t, values, degree).convert().coef
    return np.pad(found, (0, degree + 1 - len(found)))


@compiled
def _own_levels(columns, row, t, height):
    """The levels (n,) of points on columns of these heights, at turned rows."""
    out = np.empty(row.size)
    borders = len(columns.zero)
    for n in range(row.size):
        b = min(max(int(np.floor(row[n] + 0.5)), 0), borders - 2)
        share = row[n] + 0.5 - b
        low = cubic(columns.zero[b], t[n]) + height[n] * cubic(columns.rise[b], t[n])
        high = cubic(columns.zero[b + 1], t[n]) + height[n] * cubic(columns.rise[b + 1], t[n])
        out[n] = low + share * (high - low)
    return out


@compiled
def _follow(columns, row, t, level, measured, above):
    """Raise ``above`` (n,), where it is not over 0 yet or ``measured``, to what columns rise above the rays from some points."""
    for n in range(row.size):
        if measured or above[n] <= 0.0:
            above[n] = _highest_above(columns, row[n], t[n], level[n], measured, above[n])


@internal
def _on_border(columns, b, t, level):
    """A ray's column and height where it crosses the border before row ``b``."""
    height = (level - cubic(columns.zero[b], t)) / cubic(columns.rise[b], t)
    return cubic(columns.place[b], t) + (height - columns.middle) * cubic(columns.lean[b], t), height


@internal
def _highest_above(columns, row, t, level, measured, above):
    """The most by which a column rises above the ray of a level from a turned row on, if more than ``above``; else that. The first
    that does will do, unless ``measured``.
    """
    heights = columns.height
    n, m = heights.shape
    i = min(int(np.ceil(row - 0.5 - ON_CORNER)), n - 1)
    if i < 0:
        return above
    x1, h1 = _on_border(columns, i + 1, t, level)
    share = i + 0.5 - row
    if share > 0.0:  # from within the row
        x0, h0 = _on_border(columns, i, t, level)
        x1, h1 = x1 + share * (x0 - x1), h1 + share * (h0 - h1)
    while i >= 0:
        least = h1 + above + TOUCHING_M  # what a column must reach to count
        if columns.ahead[i + 1] <= least:
            return above
        if (i + 1) % BAND_CELLS == 0:
            far = i + 1 - BAND_CELLS
            x0, h0 = _on_border(columns, far, t, level)
            first, last = int(np.floor(min(x0, x1) - 0.5)) // BAND_CELLS, int(np.floor(max(x0, x1) + 1.5)) // BAND_CELLS
            if last < 0:
                return above
            clear = True
            for block in range(max(first, 0), min(last, columns.tops.shape[1] - 1) + 1):
                clear = clear and columns.tops[i // BAND_CELLS, block] <= least
            if clear:
                i, x1, h1 = far - 1, x0, h0
                continue
        x0, h0 = _on_border(columns, i, t, level)
        first, last = int(np.floor(min(x0, x1) + 0.5 - ON_CORNER)), int(np.floor(max(x0, x1) + 0.5 + ON_CORNER))
        for c in range(max(first, 0), min(last, m - 1) + 1):
            height = np.float64(heights[i, c])
            if height <= h1 + above + TOUCHING_M:
                continue
            enters = min(max(x1, c - 0.5), c + 0.5)  # where the ray comes into the cell
            here = h1 + (x1 - enters) / (x1 - x0) * (h0 - h1) if abs(x1 - enters) > ON_CORNER and x1 != x0 else h1
            if height > here + above + TOUCHING_M:
                above = height - here
                if not measured:
                    return above
        i, x1, h1 = i - 1, x0, h0
    return above
