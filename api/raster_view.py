"""Cell grids of output rasters: the level's own grid, another raster's grid, or square cells of a given resolution."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from pyproj import CRS
from rasterio.errors import RasterioError

from skugga.api.raster_file import RasterCells
from skugga.terrain.errors import InputError, SourceError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.grid import Grid, MapView, step_at_anchor_m
from skugga.terrain.level.rasters import open_raster
from skugga.terrain.scene import Scene

Bounds = tuple[float, float, float, float]
"""West, south, east and north in units of a CRS."""

ASPECT_TOLERANCE = 1e-6
"""Tolerance of a square cell's aspect ratio."""

MAX_RESOLUTION = 1e8
"""Upper bound of a resolution, CRS units. In metres it is more than twice the earth's circumference."""

MAX_CELLS = 2.0**40
"""Maximum number of cells of an output raster."""


@dataclass(frozen=True)
class CellOrder:
    """Order of a raster's cells relative to a map view of them. The view's rows run from west to east, the northern row first.

    Attributes
    ----------
    is_transposed
        Whether the raster's rows are the view's columns.
    are_rows_reversed, are_cols_reversed
        Whether the raster's first row, or column, is the view's last one.
    """

    is_transposed: bool = False
    are_rows_reversed: bool = False
    are_cols_reversed: bool = False

    def in_raster_order(self, array: np.ndarray) -> np.ndarray:
        """Reorder cells (rows, cols, ...) of the view into the raster's order of rows and columns."""
        cells = array.swapaxes(0, 1) if self.is_transposed else array
        return cells[:: -1 if self.are_rows_reversed else 1, :: -1 if self.are_cols_reversed else 1]


@dataclass(frozen=True, eq=False)
class RasterView:
    """The cell grid of an output raster, and the map view of its cells.

    Attributes
    ----------
    view
        The cells as a map in the raster's CRS, x to the east and y to the north.
    order
        Order of the raster's cells relative to the view.
    crs, transform
        The raster's CRS and geotransform, in GDAL's axis order.
    """

    view: MapView
    order: CellOrder
    crs: CRS
    transform: Affine

    @property
    def shape(self) -> tuple[int, int]:
        """The raster's rows and columns."""
        shape = self.view.rows, self.view.cols
        return shape[::-1] if self.order.is_transposed else shape

    def window_in_raster_order(self, row: int, col: int, array: np.ndarray) -> tuple[int, int, np.ndarray]:
        """Return the first row and column of a window in the raster, and the window's cells in the raster's order.

        ``row`` and ``col`` are the first cell of ``array`` (rows, cols, ...) in the view.
        """
        cells = self.order.in_raster_order(array)
        first_row, first_col = (col, row) if self.order.is_transposed else (row, col)
        rows, cols = self.shape
        if self.order.are_rows_reversed:
            first_row = rows - first_row - cells.shape[0]
        if self.order.are_cols_reversed:
            first_col = cols - first_col - cells.shape[1]
        return first_row, first_col, cells

    def part(self, row: int, col: int, rows: int, cols: int) -> RasterView:
        """Return a rectangular section of the raster, as a raster of its own.

        ``row`` and ``col`` are its first row and column in the view, which may be negative.
        """
        first_row, first_col, _ = self.window_in_raster_order(row, col, np.empty((rows, cols), np.bool_))
        transform = self.transform @ Affine.translation(first_col, first_row)
        return RasterView(self.view.part(row, col, rows, cols), self.order, self.crs, transform)

    def raster_part(self, top: int, left: int, rows: int, cols: int) -> RasterView:
        """Return a rectangular section of the raster as a raster of its own.

        ``top`` and ``left`` are its first row and column in the raster's own order.
        """
        all_rows, all_cols = self.shape
        if self.order.are_rows_reversed:
            top = all_rows - top - rows
        if self.order.are_cols_reversed:
            left = all_cols - left - cols
        return self.part(left, top, cols, rows) if self.order.is_transposed else self.part(top, left, rows, cols)


