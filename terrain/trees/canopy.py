"""Trees from a canopy height model (CHM): detected treetops if the cells are fine enough, otherwise scattered trees.

A treetop is the highest cell of a round window whose radius grows with the height of the cell (local maximum filter with a variable
window: S. C. Popescu, R. H. Wynne: Seeing the trees in the forest, Photogrammetric Engineering & Remote Sensing 70, 2004). Of
equal heights the one with the largest hash of its cell counts, so that a flat canopy has trees one window apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.errors import RasterioError
from rasterio.windows import Window

from skugga.terrain.compiled import compiled
from skugga.terrain.errors import SourceError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.vectors import same_coordinates, transformer_between
from skugga.terrain.ground.georeference import check_cells, check_geotransform
from skugga.terrain.ground.open_raster import open_masked_raster
from skugga.terrain.ground.vertical import vertical_axis
from skugga.terrain.trees.canopy_sample import MAX_PLAUSIBLE_HEIGHT_M, MIN_TREE_HEIGHT_M
from skugga.terrain.trees.scatter import HECTARE_M2, TreePositions, pair_key, point_keys, scatter_trees

MAX_DETECTION_CELL_M = 3.0
"""Largest side of a cell, in metres, at which single trees can be detected."""

MIN_CROWN_CELLS = 1.3
"""Smallest usual crown diameter, in cells, of trees that can be detected. Smaller crowns give fewer tops than trees."""

TREETOP_WINDOW_RADIUS_LINES: dict[str, tuple[float, float]] = {"conifer": (0.8, 0.05), "broadleaf": (0.5, 0.15)}
"""Radius of a treetop's window: metres, and metres per metre of height. The window always includes the eight neighbours.

- Conifers: the line of ForestTools' ``vwf`` (A. Plowright).
- Broadleaved crowns have several humps. The line approximates half of Popescu and Wynne's width of deciduous crowns, 3.09632 m +
  0.00895 h**2 / m. It deviates by at most 0.22 m from 8 m to 25 m, and does not grow as fast beyond.
"""

CROWN_NEIGHBOUR_COUNT = 3
"""Number of nearest treetops whose mean distance limits a crown."""

MAX_CROWN_RATIO = 1.2
"""Upper bound of a crown's diameter, as a multiple of the mean distance to the ``CROWN_NEIGHBOUR_COUNT`` nearest treetops."""

HEXAGONAL_CROWNS_PER_SQUARE = 2.0 / np.sqrt(3.0)
"""Number of crowns in a square with a crown's diameter as side, in a closed canopy (hexagonal packing)."""

_BLOCK_CELLS = 1024
"""Side of the blocks of treetop detection, cells."""

_SCATTER_SQUARE_M, _SCATTER_SQUARE_CELLS = 1000.0, 16.0
"""Side of the squares in which trees are scattered, in metres and in cells. The larger one counts."""


@dataclass(frozen=True, eq=False)
class CanopyTrees:
    """Trees of a canopy.

    Attributes
    ----------
    positions
        Positions (n,) in the requested CRS.
    height_m
        Heights float64 (n,), metres.
    """

    positions: TreePositions
    height_m: np.ndarray


@dataclass(frozen=True)
class CellWindow:
    """Rows [row0, row1) and columns [col0, col1) of a raster."""

    row0: int
    col0: int
    row1: int
    col1: int


