"""The ground around a point, in pages that are read when a line of sight needs them.

A page has 256 quads a side, between nodes of the ground's grid (or, for ``surface: blocks``, 256 cells). Distant ground uses a
coarser level of detail with every second, fourth and so on node. ``skugga.terrain.casters.reach`` defines the level of detail by
distance. The raster's overview gives an upper bound of the heights of each page before it is read. A page in memory also holds the
maximum height of each tile of 8 quads a side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import PATCH_QUADS
from skugga.terrain.casters.overview_cells import overview_on_grid
from skugga.terrain.casters.reach import FULL_DETAIL_NODES
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.geo.grid import Grid, map_grid, step_at_anchor_m
from skugga.terrain.geo.world import World, transformer
from skugga.terrain.ground.columns import Columns
from skugga.terrain.ground.elevation import MAX_FILL_CELLS, Elevation
from skugga.terrain.ground.surface import Surface
from skugga.terrain.heightfield.walks import write_tile_max
from skugga.terrain.scene import Scene

TILE_QUADS = 8
"""Quads per side of a tile, the part of a page whose maximum height is stored."""

PAGE_TILES = PATCH_QUADS // TILE_QUADS
"""Tiles along a side of a page."""

MAX_PAGES = 1024
"""Number of pages, 0.26 MB each, above which the next request empties the cache. One request may read more."""


@dataclass(eq=False)
class PagedLevel:
    """The ground at one level of detail: every 2**``level``-th node of a grid.

    Attributes
    ----------
    level
        Level of detail.
    page_bound_m
        float32 (m, n): upper bound of each page's heights; -inf without ground.
    first_row, first_col
        Row and column of the page of ``page_bound_m[0, 0]``, counted in pages from the grid's origin.
    page_index
        int32 (m, n): index of each page in ``height_m`` and ``tile_max_m``; -1 if it is not read.
    height_m
        float32 (pages, 257, 257), metres: heights; NaN without ground.
    tile_max_m
        float32 (pages, 32, 32), metres: the maximum height of each tile.
    page_count
        Number of pages that have been read.
    """

    level: int
    page_bound_m: np.ndarray
    first_row: int
    first_col: int
    page_index: np.ndarray
    height_m: np.ndarray
    tile_max_m: np.ndarray
    page_count: int = 0

    def store_page(self, row: int, col: int, height_m: np.ndarray) -> None:
        """Store the heights (257, 257) of the page at ``row`` and ``col`` of ``page_bound_m``."""
        if self.page_count == len(self.height_m):
            capacity = max(2 * self.page_count, 16)
            self.height_m, self.tile_max_m = _enlarged_copy(self.height_m, capacity), _enlarged_copy(self.tile_max_m, capacity)
        self.height_m[self.page_count] = height_m
        write_tile_max(height_m, self.tile_max_m[self.page_count], TILE_QUADS)
        self.page_index[row, col] = self.page_count
        self.page_count += 1


@dataclass(eq=False)
class PageCache:
    """The cached pages of a ground: its grid, and the pages read so far by level of detail."""

    grid: Grid
    levels: dict[int, PagedLevel]


@dataclass(frozen=True, eq=False)
class PagedRelief:
    """A level's ground in pages, by level of detail.

    Attributes
    ----------
    world
        The world.
    elevation
        The elevation raster.
    grid
        Grid of the nodes at full detail.
    levels
        Pages by level of detail.
    """

    world: World
    elevation: Elevation
    grid: Grid
    levels: dict[int, PagedLevel]

    @property
    def has_columns(self) -> bool:
        """Whether cells are columns with flat tops, and not nodes with triangles between them."""
        return self.elevation.surface == "blocks"

    @property
    def cell_m(self) -> float:
        """Distance of neighbouring nodes of the grid at full detail, metres."""
        return step_at_anchor_m(self.world, self.grid)

    def level(self, level: int) -> PagedLevel:
        """Return the ground at one level of detail."""
        if level not in self.levels:
            bound, first_row, first_col = _page_bounds(self, level)
            side, empty = PATCH_QUADS + 1, np.full(bound.shape, -1, np.int32)
            pages = np.empty((0, side, side), np.float32), np.empty((0, PAGE_TILES, PAGE_TILES), np.float32)
            self.levels[level] = PagedLevel(level, bound, first_row, first_col, empty, *pages)
        return self.levels[level]

    def read_pages(self, level: int, needed_pages: np.ndarray) -> None:
        """Read the pages of a level of detail that are True in ``needed_pages``, bool (m, n)."""
        pages, side = self.level(level), PATCH_QUADS + 1
        for row, col in zip(*np.nonzero(needed_pages & (pages.page_index < 0)), strict=True):
            first = (row + pages.first_row) * PATCH_QUADS, (col + pages.first_col) * PATCH_QUADS
            pages.store_page(row, col, self.nodes(level, *first, side, side))

    def nodes(self, level: int, row0: int, col0: int, rows: int, cols: int) -> np.ndarray:
        """Return the heights (rows, cols) in metres of a window of nodes, or of columns, at a level of detail.

        The nodes include the rim nodes beyond the raster, which cast shadows in maps (``Elevation.heights_with_rim``).
        ``row0`` and ``col0`` are the first row and column, counted at this level of detail.
        """
        if self.has_columns:
            return Columns(self.world, self.elevation, level).heights(row0, col0, rows, cols)[0]
        surface = Surface(self.world, self.elevation, self.grid.coarser(level))
        return surface.height_window(row0, col0, rows, cols, includes_rim=True).height_m

    def node_of(self, x: np.ndarray | float, y: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Convert coordinates in the grid's CRS to fractional rows and columns of the grid.

        In a CRS with degrees, x is shifted by multiples of 360 degrees, as near as possible to the raster's centre.
        """
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        if self.grid.crs.is_geographic:
            west, _, east, _ = self.elevation.bounds
            x = x + 360.0 * np.rint(((west + east) / 2 - x) / 360.0)
        return self.grid.row(y), self.grid.col(x)

    def ground_at(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the heights of the ground at fractional rows and columns (n,), and whether a picture shows ground there.

        Heights (n,) are in metres, and NaN without ground. Small holes of the raster have an interpolated height, but are not
        shown. Nodes are read in blocks of ``PATCH_QUADS`` a side.
        """
        height, is_visible = np.full(len(row), np.nan), np.zeros(len(row), bool)
        if not len(row):
            return height, is_visible
        near_row, near_col = (np.floor(v + 0.5).astype(np.int64) for v in (row, col))
        first_row, first_col = (near_row, near_col) if self.has_columns else (np.floor(v).astype(np.int64) for v in (row, col))
        order = np.lexsort((first_col // PATCH_QUADS, first_row // PATCH_QUADS))
        block = np.stack([first_row[order] // PATCH_QUADS, first_col[order] // PATCH_QUADS])
        for block_points in np.split(order, np.flatnonzero((np.diff(block) != 0).any(axis=0)) + 1):
            row0, col0 = int(first_row[block_points].min()), int(first_col[block_points].min())
            rows, cols = int(first_row[block_points].max()) - row0 + 1, int(first_col[block_points].max()) - col0 + 1
            cells = near_row[block_points] - row0, near_col[block_points] - col0
            if self.has_columns:
                top_m, is_shown = Columns(self.world, self.elevation, 0).heights(row0, col0, rows, cols)
                height[block_points], is_visible[block_points] = top_m[cells], is_shown[cells]
                continue
            window = Surface(self.world, self.elevation, self.grid).height_window(row0, col0, rows + 1, cols + 1)
            is_visible[block_points] = window.valid[cells]
            height[block_points] = _sheet_heights(window.height_m, row[block_points] - row0, col[block_points] - col0)
        return height, is_visible


def paged_relief(scene: Scene) -> PagedRelief:
    """Return the ground of a level in pages. It does not depend on the sun.

    Pages read for earlier points are reused. All of them are dropped if they are more than ``MAX_PAGES``.
    """
    cache = _page_cache(scene.world, scene.elevation, scene.map_crs)
    if sum(pages.page_count for pages in cache.levels.values()) > MAX_PAGES:
        cache.levels.clear()
    return PagedRelief(scene.world, scene.elevation, cache.grid, cache.levels)


@cached("scene", 1024 * MIB, size_of=lambda _: MAX_PAGES * MIB // 4)
def _page_cache(world: World, elevation: Elevation, map_crs: CRS) -> PageCache:
    """Return the cache for a ground's pages, without any page. Later reads store their pages in it."""
    if elevation.is_north_up:
        return PageCache(Columns(world, elevation, 0).grid, {})
    west, south, east, north = elevation.bounds
    if elevation.crs != map_crs:
        west, south, east, north = transformer(elevation.crs, map_crs).transform_bounds(west, south, east, north, densify_pts=21)
    probe = map_grid(world, map_crs, max(east - west, north - south) / 64)
    cell_m = elevation.cell_size_m(world.metres_per_unit)
    return PageCache(map_grid(world, map_crs, 1.01 * probe.step * cell_m / step_at_anchor_m(world, probe)), {})


def detail_distance_ranges(farthest_nodes: float) -> list[tuple[float, float]]:
    """Return the nearest and the farthest distance at which each level of detail is used, in nodes at full detail.

    The last range includes ``farthest_nodes``.
    """
    ends, near, far = [], 0.0, float(FULL_DETAIL_NODES)
    while near < farthest_nodes:
        ends.append((near, far))
        near, far = far, 2.0 * far
    return ends


def _page_bounds(ground: PagedRelief, level: int) -> tuple[np.ndarray, int, int]:
    """Return upper bounds of the heights of pages at a level of detail, float32 (m, n) in metres, and the first page.

    The first page is given by its row and column, counted in pages from the grid's origin.
    """
    row, col, half = overview_on_grid(ground.world, ground.elevation, ground.grid)
    high = ground.elevation.overview.max_heights_m
    # Heights in holes are interpolated from the ground around them.
    holes = MAX_FILL_CELLS * 2**level if np.isnan(high).any() else 0
    valid = np.isfinite(high) & np.isfinite(row) & np.isfinite(col)
    row, col, half, high = row[valid], col[valid], half[valid] + holes + 2**level, high[valid]
    side = PATCH_QUADS * 2**level
    spans = [(np.floor((v - half) / side).astype(np.int64), np.floor((v + half) / side).astype(np.int64)) for v in (row, col)]
    (top, bottom), (left, right) = spans
    first_row, first_col = int(top.min()), int(left.min())
    revolution = _columns_per_revolution(ground) / side
    bound = np.full((int(bottom.max()) - first_row + 1, int(right.max()) - first_col + 1), -np.inf, np.float32)
    for down in range(int((bottom - top).max()) + 1):
        for offset in range(int((right - left).max()) + 1):
            np.maximum.at(bound, (np.minimum(top + down, bottom) - first_row, np.minimum(left + offset, right) - first_col), high)
    if not revolution:
        return bound, first_row, first_col
    reach = int(np.ceil(revolution)) + 1  # a global raster: add 360 degrees to either side
    wide = np.full((bound.shape[0], bound.shape[1] + 2 * reach), high.max(), np.float32)
    wide[:, reach:-reach] = np.where(np.isfinite(bound), bound, high.max())
    return wide, first_row, first_col - reach


def _columns_per_revolution(ground: PagedRelief) -> float:
    """Return the number of grid columns in 360 degrees, if the ground spans the whole earth; otherwise 0."""
    west, _, east, _ = ground.elevation.bounds
    if not ground.grid.crs.is_geographic or east - west < 360.0 - 1.5 * ground.grid.step:
        return 0.0
    return 360.0 / ground.grid.step


def _enlarged_copy(array: np.ndarray, capacity: int) -> np.ndarray:
    """Return a copy of an array of pages, enlarged to ``capacity`` pages."""
    grown = np.empty((capacity, *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


@internal
def quad_height(nw, ne, sw, se, down_share, right_share):
    """Return the height of the ground at a position in a quad.

    The position is ``down_share`` of the way from north to south and ``right_share`` of the way from west to east.
    ``nw``, ``ne``, ``sw`` and ``se`` are the heights of its corners. The quad is cut into two triangles along its higher diagonal
    (``skugga.terrain.ground.sheet``). The result is NaN in a triangle with a missing corner.
    """
    rising = ne + sw
    if nw + se > rising or np.isnan(rising):
        if down_share < right_share:
            return nw + right_share * (ne - nw) + down_share * (se - ne)
        return nw + down_share * (sw - nw) + right_share * (se - sw)
    if down_share + right_share <= 1.0:
        return nw + right_share * (ne - nw) + down_share * (sw - nw)
    return se + (1.0 - right_share) * (sw - se) + (1.0 - down_share) * (ne - se)


@compiled
def _sheet_heights(node_height_m, row, col):
    """Return the heights (n,) of the ground at rows and columns (n,) of a window of nodes with heights (rows, cols)."""
    out = np.empty(len(row))
    for n in range(len(row)):
        i, j = int(np.floor(row[n])), int(np.floor(col[n]))
        fr, fc = row[n] - i, col[n] - j
        nw, ne = np.float64(node_height_m[i, j]), np.float64(node_height_m[i, j + 1])
        sw, se = np.float64(node_height_m[i + 1, j]), np.float64(node_height_m[i + 1, j + 1])
        if fr == 0.0 or fc == 0.0:  # on an edge between two nodes: the other two may be NaN
            end, share = (sw, fr) if fc == 0.0 else (ne, fc)
            out[n] = nw + share * (end - nw) if share != 0.0 else nw
        else:
            out[n] = quad_height(nw, ne, sw, se, fr, fc)
    return out
