"""Build the drawn surface: heights at the nodes of a map grid, and the nodes' points in a local frame.

The position of a node, in the raster and on earth at height 0, is computed exactly on every ``stride``-th node of the grid only:
the exact nodes. Cubic Lagrange interpolation gives the positions of the others. The mapping is so smooth that the error is below a
millimetre. Exact nodes are counted from the grid's origin, not from the window. So a node has bit-identical coordinates in all
windows that share a frame.

Rim nodes lie just beyond the raster. They cast shadows and are not visible (``Elevation.heights_with_rim``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.geo.grid import Grid, MapView, step_at_anchor_m
from skugga.terrain.geo.world import LocalFrame, World, is_longitude_latitude, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.height_tiles import HeightsAndRim, tiled_heights
from skugga.terrain.ground.sheet import Sheet, sheet_of

EXACT_SPACING_M = 16000.0
"""Maximum distance between exactly computed nodes, metres: the cubic's error is then below 0.1 mm on the globe."""

MAX_CUBIC_ERROR_M = 1e-3
"""Maximum error of the cubics on a small body in metres, which limits the distance between exactly computed nodes there."""

EXACT_STRIDE = 64
"""Maximum distance between exactly computed nodes, in nodes."""


@dataclass(frozen=True, eq=False)
class HeightWindow:
    """Nodes [row0, row0 + rows) x [col0, col0 + cols) of a grid.

    Attributes
    ----------
    row0, col0
        First row and column.
    height_m
        float32 (rows, cols), metres. Holes are filled; NaN off the data. If rim nodes are included, ground continues for one node
        beyond the raster.
    valid
        Valid mask (rows, cols): whether the surface is visible. Filled holes and rim nodes are not valid.
    """

    row0: int
    col0: int
    height_m: np.ndarray
    valid: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.height_m.shape
        return rows, cols


@dataclass(frozen=True, eq=False)
class RefinedWindow:
    """Nodes of a refined grid (``Grid.refined``), whose heights are interpolated on first use from a coarser grid's window.

    Attributes
    ----------
    row0, col0
        First row and column.
    shape
        Rows and columns.
    coarser
        Window of the grid with half as many nodes per side, whose nodes surround those of this window.
    """

    row0: int
    col0: int
    shape: tuple[int, int]
    coarser: HeightWindow

    @cached_property
    def height_m(self) -> np.ndarray:
        """Heights (rows, cols) float32, metres."""
        return _refine(self.coarser.height_m, self.row0 % 2, self.col0 % 2, *self.shape)

    @cached_property
    def valid(self) -> np.ndarray:
        """Valid mask (rows, cols)."""
        return _refine_valid(self.coarser.valid, self.row0 % 2, self.col0 % 2, *self.shape)


NodeHeights = HeightWindow | RefinedWindow


@dataclass(frozen=True, eq=False)
class SurfaceWindow(HeightWindow):
    """A ``HeightWindow`` with the nodes' points in a local frame.

    Attributes
    ----------
    position_frame_m
        float64 (rows, cols, 3), metres; NaN where the height is missing.
    centre_frame_m
        (3,): the point that up vectors point away from: the earth's centre, or in a flat world a point infinitely far below.
    rim
        The rim nodes, which lie beyond the raster, cast shadows and are not visible; ``None`` without any.
    is_cut_nw_se
        The diagonals along which quads are cut (``Sheet``); ``None``: those that follow from the heights.
    """

    position_frame_m: np.ndarray
    centre_frame_m: np.ndarray
    rim: RimNodes | None = None
    is_cut_nw_se: np.ndarray | None = None

    @cached_property
    def sheet(self) -> Sheet:
        """The nodes as a grid mesh."""
        if self.is_cut_nw_se is None:
            return sheet_of(self.position_frame_m, self.height_m)
        return Sheet(self.position_frame_m, self.is_cut_nw_se)

    @cached_property
    def with_rim(self) -> SurfaceWindow:
        """The ground that casts shadows: this window with its rim nodes.

        Visible quads are cut along the same diagonals as in ``sheet``, so that no triangle shades its own points.
        """
        if self.rim is None:
            return self
        height, position = self.height_m.copy(), self.position_frame_m.copy()
        at = self.rim.row, self.rim.col
        height[at], position[at] = self.rim.height_m, self.rim.position_frame_m
        has_height = np.isfinite(self.height_m).astype(np.uint8)
        is_visible = has_height[:-1, :-1] + has_height[:-1, 1:] + has_height[1:, :-1] + has_height[1:, 1:] >= 3
        is_cut_nw_se = np.where(is_visible, self.sheet.is_cut_nw_se, sheet_of(position, height).is_cut_nw_se)
        return replace(self, height_m=height, position_frame_m=position, rim=None, is_cut_nw_se=is_cut_nw_se)


