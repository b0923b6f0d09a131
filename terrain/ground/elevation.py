"""Read heights from any raster that GDAL opens, by windows and overviews only.

By default the surface is bilinear between the centres of the raster's cells. If the level file sets blocks, each cell has a flat
top instead (``skugga.terrain.ground.columns``). Cells are addressed as (row, col), with whole numbers at the centres.

A level of detail ``lod`` has cells that are averages of ``2**lod`` x ``2**lod`` raster cells. They are counted from the raster's
first cell, so that they do not depend on the window that is read. Raster cells at the south and east borders that fill no whole
cell of the level of detail are ignored.

Holes (cells without data) are not visible, but they are filled for casting shadows. The fill continues the heights at the hole's
edge smoothly, so it makes no walls and no pits. Cells farther than ``MAX_FILL_CELLS`` from any data stay empty and cast no shadows.

A raster's cells reach half a cell beyond their centres. So the ground that casts shadows continues for one node beyond the
outermost nodes of a grid on the raster. These rim nodes have the height of the raster's border (``heights_with_rim``). Visible
ground ends at the outermost nodes.

Standing water is part of the surface: no returned height lies below it. Shores run where the bilinear ground rises out of the
water, not along cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from affine import Affine
from pyproj import CRS
from rasterio.enums import Resampling
from rasterio.errors import RasterioError, RasterioIOError
from rasterio.fill import fillnodata
from rasterio.io import MemoryFile
from rasterio.windows import Window

from skugga.terrain.cache import estimated_bytes
from skugga.terrain.errors import SourceError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, ellipsoid_of, is_on_earth, transformer
from skugga.terrain.ground.georeference import checked_crs
from skugga.terrain.ground.open_raster import impossible_nodata, open_height_raster
from skugga.terrain.ground.overview import Overview, check_overviews, lacks_overviews, read_overview
from skugga.terrain.ground.undeclared_nodata import UndeclaredNodata
from skugga.terrain.ground.vertical import vertical_axis
from skugga.terrain.level.bundled import BUNDLED
from skugga.terrain.level.gdal_guard import limit_gdal_caches
from skugga.terrain.level.level_source import option_remedy
from skugga.terrain.level.parts import GroundSurface, Positive, Units

MAX_FILL_CELLS = 64
"""Maximum distance from its edge to which a hole is filled, in cells of the level of detail that is read."""

PLAUSIBLE_HEIGHTS_M = (-11500.0, 9500.0)
"""Lowest and highest plausible height on earth, metres.

Cells with other values are holes: infinities, and undeclared sentinels (values that stand for missing data) such as -32768.
"""

PLAUSIBLE_HEIGHTS_OFF_EARTH_M = (-32000.0, 32000.0)
"""Lowest and highest height on other celestial bodies, metres.