def raster_view(
    scene: Scene,
    bounds: Bounds | None = None,
    crs: str | None = None,
    resolution: float | None = None,
    like: Path | RasterCells | None = None,
) -> RasterView:
    """Return the cell grid of an output raster.

    Without parameters it is the grid of the level's own raster.

    Parameters
    ----------
    scene
        The level's scene.
    bounds
        West, south, east and north in ``crs``.
    crs
        CRS of the output. The default is the CRS of the level's maps.
    resolution
        Side of square cells, CRS units; their edges lie on multiples of it. The default is the size of the level's cells.
    like
        A raster whose grid is used. It excludes the other parameters.

    Raises
    ------
    InputError
        Parameters exclude each other, or the grid has too many cells or does not overlap the level.
    SourceError
        The raster ``like`` cannot be read, has no CRS, or has a rotated grid.
    """
    if like is not None:
        for name, value in (("bounds", bounds), ("crs", crs), ("resolution", resolution)):
            if value is not None:
                raise InputError.conflict(name, "like")
        return _view_like(scene, cells_of_raster(like) if isinstance(like, Path) else like)
    map_view = scene.view("map", bounds, crs)  # checks the parameters
    target = map_view.grid.crs if isinstance(map_view, MapView) else scene.map_crs
    is_default = crs is None and bounds is None
    if resolution is None and (is_default or target == scene.elevation.crs):
        level_raster = _level_raster_view(scene)
        if level_raster is not None:
            return level_raster if bounds is None else _crop(level_raster, bounds)
    west, south, east, north = bounds or scene.default_bounds(target)
    if resolution is None:
        cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
        resolution = float(f"{cell_m / step_at_anchor_m(scene.world, Grid(target, 0.0, 0.0, 1.0)):.3g}")
    if not 0.0 < resolution <= MAX_RESOLUTION or (east - west) / resolution * (north - south) / resolution > MAX_CELLS:
        raise InputError(
            "resolution",
            resolution,
            f"more than 0 and at most {MAX_RESOLUTION:g} units of {target.name}, with at most 2^40 cells in all",
        )
    col0, row0 = np.floor(west / resolution + 1e-9), np.floor(-north / resolution + 1e-9)
    cols, rows = np.ceil(east / resolution - 1e-9) - col0, np.ceil(-south / resolution - 1e-9) - row0
    grid = Grid(target, resolution / 2.0, -resolution / 2.0, resolution)
    view = MapView(grid, float(row0), float(col0), 1.0, 1.0, int(rows), int(cols))
    west, _, _, north = view.bounds
    return RasterView(view, CellOrder(), target, Affine(resolution, 0.0, west, 0.0, -resolution, north))


def _level_raster_view(scene: Scene) -> RasterView | None:
    """Return the cells of the level's own raster; ``None`` if its rows and columns do not run along the axes of its CRS."""
    elevation = scene.elevation
    return _view_of(RasterCells(elevation.name, elevation.crs, elevation.geotransform, elevation.rows, elevation.cols))


def cells_of_raster(path: Path) -> RasterCells:
    """Return the cell grid of a raster file. Raises ``SourceError``."""
    try:
        with warnings.catch_warnings(action="ignore"), open_raster(str(path)) as dataset:
            crs, transform, (rows, cols) = dataset.crs, dataset.transform, dataset.shape
    except RasterioError:
        raise SourceError(str(path), "cannot be opened", "Use a raster that GDAL reads") from None
    if crs is None:
        raise SourceError(str(path), "no coordinate reference system", "Use a raster with a CRS")
    return RasterCells(str(path), CRS.from_user_input(crs.to_wkt()), transform, rows, cols)


def _view_like(scene: Scene, cells: RasterCells) -> RasterView:
    """Return the grid of another raster.

    Raises ``SourceError`` if it is rotated, ``InputError`` if it does not overlap the level.
    """
    scene.check_crs(cells.name, cells.crs)
    view = _view_of(cells)
    if view is None:
        raise SourceError(cells.name, "its grid is rotated", "Use a raster with rows and columns along the axes of its CRS")
    west, south, east, north = view.view.bounds
    right, up = (east - west) / view.view.cols / 2.0, (north - south) / view.view.rows / 2.0
    if not scene.overlaps(cells.crs, (west + right, south + up, east - right, north - up)):  # the cells' centres
        level_bounds = scene.default_bounds(cells.crs)
        raise InputError(
            "like", cells.name, f"a raster that overlaps the level; {_extents_text(view.view.bounds, level_bounds, cells.crs)}"
        )
    return view