class RimNodes(NamedTuple):
    """The n rim nodes of a window: nodes just beyond the raster that cast shadows and are not visible.

    Attributes
    ----------
    row, col
        (n,): rows and columns in the window.
    height_m
        float32 (n,), metres.
    position_frame_m
        float64 (n, 3), metres.
    """

    row: np.ndarray
    col: np.ndarray
    height_m: np.ndarray
    position_frame_m: np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of a raster on the nodes of a grid.

    Attributes
    ----------
    world
        The world that the raster lies in.
    elevation
        The raster.
    grid
        The grid.
    step_m
        Distance between neighbouring nodes at the anchor, metres.
    lod
        Level of detail that heights are read from: its cells are ``2**lod`` raster cells a side.
    cells_per_step
        Number of raster cells between neighbouring nodes.
    stride
        Distance between exactly computed nodes, in nodes.
    """

    world: World
    elevation: Elevation
    grid: Grid
    step_m: float = field(init=False)
    lod: int = field(init=False)
    cells_per_step: float = field(init=False)
    stride: int = field(init=False)

    def __post_init__(self) -> None:
        steps = _resolve_steps(self.world, self.elevation, self.grid)
        for name, value in zip(("step_m", "lod", "cells_per_step", "stride"), steps, strict=True):
            object.__setattr__(self, name, value)

    def window(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> SurfaceWindow:
        """Return the heights and frame points of the ``rows`` x ``cols`` nodes from (``row0``, ``col0``) on."""
        height, valid, is_rim = self._heights_and_rim(row0, col0, rows, cols)
        exact, exact_rows, exact_cols = self.exact_verticals(row0, col0, rows, cols, frame)
        position = _positions(exact, exact_rows, exact_cols, self.stride, row0, col0, height)
        valid &= np.isfinite(position[..., 2])
        centre = np.array([0.0, 0.0, -np.inf]) if self.world.flat else frame.points_from_earth(np.zeros(3))
        if is_rim is None:
            return SurfaceWindow(row0, col0, height, valid, position, centre)
        row, col = np.nonzero(is_rim)
        rim = RimNodes(row, col, height[row, col], position[row, col])
        height[row, col], position[row, col] = np.nan, np.nan
        return SurfaceWindow(row0, col0, height, valid, position, centre, rim)

    def exact_verticals(self, row0: int, col0: int, rows: int, cols: int, frame: LocalFrame) -> tuple[np.ndarray, int, int]:
        """Return points of height 0 and unit up vectors (m, n, 6), in a frame, of the exact nodes that a window needs.

        Also returns the row and column of the first exact node, divided by ``stride``.
        """
        first_row, first_col, x, y = self.exact_nodes(row0, col0, rows, cols, self.stride)
        point, up = self.world.ground(self.grid.crs, x, y)
        return np.concatenate([frame.points_from_earth(point), frame.directions_from_earth(up)], axis=-1), first_row, first_col

    def height_window(self, row0: int, col0: int, rows: int, cols: int, rim: bool = False) -> NodeHeights:
        """Return the heights of a window's nodes from cached tiles, without frame points.

        ``rim`` is whether to include the heights of rim nodes, which lie beyond the raster and cast shadows.
        """
        if self.grid.refinement_count:
            coarser = Surface(self.world, self.elevation, self.grid.coarser(1))
            window = coarser.height_window(*_coarser_window(row0, col0, rows, cols), rim)
            if isinstance(window, RefinedWindow):
                window = HeightWindow(window.row0, window.col0, window.height_m, window.valid)
            return RefinedWindow(row0, col0, (rows, cols), window)
        height, valid = tiled_heights(self.world, self.elevation, self.grid, self._heights_and_rim, row0, col0, rows, cols, rim)
        valid &= np.isfinite(height)
        return HeightWindow(row0, col0, height, valid)

    def positions(self, row: np.ndarray, col: np.ndarray, height_m: np.ndarray, frame: LocalFrame) -> np.ndarray:
        """Return frame points (n, 3) float64 of single nodes with given heights, bit-identical to those of a window.

        ``row``, ``col`` and ``height_m`` (n,) are the nodes' rows, columns and heights in metres.
        """
        if not len(row):
            return np.zeros((0, 3))
        row0, col0 = int(row.min()), int(col.min())
        rows, cols = int(row.max()) - row0 + 1, int(col.max()) - col0 + 1
        exact, exact_rows, exact_cols = self.exact_verticals(row0, col0, rows, cols, frame)
        out = np.empty((len(row), 3))
        run_in_chunks(
            len(row), _positions_of_nodes, exact, exact_rows, exact_cols, self.stride, row.astype(np.int64),
            col.astype(np.int64), height_m,
            out,
        )  # fmt: skip
        return out

    def points(self, row0: int, col0: int, height_m: np.ndarray, frame: LocalFrame) -> np.ndarray:
        """Return frame points (rows, cols, 3) float64 of a window's nodes with the heights ``height_m`` (rows, cols)."""
        rows, cols = height_m.shape
        return _positions(*self.exact_verticals(row0, col0, rows, cols, frame), self.stride, row0, col0, height_m)

    def write_axis_coordinates(
        self, axis_earth: np.ndarray, origin_earth_m: np.ndarray, windows: list[NodeHeights], out: list[np.ndarray]
    ) -> None:
        """Write the coordinates along one axis of the nodes of windows, at their heights, into float32 arrays, metres.

        ``axis_earth`` (3,) is an earth-fixed unit vector, and ``origin_earth_m`` (3,) the earth-fixed point with coordinate 0.
        ``out`` has an array (rows, cols) of any memory order for each of the ``windows``.
        """
        row0, col0 = min(window.row0 for window in windows), min(window.col0 for window in windows)
        rows = max(window.row0 + window.shape[0] for window in windows) - row0
        cols = max(window.col0 + window.shape[1] for window in windows) - col0
        first_row, first_col, x, y = self.exact_nodes(row0, col0, rows, cols, self.stride)
        point, up = self.world.ground(self.grid.crs, x, y)
        foot, per_metre = (point - origin_earth_m) @ axis_earth, up @ axis_earth
        for window, array in zip(windows, out, strict=True):
            refined = isinstance(window, RefinedWindow)
            height = window.coarser.height_m if isinstance(window, RefinedWindow) else window.height_m
            _write_axis_coordinates(
                foot, per_metre, first_row, first_col, self.stride, window.row0, window.col0, *window.shape, height, refined,
                *_memory_layout(array),
            )  # fmt: skip

    def heights(self, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return heights in metres (float32) of a window's nodes, and the valid mask."""
        height, valid, is_rim = self._heights_and_rim(row0, col0, rows, cols)
        if is_rim is not None:
            height[is_rim] = np.nan
        return height, valid

    def _heights_and_rim(self, row0: int, col0: int, rows: int, cols: int) -> HeightsAndRim:
        """Return the heights of a window's nodes, including rim nodes, the valid mask, and the mask of rim nodes.

        That mask is ``None`` if the window has no rim nodes, which lie beyond the raster and only cast shadows.
        """
        if self.grid.refinement_count:
            coarser, window = Surface(self.world, self.elevation, self.grid.coarser(1)), _coarser_window(row0, col0, rows, cols)
            height, valid, is_rim = coarser._heights_and_rim(*window)
            refined = row0 % 2, col0 % 2, rows, cols
            if is_rim is None:
                return _refine(height, *refined), _refine_valid(valid, *refined), None
            with_rim = _refine(height, *refined)
            height[is_rim] = np.nan
            visible = _refine(height, *refined)
            is_refined_rim = np.isfinite(with_rim) & ~np.isfinite(visible)
            return np.where(is_refined_rim, with_rim, visible), _refine_valid(valid, *refined), is_refined_rim
        stride, padded_window = self.stride, (row0 - 1, col0 - 1, rows + 2, cols + 2)
        exact_rows, exact_cols, x, y = self.exact_nodes(*padded_window, stride)
        cell = self.cells_at(x, y)
        if cell is None:  # longitudes jump within the window, so the mapping is not smooth enough to interpolate
            stride = 1
            exact_rows, exact_cols, x, y = self.exact_nodes(*padded_window, stride)
            cell = self.cells_at(x, y, everywhere=True)
            assert cell is not None
        exact = np.stack(cell, axis=-1)
        if self.elevation.surface == "blocks" or self.elevation.covers_cells(self.lod, *cell):
            cells = interpolated(exact, exact_rows, exact_cols, stride, row0, col0, rows, cols)
            return *self.elevation.heights_at(self.lod, cells[0], cells[1]), None
        cells = interpolated(exact, exact_rows, exact_cols, stride, *padded_window)
        height, valid, is_rim = self.elevation.heights_with_rim(self.lod, cells[0], cells[1])
        return height, valid, is_rim if is_rim.any() else None

    def exact_nodes(self, row0: int, col0: int, rows: int, cols: int, stride: int) -> tuple[int, int, np.ndarray, np.ndarray]:
        """Return the row and column of the first exact node, divided by ``stride``, and x and y of the exact nodes.

        These are the exact nodes that cubic interpolation of a window needs. x and y (m, n) are in CRS units.
        """
        first_row, first_col = row0 // stride - 1, col0 // stride - 1
        last_row, last_col = (row0 + rows - 1) // stride + 2, (col0 + cols - 1) // stride + 2
        row = np.arange(first_row, last_row + 1) * stride
        col = np.arange(first_col, last_col + 1) * stride
        x, y = np.meshgrid(self.grid.x(col), self.grid.y(row))
        return first_row, first_col, x, y

    def cells_at(self, x: np.ndarray, y: np.ndarray, everywhere: bool = False) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the (fractional) rows and columns in the raster of coordinates in the grid's CRS.

        Returns ``None`` if longitudes jump between neighbouring coordinates, so that interpolation would fail. With ``everywhere``
        it returns rows and columns even then.
        """
        source = self.elevation.crs
        if self.grid.crs != source:
            if is_longitude_latitude(source):
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


def _coarser_window(row0: int, col0: int, rows: int, cols: int) -> tuple[int, int, int, int]:
    """Return the window of the grid with half as many nodes per side whose nodes surround those of a window.

    A window is its first row, first column, number of rows and number of columns.
    """
    top, left = row0 // 2, col0 // 2
    return top, left, (row0 + rows) // 2 - top + 1, (col0 + cols) // 2 - left + 1


def _exact_spacing_m(world: World) -> float:
    """Return the maximum distance between exactly computed nodes in metres.

    The error of cubic Lagrange interpolation on a circle of radius r, between points at a distance s, is at most
    3 / 128 r (s / r)^4.
    """
    if world.flat:
        return EXACT_SPACING_M
    min_radius_m = world.ellipsoid.b**2 / world.ellipsoid.a  # of curvature: along the meridian at the equator
    return float(min(EXACT_SPACING_M, (128.0 / 3.0 * MAX_CUBIC_ERROR_M * min_radius_m**3) ** 0.25))


@cached("scene", MIB, size_of=lambda _: 512)
def _resolve_steps(world: World, elevation: Elevation, grid: Grid) -> tuple[float, int, float, int]:
    """Return ``step_m``, ``lod``, ``cells_per_step`` and ``stride`` of a surface.

    The result is cached, since a new ``Surface`` is made for every part of the ground.
    """
    step_m, cell_m = step_at_anchor_m(world, grid), elevation.cell_size_m(world.metres_per_unit)
    detail_m = max(step_m, elevation.resolution_m or 0.0)
    stride = int(2 ** np.clip(np.floor(np.log2(_exact_spacing_m(world) / step_m)), 0, np.log2(EXACT_STRIDE)))
    return step_m, max(int(np.rint(np.log2(detail_m / cell_m))), 0), step_m / cell_m, stride


def map_pixel_m(world: World, view: MapView) -> float:
    """Return the side of a map's pixels on the ground at the anchor, metres: the square root of a pixel's area."""
    return step_at_anchor_m(world, view.grid) * view.pixel_share * float(np.sqrt(view.row_step * view.col_step))


@compiled
def _refine(height, row0, col0, rows, cols):
    """Return heights (rows, cols) float32 on the refined grid, which has twice as many nodes per side.

    Its nodes are those of the coarser grid, the centres of their quads, and the midpoints of the quads' sides. ``row0`` and
    ``col0``, each 0 or 1, are the first refined row and column. Quads are cut along their higher diagonals
    (``skugga.terrain.ground.sheet``).
    """
    out = np.empty((rows, cols), np.float32)
    for i in range(rows):
        refine_row(height, row0 + i, col0, out[i])
    return out


@internal
def refine_row(height, row, col0, out):
    """Fill ``out`` with the heights of row ``row`` of the refined grid, from its column ``col0`` (0 or 1) on.

    ``height`` has the heights of the coarser grid. The loops compile to vector instructions.
    """
    above, below = height[row // 2], height[(row + 1) // 2]
    if col0 == 1:
        out[0] = _quad_middle(above[0], above[1], below[0], below[1]) if row % 2 else _middle(above[0], above[1])
    pairs = (out.size - col0) // 2
    at, last = out[col0 : col0 + 2 * pairs], col0 + 2 * pairs
    west, east = above[col0 : col0 + pairs], above[col0 + 1 : col0 + 1 + pairs]
    if row % 2:
        south_west, south_east = below[col0 : col0 + pairs], below[col0 + 1 : col0 + 1 + pairs]
        for j in range(pairs):
            at[2 * j] = _middle(west[j], south_west[j])
            at[2 * j + 1] = _quad_middle(west[j], east[j], south_west[j], south_east[j])
    else:
        for j in range(pairs):
            at[2 * j] = west[j]
            at[2 * j + 1] = _middle(west[j], east[j])
    if last < out.size:
        out[last] = _middle(above[col0 + pairs], below[col0 + pairs])


@internal
def _middle(a, b):
    return np.float32(0.5 * (np.float64(a) + np.float64(b)))


@internal
def _quad_middle(west, east, south_west, south_east):
    """Return the height at the centre of a quad, on its higher diagonal."""
    falling = 0.5 * (np.float64(west) + np.float64(south_east))
    rising = 0.5 * (np.float64(east) + np.float64(south_west))
    return np.float32(rising if (rising > falling) | np.isnan(falling) else falling)


@compiled
def _refine_valid(valid, row0, col0, rows, cols):
    """Return the valid mask (rows, cols) of the nodes of ``_refine``.

    A midpoint of a side is valid if both ends of the side are, a centre if both ends of one of its quad's diagonals are.
    """
    out = np.empty((rows, cols), np.bool_)
    for i in range(rows):
        _refine_valid_row(valid[(row0 + i) // 2], valid[(row0 + i + 1) // 2], col0, out[i])
    return out


@internal
def _refine_valid_row(above, below, col0, out):
    if col0 == 1:
        out[0] = (above[0] & below[1]) | (above[1] & below[0])
    pairs = (out.size - col0) // 2
    at, last = out[col0 : col0 + 2 * pairs], col0 + 2 * pairs
    nw, ne = above[col0 : col0 + pairs], above[col0 + 1 : col0 + 1 + pairs]
    sw, se = below[col0 : col0 + pairs], below[col0 + 1 : col0 + 1 + pairs]
    for j in range(pairs):
        at[2 * j] = nw[j] & sw[j]
        at[2 * j + 1] = (nw[j] & se[j]) | (ne[j] & sw[j])
    if last < out.size:
        out[last] = above[col0 + pairs] & below[col0 + pairs]


@internal
def cubic_weights(t):
    """Return the weights of the nodes at -1, 0, 1 and 2 in cubic Lagrange interpolation at ``t`` in [0, 1)."""
    return (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


@compiled
def interpolated(exact, first_row, first_col, stride, row0, col0, rows, cols):
    """Return values (k, rows, cols) at a window's nodes, interpolated by cubics from those of exact nodes (m, n, k).

    Exact nodes are ``stride`` nodes apart. The first one has row ``first_row * stride`` and column ``first_col * stride``. Sums are
    in a fixed order, so that results are bit-identical in all windows.
    """
    components = exact.shape[2]
    out = np.empty((components, rows, cols))
    row_values = np.empty(exact.shape[1])
    weights = np.empty((4, stride))  # for the nodes between two exact ones
    for n in range(stride):
        weights[0, n], weights[1, n], weights[2, n], weights[3, n] = cubic_weights(n / stride)
    for i in range(rows):
        exact_index = (row0 + i) // stride
        m, share = exact_index - first_row, (row0 + i - exact_index * stride) / stride
        for k in range(components):
            _interpolate_row(exact[:, :, k], m, share, row_values)
            for exact_index in range(col0 // stride, (col0 + cols - 1) // stride + 1):
                n, at = exact_index - first_col, exact_index * stride - col0
                begin, end = max(at, 0), min(at + stride, cols)
                _interpolate_between(row_values, n - 1, weights, begin - at, out[k, i, begin:end])
                if begin == at:  # an exact column: zero weights must not carry a neighbour's NaN
                    out[k, i, at] = row_values[n]
    return out


AXIS_STRIP_ROWS = 64
"""Rows that ``_write_axis_coordinates`` processes at a time, so that a column-major array is written as fast as others."""


def _memory_layout(array: np.ndarray) -> tuple[np.ndarray, int, int, int]:
    """Return the flat memory behind an array (rows, cols), the array's offset in it, and the array's row and column strides.

    Offset and strides are in values, not in bytes. One of the strides is 1 or -1.
    """
    owner = array if array.base is None else array.base
    assert isinstance(owner, np.ndarray)
    start = (array.__array_interface__["data"][0] - owner.__array_interface__["data"][0]) // array.itemsize
    return owner.reshape(-1), start, array.strides[0] // array.itemsize, array.strides[1] // array.itemsize


COLUMN_BLOCK = 8
"""Columns written at a time into a column-major array."""


@compiled
def _write_axis_coordinates(
    foot, per_metre, first_row, first_col, stride, row0, col0, rows, cols, height, refined, flat, start, down, right
):
    """Write the coordinates (rows, cols) of nodes at their heights into an array described by ``_memory_layout``.

    ``foot`` (m, n) are the coordinates of exact nodes at height 0, and ``per_metre`` (m, n) their change per metre of height. Sums
    follow the order of ``interpolated``. ``height`` has the heights of the nodes or, if ``refined``, those of the coarser grid.
    """
    refined_heights = np.empty(cols, np.float32)
    feet, slopes = np.empty(foot.shape[1]), np.empty(foot.shape[1])
    tops = np.empty((AXIS_STRIP_ROWS, cols), np.float32)
    weights = np.empty((4, stride))
    for n in range(stride):
        weights[0, n], weights[1, n], weights[2, n], weights[3, n] = cubic_weights(n / stride)
    for top in range(0, rows, AXIS_STRIP_ROWS):
        count = min(AXIS_STRIP_ROWS, rows - top)
        for i in range(count):
            exact_row = (row0 + top + i) // stride
            m, share = exact_row - first_row, (row0 + top + i - exact_row * stride) / stride
            _interpolate_row(foot, m, share, feet)
            _interpolate_row(per_metre, m, share, slopes)
            if refined:
                refine_row(height, row0 % 2 + top + i, col0 % 2, refined_heights)
            heights, row_tops = refined_heights if refined else height[top + i], tops[i]
            for first in range(col0 // stride * stride, col0 + cols, stride):
                n = first // stride - first_col
                begin, end = max(first, col0) - first, min(first + stride, col0 + cols) - first
                at = first + begin - col0
                _write_node_coordinates(feet, slopes, n - 1, weights, begin, heights, at, row_tops, end - begin)
                if begin == 0:  # an exact column: zero weights must not carry a neighbour's NaN
                    row_tops[at] = feet[n] + np.float64(heights[at]) * slopes[n]
        if abs(right) == 1:
            for i in range(count):
                _write_contiguous(tops[i], flat, start + (top + i) * down, right)
        else:
            _write_columns(tops, count, flat, start + top * down, down, right)


@internal
def _interpolate_row(exact, m, share, out):
    """Interpolate a row's values (n,) at the exact columns, between the values of exact rows (m, n).

    The row lies at the fraction ``share`` of the way from exact row ``m`` to the next one.
    """
    w = cubic_weights(share)
    for n in range(out.size):
        if w[1] == 1.0:  # an exact row
            out[n] = exact[m, n]
        else:
            out[n] = w[0] * exact[m - 1, n] + w[1] * exact[m, n] + w[2] * exact[m + 1, n] + w[3] * exact[m + 2, n]


# The next loops are written so that they compile to vector instructions: slices have known lengths, and rows are contiguous.


@internal
def _interpolate_between(values, n, weights, first, out):
    """Interpolate the nodes of a row between the exact columns ``n`` + 1 and ``n`` + 2.

    The first node is the ``first``-th after exact column ``n`` + 1.
    """
    a, b, c, d = values[n], values[n + 1], values[n + 2], values[n + 3]
    w0, w1 = weights[0][first : first + out.size], weights[1][first : first + out.size]
    w2, w3 = weights[2][first : first + out.size], weights[3][first : first + out.size]
    for j in range(out.size):
        out[j] = w0[j] * a + w1[j] * b + w2[j] * c + w3[j] * d


@internal
def _write_node_coordinates(feet, slopes, n, weights, first, height, at, out, count):
    """Write the coordinates of ``count`` nodes of a row, at their heights, between the exact columns ``n`` + 1 and ``n`` + 2.

    The first node is the ``first``-th after exact column ``n`` + 1, in column ``at`` of the window.
    """
    a, b, c, d = feet[n], feet[n + 1], feet[n + 2], feet[n + 3]
    e, f, g, h = slopes[n], slopes[n + 1], slopes[n + 2], slopes[n + 3]
    for j in range(count):
        k, m = np.uintp(first + j), np.uintp(at + j)  # slices would take longer than so short a loop
        w0, w1, w2, w3 = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
        foot = w0 * a + w1 * b + w2 * c + w3 * d
        slope = w0 * e + w1 * f + w2 * g + w3 * h
        out[m] = foot + np.float64(height[m]) * slope


@compiled
def interpolate_columns(exact, first_col, stride, col0, cols):
    """Return values (m, cols) of ``cols`` columns from ``col0`` on, interpolated by cubics from those of exact columns (m, n)."""
    out = np.empty((exact.shape[0], cols))
    for j in range(cols):
        exact_col = (col0 + j) // stride
        w = cubic_weights((col0 + j - exact_col * stride) / stride)
        n = exact_col - first_col
        for m in range(exact.shape[0]):
            if w[1] == 1.0:
                out[m, j] = exact[m, n]
            else:
                out[m, j] = w[0] * exact[m, n - 1] + w[1] * exact[m, n] + w[2] * exact[m, n + 1] + w[3] * exact[m, n + 2]
    return out


@internal
def interpolate_row_between(exact, m, share, out):
    """Interpolate a row (cols,) by cubics, at the fraction ``share`` of the way from exact row ``m`` to the next exact row."""
    current = exact[m]
    if share == 0.0:  # an exact row
        for j in range(out.size):
            out[j] = current[j]
    else:
        w0, w1, w2, w3 = cubic_weights(share)
        previous, next_row, second_next = exact[m - 1], exact[m + 1], exact[m + 2]
        for j in range(out.size):
            out[j] = w0 * previous[j] + w1 * current[j] + w2 * next_row[j] + w3 * second_next[j]


@internal
def add_heights(foot, slope, height, out):
    """Compute coordinates (cols,) of nodes at their heights from those at height 0 and their change per metre of height."""
    for j in range(height.size):
        out[j] = foot[j] + np.float64(height[j]) * slope[j]


@internal
def _write_contiguous(values, flat, start, step):
    """Write values into consecutive elements of an array, from ``start`` forwards (``step`` 1) or backwards (-1)."""
    count = values.size
    if step == 1:
        target = flat[start : start + count]
        for n in range(count):
            target[n] = values[n]
    else:
        target = flat[start - count + 1 : start + 1]
        for n in range(count):
            target[count - 1 - n] = values[n]


@internal
def _write_columns(values, count, flat, start, down, right):
    """Write the first ``count`` rows of values into a column-major array, in blocks that fill whole cache lines."""
    for first in range(0, values.shape[1], COLUMN_BLOCK):
        last = min(first + COLUMN_BLOCK, values.shape[1])
        for i in range(count):
            at = start + i * down + first * right
            for j in range(first, last):
                flat[np.uintp(at)] = values[np.uintp(i), np.uintp(j)]
                at += right


@compiled
def _positions(exact, first_row, first_col, stride, row0, col0, height):
    """Return frame points (rows, cols, 3): the ground at height 0 plus the height along the up vector there."""
    rows, cols = height.shape
    verticals = interpolated(exact, first_row, first_col, stride, row0, col0, rows, cols)
    out = np.empty((rows, cols, 3))
    for i in range(rows):
        for j in range(cols):
            h = np.float64(height[i, j])
            for k in range(3):
                out[i, j, k] = verticals[k, i, j] + h * verticals[k + 3, i, j]
    return out


@compiled
def _positions_of_nodes(first, last, exact, first_row, first_col, stride, row, col, height, out):
    """Write the frame points of the nodes [first, last) of a list into ``out`` (n, 3).

    Sums have the same order as in ``_positions``, so the results are bit-identical.
    """
    for n in range(first, last):
        m, w = row[n] // stride, cubic_weights((row[n] - row[n] // stride * stride) / stride)
        p, v = col[n] // stride, cubic_weights((col[n] - col[n] // stride * stride) / stride)
        m, p = m - first_row, p - first_col
        for k in range(3):
            ground = _cubic(exact, m, p, w, v, k)
            out[n, k] = ground + np.float64(height[n]) * _cubic(exact, m, p, w, v, k + 3)


@internal
def _cubic(exact, m, p, w, v, k):
    if v[1] == 1.0:
        return _cubic_down(exact, m, p, w, k)
    return (
        v[0] * _cubic_down(exact, m, p - 1, w, k) + v[1] * _cubic_down(exact, m, p, w, k)
        + v[2] * _cubic_down(exact, m, p + 1, w, k) + v[3] * _cubic_down(exact, m, p + 2, w, k)
    )  # fmt: skip


@internal
def _cubic_down(exact, m, n, w, k):
    if w[1] == 1.0:
        return exact[m, n, k]
    return w[0] * exact[m - 1, n, k] + w[1] * exact[m, n, k] + w[2] * exact[m + 1, n, k] + w[3] * exact[m + 2, n, k]