Olympus Mons on Mars is 21 km high, the basin Rheasilvia on Vesta 19 km deep.
"""

BEYOND_MARGIN_CELLS = 2.0
"""Distance from the raster, in cells, from which on nodes are taken to lie off it without a look at each of them."""

READ_BLOCK_SIDE_CELLS = 1024
"""Side of the blocks in which heights at scattered points are read, in cells: a few points far apart do not load a whole raster."""

limit_gdal_caches()


class Elevation:
    """An open raster of heights. Not thread-safe: do not share it between threads.

    Parameters
    ----------
    source
        The raster's file.
    units
        Unit of the heights; overrides the unit that the file states.
    exaggeration
        Factor of the heights.
    resolution_m
        Finest detail that is drawn, metres; ``None`` for the raster's own.
    raster_in_memory
        A raster in memory that replaces the file ``source``.
    water_m
        Height of standing water, metres; ``None``: no water. Water is the surface wherever the exaggerated ground lies below it.
        Holes stay holes.
    surface
        The surface between the cells' centres: smooth, or blocks.
    nodata
        A value of the file's cells that means no height, in addition to the one that the file declares.
    positive
        Whether the file's numbers grow upwards or downwards; overrides what the file states.

    Attributes
    ----------
    vertical
        Unit and direction of the file's numbers, as used.
    undeclared_nodata
        Counts of the cells that cannot be heights, although the file does not declare them as nodata.

    Raises
    ------
    SourceError
        If the raster is missing, broken, without a CRS, outside its CRS, or without a single height.
    """

    def __init__(
        self,
        source: str,
        units: Units | None = None,
        exaggeration: float = 1.0,
        resolution_m: float | None = None,
        raster_in_memory: MemoryFile | None = None,
        water_m: float | None = None,
        surface: GroundSurface = "smooth",
        nodata: float | None = None,
        positive: Positive | None = None,
    ) -> None:
        self.name = source
        self.surface = surface
        self.resolution_m = resolution_m
        self.water_m = -np.inf if water_m is None else float(np.float32(water_m))  # heights are float32
        try:
            in_memory = BUNDLED[source]() if source in BUNDLED else raster_in_memory
            self._dataset = open_height_raster(source, in_memory, nodata)
        except (RasterioError, OSError) as error:
            reason = str(error).replace(f"'{source}'", "the file").replace(source, "the file").strip().rstrip(".")
            reason = reason or "it cannot be opened"
            raise SourceError(source, reason, "Give a raster that GDAL reads") from None
        dataset = self._dataset
        if dataset.count < 1 or dataset.dtypes[0].startswith("complex"):
            raise SourceError(
                source, f"its first band is of type {dataset.dtypes[0]}" if dataset.count else "it has no band",
                "Give a raster whose first band has real numbers",
            )  # fmt: skip
        self.dtype, self.impossible_nodata = dataset.dtypes[0], None if nodata is not None else impossible_nodata(dataset)
        self.crs = checked_crs(source, dataset)
        self.rows, self.cols = dataset.height, dataset.width
        self.flat = self.crs.is_engineering
        self.vertical = vertical_axis(source, dataset, units, positive)
        self._scale = dataset.scales[0] * self.vertical.metres_per_stored_unit * exaggeration
        self._offset = dataset.offsets[0] * self.vertical.metres_per_stored_unit * exaggeration
        self._limits = tuple(v * exaggeration for v in plausible_heights_m(self.crs))
        self._transform = axes_of(self.crs).affine @ dataset.transform
        self._cell_from_crs = ~self._transform
        x_cell = abs(self._transform.a)
        self._wrap_period = round(360.0 / x_cell) if self.crs.is_geographic and x_cell * self.cols > 360.0 - 1.5 * x_cell else 0
        self._resampling, self._is_resampling_chosen, self.undeclared_nodata = Resampling.nearest, False, UndeclaredNodata()
        self.overview = self._read_overview()
        if not np.isfinite(self.overview.mean_heights_m).any():
            if not self.undeclared_nodata.implausible_count:
                raise SourceError(source, "no height in any cell (all nodata)", "Give a raster with heights")
            problem = f"no plausible height on earth in any cell ({self.undeclared_nodata.implausible_range(self.vertical)})"
            raise SourceError(source, problem, f"State the unit of its heights: {option_remedy('units', 'UNIT')}")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.cols

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north of the raster in its own CRS."""
        x, y = self.xy(np.array([-0.5, -0.5, self.rows - 0.5, self.rows - 0.5]), np.array([-0.5, self.cols - 0.5] * 2))
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    @property
    def square_cell_size(self) -> float | None:
        """Side of a cell in CRS units; ``None`` if cells are not square or rows do not run from north to south."""
        gt = self._transform
        square = gt.b == 0 and gt.d == 0 and gt.a > 0 and abs(gt.a + gt.e) <= 1e-9 * gt.a
        return float(gt.a) if square else None

    @property
    def is_north_up(self) -> bool:
        """Whether the raster is north-up: rows run from west to east, the northernmost one first."""
        gt = self._transform
        return bool(gt.b == 0 and gt.d == 0 and gt.a > 0 and gt.e < 0)

    @property
    def geotransform(self) -> Affine:
        """The geotransform that the file states, in GDAL's order and directions of axes."""
        return self._dataset.transform

    @property
    def nbytes(self) -> int:
        """Bytes held in memory: the overview. Everything else is read on demand."""
        return estimated_bytes(self.overview)

    def stored_values(self, rows: slice, cols: slice, shape: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the values of a window's cells as stored in the file, and a mask of the cells that hold heights.

        A ``shape`` smaller than the window decimates the cells by nearest neighbour.
        """
        window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        stored_values, _, is_nodata, plausible = self._read_cells(window, shape, Resampling.nearest)
        return stored_values, plausible & ~is_nodata

    @property
    def metres_per_stored_unit(self) -> float:
        """Drawn height of a step of 1 in the stored values, metres; negative if they count downwards."""
        return float(self._scale)

    def surface_range_m(self, cells: np.ndarray) -> tuple[float, float]:
        """Return the lowest and highest surface of cells with some stored values, metres: at least the height of water."""
        ends = np.array([cells.min(), cells.max()], np.float64) * self._scale + self._offset
        low, high = sorted(max(float(end), self.water_m) for end in ends)
        return low, high

    @property
    def overview_factors(self) -> tuple[int, ...]:
        """Factors by which the file's overviews are coarser than its cells. Overviews that are not used are omitted."""
        return tuple(self._dataset.overviews(1))

    def close(self) -> None:
        """Close the raster."""
        self._dataset.close()

    def xy(self, row: np.ndarray | float, col: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates of (fractional) cells in the raster's CRS.

        x is to the east and y to the north (``skugga.terrain.geo.axes``).
        """
        gt, row, col = self._transform, np.asarray(row) + 0.5, np.asarray(col) + 0.5
        return gt.a * col + gt.b * row + gt.c, gt.d * col + gt.e * row + gt.f

    def cell_of(self, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (fractional) row and column of coordinates in the raster's CRS; not finite where the coordinates are not."""
        gt, inverse = self._transform, self._cell_from_crs
        # Relative to the raster's corner, so that large coordinates cancel before they are multiplied.
        x, y = np.asarray(x, np.float64) - gt.c, np.asarray(y, np.float64) - gt.f
        with np.errstate(invalid="ignore"):  # coordinates outside the CRS's area are infinite
            return inverse.d * x + inverse.e * y - 0.5, inverse.a * x + inverse.b * y - 0.5

    def covers(self, x: float | np.ndarray, y: float | np.ndarray) -> np.ndarray:
        """Return whether coordinates in the raster's CRS lie on the raster, with longitudes wrapped."""
        row, col = self.cell_of(self._wrap_longitudes(x), y)
        inside = (row >= -0.5) & (row <= self.rows - 0.5)
        return inside if self._wrap_period else inside & (col >= -0.5) & (col <= self.cols - 0.5)

    def ground_m(self, x: float | np.ndarray, y: float | np.ndarray) -> np.ndarray:
        """Return heights in metres (float64, the shape of x) at coordinates in the raster's CRS; NaN off the raster and in holes.

        Longitudes are wrapped. Cells are read in blocks of ``READ_BLOCK_SIDE_CELLS`` a side.
        """
        height, valid = self._heights_at_points(x, y)
        return np.where(valid, height, np.nan)

    def filled_ground_m(self, x: float | np.ndarray, y: float | np.ndarray) -> np.ndarray:
        """Return heights as ``ground_m`` does, but with holes filled; NaN off the raster and far from any data.

        Objects on the ground use these heights: ground models often have holes just where buildings are.
        """
        return self._heights_at_points(x, y)[0]

    def _wrap_longitudes(self, x: float | np.ndarray) -> float | np.ndarray:
        """Return longitudes shifted by multiples of 360 degrees to the nearest ones to the raster's centre.

        In a CRS that is not geographic, x is unchanged.
        """
        if not self.crs.is_geographic:
            return x
        middle = float(self.xy(0, (self.cols - 1) / 2)[0])
        return np.asarray(x) + 360.0 * np.rint((middle - np.asarray(x)) / 360.0)

    def _heights_at_points(self, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights at coordinates, metres, float64, holes filled, NaN without data nearby; and the valid mask."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        height, valid = np.full(x.size, np.nan), np.zeros(x.size, bool)
        on = np.flatnonzero(self.covers(x, y))
        row, col = self.cell_of(self._wrap_longitudes(x.ravel()[on]), y.ravel()[on])
        block = np.floor(row / READ_BLOCK_SIDE_CELLS).astype(np.int64) * (self.cols + 1) + np.floor(
            col / READ_BLOCK_SIDE_CELLS
        ).astype(np.int64)
        order = np.argsort(block, kind="stable")
        for block_points in np.split(order, np.flatnonzero(np.diff(block[order])) + 1):
            height[on[block_points]], valid[on[block_points]] = (
                v[0] for v in self.heights_at(0, row[None, block_points], col[None, block_points])
            )
        return height.reshape(x.shape), valid.reshape(x.shape)

    def cell_size_m(self, metres_per_unit: float) -> float:
        """Return the side of a cell on the ground at the raster's centre, metres: the square root of its area.

        On the globe this differs from the cell size in a projection's units. At 60 degrees of latitude, a cell of Web Mercator is
        half as long on the ground.
        """
        row, col = (self.rows - 1) / 2, (self.cols - 1) / 2
        xs, ys = self.xy(np.array([row, row, row - 0.5, row + 0.5]), np.array([col - 0.5, col + 0.5, col, col]))
        if self.crs.is_geographic:
            ys = ys - ys[0] + np.clip(ys[0], -89.9, 89.9)
        elif not self.flat:
            xs, ys = transformer(self.crs, LONGITUDE_LATITUDE).transform(xs, ys)
        if not self.flat and np.isfinite(xs).all() and np.isfinite(ys).all():
            ellipsoid = ellipsoid_of(self.crs)
            _, _, width = ellipsoid.inv(xs[0], ys[0], xs[1], ys[1])
            _, _, height = ellipsoid.inv(xs[2], ys[2], xs[3], ys[3])
            return float(np.sqrt(width * height))
        return float(np.sqrt(abs(self._transform.determinant))) * metres_per_unit

    def heights_at(self, lod: int, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights in metres (float32) at (fractional) rows and columns of the raster, and the valid mask (bool).

        Heights are bilinear between the centres of cells of ``2**lod`` raster cells a side. If ``surface`` is blocks, they are the
        heights of these cells. NaN means no data nearby.
        """
        row, col, ends = self._positions_at_lod(lod, row, col)
        return self._heights_at_lod(lod, row, col, ends)

    def heights_with_rim(self, lod: int, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return heights, valid mask and rim mask (rows, cols) of the nodes at (fractional) rows and columns of the raster.

        ``row`` and ``col`` (rows + 2, cols + 2) include a margin of one node. Rim nodes lie off the raster, next to a node on it
        along a row, a column or a diagonal. They have the height of the raster's border and are not valid. The ground that casts
        shadows must end with the cells, not with their centres: a ray just beyond the outermost centre is still above a cell.
        """
        on_row, on_col, ends = self._positions_at_lod(lod, row, col)
        if not np.isfinite(ends).all():
            inner = row.shape[0] - 2, row.shape[1] - 2
            return np.full(inner, np.nan, np.float32), np.zeros(inner, bool), np.zeros(inner, bool)
        on_raster = np.isfinite(on_row)
        rim_index = np.nonzero(_dilated(on_raster) & ~on_raster)
        rim_row, rim_col = self._clamped_positions(lod, row[rim_index], col[rim_index])
        on_row[rim_index], on_col[rim_index] = rim_row, rim_col
        if np.isfinite(rim_row).any():
            rim_ends = np.array([[np.nanmin(axis), np.nanmax(axis)] for axis in (rim_row, rim_col)])
            ends = np.stack([np.minimum(ends, rim_ends)[:, 0], np.maximum(ends, rim_ends)[:, 1]], axis=1)
        height, valid = self._heights_at_lod(lod, on_row, on_col, ends)
        valid &= on_raster
        rim = np.isfinite(height) & ~on_raster
        return height[1:-1, 1:-1].copy(), valid[1:-1, 1:-1].copy(), rim[1:-1, 1:-1].copy()

    def covers_cells(self, lod: int, row: np.ndarray, col: np.ndarray) -> bool:
        """Return whether all (fractional) rows and columns of the raster lie within the cells of a level of detail."""
        rows, cols = (count * 2**lod for count in self._lod_shape(lod))
        inside = (row >= -0.5) & (row <= rows - 0.5) & np.isfinite(col)
        return bool((inside if self._wrap_period else inside & (col >= -0.5) & (col <= cols - 0.5)).all())

    def is_beyond_cells(self, lod: int, row: np.ndarray, col: np.ndarray) -> bool:
        """Return whether all (fractional) rows and columns of the raster lie beyond one side of the cells of a level of detail.

        They must be at least ``BEYOND_MARGIN_CELLS`` of these cells away, so that positions interpolated between them are off the
        raster, too.
        """
        rows, cols = (count * 2**lod for count in self._lod_shape(lod))
        margin = BEYOND_MARGIN_CELLS * 2**lod
        sides = [row < -margin, row > rows + margin]
        if not self._wrap_period:
            sides += [col < -margin, col > cols + margin]
        return any(bool(side.all()) for side in sides)

    def _positions_at_lod(self, lod: int, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Convert rows and columns of the raster to rows and columns at a level of detail, NaN off the raster.

        The third result (2, 2) is the minimum and maximum row, then the minimum and maximum column.
        """
        from skugga.terrain.ground.elevation_loops import convert_to_lod  # imported here: only heights need numba

        rows, cols = self._lod_shape(lod)
        row, col = (axis.copy() if 0 in axis.strides else axis for axis in (row, col))  # numba rejects broadcast arrays
        if self._wrap_period:
            return convert_to_lod(row, self._columns_at_lod(lod, col), 2.0**lod, rows, np.inf)
        return convert_to_lod(row, col, 2.0**lod, rows, np.float64(cols))

    def _clamped_positions(self, lod: int, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert rows and columns (n,) of the full raster to rows and columns (n,) at a level of detail.

        The results are clamped to the centres of the outermost cells. A position beyond a pole gives NaN.
        """
        rows, cols = self._lod_shape(lod)
        on_row = np.clip((row + 0.5) / 2**lod - 0.5, 0.0, rows - 1.0)
        on_col = self._columns_at_lod(lod, col) if self._wrap_period else np.clip((col + 0.5) / 2**lod - 0.5, 0.0, cols - 1.0)
        is_position = np.isfinite(row) & np.isfinite(col)
        if self.crs.is_geographic:
            is_position &= np.abs(self.xy(row, col)[1]) <= 90.0
        return np.where(is_position, on_row, np.nan), np.where(is_position, on_col, np.nan)

    def _heights_at_lod(
        self, lod: int, row: np.ndarray, col: np.ndarray, position_ranges: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return heights and valid mask as ``heights_at`` does, for rows and columns at a level of detail.

        ``position_ranges`` (2, 2) are the minimum and maximum row, then the minimum and maximum column.
        """
        from skugga.terrain.ground.cells import cell_heights
        from skugga.terrain.ground.elevation_loops import bilinear

        if not np.isfinite(position_ranges).all():
            return np.full(row.shape, np.nan, np.float32), np.zeros(row.shape, bool)
        rows, cols = self._lod_shape(lod)
        (row0, row1), (col0, col1) = ((int(np.floor(low)), int(np.floor(high)) + 2) for low, high in position_ranges)
        row0, row1 = max(row0, 0), min(row1, rows)
        if not self._wrap_period:
            col0, col1 = max(col0, 0), min(col1, cols)
        values, valid = self._filled_heights(lod, row0, row1, col0, col1)
        if self.surface == "blocks":
            height, valid = cell_heights(values, valid, row - row0, col - col0)
        else:
            height, valid = bilinear(values, valid, bool(valid.all()), row, col, np.float64(row0), np.float64(col0))
        return self._raised_to_water(height), valid

    def _raised_to_water(self, height_m: np.ndarray) -> np.ndarray:
        """Return the higher one of ground and standing water, metres, float32; NaN where the ground is missing."""
        return height_m if self.water_m == -np.inf else np.maximum(height_m, np.float32(self.water_m))

    def _filled_heights(self, lod: int, row0: int, row1: int, col0: int, col1: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the heights of a window's cells, metres, with holes filled, and the valid mask (``False`` in holes).

        The fill reads a margin of ``MAX_FILL_CELLS`` round the window, so that a hole is filled alike in every window.
        """
        values = self._read(lod, row0, row1, col0, col1)
        valid = np.isfinite(values)
        if valid.all():
            return values, valid
        rows, cols = self._lod_shape(lod)
        top, bottom = max(row0 - MAX_FILL_CELLS - 1, 0), min(row1 + MAX_FILL_CELLS + 1, rows)
        left, right = col0 - MAX_FILL_CELLS - 1, col1 + MAX_FILL_CELLS + 1
        if not self._wrap_period:  # where columns wrap, a hole's rim continues beyond the last one
            left, right = max(left, 0), min(right, cols)
        padded_values = self._read(lod, top, bottom, left, right)
        if np.isfinite(padded_values).any():
            padded_values = fillnodata(
                padded_values, mask=np.isfinite(padded_values), max_search_distance=MAX_FILL_CELLS, smoothing_iterations=0
            )
        return padded_values[row0 - top : row1 - top, col0 - left : col1 - left], valid

    def _read(self, lod: int, row0: int, row1: int, col0: int, col1: int) -> np.ndarray:
        """Return heights in metres of a window of cells of a level of detail, float32, NaN in holes."""
        if not self._wrap_period:
            return self._read_inside(lod, row0, row1, col0, col1)
        period, (_, cols) = self._columns_per_turn(lod), self._lod_shape(lod)
        parts, col = [], col0
        while col < col1:
            revolution = col // period
            end = min(col1, (revolution + 1) * period)
            part, first = np.full((row1 - row0, end - col), np.nan, np.float32), col - revolution * period
            col_count = min(end - col, cols - first)  # a raster may end one column before it wraps
            if col_count > 0:
                part[:, :col_count] = self._read_inside(lod, row0, row1, first, first + col_count)
            parts.append(part)
            col = end
        return np.concatenate(parts, axis=1)

    def _read_inside(self, lod: int, row0: int, row1: int, col0: int, col1: int) -> np.ndarray:
        """Return heights in metres, float32, NaN in holes, of cells of a level of detail within the raster.

        The cells are those in rows [row0, row1) and columns [col0, col1). Undeclared nodata are counted until the resampling is
        chosen.
        """
        factor = 2**lod
        window = Window(
            col0 * factor, row0 * factor, min(col1 * factor, self.cols) - col0 * factor,
            min(row1 * factor, self.rows) - row0 * factor,
        )  # fmt: skip
        stored_values, height_m, is_nodata, plausible = self._read_cells(window, (row1 - row0, col1 - col0), self._resampling)
        if not self._is_resampling_chosen:
            self.undeclared_nodata.add(stored_values, height_m, is_nodata, plausible)
        height_m[is_nodata | ~plausible] = np.nan
        return height_m.astype(np.float32)

    def _read_cells(self, window: Window, shape: tuple[int, int] | None, resampling: Resampling) -> tuple[np.ndarray, ...]:
        """Return stored values, heights in metres (float64), and two masks: declared as nodata, and plausible as heights."""
        try:
            data = self._dataset.read(1, window=window, out_shape=shape, masked=True, resampling=resampling)
        except RasterioIOError:
            raise SourceError(self.name, "a part of it cannot be read", "Give an undamaged file") from None
        height_m = data.data.astype(np.float64) * self._scale + self._offset
        with np.errstate(invalid="ignore"):
            plausible = (height_m >= self._limits[0]) & (height_m <= self._limits[1])
        return data.data, height_m, np.ma.getmaskarray(data), plausible

    def _columns_per_turn(self, lod: int) -> int:
        """Return the number of cells of a level of detail in one turn round the earth, for a raster that wraps."""
        return max(self._wrap_period // 2**lod, 1)

    def _columns_at_lod(self, lod: int, col: np.ndarray) -> np.ndarray:
        """Return (fractional) columns at a level of detail from columns of the raster, which wraps round the earth.

        Less than one cell of the level of detail may be left over at the end of a turn round the earth. The columns between the
        last cell's centre and the first one's are stretched over that remainder. So a position has the same column, up to whole
        turns, whether it is reached from the west or from the east.
        """
        factor, cols_per_turn = 2**lod, self._columns_per_turn(lod)
        col = (col + 0.5) / factor - 0.5
        if cols_per_turn * factor == self._wrap_period:
            return col
        round_the_earth = self._wrap_period / factor
        revolution = np.floor((col + 0.5) / round_the_earth)
        col = col - revolution * round_the_earth
        to_first = round_the_earth - (cols_per_turn - 1)
        before_first, after_last = col / to_first, cols_per_turn - 1 + (col - (cols_per_turn - 1)) / to_first
        return revolution * cols_per_turn + np.where(col < 0, before_first, np.where(col > cols_per_turn - 1, after_last, col))

    def _lod_shape(self, lod: int) -> tuple[int, int]:
        """Return the number of whole cells of a level of detail: rows and columns, at least one each."""
        return max(self.rows // 2**lod, 1), max(self.cols // 2**lod, 1)

    def _read_overview(self) -> Overview:
        """Return the overview of the drawn surface, whose heights are at least the height of water. Raises ``SourceError``."""
        factors = self._dataset.overviews(1)
        check_overviews(self.name, self.rows, self.cols, factors)
        self.lacks_overviews = lacks_overviews(self.rows, self.cols, factors)
        overview = read_overview(_GroundReader(self), self.rows, self.cols)
        fine_maxima_m = None if overview.fine_max_heights_m is None else self._raised_to_water(overview.fine_max_heights_m)
        return replace(
            overview, mean_heights_m=self._raised_to_water(overview.mean_heights_m),
            max_heights_m=self._raised_to_water(overview.max_heights_m),
            fine_max_heights_m=fine_maxima_m
        )  # fmt: skip

    def _choose_resampling(self) -> None:
        """Read averages of cells from now on, unless the cells read so far contain an undeclared sentinel.

        Until then, the nearest cells are read. A sentinel is a value that stands for missing data and would spoil averages.
        """
        self._resampling = Resampling.nearest if self.undeclared_nodata.has_implausible else Resampling.average
        self._is_resampling_chosen = True


def plausible_heights_m(crs: CRS) -> tuple[float, float]:
    """Return the lowest and highest plausible height of ground in a CRS, metres; nearly unlimited in an engineering CRS."""
    if crs.is_engineering:
        return -1e6, 1e6
    return PLAUSIBLE_HEIGHTS_M if is_on_earth(crs) else PLAUSIBLE_HEIGHTS_OFF_EARTH_M


def _dilated(mask: np.ndarray) -> np.ndarray:
    """Return a mask (rows, cols) dilated by one cell in all eight directions."""
    row_dilated = mask.copy()
    row_dilated[1:] |= mask[:-1]
    row_dilated[:-1] |= mask[1:]
    dilated = row_dilated.copy()
    dilated[:, 1:] |= row_dilated[:, :-1]
    dilated[:, :-1] |= row_dilated[:, 1:]
    return dilated


@dataclass(frozen=True, eq=False)
class _GroundReader:
    """Adapter of an ``Elevation`` for ``read_overview``, which reads the ground without water.

    The public methods of ``Elevation`` return the surface, which includes water.
    """

    elevation: Elevation

    def lod_shape(self, lod: int) -> tuple[int, int]:
        return self.elevation._lod_shape(lod)

    def read(self, lod: int, row0: int, row1: int, col0: int, col1: int) -> np.ndarray:
        return self.elevation._read_inside(lod, row0, row1, col0, col1)

    def choose_resampling(self) -> None:
        self.elevation._choose_resampling()