def extent_warning(scene: Scene, raster: RasterView) -> str | None:
    """Return a warning about a raster that extends beyond the level by more than a cell, else ``None``."""
    try:
        level_bounds = scene.default_bounds(raster.crs)
    except InputError:  # the level has no extent in that CRS
        return None
    west, south, east, north = raster.view.bounds
    if raster.crs.is_geographic:  # shift the raster by multiples of 360 degrees to the level
        shift_deg = 360.0 * round((level_bounds[0] + level_bounds[2] - west - east) / 720.0)
        west, east = west + shift_deg, east + shift_deg
    cell = max(abs(value) for value in (raster.transform.a, raster.transform.b, raster.transform.d, raster.transform.e))
    if min(west - level_bounds[0], south - level_bounds[1], level_bounds[2] - east, level_bounds[3] - north) >= -cell:
        return None
    return f"the raster extends beyond the level and is empty there; {_extents_text(raster.view.bounds, level_bounds, raster.crs)}"


def _extents_text(raster_bounds: Bounds, level_bounds: Bounds, crs: CRS) -> str:
    """Return the extents of a raster and of a level as text."""
    raster_text, level_text = (",".join(f"{value:.9g}" for value in bounds) for bounds in (raster_bounds, level_bounds))
    return f"the raster is {raster_text}, the level {level_text} (west,south,east,north in {crs.name})"


def _view_of(cells: RasterCells) -> RasterView | None:
    """Return a raster's cells and their map view; ``None`` if rows and columns do not run along the axes of the CRS."""
    gt = axes_of(cells.crs).affine @ cells.transform
    if gt.b == 0.0 == gt.d and gt.a and gt.e:
        order, shape = CellOrder(False, gt.e > 0.0, gt.a < 0.0), (cells.rows, cells.cols)
        right, down = gt.a, gt.e
    elif gt.a == 0.0 == gt.e and gt.b and gt.d:
        order, shape = CellOrder(True, gt.b < 0.0, gt.d > 0.0), (cells.cols, cells.rows)
        right, down = gt.b, gt.d
    else:
        return None
    west = gt.c + min(right * shape[1], 0.0) + abs(right) / 2.0
    north = gt.f + max(down * shape[0], 0.0) - abs(down) / 2.0
    view = _cell_center_view(cells.crs, west, north, abs(right), abs(down), *shape)
    return RasterView(view, order, cells.crs, cells.transform)


def _cell_center_view(crs: CRS, x0: float, y0: float, col_step: float, row_step: float, rows: int, cols: int) -> MapView:
    """Return a map view whose nodes are the centres of cells. Shade is then computed at the cells' own heights.

    ``x0`` and ``y0`` are the centre of the first cell. ``col_step`` and ``row_step`` are the sides of a cell, in units of the CRS.
    """
    stretch = row_step / col_step
    grid = Grid(crs, x0, y0, col_step, 1.0 if abs(stretch - 1.0) <= ASPECT_TOLERANCE else stretch)
    return MapView(grid, 0.0, 0.0, 1.0, 1.0, rows, cols)


def _crop(raster: RasterView, bounds: Bounds) -> RasterView:
    """Return the section of a raster whose cells intersect bounds in its CRS."""
    west, south, east, north = bounds
    view = raster.view
    rows = ((view.grid.row(y) - view.row0) / view.row_step + 0.5 for y in (north, south))
    cols = ((view.grid.col(x) - view.col0) / view.col_step + 0.5 for x in (west, east))
    (top, bottom), (left, end) = ((int(np.floor(low + 1e-9)), int(np.ceil(high - 1e-9))) for low, high in (rows, cols))
    return raster.part(top, left, bottom - top, end - left)
