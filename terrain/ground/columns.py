"""Ground as columns: every raster cell has a flat top, and vertical walls stand on the borders between cells.

City surface models describe such ground: heights of cells, with walls that have no width in a map. A column stands on each cell of
the raster in the raster's own CRS, whatever the CRS of the map. Zoomed out, a column stands on 2 x 2, 4 x 4, ... cells and has
their average height.

**One sample per column.** A pixel shows the light at the centre of the column's top that contains it, at every zoom. So a whole top
has one value, as in the tools of urban climatology. (Samples at the pixels' own positions would show the shadows that the steps of
a pitched roof cast on each other, as hatching.)

**As a mesh**, each corner of a cell is a node of its own: four nodes where four cells meet. The quads between the nodes of
neighbouring cells are walls. The quad between the four nodes where cells meet is vertical, and is a point seen from above. So the
mesh is one piece, and its walls have no seams.
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
from skugga.terrain.ground.sheet import Sheet, diagonal_cuts, sheet_triangles
from skugga.terrain.ground.surface import Surface
from skugga.terrain.ground.surface_loops import cubic_weights, interpolate_nodes

MAX_WINDOW_CELLS = 2**26
"""Maximum cells under a block. Only a map that distorts the raster heavily, as round a pole, has more."""


@dataclass(frozen=True, eq=False)
class ColumnMesh(Sheet):
    """The mesh of columns.

    Its nodes (2 rows, 2 cols) are the north-west, north-east, south-west and south-east corner of each cell.

    Attributes
    ----------
    height_m
        Heights of the cells, metres, float32 (rows, cols).
    """

    height_m: np.ndarray

    @cached_property
    def triangles(self) -> np.ndarray:
        """Node indices (n, 3) int32 as in ``Sheet``, without triangles whose area is zero.

        These are in walls between cells of equal height, and where the corners of four cells meet.
        """
        return sheet_triangles(self.is_cut_nw_se)[np.repeat(self.is_quad_with_area.ravel(), 2)]

    @cached_property
    def is_quad_with_area(self) -> np.ndarray:
        """Whether a quad is a top, or a wall between cells of different heights: bool (2 rows - 1, 2 cols - 1)."""
        return _quad_with_area_mask(self.height_m)


@dataclass(frozen=True, eq=False)
class ColumnWindow:
    """Cells [row0, row0 + rows) x [col0, col0 + cols) of ``Columns``: the counterpart of ``SurfaceWindow``.

    Attributes
    ----------
    columns
        The columns that the window is cut from.
    row0, col0
        First row and column.
    height_m
        Heights of the columns, metres, float32 (rows, cols); NaN where no column stands.
    valid
        Valid mask (rows, cols): whether a column is visible, and not only casts shadows (filled holes).
    frame
        Local frame of ``sheet``.
    """

    columns: Columns
    row0: int
    col0: int
    height_m: np.ndarray
    valid: np.ndarray
    frame: LocalFrame

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.height_m.shape
        return rows, cols

    @cached_property
    def sheet(self) -> ColumnMesh:
        """The mesh of the columns' tops and walls."""
        rows, cols = self.height_m.shape
        ground = self.columns.corner_verticals(self.row0, self.col0, rows, cols, self.frame)
        doubled = np.repeat(np.repeat(self.height_m, 2, axis=0), 2, axis=1)
        return ColumnMesh(_corners(ground, self.height_m), diagonal_cuts(doubled), self.height_m)


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of a raster's cells at one level of detail.

    Attributes
    ----------
    world
        The world that the raster lies in.
    elevation
        The raster.
    lod
        Level of detail: a column is ``2**lod`` raster cells a side.
    """

    world: World
    elevation: Elevation
    lod: int

    @cached_property
    def grid(self) -> Grid:
        """The grid whose nodes are the centres of the columns."""
        side, middle = 2**self.lod, (2**self.lod - 1) / 2
        (x0, x1), (y0, y1) = self.elevation.xy(np.array([middle, middle + 1.0]), np.array([middle, middle + 1.0]))
        return Grid(self.elevation.crs, float(x0), float(y0), float(x1 - x0) * side, float((y0 - y1) / (x1 - x0)))

    def coarser(self, lod: int) -> Columns:
        """Return columns that are ``2**lod`` times as wide."""
        return replace(self, lod=self.lod + lod)

    def window(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> ColumnWindow:
        """Return the columns of a window of ``rows`` x ``cols`` cells from (``row0``, ``col0``) on, with their mesh in a frame."""
        return ColumnWindow(self, row0, col0, *self.heights(row0, col0, rows, cols), frame)

    def heights(self, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the heights of a window's cells, metres, float32 (rows, cols), and their valid mask."""
        side = 2**self.lod
        row, col = ((np.arange(first, first + count) + 0.5) * side - 0.5 for first, count in ((row0, rows), (col0, cols)))
        return self.elevation.heights_at(self.lod, *np.meshgrid(row, col, indexing="ij"))

    def corner_verticals(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> np.ndarray:
        """Return frame points of height 0 and unit up vectors (rows + 1, cols + 1, 6) at the corners of a window's cells."""
        cells = self.grid
        grid = replace(cells, x0=float(cells.x(-0.5)), y0=float(cells.y(-0.5)))
        return self.grid_verticals(grid, row0, col0, rows + 1, cols + 1, frame)

    def grid_verticals(self, grid: Grid, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> np.ndarray:
        """Return frame points of height 0 and unit up vectors (rows, cols, 6) at the nodes of a grid."""
        surface = Surface(self.world, self.elevation, grid)
        exact_row, exact_col, x, y = surface.exact_nodes(row0, col0, rows, cols, surface.stride)
        point, up = self.world.points_at_zero_height(grid.crs, x, y)
        exact = np.concatenate([frame.points_from_earth(point), frame.directions_from_earth(up)], axis=-1)
        placed = interpolate_nodes(exact, exact_row, exact_col, surface.stride, row0, col0, rows, cols)
        return np.ascontiguousarray(np.moveaxis(placed, 0, -1))


@dataclass(frozen=True, eq=False)
class ColumnIndices:
    """The columns under positions (rows, cols).

    Attributes
    ----------
    window
        The window that contains all positions.
    row, col
        int32 (rows, cols): row and column in the window of the cell under each position; -1 where no column is visible.
    """

    window: ColumnWindow
    row: np.ndarray
    col: np.ndarray


@dataclass(frozen=True, eq=False)
class ColumnTops:
    """Tops of the columns under positions (rows, cols).

    Attributes
    ----------
    valid
        Valid mask (rows, cols): whether a column is visible at the position.
    position_frame_m
        Centres of the tops in a frame, metres, (rows, cols, 3).
    height_m
        Heights of the columns, metres, (rows, cols).
    up_frame
        Unit up vectors at the centres, in the frame, (rows, cols, 3).
    """

    valid: np.ndarray
    position_frame_m: np.ndarray
    height_m: np.ndarray
    up_frame: np.ndarray


def find_columns(surface: Surface, row: np.ndarray, col: np.ndarray, frame: LocalFrame) -> tuple[ColumnIndices, ColumnTops]:
    """Return the columns under positions at (fractional) rows (n,) and columns (m,) of a surface's grid, and their tops.

    The columns have the surface's level of detail. Positions of tops are in ``frame``. Raises ``UnsupportedError`` if the map
    distorts the raster so heavily that the positions span more than ``MAX_WINDOW_CELLS`` cells.
    """
    stride = surface.stride
    row0, col0 = int(np.floor(row[0])), int(np.floor(col[0]))
    shape = int(np.ceil(row[-1])) - row0 + 1, int(np.ceil(col[-1])) - col0 + 1
    exact_row, exact_col, x, y = surface.exact_nodes(row0, col0, *shape, stride)
    cell = surface.cells_at(x, y)
    if cell is None:
        stride = 1
        exact_row, exact_col, x, y = surface.exact_nodes(row0, col0, *shape, stride)
        cell = surface.cells_at(x, y, allow_jumps=True)
        assert cell is not None
    cells = _interpolate_at(np.stack(cell, axis=-1), exact_row, exact_col, stride, row, col)
    columns = Columns(surface.world, surface.elevation, surface.lod)
    cell_row, cell_col = ((cells[..., k] + 0.5) / 2**columns.lod - 0.5 for k in (0, 1))
    window = _enclosing_window(columns, cell_row, cell_col, frame)
    rows, cols = window.height_m.shape
    centres = columns.grid_verticals(columns.grid, window.row0, window.col0, rows, cols, frame)
    cell_row, cell_col, valid, position, height, up = _find_tops(
        window.height_m, window.valid, centres, cell_row - window.row0, cell_col - window.col0
    )
    return ColumnIndices(window, cell_row, cell_col), ColumnTops(valid, position, height, up)


def _enclosing_window(columns: Columns, row: np.ndarray, col: np.ndarray, frame: LocalFrame) -> ColumnWindow:
    """Return the window of columns that contains all positions, with a margin of one cell, clipped to the raster."""
    is_located = np.isfinite(row) & np.isfinite(col)
    ends = []
    for values, cells in ((row, columns.elevation.rows), (col, columns.elevation.cols)):
        low, high = (np.floor([values[is_located].min(), values[is_located].max()]) if is_located.any() else (0.0, 0.0)) + np.array(
            [-1.0, 2.0]
        )
        if values is row or not columns.elevation.crs.is_geographic:  # longitudes wrap
            low, high = max(low, -2.0), min(high, cells / 2**columns.lod + 2.0)
        ends.append((int(low), max(int(high - low) + 1, 2)))
    (row0, rows), (col0, cols) = ends
    if rows * cols > MAX_WINDOW_CELLS:
        problem = f"a block of this map covers {rows * cols} columns of cubes, more than the limit of {MAX_WINDOW_CELLS}"
        raise UnsupportedError("terrain.surface", "blocks", problem)
    return columns.window(row0, col0, rows, cols, frame)


@compiled
def _interpolate_at(exact, first_row, first_col, stride, row, col):
    """Return values (n, m, k) float64 at fractional rows (n,) and columns (m,), interpolated from exact ones by cubics.

    ``exact`` holds the values at every ``stride``-th row and column. The interpolation is that of
    ``skugga.terrain.ground.surface_loops.interpolate_nodes``.
    """
    components = exact.shape[2]
    out = np.empty((row.size, col.size, components))
    row_values = np.empty((exact.shape[1], components))
    for i in range(row.size):
        exact_index = int(np.floor(row[i] / stride))
        w, m = cubic_weights((row[i] - exact_index * stride) / stride), exact_index - first_row
        for n in range(exact.shape[1]):
            for k in range(components):
                if w[1] == 1.0:  # an exact row: zero weights must not carry a neighbour's NaN
                    row_values[n, k] = exact[m, n, k]
                else:
                    row_values[n, k] = (
                        w[0] * exact[m - 1, n, k] + w[1] * exact[m, n, k] + w[2] * exact[m + 1, n, k] + w[3] * exact[m + 2, n, k]
                    )
        for j in range(col.size):
            exact_index = int(np.floor(col[j] / stride))
            v, n = cubic_weights((col[j] - exact_index * stride) / stride), exact_index - first_col
            for k in range(components):
                if v[1] == 1.0:
                    out[i, j, k] = row_values[n, k]
                else:
                    out[i, j, k] = (
                        v[0] * row_values[n - 1, k]
                        + v[1] * row_values[n, k]
                        + v[2] * row_values[n + 1, k]
                        + v[3] * row_values[n + 2, k]
                    )
    return out


@compiled
def _find_tops(height, top_valid, centres, row, col):
    """Look up the columns under positions (n, m) of a window, given as fractional rows and columns.

    Returns six arrays: the row and the column of each position's cell (-1 where no column is visible), the valid mask, the centres
    of the columns' tops, their heights, and the up vectors at the centres.
    """
    cell_row, cell_col = np.full(row.shape, -1, np.int32), np.full(row.shape, -1, np.int32)
    valid = np.zeros(row.shape, np.bool_)
    point = np.full((row.shape[0], row.shape[1], 3), np.nan)
    top_height = np.full(row.shape, np.nan, np.float32)
    up = np.full((row.shape[0], row.shape[1], 3), np.nan, np.float32)
    for i in range(row.shape[0]):
        for j in range(row.shape[1]):
            r, c = highest_cell(height, row[i, j], col[i, j])
            if r < 0 or not top_valid[r, c] or not np.isfinite(centres[r, c, 0]):
                continue
            valid[i, j] = True
            cell_row[i, j], cell_col[i, j] = r, c
            top_height[i, j] = height[r, c]
            for k in range(3):
                point[i, j, k] = centres[r, c, k] + np.float64(height[r, c]) * centres[r, c, k + 3]
                up[i, j, k] = centres[r, c, k + 3]
    return cell_row, cell_col, valid, point, top_height, up


@compiled
def _corners(ground, height):
    """Return the mesh nodes (2 rows, 2 cols, 3) of columns with heights (rows, cols).

    ``ground`` (rows + 1, cols + 1, 6) has the points of height 0 and the up vectors at the corners of their cells.
    """
    rows, cols = height.shape
    out = np.empty((2 * rows, 2 * cols, 3))
    for i in range(2 * rows):
        for j in range(2 * cols):
            h, g = np.float64(height[i // 2, j // 2]), ground[(i + 1) // 2, (j + 1) // 2]
            for k in range(3):
                out[i, j, k] = g[k] + h * g[k + 3]
    return out


@compiled
def _quad_with_area_mask(height):
    """Return which quads of the mesh of columns with the heights ``height`` (rows, cols) have an area, bool.

    The result has the shape (2 rows - 1, 2 cols - 1). A quad at an even row and column is the top of a column, and has an area. A
    quad at one odd index is a wall between two columns, and has an area if their heights differ. A quad at two odd indices lies
    where the corners of four columns meet, and has none. A quad beside a missing column (NaN) has none either.
    """
    rows, cols = height.shape
    out = np.zeros((2 * rows - 1, 2 * cols - 1), np.bool_)
    for i in range(2 * rows - 1):
        for j in range(2 * cols - 1):
            first_height, second_height = height[i // 2, j // 2], height[(i + 1) // 2, (j + 1) // 2]
            if np.isfinite(first_height) and np.isfinite(second_height):
                top, corner = i % 2 == 0 and j % 2 == 0, i % 2 == 1 and j % 2 == 1
                out[i, j] = top or (first_height != second_height and not corner)
    return out
