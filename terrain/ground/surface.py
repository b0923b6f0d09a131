"""The drawn surface: heights at the nodes of a map grid, and their points in a local frame.

Where a node lies (in the raster, and on earth at height 0) is computed exactly on every ``stride``-th node of the grid
and by cubic Lagrange interpolation between; the mapping is so smooth there that the error is under a millimetre. The
exact nodes are multiples counted from the grid's origin, never from a window: the same node has the same bits in every
window that shares its frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from terrain.compiled import compiled
from terrain.geo.grid import Grid, MapView
from terrain.geo.world import LONGITUDE_LATITUDE, LocalFrame, World, transformer
from terrain.ground.elevation import Elevation
from terrain.ground.sheet import Sheet, sheet_of

EXACT_SPACING_M = 16000.0
"""Largest distance between exactly computed nodes: the cubic's error there is below 0.1 mm on the globe."""

EXACT_STRIDE = 64
"""Largest distance between exactly computed nodes, in nodes."""


SURFACE_BAND_ROWS = 256
"""Rows of a window that are worked on at a time."""


@dataclass(frozen=True, eq=False)
class HeightWindow:
    """Nodes [row0, row0 + rows) x [col0, col0 + cols) of a grid.

    ``height_m`` is (rows, cols) float32, NaN where no surface can be (outside the data). ``there`` says where the picture shows a
    surface: holes are filled, but not ``there``.
    """

    row0: int
    col0: int
    height_m: np.ndarray
    there: np.ndarray


