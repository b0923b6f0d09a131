"""The sample grid of a map view, and views and blocks on it.

A map view has no camera. Its surface is one world-fixed grid of samples (nodes) per level, CRS and zoom. The same ground therefore
has the same triangles in every view. Node (row, col) lies at ``x = x0 + col * step``, ``y = y0 - row * step``; rows grow
southwards. ``skugga.terrain.ground.sheet`` defines how the quads between nodes are split.

The nodes of tiles are the centres of the tile matrix's pixels. Other map views use the largest power-of-two resolution that is not
coarser than the requested one:

- In the CRSs of ``MATRIX_SET_NAMES`` it is the resolution of a tile matrix. These resolutions halve from zoom to zoom.
- In other CRSs it is a power of two of the CRS's unit. Nodes are counted from the anchor, the centre of the level's bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from pyproj import CRS

from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, epsg_of, transformer

if TYPE_CHECKING:
    from morecantile import TileMatrixSet

BLOCK_PX = 1024
"""Side of a map block in pixels: the unit of work and of caching."""
TILE_PX = 256
"""Side of a tile in pixels."""

MAX_WINDOW_NODES = 8192
"""Maximum number of nodes along a side of a block, which limits how oblong pixels may be.

Pixels up to four times as long as wide always pass, and more oblong ones in small pictures.
"""

MATRIX_SET_NAMES = {3857: "WebMercatorQuad", 4326: "WGS1984Quad"}
"""EPSG codes of CRSs whose maps share the grids of a tile matrix set, and the name of that set."""


FloatOrArray = TypeVar("FloatOrArray", float, np.ndarray)

PixelWindow = tuple[slice, slice]
"""Rows and columns of a picture."""


class PixelArea(Protocol):
    """An object with rows and columns of pixels, such as a view."""

    @property
    def rows(self) -> int: ...

    @property
    def cols(self) -> int: ...


@dataclass(frozen=True)
class Grid:
    """A world-fixed lattice of samples in a CRS.

    Attributes
    ----------
    crs
        The CRS.
    x0, y0
        Coordinates of node (0, 0) in CRS units.
    step
        Distance of neighbouring nodes in x, in CRS units.
    y_to_x_step_ratio
        The step in y over that in x. It is 1 except for rasters' own cells.
    refinement_count
        How many times the grid was refined (``refined``). A refined grid has the same surface as the coarse one, since its nodes
        lie on the coarse one's quads.
    """

    crs: CRS
    x0: float
    y0: float
    step: float
    y_to_x_step_ratio: float = 1.0
    refinement_count: int = 0

    def __hash__(self) -> int:
        return hash(
            (self.x0, self.y0, self.step, self.y_to_x_step_ratio, self.refinement_count)
        )  # without the CRS, whose hash is slow

    def x(self, col: FloatOrArray) -> FloatOrArray:
        """Return x of a (fractional) column, in CRS units."""
        return self.x0 + col * self.step

    def y(self, row: FloatOrArray) -> FloatOrArray:
        """Return y of a (fractional) row, in CRS units."""
        return self.y0 - row * (self.step * self.y_to_x_step_ratio)

    def col(self, x: FloatOrArray) -> FloatOrArray:
        """Return the (fractional) column of x."""
        return (x - self.x0) / self.step

    def row(self, y: FloatOrArray) -> FloatOrArray:
        """Return the (fractional) row of y."""
        return (self.y0 - y) / (self.step * self.y_to_x_step_ratio)

    def coarser(self, lod: int) -> Grid:
        """Return the grid of every ``2**lod``-th node."""
        return replace(self, step=self.step * 2**lod, refinement_count=max(self.refinement_count - lod, 0))

    def finer(self, halvings: int) -> Grid:
        """Return the grid with ``2**halvings`` times as many nodes per side. It contains this grid's nodes.

        Heights are read at all of its nodes. (``refined`` instead keeps this grid's surface.)
        """
        return replace(self, step=self.step / 2**halvings)

    def refined(self) -> Grid:
        """Return the grid of the same surface with twice as many nodes per side. It contains this grid's nodes.

        Heights at the other nodes are interpolated on the quads between this grid's nodes.
        """
        return replace(self, step=self.step / 2, refinement_count=self.refinement_count + 1)

    def subdivided(self, halvings: int) -> Grid:
        """Return the grid whose pixels divide each of this grid's pixels into ``2**halvings`` x ``2**halvings``.

        For a tile matrix this is the grid of the matrix ``halvings`` zooms further in.
        """
        step, side = self.step / 2**halvings, self.step * self.y_to_x_step_ratio
        y0 = self.y0 + side / 2 - step * self.y_to_x_step_ratio / 2
        return Grid(self.crs, self.x0 - self.step / 2 + step / 2, y0, step, self.y_to_x_step_ratio)


@dataclass(frozen=True)
class MapView:
    """Pixels of a map. Their centres are (fractional) node coordinates of a grid.

    The centre of pixel (i, j) lies at row ``row0 + i * row_step`` and column ``col0 + j * col_step``.

    Attributes
    ----------
    grid
        The grid.
    row0, col0
        Node coordinates of the first pixel's centre.
    row_step, col_step
        Distance of neighbouring pixels in nodes.
    rows, cols
        Size in pixels.
    pixel_share
        A pixel's side as a share of the steps. It is 1 except in views of every n-th pixel.
    """

    grid: Grid
    row0: float
    col0: float
    row_step: float
    col_step: float
    rows: int
    cols: int
    pixel_share: float = 1.0

    @property
    def is_on_nodes(self) -> bool:
        """Whether every pixel centre is a node, as in tiles."""
        steps = self.row_step == 1.0 and self.col_step == 1.0
        return steps and float(self.row0).is_integer() and float(self.col0).is_integer()

    @property
    def centre_node(self) -> tuple[float, float]:
        """(Fractional) row and column of the centre."""
        return self.row0 + (self.rows - 1) / 2 * self.row_step, self.col0 + (self.cols - 1) / 2 * self.col_step

    @property
    def centre(self) -> tuple[float, float]:
        """x, y of the centre in CRS units."""
        row, col = self.centre_node
        return float(self.grid.x(col)), float(self.grid.y(row))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north of the pixels' outer edges in CRS units."""
        west, east = self.col0 - self.col_step / 2, self.col0 + (self.cols - 0.5) * self.col_step
        north, south = self.row0 - self.row_step / 2, self.row0 + (self.rows - 0.5) * self.row_step
        return float(self.grid.x(west)), float(self.grid.y(south)), float(self.grid.x(east)), float(self.grid.y(north))

    def part(self, row: int, col: int, rows: int, cols: int) -> MapView:
        """Return the view of ``rows`` x ``cols`` pixels, the first of which is pixel (``row``, ``col``) of this view.

        ``row`` and ``col`` may be negative.
        """
        row0, col0 = self.row0 + row * self.row_step, self.col0 + col * self.col_step
        return replace(self, row0=row0, col0=col0, rows=rows, cols=cols)

    def shifted(self, rows: float, cols: float) -> MapView:
        """Return the view with all pixel centres moved down and to the right by fractions of a pixel."""
        down, right = self.pixel_share * self.row_step, self.pixel_share * self.col_step
        return replace(self, row0=self.row0 + rows * down, col0=self.col0 + cols * right)

    def with_pixels_as_nodes(self) -> MapView:
        """Return the same pixels as nodes of a new grid, whose spacing is the pixels' spacing.

        Node (0, 0) of the new grid is within half a pixel of node (0, 0) of this grid. A view whose pixels are nodes is unchanged.
        """
        if self.is_on_nodes:
            return self
        row, col = self.row0 / self.row_step, self.col0 / self.col_step
        whole_row, whole_col = np.rint(row), np.rint(col)
        x0, y0 = self.grid.x((col - whole_col) * self.col_step), self.grid.y((row - whole_row) * self.row_step)
        stretch = self.grid.y_to_x_step_ratio * self.row_step / self.col_step
        grid = Grid(self.grid.crs, float(x0), float(y0), self.grid.step * self.col_step, stretch)
        return MapView(grid, float(whole_row), float(whole_col), 1.0, 1.0, self.rows, self.cols, self.pixel_share)

    def coarser_nodes(self, pixels_per_node: int, margin: int = 0) -> tuple[MapView, tuple[float, float]]:
        """Return a lattice of nodes, ``pixels_per_node`` pixels apart, that surrounds the view's pixels.

        Nodes are centres of squares of pixels, counted from the grid's origin. So neighbouring views share them. The lattice has at
        least ``margin`` nodes beyond those between which the pixels lie.

        Returns
        -------
        tuple
            The nodes as a view, and row and column of its first node in pixels of this view.
        """
        pixels = self.with_pixels_as_nodes()
        first_nodes, counts = [], []
        for start, count in ((pixels.row0, pixels.rows), (pixels.col0, pixels.cols)):
            begin = int(np.floor(start / pixels_per_node)) - 1 - margin
            counts.append(int(np.ceil((start + count) / pixels_per_node)) + 1 + margin - begin)
            first_nodes.append(pixels_per_node * begin + 0.5 * (pixels_per_node - 1))
        step = float(pixels_per_node)
        nodes = MapView(pixels.grid, first_nodes[0], first_nodes[1], step, step, counts[0], counts[1])
        return nodes, (first_nodes[0] - pixels.row0, first_nodes[1] - pixels.col0)

    def finer(self, subpixels_per_side: int) -> MapView:
        """Return the view on the same grid that divides each pixel into ``subpixels_per_side`` x ``subpixels_per_side`` pixels."""
        first = (1.0 / subpixels_per_side - 1.0) / 2.0
        shifted_view = self.shifted(first, first)
        return replace(
            shifted_view,
            row_step=self.row_step / subpixels_per_side,
            col_step=self.col_step / subpixels_per_side,
            rows=self.rows * subpixels_per_side,
            cols=self.cols * subpixels_per_side,
        )


def map_grid(world: World, crs: CRS, resolution: float) -> Grid:
    """Return the grid of a map view other than a tile, for pixels of ``resolution`` CRS units.

    The distance between its nodes is the largest power-of-two resolution (see the module) that does not exceed ``resolution``.
    """
    name = None if world.is_flat else MATRIX_SET_NAMES.get(epsg_of(crs) or 0)
    if name is not None:
        from morecantile import tms as matrix_sets  # imported here: takes 0.2 s, and maps in other CRSs do not need it

        tms = matrix_sets.get(name)
        base = tms.matrix(0).cellSize
        zoom = int(np.clip(np.ceil(np.log2(base / resolution) - 1e-9), -30, 60))
        if zoom < 0:
            return tile_grid(tms, 0).coarser(-zoom)
        return tile_grid(tms, zoom) if zoom <= tms.maxzoom else tile_grid(tms, tms.maxzoom).finer(zoom - tms.maxzoom)
    step = float(2.0 ** np.floor(np.log2(resolution) + 1e-9))
    x, y = world.anchor_x, world.anchor_y
    if crs != world.crs:
        x, y = transformer(LONGITUDE_LATITUDE, crs).transform(world.anchor_lon_deg, world.anchor_lat_deg)
    return Grid(crs, x + step / 2, y - step / 2, step)  # pixels, not nodes, touch at the anchor


@cached("process", MIB, size_of=lambda _: 512)
def step_at_anchor_m(world: World, grid: Grid) -> float:
    """Return the ground distance between neighbouring nodes at the anchor in metres: the square root of a quad's area.

    The anchor is the centre of the level's bounds. One value serves the whole level, so that all its tiles choose the same detail.
    """
    if world.is_flat:
        return grid.step * world.metres_per_unit * float(np.sqrt(grid.y_to_x_step_ratio))
    if grid.crs == world.crs:
        x, y = world.anchor_x, world.anchor_y
    else:
        x, y = transformer(LONGITUDE_LATITUDE, grid.crs).transform(world.anchor_lon_deg, world.anchor_lat_deg)
    half = grid.step / 2
    down = half * grid.y_to_x_step_ratio
    point, _ = world.points_at_zero_height(grid.crs, np.array([x - half, x + half, x, x]), np.array([y, y, y - down, y + down]))
    size = np.linalg.norm(point[1] - point[0]) * np.linalg.norm(point[3] - point[2])
    return float(np.sqrt(size))


@cached("process", MIB, key=lambda tms: (tms.id,), size_of=lambda _: 2**14)
def crs_of_tiles(tms: TileMatrixSet) -> CRS:
    """Return the CRS of a tile matrix set: the same object each time, since caches compare CRSs by identity."""
    return CRS.from_user_input(tms.rasterio_crs.to_wkt())


@cached("process", MIB, key=lambda tms, zoom: (tms.id, zoom), size_of=lambda _: 512)
def tile_grid(tms: TileMatrixSet, zoom: int) -> Grid:
    """Return the grid of a tile matrix. Nodes are the centres of its pixels, counted from the matrix's north-west corner."""
    from morecantile import Tile

    step = tms.matrix(zoom).cellSize
    corner = tms.xy_bounds(Tile(0, 0, zoom))
    return Grid(crs_of_tiles(tms), corner.left + step / 2, corner.top - step / 2, step)


def map_view(world: World, crs: CRS, bounds: tuple[float, float, float, float], rows: int, cols: int) -> MapView:
    """Return the view of a map extent (west, south, east, north in ``crs``) with a size in pixels.

    Pixel centres that lie on nodes within rounding errors are snapped to them.
    """
    west, south, east, north = bounds
    col_px, row_px = (east - west) / cols, (north - south) / rows
    grid = map_grid(world, crs, min(col_px, row_px))
    nodes = max(min(cols, BLOCK_PX) * col_px, min(rows, BLOCK_PX) * row_px) / grid.step
    if nodes > MAX_WINDOW_NODES:
        problem = Problem(f"{cols}x{rows} gives pixels of {col_px:.3g} by {row_px:.3g} in {crs.name}")
        raise InputError("size", problem, "Choose a size with nearly square pixels")
    # Subtract first: with coordinates in the millions differences are exact where sums are not.
    row0, row_step = _snapped(((grid.y0 - north) + row_px / 2) / grid.step, row_px / grid.step, rows)
    col0, col_step = _snapped(((west - grid.x0) + col_px / 2) / grid.step, col_px / grid.step, cols)
    return MapView(grid, row0, col0, row_step, col_step, rows, cols)


def blocks_of(view: MapView) -> list[tuple[MapView, int, int]]:
    """Return the blocks that cover a view, each with the row and column in the view of the block's first pixel.

    These may be negative. Where pixels are nodes, blocks are world-fixed: they start at multiples of ``BLOCK_PX`` nodes. Every view
    then uses the same blocks. Otherwise blocks start at the view's corner.
    """
    first_row = int(view.row0) % BLOCK_PX if view.is_on_nodes else 0
    first_col = int(view.col0) % BLOCK_PX if view.is_on_nodes else 0
    blocks = []
    for row in range(-first_row, view.rows, BLOCK_PX):
        for col in range(-first_col, view.cols, BLOCK_PX):
            rows = BLOCK_PX if view.is_on_nodes else min(BLOCK_PX, view.rows - row)
            cols = BLOCK_PX if view.is_on_nodes else min(BLOCK_PX, view.cols - col)
            blocks.append((view.part(row, col, rows, cols), row, col))
    return blocks


def overlap_windows(view: PixelArea, block: PixelArea, row: int, col: int) -> tuple[PixelWindow, PixelWindow]:
    """Return the rows and columns of a view that a block covers, and the same pixels' rows and columns in the block.

    ``row`` and ``col`` are the view's row and column of the block's first pixel, as in ``blocks_of``.
    """
    view_window = (slice(max(row, 0), min(row + block.rows, view.rows)), slice(max(col, 0), min(col + block.cols, view.cols)))
    return view_window, (
        slice(view_window[0].start - row, view_window[0].stop - row),
        slice(view_window[1].start - col, view_window[1].stop - col),
    )


def _snapped(start: float, step: float, count: int) -> tuple[float, float]:
    """Return the position of the first pixel and the distance of neighbouring pixels, along one axis, in nodes.

    They are rounded to whole numbers if all ``count`` pixels then keep their positions within rounding errors.
    """
    rounded = np.rint(start), np.rint(step)
    if abs(start - rounded[0]) < 1e-6 and abs(step - rounded[1]) * count < 1e-6 and rounded[1] >= 1:
        return float(rounded[0]), float(rounded[1])
    return start, step
