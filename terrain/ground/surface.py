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
from skugga.terrain.compiled import run_in_chunks
from skugga.terrain.geo.grid import Grid, MapView, step_at_anchor_m
from skugga.terrain.geo.world import LocalFrame, World, is_longitude_latitude, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.height_tiles import HeightsAndRim, tiled_heights
from skugga.terrain.ground.sheet import Sheet, sheet_of
from skugga.terrain.ground.surface_loops import (
    interpolate_nodes,
    refine_heights,
    refine_valid,
    window_points,
    write_axis_coordinates,
    write_node_points,
)

MAX_EXACT_NODE_SPACING_M = 16000.0
"""Maximum distance between exactly computed nodes, metres: the cubic's error is then below 0.1 mm on the globe."""

MAX_CUBIC_ERROR_M = 1e-3
"""Maximum error of the cubics on a small body in metres, which limits the distance between exactly computed nodes there."""

MAX_EXACT_NODE_STRIDE = 64
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
    coarser_window
        Window of the grid with half as many nodes per side, whose nodes surround those of this window.
    """

    row0: int
    col0: int
    shape: tuple[int, int]
    coarser_window: HeightWindow

    @cached_property
    def height_m(self) -> np.ndarray:
        """Heights (rows, cols) float32, metres."""
        return refine_heights(self.coarser_window.height_m, self.row0 % 2, self.col0 % 2, *self.shape)

    @cached_property
    def valid(self) -> np.ndarray:
        """Valid mask (rows, cols)."""
        return refine_valid(self.coarser_window.valid, self.row0 % 2, self.col0 % 2, *self.shape)


NodeHeights = HeightWindow | RefinedWindow


@dataclass(frozen=True, eq=False)
class SurfaceWindow(HeightWindow):
    """A ``HeightWindow`` with the nodes' points in a local frame.

    Attributes
    ----------
    position_frame_m
        float64 (rows, cols, 3), metres; NaN where the height is missing.
    up_origin_frame_m
        (3,): the point that up vectors point away from: the earth's centre, or in a flat world a point infinitely far below.
    rim
        The rim nodes, which lie beyond the raster, cast shadows and are not visible; ``None`` without any.
    is_cut_nw_se
        The diagonals along which quads are cut (``Sheet``); ``None``: those that follow from the heights.
    """

    position_frame_m: np.ndarray
    up_origin_frame_m: np.ndarray
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

    def part(self, rows: slice, cols: slice) -> SurfaceWindow:
        """Return a copy of a part of the window. ``rows`` and ``cols`` are slices of its rows and columns, with both ends."""
        height, valid, position = (
            np.ascontiguousarray(values[rows, cols]) for values in (self.height_m, self.valid, self.position_frame_m)
        )
        rim, cuts = self.rim, self.is_cut_nw_se
        if rim is not None:
            row, col = rim.row - rows.start, rim.col - cols.start
            inside = (row >= 0) & (row < height.shape[0]) & (col >= 0) & (col < height.shape[1])
            rim = RimNodes(row[inside], col[inside], rim.height_m[inside], rim.position_frame_m[inside]) if inside.any() else None
        if cuts is not None:
            cuts = np.ascontiguousarray(cuts[rows.start : rows.stop - 1, cols.start : cols.stop - 1])
        return SurfaceWindow(
            self.row0 + rows.start, self.col0 + cols.start, height, valid, position, self.up_origin_frame_m, rim, cuts
        )


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
        position = window_points(exact, exact_rows, exact_cols, self.stride, row0, col0, height)
        valid &= np.isfinite(position[..., 2])
        centre = np.array([0.0, 0.0, -np.inf]) if self.world.is_flat else frame.points_from_earth(np.zeros(3))
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
        point, up = self.world.points_at_zero_height(self.grid.crs, x, y)
        return np.concatenate([frame.points_from_earth(point), frame.directions_from_earth(up)], axis=-1), first_row, first_col

    def height_window(self, row0: int, col0: int, rows: int, cols: int, includes_rim: bool = False) -> NodeHeights:
        """Return the heights of a window's nodes from cached tiles, without frame points.

        ``includes_rim`` is whether to include the heights of rim nodes, which lie beyond the raster and cast shadows.
        """
        if self.grid.refinement_count:
            coarser = Surface(self.world, self.elevation, self.grid.coarser(1))
            window = coarser.height_window(*_coarser_window(row0, col0, rows, cols), includes_rim)
            if isinstance(window, RefinedWindow):
                window = HeightWindow(window.row0, window.col0, window.height_m, window.valid)
            return RefinedWindow(row0, col0, (rows, cols), window)
        height, valid = tiled_heights(
            self.world, self.elevation, self.grid, self._heights_and_rim, row0, col0, rows, cols, includes_rim
        )
        valid &= np.isfinite(height)
        return HeightWindow(row0, col0, height, valid)

    def node_positions(self, row: np.ndarray, col: np.ndarray, height_m: np.ndarray, frame: LocalFrame) -> np.ndarray:
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
            len(row), write_node_points, exact, exact_rows, exact_cols, self.stride, row.astype(np.int64),
            col.astype(np.int64), height_m,
            out,
        )  # fmt: skip
        return out

    def window_positions(self, row0: int, col0: int, height_m: np.ndarray, frame: LocalFrame) -> np.ndarray:
        """Return frame points (rows, cols, 3) float64 of a window's nodes with the heights ``height_m`` (rows, cols)."""
        rows, cols = height_m.shape
        return window_points(*self.exact_verticals(row0, col0, rows, cols, frame), self.stride, row0, col0, height_m)

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
        point, up = self.world.points_at_zero_height(self.grid.crs, x, y)
        base, slope = (point - origin_earth_m) @ axis_earth, up @ axis_earth
        for window, array in zip(windows, out, strict=True):
            refined = isinstance(window, RefinedWindow)
            height = window.coarser_window.height_m if isinstance(window, RefinedWindow) else window.height_m
            write_axis_coordinates(
                base, slope, first_row, first_col, self.stride, window.row0, window.col0, *window.shape, height, refined,
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
                return refine_heights(height, *refined), refine_valid(valid, *refined), None
            with_rim = refine_heights(height, *refined)
            height[is_rim] = np.nan
            visible = refine_heights(height, *refined)
            is_refined_rim = np.isfinite(with_rim) & ~np.isfinite(visible)
            return np.where(is_refined_rim, with_rim, visible), refine_valid(valid, *refined), is_refined_rim
        stride, padded_window = self.stride, (row0 - 1, col0 - 1, rows + 2, cols + 2)
        exact_rows, exact_cols, x, y = self.exact_nodes(*padded_window, stride)
        cell = self.cells_at(x, y)
        if cell is None:  # longitudes jump within the window, so the mapping is not smooth enough to interpolate
            stride = 1
            exact_rows, exact_cols, x, y = self.exact_nodes(*padded_window, stride)
            cell = self.cells_at(x, y, allow_jumps=True)
            assert cell is not None
        if self.elevation.is_beyond_cells(self.lod, *cell):
            return np.full((rows, cols), np.nan, np.float32), np.zeros((rows, cols), np.bool_), None
        exact = np.stack(cell, axis=-1)
        if self.elevation.surface == "blocks" or self.elevation.covers_cells(self.lod, *cell):
            cells = interpolate_nodes(exact, exact_rows, exact_cols, stride, row0, col0, rows, cols)
            return *self.elevation.heights_at(self.lod, cells[0], cells[1]), None
        cells = interpolate_nodes(exact, exact_rows, exact_cols, stride, *padded_window)
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

    def cells_at(self, x: np.ndarray, y: np.ndarray, allow_jumps: bool = False) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the (fractional) rows and columns in the raster of coordinates in the grid's CRS.

        Returns ``None`` if longitudes jump between neighbouring coordinates, so that interpolation would fail. With ``allow_jumps``
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
            if allow_jumps:
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
    if world.is_flat:
        return MAX_EXACT_NODE_SPACING_M
    min_radius_m = world.ellipsoid.b**2 / world.ellipsoid.a  # of curvature: along the meridian at the equator
    return float(min(MAX_EXACT_NODE_SPACING_M, (128.0 / 3.0 * MAX_CUBIC_ERROR_M * min_radius_m**3) ** 0.25))


@cached("scene", MIB, size_of=lambda _: 512)
def _resolve_steps(world: World, elevation: Elevation, grid: Grid) -> tuple[float, int, float, int]:
    """Return ``step_m``, ``lod``, ``cells_per_step`` and ``stride`` of a surface.

    The result is cached, since a new ``Surface`` is made for every part of the ground.
    """
    step_m, cell_m = step_at_anchor_m(world, grid), elevation.cell_size_m(world.metres_per_unit)
    detail_m = max(step_m, elevation.resolution_m or 0.0)
    stride = int(2 ** np.clip(np.floor(np.log2(_exact_spacing_m(world) / step_m)), 0, np.log2(MAX_EXACT_NODE_STRIDE)))
    return step_m, max(int(np.rint(np.log2(detail_m / cell_m))), 0), step_m / cell_m, stride


def map_pixel_m(world: World, view: MapView) -> float:
    """Return the side of a map's pixels on the ground at the anchor, metres: the square root of a pixel's area."""
    return step_at_anchor_m(world, view.grid) * view.pixel_share * float(np.sqrt(view.row_step * view.col_step))


def _memory_layout(array: np.ndarray) -> tuple[np.ndarray, int, int, int]:
    """Return the flat memory behind an array (rows, cols), the array's offset in it, and the array's row and column strides.

    Offset and strides are in values, not in bytes. One of the strides is 1 or -1.
    """
    owner = array if array.base is None else array.base
    assert isinstance(owner, np.ndarray) and owner.dtype == array.dtype
    start = (array.__array_interface__["data"][0] - owner.__array_interface__["data"][0]) // array.itemsize
    return owner.reshape(-1), start, array.strides[0] // array.itemsize, array.strides[1] // array.itemsize
