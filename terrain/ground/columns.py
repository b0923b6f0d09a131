"""The ground as upright columns: every cell of a raster has a flat top, and walls stand on the borders between cells.

That is what surface models of cities state: heights of cells, with walls that have no width in a map. The columns are those of the
raster's own cells in its own CRS, whatever map they are drawn in; zoomed out, those of cells that are averaged 2 x 2, 4 x 4, ...

**One place a column.** A pixel shows the middle of the top that it lies in, at every zoom: a cell has one class, as in the tools of
city climate. (Taken where the pixels lie, the shadows that the steps of a pitched roof throw on each other would show as hatching.)

**As a sheet** the cells' corners are nodes, each as often as cells meet in it: between the tops lie walls, and over a corner of
four cells a quad that is upright, too, and seen from above a point. So the sheet is of one piece, and its walls have no seams.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.cells import highest_cell
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.sheet import Sheet, cuts_of, sheet_triangles
from skugga.terrain.ground.surface import Surface, cubic_weights, interpolated

MAX_WINDOW_CELLS = 2**26
"""Most cells under a block: more lie under one only where a map bends the raster out of shape, as round a pole."""


@dataclass(frozen=True, eq=False)
class ColumnSheet(Sheet):
    """The sheet of columns: nodes (2 rows, 2 cols), of each cell its north-west, north-east, south-west and south-east corner."""

    height_m: np.ndarray

    @cached_property
    def triangles(self) -> np.ndarray:
        """As a ``Sheet`` has them, but for those without any area: walls between cells that are level, and corners."""
        return sheet_triangles(self.falls)[np.repeat(self.has_area.ravel(), 2)]

    @cached_property
    def has_area(self) -> np.ndarray:
        """Which quads (2 rows - 1, 2 cols - 1) are tops, or walls between cells of different heights."""
        return _has_area(self.height_m)


@dataclass(frozen=True, eq=False)
class ColumnWindow:
    """Cells [row0, row0 + rows) x [col0, col0 + cols) of ``Columns``, as a ``SurfaceWindow`` has nodes: ``height_m`` (rows, cols)
    float32, NaN where there is no column; ``there`` says where the picture shows one; and their ``sheet`` in a frame.
    """

    columns: Columns
    row0: int
    col0: int
    height_m: np.ndarray
    there: np.ndarray
    frame: LocalFrame

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.height_m.shape
        return rows, cols

    @cached_property
    def sheet(self) -> ColumnSheet:
        """The columns' tops and walls."""
        rows, cols = self.height_m.shape
        ground = self.columns.corners(self.row0, self.col0, rows, cols, self.frame)
        doubled = np.repeat(np.repeat(self.height_m, 2, axis=0), 2, axis=1)
        return ColumnSheet(_corners(ground, self.height_m), cuts_of(doubled), self.height_m)


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of a raster's cells of a level: 2**level of its cells a side. ``grid`` is of their centres."""

    world: World
    elevation: Elevation
    level: int

    @cached_property
    def grid(self) -> Grid:
        """The grid of the cells' centres."""
        side, middle = 2**self.level, (2**self.level - 1) / 2
        (x0, x1), (y0, y1) = self.elevation.xy(np.array([middle, middle + 1.0]), np.array([middle, middle + 1.0]))
        return Grid(self.elevation.crs, float(x0), float(y0), float(x1 - x0) * side, float((y0 - y1) / (x1 - x0)))

    def coarser(self, level: int) -> Columns:
        """The columns of 2**level times as large cells."""
        return replace(self, level=self.level + level)

    def window(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> ColumnWindow:
        """The columns of a window, in a frame."""
        return ColumnWindow(self, row0, col0, *self.heights(row0, col0, rows, cols), frame)

    def heights(self, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Heights in metres (float32) of a window's cells, and where there is a surface."""
        side = 2**self.level
        row, col = ((np.arange(first, first + count) + 0.5) * side - 0.5 for first, count in ((row0, rows), (col0, cols)))
        return self.elevation.heights_at(self.level, *np.meshgrid(row, col, indexing="ij"))

    def corners(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> np.ndarray:
        """Frame points of height 0 and the directions up (rows + 1, cols + 1, 6) at the corners of a window's cells."""
        cells = self.grid
        grid = replace(cells, x0=float(cells.x(-0.5)), y0=float(cells.y(-0.5)))
        return self.ground(grid, row0, col0, rows + 1, cols + 1, frame)

    def ground(self, grid: Grid, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> np.ndarray:
        """The same (rows, cols, 6) at the nodes of a grid."""
        surface = Surface(self.world, self.elevation, grid)
        exact_row, exact_col, x, y = surface.exact_nodes(row0, col0, rows, cols, surface.stride)
        point, up = self.world.ground(grid.crs, x, y)
        exact = np.concatenate([frame.points_from_earth(point), frame.directions_from_earth(up)], axis=-1)
        placed = interpolated(exact, exact_row, exact_col, surface.stride, row0, col0, rows, cols)
        return np.ascontiguousarray(np.moveaxis(placed, 0, -1))


@dataclass(frozen=True, eq=False)
class PlacedOnColumns:
    """Places (rows, cols) on columns: the ``window`` round them all, and ``row`` and ``col`` int32 of the cells there that they lie
    in; -1 where there is none.
    """

    window: ColumnWindow
    row: np.ndarray
    col: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenFromAbove:
    """What is seen of columns at places (rows, cols): whether anything, the middles of their tops in a frame, their heights, and
    the directions up there.
    """

    there: np.ndarray
    position_frame_m: np.ndarray
    height_m: np.ndarray
    up_frame: np.ndarray


def columns_under(surface: Surface, row: np.ndarray, col: np.ndarray, frame: LocalFrame) -> tuple[PlacedOnColumns, SeenFromAbove]:
    """The columns under places at rows (n,) and columns (m,) of a surface's grid, of the cells that the surface would show.

    Raises ``UnsupportedError`` where the map bends the raster so much that too many cells would be needed.
    """
    stride = surface.stride
    row0, col0 = int(np.floor(row[0])), int(np.floor(col[0]))
    shape = int(np.ceil(row[-1])) - row0 + 1, int(np.ceil(col[-1])) - col0 + 1
    exact_row, exact_col, x, y = surface.exact_nodes(row0, col0, *shape, stride)
    cell = surface.cells_of(x, y)
    if cell is None:
        stride = 1
        exact_row, exact_col, x, y = surface.exact_nodes(row0, col0, *shape, stride)
        cell = surface.cells_of(x, y, everywhere=True)
        assert cell is not None
    placed = _placed(np.stack(cell, axis=-1), exact_row, exact_col, stride, row, col)
    columns = Columns(surface.world, surface.elevation, surface.level)
    cell_row, cell_col = ((placed[..., k] + 0.5) / 2**columns.level - 0.5 for k in (0, 1))
    window = _window_round(columns, cell_row, cell_col, frame)
    rows, cols = window.height_m.shape
    middles = columns.ground(columns.grid, window.row0, window.col0, rows, cols, frame)
    cell_row, cell_col, there, position, height, up = _tops(
        window.height_m, window.there, middles, cell_row - window.row0, cell_col - window.col0
    )
    return PlacedOnColumns(window, cell_row, cell_col), SeenFromAbove(there, position, height, up)


def _window_round(columns: Columns, row: np.ndarray, col: np.ndarray, frame: LocalFrame) -> ColumnWindow:
    """The window round places, with a rim of one cell, as far as the raster goes."""
    known = np.isfinite(row) & np.isfinite(col)
    ends = []
    for values, cells in ((row, columns.elevation.rows), (col, columns.elevation.cols)):
        low, high = (np.floor([values[known].min(), values[known].max()]) if known.any() else (0.0, 0.0)) + np.array([-1.0, 2.0])
        if values is row or not columns.elevation.crs.is_geographic:  # longitudes go on round the earth
            low, high = max(low, -2.0), min(high, cells / 2**columns.level + 2.0)
        ends.append((int(low), max(int(high - low) + 1, 2)))
    (row0, rows), (col0, cols) = ends
    if rows * cols > MAX_WINDOW_CELLS:
        allowed = f"maps with up to {MAX_WINDOW_CELLS} columns under a block: here there are {rows * cols}"
        raise UnsupportedError("terrain.surface", "blocks", allowed)
    return columns.window(row0, col0, rows, cols, frame)


@compiled
def _placed(exact, first_row, first_col, stride, row, col):
    """As ``skugga.terrain.ground.surface.interpolated``, at (fractional) rows and columns."""
    kinds = exact.shape[2]
    out = np.empty((row.size, col.size, kinds))
    along = np.empty((exact.shape[1], kinds))
    for i in range(row.size):
        coarse = int(np.floor(row[i] / stride))
        w, m = cubic_weights((row[i] - coarse * stride) / stride), coarse - first_row
        for n in range(exact.shape[1]):
            for k in range(kinds):
                if w[1] == 1.0:  # an exact row: zero weights must not carry a neighbour's NaN
                    along[n, k] = exact[m, n, k]
                else:
                    along[n, k] = (
                        w[0] * exact[m - 1, n, k] + w[1] * exact[m, n, k] + w[2] * exact[m + 1, n, k] + w[3] * exact[m + 2, n, k]
                    )
        for j in range(col.size):
            coarse = int(np.floor(col[j] / stride))
            v, n = cubic_weights((col[j] - coarse * stride) / stride), coarse - first_col
            for k in range(kinds):
                if v[1] == 1.0:
                    out[i, j, k] = along[n, k]
                else:
                    out[i, j, k] = v[0] * along[n - 1, k] + v[1] * along[n, k] + v[2] * along[n + 1, k] + v[3] * along[n + 2, k]
    return out


@compiled
def _tops(height, shown, middles, row, col):
    """Of places (n, m) of a window: row and column of their cells, whether they show one, its top's middle, height and way up."""
    cell_row, cell_col = np.full(row.shape, -1, np.int32), np.full(row.shape, -1, np.int32)
    there = np.zeros(row.shape, np.bool_)
    point = np.full((row.shape[0], row.shape[1], 3), np.nan)
    level = np.full(row.shape, np.nan, np.float32)
    up = np.full((row.shape[0], row.shape[1], 3), np.nan, np.float32)
    for i in range(row.shape[0]):
        for j in range(row.shape[1]):
            r, c = highest_cell(height, row[i, j], col[i, j])
            if r < 0 or not shown[r, c] or not np.isfinite(middles[r, c, 0]):
                continue
            there[i, j] = True
            cell_row[i, j], cell_col[i, j] = r, c
            level[i, j] = height[r, c]
            for k in range(3):
                point[i, j, k] = middles[r, c, k] + np.float64(height[r, c]) * middles[r, c, k + 3]
                up[i, j, k] = middles[r, c, k + 3]
    return cell_row, cell_col, there, point, level, up


@compiled
def _corners(ground, height):
    """The nodes (2 rows, 2 cols, 3) of columns over the ground (rows + 1, cols + 1, 6) at their corners."""
    rows, cols = height.shape
    out = np.empty((2 * rows, 2 * cols, 3))
    for i in range(2 * rows):
        for j in range(2 * cols):
            h, g = np.float64(height[i // 2, j // 2]), ground[(i + 1) // 2, (j + 1) // 2]
            for k in range(3):
                out[i, j, k] = g[k] + h * g[k + 3]
    return out


@compiled
def _has_area(height):
    rows, cols = height.shape
    out = np.zeros((2 * rows - 1, 2 * cols - 1), np.bool_)
    for i in range(2 * rows - 1):
        for j in range(2 * cols - 1):
            one, other = height[i // 2, j // 2], height[(i + 1) // 2, (j + 1) // 2]
            if np.isfinite(one) and np.isfinite(other):
                top, corner = i % 2 == 0 and j % 2 == 0, i % 2 == 1 and j % 2 == 1
                out[i, j] = top or (one != other and not corner)
    return out