class Canopy:
    """An open raster of canopy heights above ground. Do not share it between threads.

    Parameters
    ----------
    source
        The raster, by GDAL's name.

    Attributes
    ----------
    name
        The source.
    min_height_m
        Minimum height of trees, metres. Lower canopy is ignored.
    crs
        The raster's CRS.
    rows, cols
        Size of the raster in cells.

    Raises
    ------
    SourceError
        If the source is no raster, is damaged, or has no CRS or an unknown unit.
    """

    min_height_m = MIN_TREE_HEIGHT_M

    def __init__(self, source: str) -> None:
        self.name = source
        try:
            self._dataset = dataset = open_masked_raster(source)
            crs = CRS.from_user_input(dataset.crs.to_wkt()) if dataset.crs else None
        except (RasterioError, CRSError) as error:
            reason = str(error).replace(f"'{source}'", "the file").replace(source, "the file").strip().rstrip(".")
            raise SourceError(source, reason or "cannot be opened", "Use a raster that GDAL reads") from None
        if dataset.count < 1 or dataset.dtypes[0].startswith("complex"):
            problem = f"band 1 has the data type {dataset.dtypes[0]}" if dataset.count else "no band"
            raise SourceError(source, problem, "Use a raster whose first band holds canopy heights as real numbers")
        check_geotransform(source, dataset)
        if crs is None:
            raise SourceError(source, "no coordinate reference system", "Use a raster with a CRS")
        self.crs = crs
        check_cells(source, dataset)
        self._transform = axes_of(crs).affine @ dataset.transform
        unit_m = vertical_axis(source, dataset, positive="up").unit_m  # canopies grow upwards, whatever band and CRS say
        self._scale, self._offset = dataset.scales[0] * unit_m, dataset.offsets[0] * unit_m
        self.rows, self.cols = dataset.height, dataset.width

    def heights_m(self, row0: int, col0: int, rows: int, cols: int) -> np.ndarray:
        """Return heights float32 (rows, cols) of a window, metres. Cells without trees or outside the raster are 0.

        Raises ``SourceError`` if a part of the raster cannot be read.
        """
        out = np.zeros((rows, cols), np.float32)
        top, left = max(row0, 0), max(col0, 0)
        bottom, right = min(row0 + rows, self.rows), min(col0 + cols, self.cols)
        if top >= bottom or left >= right:
            return out
        window = Window(left, top, right - left, bottom - top)
        try:
            data = self._dataset.read(1, window=window, masked=True)
        except RasterioError:
            raise SourceError(self.name, "a part of it cannot be read", "Use an undamaged file") from None
        values = data.filled(0).astype(np.float64) * self._scale + self._offset
        with np.errstate(invalid="ignore"):
            tree = ~np.ma.getmaskarray(data) & (values >= self.min_height_m) & (values <= MAX_PLAUSIBLE_HEIGHT_M)
        out[top - row0 : bottom - row0, left - col0 : right - col0] = np.where(tree, values, 0.0)
        return out

    def xy(self, crs: CRS, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates in ``crs`` of fractional cells (integers are cell centres); infinite where ``crs`` is undefined."""
        gt, row, col = self._transform, np.asarray(row) + 0.5, np.asarray(col) + 0.5
        x, y = gt.a * col + gt.b * row + gt.c, gt.d * col + gt.e * row + gt.f
        return (x, y) if same_coordinates(self.crs, crs) else transformer_between(self.name, self.crs, crs).transform(x, y)

    def cell_of(self, crs: CRS, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return fractional rows and columns of coordinates in ``crs``; infinite where the raster's CRS is undefined."""
        if not same_coordinates(self.crs, crs):
            x, y = transformer_between(self.name, self.crs, crs, inverse=True).transform(x, y)
        gt, inverse = self._transform, ~self._transform
        if self.crs.is_geographic:
            middle = gt.c + 0.5 * (gt.a * self.cols + gt.b * self.rows)
            x = x + 360.0 * np.rint((middle - x) / 360.0)
        x, y = np.asarray(x) - gt.c, np.asarray(y) - gt.f
        return inverse.d * x + inverse.e * y - 0.5, inverse.a * x + inverse.b * y - 0.5

    def outline(self, crs: CRS) -> np.ndarray:
        """Return points (n, 2) of the raster's border in ``crs``."""
        return np.column_stack(self.xy(crs, *border_cells(self.rows, self.cols)))

    def window(self, crs: CRS, area: shapely.Polygon | None) -> CellWindow | None:
        """Return the window of cells that may lie in an area of ``crs`` (``None``: all), or ``None`` if no cell does."""
        if area is None:
            return CellWindow(0, 0, self.rows, self.cols)
        border = shapely.get_coordinates(area)
        row, col = self.cell_of(crs, border[:, 0], border[:, 1])
        if not (np.isfinite(row).all() and np.isfinite(col).all()):
            return CellWindow(0, 0, self.rows, self.cols)
        row0, col0 = max(int(row.min()) - 1, 0), max(int(col.min()) - 1, 0)
        row1, col1 = min(int(row.max()) + 3, self.rows), min(int(col.max()) + 3, self.cols)
        return CellWindow(row0, col0, row1, col1) if row0 < row1 and col0 < col1 else None

    def trees(
        self,
        crs: CRS,
        unit_m: float,
        window: CellWindow,
        crown_diameter_of: Callable[[np.ndarray], np.ndarray],
        radius_line: tuple[float, float],
        seed: int,
    ) -> Iterator[CanopyTrees]:
        """Yield the trees of a window of the canopy, in parts.

        The detection limit is the minimum height of trees whose crowns are wide enough for the cells. Higher trees are detected as
        treetops. Lower trees and shrubs are scattered at the density of a closed canopy.

        Parameters
        ----------
        crs
            CRS of the trees' positions.
        unit_m
            Unit of ``crs`` in metres.
        window
            The window of cells.
        crown_diameter_of
            Function from heights to usual crown diameters, both in metres.
        radius_line
            Radius of a treetop's window: metres, and metres per metre of height (``TREETOP_WINDOW_RADIUS_LINES``).
        seed
            Seed of the hashes from which positions and other random properties of trees derive.

        Raises
        ------
        SourceError
            If the raster cannot be read, or its CRS cannot be transformed into ``crs``.
        """
        to_m, cell_m = self._metres_from_cells(crs, unit_m, window), self.cell_side_m(crs, unit_m, window)
        detection_limit_m = _detection_limit_m(cell_m, crown_diameter_of, self.min_height_m)
        if self.min_height_m < MIN_TREE_HEIGHT_M:
            detection_limit_m = max(detection_limit_m, MIN_TREE_HEIGHT_M)  # hedges and vines have no single tops
        if detection_limit_m > self.min_height_m:
            side = max(_SCATTER_SQUARE_M, _SCATTER_SQUARE_CELLS * cell_m) / unit_m
            for square in self._squares(crs, window, side):
                yield from self._scatter_low_trees(crs, unit_m, square, crown_diameter_of, detection_limit_m, seed)
        if np.isinf(detection_limit_m):
            return
        for row, col, height_m in self.treetops(to_m, window, radius_line):
            x, y = self.xy(crs, row, col)
            valid = np.isfinite(x) & np.isfinite(y) & (height_m >= detection_limit_m)
            positions = TreePositions(x[valid], y[valid], point_keys(seed, x[valid] * unit_m, y[valid] * unit_m))
            yield CanopyTrees(positions, height_m[valid])

    def treetops(
        self, metres_from_cells: np.ndarray, window: CellWindow, radius_line: tuple[float, float]
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield rows, columns and heights (metres) of the treetops in a window, block by block.

        ``metres_from_cells`` (2, 2) maps an offset in columns and rows to metres on the ground. ``radius_line`` is the radius of a
        treetop's window: metres, and metres per metre of height.
        """
        offsets, distance_m = _window_offsets(metres_from_cells, radius_line[0] + radius_line[1] * MAX_PLAUSIBLE_HEIGHT_M)
        halo = int(np.abs(offsets).max())
        for top in range(window.row0, window.row1, _BLOCK_CELLS):
            for left in range(window.col0, window.col1, _BLOCK_CELLS):
                rows, cols = min(_BLOCK_CELLS, window.row1 - top), min(_BLOCK_CELLS, window.col1 - left)
                heights = self.heights_m(top - halo, left - halo, rows + 2 * halo, cols + 2 * halo)
                is_top = _treetop_mask(heights, halo, top - halo, left - halo, offsets, distance_m, *radius_line)
                row, col = np.nonzero(is_top)
                yield row + top, col + left, heights[row + halo, col + halo].astype(np.float64)

    def sample_heights(self, window: CellWindow, max_side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, columns and heights (n,) of the cells of a window, subsampled to at most ``max_side`` a side.

        Heights are in metres, NaN for nodata. Raises ``SourceError`` if a part of the raster cannot be read.
        """
        rows, cols = window.row1 - window.row0, window.col1 - window.col0
        shape = min(rows, max_side), min(cols, max_side)
        try:
            part = Window(window.col0, window.row0, cols, rows)
            data = self._dataset.read(1, window=part, out_shape=shape, masked=True)
        except RasterioError:
            raise SourceError(self.name, "a part of it cannot be read", "Use an undamaged file") from None
        heights = data.astype(np.float64).filled(np.nan) * self._scale + self._offset
        row, col = np.indices(shape)
        rows_at = window.row0 + np.floor((row + 0.5) * rows / shape[0])
        cols_at = window.col0 + np.floor((col + 0.5) * cols / shape[1])
        return rows_at.ravel(), cols_at.ravel(), np.where(np.isfinite(heights), heights, np.nan).ravel()

    def cell_side_m(self, crs: CRS, unit_m: float, window: CellWindow) -> float:
        """Return the square root of a cell's area on the ground, metres.

        Raises ``SourceError`` if the raster's CRS cannot be transformed into ``crs``.
        """
        cell_m = float(np.sqrt(abs(np.linalg.det(self._metres_from_cells(crs, unit_m, window)))))
        if not np.isfinite(cell_m) or cell_m == 0:
            problem = f"its CRS '{self.crs.name}' cannot be transformed into '{crs.name}'"
            raise SourceError(self.name, problem, "Use a raster in another CRS")
        return cell_m

    def close(self) -> None:
        """Close the raster."""
        self._dataset.close()

    def _metres_from_cells(self, crs: CRS, unit_m: float, window: CellWindow) -> np.ndarray:
        """Return the matrix (2, 2) from an offset in columns and rows to metres on the ground, in the middle of a window."""
        return self._jacobian(crs, (window.row0 + window.row1 - 1) / 2, (window.col0 + window.col1 - 1) / 2) * unit_m

    def _jacobian(self, crs: CRS, row: float, col: float) -> np.ndarray:
        """Return the derivatives (2, 2) of x and y in ``crs`` by column and row."""
        x, y = self.xy(crs, row + np.array([0.0, 0.0, -0.5, 0.5]), col + np.array([-0.5, 0.5, 0.0, 0.0]))
        return np.array([[x[1] - x[0], x[3] - x[2]], [y[1] - y[0], y[3] - y[2]]])

    def _squares(self, crs: CRS, window: CellWindow, side: float) -> Iterator[shapely.Polygon]:
        """Yield the squares that a window of cells may touch. They belong to a grid from the origin of ``crs``."""
        t = np.linspace(0.0, 1.0, 33)
        row, col = np.meshgrid(
            window.row0 - 0.5 + t * (window.row1 - window.row0), window.col0 - 0.5 + t * (window.col1 - window.col0)
        )
        x, y = self.xy(crs, row, col)
        valid = np.isfinite(x) & np.isfinite(y)
        west, east = np.floor(np.array([x[valid].min(), x[valid].max()]) / side).astype(int).tolist()
        south, north = np.floor(np.array([y[valid].min(), y[valid].max()]) / side).astype(int).tolist()
        for j in range(south, north + 1):
            for i in range(west, east + 1):
                yield shapely.box(i * side, j * side, (i + 1) * side, (j + 1) * side)

    def _scatter_low_trees(
        self,
        crs: CRS,
        unit_m: float,
        square: shapely.Polygon,
        crown_diameter_of: Callable[[np.ndarray], np.ndarray],
        below_m: float,
        seed: int,
    ) -> Iterator[CanopyTrees]:
        """Yield scattered trees for the canopy lower than ``below_m`` metres in a square.

        Each height class has a lattice of trees of its own, at the density of a closed canopy of its crowns.
        """
        west, south, _, _ = square.bounds
        origin, step, heights = self._linear_map(crs, square)
        heights = np.where(heights < below_m, heights, 0.0)
        edges_m = _height_classes(crown_diameter_of, self.min_height_m)
        class_numbers = np.unique(np.searchsorted(edges_m, heights[heights > 0], side="right") - 1)
        for number in class_numbers.tolist():
            low_m, high_m = edges_m[number : number + 2]
            crown_m = crown_diameter_of(np.sqrt([low_m * high_m]))[0]
            p = scatter_trees(square, HEXAGONAL_CROWNS_PER_SQUARE * HECTARE_M2 / crown_m**2, seed + number, unit_m)
            row, col = np.rint(origin[:, None] + step @ np.stack([p.x - west, p.y - south])).astype(np.int64)
            is_inside = (row >= 0) & (row < heights.shape[0]) & (col >= 0) & (col < heights.shape[1])
            height = np.where(is_inside, heights[np.where(is_inside, row, 0), np.where(is_inside, col, 0)], 0.0)
            in_class = (height >= low_m) & (height < high_m)
            yield CanopyTrees(TreePositions(p.x[in_class], p.y[in_class], p.key[in_class]), height[in_class])

    def _linear_map(self, crs: CRS, square: shapely.Polygon) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return a linear map from a square to cells, and the heights of the window of these cells.

        Returns
        -------
        origin, step, heights
            Row and column (2,) of the south-west corner in the window, their derivatives (2, 2) by x and y, and heights float32
            (rows, cols).
        """
        west, south, east, north = square.bounds
        cell = np.stack(self.cell_of(crs, np.array([west, east, west, east]), np.array([south, south, north, north])))
        if not np.isfinite(cell).all():
            return np.zeros(2), np.zeros((2, 2)), np.zeros((1, 1), np.float32)
        corners = cell.reshape(2, 2, 2)  # row or column, south or north, west or east
        along_x, along_y = np.diff(corners, axis=2).mean(axis=1)[:, 0], np.diff(corners, axis=1).mean(axis=2)[:, 0]
        step = np.column_stack([along_x / (east - west), along_y / (north - south)])
        first, last = np.floor(cell.min(axis=1)).astype(int) - 1, np.ceil(cell.max(axis=1)).astype(int) + 2
        heights = self.heights_m(first[0], first[1], *(last - first))
        return cell.mean(axis=1) - (along_x + along_y) / 2 - first, step, heights


def border_cells(rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """Return fractional rows and columns (n,) of points along a raster's border."""
    t = np.linspace(0.0, 1.0, 65)
    row, col = np.concatenate([t * 0, t, t * 0 + 1, 1 - t]), np.concatenate([t, t * 0 + 1, 1 - t, t * 0])
    return row * rows - 0.5, col * cols - 0.5


def growing_space_m(x: np.ndarray, y: np.ndarray, unit_m: float) -> np.ndarray:
    """Return the mean distance of each point to its ``CROWN_NEIGHBOUR_COUNT`` nearest points, float64 (n,), metres.

    It is infinite if there are not so many points. ``unit_m`` is the unit of the coordinates in metres.
    """
    from scipy.spatial import cKDTree

    if len(x) <= CROWN_NEIGHBOUR_COUNT:
        return np.full(len(x), np.inf)
    points = np.column_stack([x, y])
    return cKDTree(points).query(points, k=CROWN_NEIGHBOUR_COUNT + 1, workers=-1)[0][:, 1:].mean(axis=1) * unit_m


def _detection_limit_m(cell_m: float, crown_diameter_of: Callable[[np.ndarray], np.ndarray], min_height_m: float) -> float:
    """Return the minimum height of trees that can be detected in cells of a size, metres.

    It is 0 if all trees can be detected, and infinite if none can.
    """
    heights = np.geomspace(min_height_m, MAX_PLAUSIBLE_HEIGHT_M, 1000)
    is_too_small = crown_diameter_of(heights) < MIN_CROWN_CELLS * cell_m
    if cell_m > MAX_DETECTION_CELL_M or is_too_small.all():
        return np.inf
    return float(heights[is_too_small][-1]) if is_too_small.any() else 0.0


def _height_classes(crown_diameter_of: Callable[[np.ndarray], np.ndarray], min_height_m: float) -> np.ndarray:
    """Return the edges of height classes, metres. Within a class crown diameters grow by at most a factor of sqrt(2)."""
    heights = np.geomspace(min_height_m, MAX_PLAUSIBLE_HEIGHT_M, 1000)
    octave = np.floor(2.0 * np.log2(crown_diameter_of(heights) / crown_diameter_of(heights[:1])))
    first = np.flatnonzero(np.diff(octave, prepend=-1.0) > 0)
    return np.append(heights[first], np.nextafter(MAX_PLAUSIBLE_HEIGHT_M, np.inf))


def _window_offsets(metres_from_cells: np.ndarray, max_distance_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the offsets (n, 2), in rows and columns, of the cells within a distance, and their lengths (n,) in metres.

    They are sorted by length. The eight neighbours have length 0, so that every window includes them.
    """
    reach = np.ceil(max_distance_m * np.linalg.norm(np.linalg.inv(metres_from_cells), axis=1)).astype(int) + 1
    col, row = (v.ravel() for v in np.meshgrid(np.arange(-reach[0], reach[0] + 1), np.arange(-reach[1], reach[1] + 1)))
    distance = np.linalg.norm(metres_from_cells @ np.stack([col, row]), axis=0)
    distance[np.maximum(np.abs(row), np.abs(col)) == 1] = 0.0
    order = np.argsort(distance, kind="stable")
    order = order[(distance[order] <= max_distance_m) & ((row[order] != 0) | (col[order] != 0))]
    return np.column_stack([row, col])[order], distance[order]


@compiled
def _treetop_mask(heights, halo, row0, col0, offsets, distance_m, radius_m, radius_per_m):
    """Return the mask (rows, cols) of cells that are the highest of their windows.

    ``heights`` has a border of ``halo`` cells round those cells. ``row0`` and ``col0`` are the position of its first cell in the
    raster. A window's radius is ``radius_m`` + ``radius_per_m`` * height. ``offsets`` and ``distance_m`` come from
    ``_window_offsets``.
    """
    rows, cols = heights.shape[0] - 2 * halo, heights.shape[1] - 2 * halo
    out = np.zeros((rows, cols), np.bool_)
    for i in range(rows):
        for j in range(cols):
            r, c = i + halo, j + halo
            height = heights[r, c]
            if height <= 0.0:
                continue
            window_radius_m = radius_m + radius_per_m * height
            is_top = True
            for n in range(offsets.shape[0]):
                if distance_m[n] > window_radius_m:
                    break
                m, k = r + offsets[n, 0], c + offsets[n, 1]
                neighbour_height = heights[m, k]
                if neighbour_height > height or (
                    neighbour_height == height and pair_key(0, row0 + m, col0 + k) > pair_key(0, row0 + r, col0 + c)
                ):
                    is_top = False
                    break
            out[i, j] = is_top
    return out