@dataclass(frozen=True, eq=False)
class SurfaceWindow(HeightWindow):
    """The same with the nodes' points: ``position_frame_m`` (rows, cols, 3) float64, NaN where there is no height.

    ``centre_frame_m`` (3,) is what up points away from: the earth's centre, or in a flat world one infinitely far below.
    """

    position_frame_m: np.ndarray
    centre_frame_m: np.ndarray

    @cached_property
    def sheet(self) -> Sheet:
        """The nodes with their quads' cuts."""
        return sheet_of(self.position_frame_m, self.height_m)


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of a raster on the nodes of a grid."""

    world: World
    elevation: Elevation
    grid: Grid
    step_m: float = field(init=False)
    level: int = field(init=False)
    cells_per_step: float = field(init=False)
    stride: int = field(init=False)

    def __post_init__(self) -> None:
        step_m = step_at_anchor_m(self.world, self.grid)
        cell_m = self.elevation.cell_size_m(self.world.metres_per_unit)
        ratio, detail_m = step_m / cell_m, max(step_m, self.elevation.resolution_m or 0.0)
        stride = int(2 ** np.clip(np.floor(np.log2(EXACT_SPACING_M / step_m)), 0, np.log2(EXACT_STRIDE)))
        for name, value in {
            "step_m": step_m, "level": max(int(np.rint(np.log2(detail_m / cell_m))), 0), "cells_per_step": ratio, "stride": stride,
        }.items():  # fmt: skip
            object.__setattr__(self, name, value)

    def window(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> SurfaceWindow:
        """The nodes of a window, in a frame."""
        height, there = self.heights(row0, col0, rows, cols)
        exact_rows, exact_cols, x, y = self.exact_nodes(row0, col0, rows, cols, self.stride)
        point, up = self.world.ground(self.grid.crs, x, y)
        exact = np.concatenate([frame.points_from_earth(point), frame.directions_from_earth(up)], axis=-1)
        position = _positions(exact, exact_rows, exact_cols, self.stride, row0, col0, height)
        there &= np.isfinite(position[..., 2])
        centre = np.array([0.0, 0.0, -np.inf]) if self.world.flat else frame.points_from_earth(np.zeros(3))
        return SurfaceWindow(row0, col0, height, there, position, centre)

    def height_window(self, row0: int, col0: int, rows: int, cols: int) -> HeightWindow:
        """The nodes of a window without their points, in bands: windows may be large."""
        height, there = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.bool_)
        for start in range(0, rows, SURFACE_BAND_ROWS):
            band = slice(start, min(start + SURFACE_BAND_ROWS, rows))
            height[band], there[band] = self.heights(row0 + start, col0, band.stop - start, cols)
        there &= np.isfinite(height)
        return HeightWindow(row0, col0, height, there)

    def positions(self, row: np.ndarray, col: np.ndarray, height_m: np.ndarray, frame: LocalFrame) -> np.ndarray:
        """Frame points (n, 3) float64 of single nodes with their heights: the same as a window's."""
        if not len(row):
            return np.zeros((0, 3))
        row0, col0 = int(row.min()), int(col.min())
        shape = int(row.max()) - row0 + 1, int(col.max()) - col0 + 1
        exact_rows, exact_cols, x, y = self.exact_nodes(row0, col0, *shape, self.stride)
        point, up = self.world.ground(self.grid.crs, x, y)
        exact = np.concatenate([frame.points_from_earth(point), frame.directions_from_earth(up)], axis=-1)
        return _scattered(exact, exact_rows, exact_cols, self.stride, row.astype(np.int64), col.astype(np.int64), height_m)

    def along(self, axis_earth: np.ndarray, origin_earth_m: np.ndarray, row0: int, col0: int, height_m: np.ndarray) -> np.ndarray:
        """Coordinates (rows, cols) float32, metres, of a window's nodes with their heights, along an earth-fixed unit axis."""
        rows, cols = height_m.shape
        first_row, first_col, x, y = self.exact_nodes(row0, col0, rows, cols, self.stride)
        point, up = self.world.ground(self.grid.crs, x, y)
        exact = np.stack([(point - origin_earth_m) @ axis_earth, up @ axis_earth], axis=-1)
        out = np.empty((rows, cols), np.float32)
        for start in range(0, rows, SURFACE_BAND_ROWS):
            band = slice(start, min(start + SURFACE_BAND_ROWS, rows))
            count = band.stop - start
            placed = interpolated(exact, first_row, first_col, self.stride, row0 + start, col0, count, cols)
            _add_height(placed, height_m[band], out[band])
        return out

    def heights(self, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Heights in metres (float32) of a window's nodes, and where there is a surface."""
        if self.grid.refines:
            coarser = Surface(self.world, self.elevation, self.grid.coarser(1))
            last_row, last_col = (row0 + rows) // 2, (col0 + cols) // 2
            height, there = coarser.heights(row0 // 2, col0 // 2, last_row - row0 // 2 + 1, last_col - col0 // 2 + 1)
            return _refined(height, there, row0 % 2, col0 % 2, rows, cols)
        stride = self.stride
        exact_rows, exact_cols, x, y = self.exact_nodes(row0, col0, rows, cols, stride)
        cell = self.cells_of(x, y)
        if cell is None:  # the raster's longitudes break inside: no smooth mapping to interpolate
            stride = 1
            exact_rows, exact_cols, x, y = self.exact_nodes(row0, col0, rows, cols, stride)
            cell = self.cells_of(x, y, everywhere=True)
            assert cell is not None
        located = interpolated(np.stack(cell, axis=-1), exact_rows, exact_cols, stride, row0, col0, rows, cols)
        return self.elevation.heights_at(self.level, located[..., 0], located[..., 1])

    def exact_nodes(self, row0: int, col0: int, rows: int, cols: int, stride: int) -> tuple[int, int, np.ndarray, np.ndarray]:
        """First exact row and column (in strides), and x, y of the exact nodes that a window needs."""
        first_row, first_col = row0 // stride - 1, col0 // stride - 1
        last_row, last_col = (row0 + rows - 1) // stride + 2, (col0 + cols - 1) // stride + 2
        row = np.arange(first_row, last_row + 1) * stride
        col = np.arange(first_col, last_col + 1) * stride
        x, y = np.meshgrid(self.grid.x(col), self.grid.y(row))
        return first_row, first_col, x, y

    def cells_of(self, x: np.ndarray, y: np.ndarray, everywhere: bool = False) -> tuple[np.ndarray, np.ndarray] | None:
        """Row and column in the raster; ``None`` where its longitudes are not continuous (unless ``everywhere``)."""
        source = self.elevation.crs
        if self.grid.crs != source:
            if source.is_geographic:
                x, y = self.world.lon_lat(self.grid.crs, x, y)
            else:
                x, y = transformer(self.grid.crs, source).transform(x, y)
                outside = ~(np.isfinite(x) & np.isfinite(y))
                x, y = np.where(outside, np.nan, x), np.where(outside, np.nan, y)
        if source.is_geographic:
            middle = float(self.elevation.xy(0, (self.elevation.cols - 1) / 2)[0])
            if everywhere:
                x = x + 360.0 * np.rint((middle - x) / 360.0)
            else:
                x = np.unwrap(np.unwrap(x, period=360.0, axis=1), period=360.0, axis=0)
                steps = (np.abs(np.diff(x, axis=axis)).max(initial=0.0) for axis in (0, 1))
                if np.isfinite(x).all() and max(steps) > 20.0:
                    return None
                centre = x[x.shape[0] // 2, x.shape[1] // 2]
                x = x + 360.0 * np.rint((middle - centre) / 360.0)
        return self.elevation.cell_of(x, y)


def step_at_anchor_m(world: World, grid: Grid) -> float:
    """Ground distance between neighbouring nodes at the anchor, metres: the root of a quad's area.

    One figure for the level, so that nothing is decided per tile.
    """
    if world.flat:
        return grid.step * world.metres_per_unit * float(np.sqrt(grid.stretch))
    if grid.crs == world.crs:
        x, y = world.anchor_x, world.anchor_y
    else:
        x, y = transformer(LONGITUDE_LATITUDE, grid.crs).transform(world.anchor_lon_deg, world.anchor_lat_deg)
    half = grid.step / 2
    down = half * grid.stretch
    point, _ = world.ground(grid.crs, np.array([x - half, x + half, x, x]), np.array([y, y, y - down, y + down]))
    size = np.linalg.norm(point[1] - point[0]) * np.linalg.norm(point[3] - point[2])
    return float(np.sqrt(size))


def map_pixel_m(world: World, view: MapView) -> float:
    """Side of a map's pixels on the ground at the anchor, metres: the root of a pixel's area."""
    return step_at_anchor_m(world, view.grid) * float(np.sqrt(view.row_step * view.col_step))


@compiled
def _refined(height, there, row0, col0, rows, cols):
    """Heights and where there is a surface (rows, cols) at nodes, their quads' middles and the middles of their sides, from (row0,
    col0) on, 0 or 1. Quads are cut along their higher diagonals (``terrain.ground.sheet``).
    """
    out = np.empty((rows, cols), np.float32)
    shown = np.empty((rows, cols), np.bool_)
    for i in range(rows):
        top, bottom = (row0 + i) // 2, (row0 + i + 1) // 2
        for j in range(cols):
            left, right = (col0 + j) // 2, (col0 + j + 1) // 2
            falling = 0.5 * (np.float64(height[top, left]) + height[bottom, right])
            rising = 0.5 * (np.float64(height[top, right]) + height[bottom, left])
            out[i, j] = rising if rising > falling or np.isnan(falling) else falling
            shown[i, j] = (there[top, left] and there[bottom, right]) or (there[top, right] and there[bottom, left])
    return out, shown


@compiled
def cubic_weights(t):
    """Lagrange weights of the nodes -1, 0, 1, 2 at ``t`` in [0, 1)."""
    return (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


@compiled
def interpolated(exact, first_row, first_col, stride, row0, col0, rows, cols):
    """(rows, cols, k) values of a window from (m, n, k) exact ones every ``stride`` nodes; sums in a fixed order."""
    kinds = exact.shape[2]
    out = np.empty((rows, cols, kinds))
    along = np.empty((exact.shape[1], kinds))
    weights = np.empty((stride, 4))  # of the nodes between two exact ones
    for n in range(stride):
        weights[n, 0], weights[n, 1], weights[n, 2], weights[n, 3] = cubic_weights(n / stride)
    for i in range(rows):
        coarse = (row0 + i) // stride
        w = cubic_weights((row0 + i - coarse * stride) / stride)
        m = coarse - first_row
        for n in range(exact.shape[1]):
            for k in range(kinds):
                if w[1] == 1.0:  # an exact row: zero weights must not carry a neighbour's NaN
                    along[n, k] = exact[m, n, k]
                else:
                    along[n, k] = (
                        w[0] * exact[m - 1, n, k] + w[1] * exact[m, n, k] + w[2] * exact[m + 1, n, k] + w[3] * exact[m + 2, n, k]
                    )
        for coarse in range(col0 // stride, (col0 + cols - 1) // stride + 1):
            n, at = coarse - first_col, coarse * stride - col0
            begin, end = max(at, 0), min(at + stride, cols)
            for k in range(kinds):
                a, b = along[n - 1, k], along[n, k]
                c, d = along[n + 1, k], along[n + 2, k]
                if begin == at:
                    out[i, at, k] = b
                for j in range(max(begin, at + 1), end):
                    v = weights[j - at]
                    out[i, j, k] = v[0] * a + v[1] * b + v[2] * c + v[3] * d
    return out


@compiled
def _add_height(placed, height, out):
    """Put coordinates (rows, cols) at the ends of heights: of their feet, and by how much they change per metre (rows, cols, 2)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = placed[i, j, 0] + np.float64(height[i, j]) * placed[i, j, 1]


@compiled
def _positions(exact, first_row, first_col, stride, row0, col0, height):
    """Frame points (rows, cols, 3): the ground at height 0 plus the height along the vertical there."""
    rows, cols = height.shape
    placed = interpolated(exact, first_row, first_col, stride, row0, col0, rows, cols)
    out = np.empty((rows, cols, 3))
    for i in range(rows):
        for j in range(cols):
            h = np.float64(height[i, j])
            for k in range(3):
                out[i, j, k] = placed[i, j, k] + h * placed[i, j, k + 3]
    return out


@compiled
def _scattered(exact, first_row, first_col, stride, row, col, height):
    """As ``_positions``, for single nodes; sums in the same order, so that the bits are the same."""
    out = np.empty((row.size, 3))
    for n in range(row.size):
        m, w = row[n] // stride, cubic_weights((row[n] - row[n] // stride * stride) / stride)
        p, v = col[n] // stride, cubic_weights((col[n] - col[n] // stride * stride) / stride)
        m, p = m - first_row, p - first_col
        for k in range(3):
            ground = _cubic(exact, m, p, w, v, k)
            out[n, k] = ground + np.float64(height[n]) * _cubic(exact, m, p, w, v, k + 3)
    return out


@compiled
def _cubic(exact, m, p, w, v, k):
    if v[1] == 1.0:
        return _cubic_down(exact, m, p, w, k)
    return (
        v[0] * _cubic_down(exact, m, p - 1, w, k) + v[1] * _cubic_down(exact, m, p, w, k)
        + v[2] * _cubic_down(exact, m, p + 1, w, k) + v[3] * _cubic_down(exact, m, p + 2, w, k)
    )  # fmt: skip


@compiled
def _cubic_down(exact, m, n, w, k):
    if w[1] == 1.0:
        return exact[m, n, k]
    return w[0] * exact[m - 1, n, k] + w[1] * exact[m, n, k] + w[2] * exact[m + 1, n, k] + w[3] * exact[m + 2, n, k]
