"""Tile matrix sets: which ones are served, the zoom range of a level, and tiles without data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from morecantile import Tile, TileMatrixSet
from morecantile import tms as registered
from pyproj import CRS

from skugga.api.errors import NotServedError
from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import TILE_PX, MapView, crs_of_tiles, step_at_anchor_m, tile_grid
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, WGS84, World, transformer
from skugga.terrain.scene import Scene

FIRST_ZOOM_TILES = 0.5
"""Length of a level's longest side at its first zoom, in tiles; approximate."""

MAX_OVERZOOM = 3
"""Number of served zooms beyond the zoom whose pixels are closest in size to the raster's cells."""

CASTER_DETAIL_M = 4.0
"""Finest detail of levels with trees or meshes, metres, which sets their zoom range. At the last zoom a house of 10 m is some 20
pixels wide."""

LonLatBounds = tuple[float, float, float, float]
"""West, south, east, north in degrees; east may pass 180."""


@dataclass(frozen=True)
class ZoomRange:
    """A range of zooms.

    Attributes
    ----------
    first, last
        First and last zoom, both inclusive.
    """

    first: int
    last: int


@cached("process", 64 * MIB)
def served_matrix_sets() -> dict[str, TileMatrixSet]:
    """Return the tile matrix sets with tiles of 256 x 256 square pixels, a top left origin and constant matrix width."""
    served = {}
    for name in registered.list():
        matrix_set = registered.get(name)
        is_supported = all(
            (matrix.tileWidth, matrix.tileHeight) == (TILE_PX, TILE_PX)
            and not matrix.variableMatrixWidths
            and matrix.cornerOfOrigin == "topLeft"
            for matrix in matrix_set.tileMatrices
        )
        if is_supported:
            served[name] = matrix_set
    return served


def matrix_set_of(name: str) -> TileMatrixSet:
    """Return a tile matrix set by its name. Raises ``NotServedError``, which lists the served ones."""
    served = served_matrix_sets()
    if name not in served:
        raise NotServedError("tms", f"tms: {name[:60]!r} is not served. Served: {', '.join(served)}.")
    return served[name]


def finest_detail_m(scene: Scene) -> float:
    """Return the finest detail of a level, metres: the side of a raster cell, or ``CASTER_DETAIL_M`` with trees or meshes."""
    cell_m, level = scene.elevation.cell_size_m(scene.world.metres_per_unit), scene.loaded.level
    return min(cell_m, CASTER_DETAIL_M) if level.forest or level.meshes else cell_m


def zoom_range(matrix_set: TileMatrixSet, world: World, bounds_lon_lat: LonLatBounds, cell_m: float) -> ZoomRange | None:
    """Return the zooms at which a level is served; ``None`` if it lies outside the tile matrix set's area.

    At the first zoom the level's longest side is closest to ``FIRST_ZOOM_TILES`` tiles, so that one or two tiles show it. The last
    zoom is ``MAX_OVERZOOM`` beyond the zoom whose pixels are closest to ``cell_m`` (``finest_detail_m``). Pixels are measured on
    the ground at the level's anchor, its point of reference.
    """
    if not _intersects_area(matrix_set, bounds_lon_lat):
        return None
    zooms = np.arange(matrix_set.minzoom, matrix_set.maxzoom + 1)
    pixel_m = np.array([step_at_anchor_m(world, tile_grid(matrix_set, int(zoom))) for zoom in zooms])
    if not (np.isfinite(pixel_m) & (pixel_m > 0)).all():
        return None
    side_tiles = _longest_side_m(bounds_lon_lat) / (TILE_PX * pixel_m)
    first = int(np.abs(np.log2(side_tiles / FIRST_ZOOM_TILES)).argmin())
    last = min(int(np.abs(np.log2(pixel_m / cell_m)).argmin()) + MAX_OVERZOOM, len(zooms) - 1)
    return ZoomRange(int(zooms[min(first, last)]), int(zooms[last]))


def check_tile(matrix_set: TileMatrixSet, zooms: ZoomRange, zoom: int, x: int, y: int) -> None:
    """Raise ``NotServedError`` for a tile (column ``x``, row ``y``) outside the zoom range or the tile matrix."""
    if not zooms.first <= zoom <= zooms.last:
        raise NotServedError("z", f"z: zoom {zoom} is not served. Served: zooms {zooms.first} to {zooms.last}.")
    matrix = matrix_set.matrix(zoom)
    for name, index, count in (("x", x, matrix.matrixWidth), ("y", y, matrix.matrixHeight)):
        if not 0 <= index < count:
            raise NotServedError(name, f"{name}: tile {index} is outside the tile matrix. Allowed: 0 to {count - 1}.")


def is_quadtree_zoom(matrix_set: TileMatrixSet, zoom: int) -> bool:
    """Return whether each tile of a zoom covers exactly four tiles of the next zoom."""
    if zoom >= matrix_set.maxzoom:
        return False
    current, next_ = matrix_set.matrix(zoom), matrix_set.matrix(zoom + 1)
    return current.pointOfOrigin == next_.pointOfOrigin and abs(current.cellSize / next_.cellSize - 2.0) < 1e-9


def tile_view(matrix_set: TileMatrixSet, zoom: int, x: int, y: int, scale: int) -> MapView:
    """Return the map view of a tile with ``scale`` times 256 pixels a side, on the zoom ``zoom`` in column ``x`` and row ``y``."""
    grid, side = tile_grid(matrix_set, zoom + scale - 1), scale * TILE_PX
    return MapView(grid, float(y * side), float(x * side), 1.0, 1.0, side, side)


def tile_limits(matrix_set: TileMatrixSet, zoom: int, data_lon_lat: LonLatBounds) -> tuple[int, int, int, int]:
    """Return the first and last row, and the first and last column, of a zoom's tiles that may show data.

    All four are inclusive. Returns the whole matrix if the bounds of the data, in degrees, cannot be transformed.
    """
    matrix = matrix_set.matrix(zoom)
    rows, cols = (0, matrix.matrixHeight - 1), (0, matrix.matrixWidth - 1)
    west, south, east, north = transformer(LONGITUDE_LATITUDE, crs_of_tiles(matrix_set)).transform_bounds(
        *data_lon_lat, densify_pts=21
    )
    if data_lon_lat[2] > 180.0 or not np.isfinite([west, south, east, north]).all() or not west < east:
        return *rows, *cols
    grid = tile_grid(matrix_set, zoom)
    left, top, side = grid.x0 - grid.step / 2, grid.y0 + grid.step / 2, grid.step * TILE_PX

    def clamped_index(tile_index: float, ends: tuple[int, int]) -> int:
        return int(np.clip(np.floor(tile_index), *ends))

    return (
        clamped_index((top - north) / side, rows), clamped_index((top - south) / side, rows),
        clamped_index((west - left) / side, cols), clamped_index((east - left) / side, cols),
    )  # fmt: skip


def shows_no_data(matrix_set: TileMatrixSet, zoom: int, x: int, y: int, data_lon_lat: LonLatBounds) -> bool:
    """Return whether a tile (column ``x``, row ``y``) certainly shows no data.

    ``data_lon_lat`` are the bounds of the data in degrees.
    """
    return is_extent_without_data(crs_of_tiles(matrix_set), matrix_set.xy_bounds(Tile(x, y, zoom)), data_lon_lat)


def is_extent_without_data(crs: CRS, edges: tuple[float, float, float, float], data_lon_lat: LonLatBounds) -> bool:
    """Return whether an extent (west, south, east, north in a CRS) certainly shows no data.

    ``data_lon_lat`` are the bounds of the data in degrees. The comparison uses longitudes and latitudes, with a margin for curved
    edges. Returns ``False`` if the extent cannot be transformed; the picture is then drawn and may be empty.
    """
    west, south, east, north = transformer(crs, LONGITUDE_LATITUDE).transform_bounds(*edges, densify_pts=21)
    if not np.isfinite([west, south, east, north]).all():
        return False
    east += 360.0 if east < west else 0.0
    data_west, data_south, data_east, data_north = data_lon_lat
    margin = 0.01 * max(east - west, north - south, data_east - data_west, data_north - data_south)
    if south > data_north + margin or north < data_south - margin:
        return True
    # Shift the tile by multiples of 360 degrees, so that it begins at or after the data's western edge.
    gap = (west - (data_west - margin)) % 360.0
    begins_inside = gap <= data_east - data_west + 2.0 * margin
    reaches_round = gap + (east - west) >= 360.0
    return not (begins_inside or reaches_round)


def _intersects_area(matrix_set: TileMatrixSet, bounds: LonLatBounds) -> bool:
    """Return whether bounds in degrees lie partly in the area of use of a tile matrix set's CRS; true if the area is unknown."""
    code = matrix_set.rasterio_crs.to_epsg()
    area = None if code is None else CRS.from_epsg(code).area_of_use
    if area is None:
        return True
    west, south, east, north = bounds
    width = (area.east - area.west) % 360.0 or 360.0
    overlap_lon = (west - area.west) % 360.0 <= width or (area.west - west) % 360.0 <= east - west
    return overlap_lon and south < area.north and north > area.south


def _longest_side_m(bounds: LonLatBounds) -> float:
    """Return the longer side of some bounds, metres: along the middle parallel or along a meridian.

    The parallel is measured in steps that are short enough for geodesics to follow it.
    """
    west, south, east, north = bounds
    lon, lat = np.linspace(west, east, 9), np.full(9, (south + north) / 2)
    _, _, width = WGS84.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    _, _, height = WGS84.inv(west, south, west, north)
    return max(float(np.sum(width)), float(height), 1e-3)
