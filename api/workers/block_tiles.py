"""Cut a block into tiles, and encode them as files.

A block is a square of 4 x 4 tiles (1024 x 1024 pixels) that a render process computes as one picture or array.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skugga.api.encoding import ARRAY_FORMATS, apply_color_scale, encode
from skugga.api.products.product import MapFormat, ProductInput
from skugga.api.request import ProductRequest
from skugga.shadows.picture import Picture
from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import BLOCK_PX, TILE_PX, MapView
from skugga.terrain.geo.world import World
from skugga.terrain.scene import Scene

BLOCK_SIDE_TILES = BLOCK_PX // TILE_PX
"""Number of tiles along a side of a block."""

TilePosition = tuple[int, int]
"""Row and column of a file in its block, counted from 0 at the north-west. The unit is the side of the file, in tiles."""


def block_and_position(x: int, y: int, tiles_per_side: int) -> tuple[TilePosition, TilePosition]:
    """Return the column and row of the block that holds tile (``x``, ``y``) of a zoom, and the tile's position in the block.

    ``x`` is the tile's column and ``y`` its row in the tile matrix. The position, (row, col), is that of the file with the
    tile. Each file covers a square of ``tiles_per_side`` x ``tiles_per_side`` tiles.
    """
    return (x // BLOCK_SIDE_TILES, y // BLOCK_SIDE_TILES), (
        y % BLOCK_SIDE_TILES // tiles_per_side,
        x % BLOCK_SIDE_TILES // tiles_per_side,
    )


def tiles_of_picture(
    picture: Picture, request: ProductRequest, scene: Scene, view: MapView, format: MapFormat, tiles_per_side: int = 1
) -> dict[TilePosition, bytes | None]:
    """Return the encoded files of a drawn block, by the (row, col) position of each file in the block.

    Each file shows a square of ``tiles_per_side`` x ``tiles_per_side`` tiles of 256 x 256 pixels. ``tiles_per_side`` is 1, or
    2 for tiles of twice the side. ``view`` is the map view of the whole block. A file without data is ``None``. In array
    formats, every position has a file.
    """
    files: dict[TilePosition, bytes | None] = {}
    for position, part_view, window in _tiles_of(view, tiles_per_side):
        part = picture.part(window)
        has_data = format in ARRAY_FORMATS or bool(part.valid.any())
        files[position] = tile_of_picture(part, request, scene, part_view, format) if has_data else None
    return files


def tile_of_picture(picture: Picture, request: ProductRequest, scene: Scene, view: MapView, format: MapFormat) -> bytes:
    """Return a product's encoded file of a section of a drawn block. ``picture`` and ``view`` show that section only."""
    product = request.product_record
    if product.is_display and format not in ARRAY_FORMATS and picture.color is not None and picture.opaque_mask.all():
        array = picture.color  # avoids an alpha channel that encoding would drop
    else:
        array = product.compute(ProductInput(scene, view, request.options, picture))
    return encode(apply_color_scale(array, product, request.options, scene.world, format), product, request.options, format, view)


def tiles_of_array(
    array: np.ndarray, request: ProductRequest, world: World, view: MapView, format: MapFormat, tiles_per_side: int = 1
) -> dict[TilePosition, bytes]:
    """Return the encoded files of a block's array, by the (row, col) position of each file in the block.

    ``array`` has the block's pixels, (rows, cols) or (rows, cols, bands). ``world`` is the level's, which colour scales depend on.
    ``tiles_per_side`` and ``view`` are as in ``tiles_of_picture``.
    """
    colored_array = apply_color_scale(array, request.product_record, request.options, world, format)
    return {
        position: encode(np.ascontiguousarray(colored_array[window]), request.product_record, request.options, format, part_view)
        for position, part_view, window in _tiles_of(view, tiles_per_side)
    }


def _tiles_of(view: MapView, tiles_per_side: int) -> Iterator[tuple[TilePosition, MapView, tuple[slice, slice]]]:
    """Yield for each file of a block its (row, col) position, its map view, and its slices of the block's pixels: rows, columns.

    ``view`` is the map view of the block. Each file covers a square of ``tiles_per_side`` x ``tiles_per_side`` tiles.
    """
    side = tiles_per_side * TILE_PX
    for row in range(BLOCK_SIDE_TILES // tiles_per_side):
        for col in range(BLOCK_SIDE_TILES // tiles_per_side):
            window = slice(row * side, (row + 1) * side), slice(col * side, (col + 1) * side)
            yield (row, col), view.part(row * side, col * side, side, side), window


@cached("process", 4 * MIB)
def empty_tile(request: ProductRequest, format: MapFormat, tiles_per_side: int = 1, lowest_ground_m: float = 0.0) -> bytes:
    """Return the file of ``tiles_per_side`` x ``tiles_per_side`` tiles without data.

    ``lowest_ground_m`` is as in ``empty_file``.
    """
    return empty_file(request, (tiles_per_side * TILE_PX, tiles_per_side * TILE_PX), format, lowest_ground_m)


def empty_file(
    request: ProductRequest, shape: tuple[int, int], format: MapFormat, lowest_ground_m: float, view: MapView | None = None
) -> bytes:
    """Return the encoded file of a map of ``shape`` (rows, cols) without data.

    ``lowest_ground_m`` is the height of the level's lowest ground in metres, from which heights without data are made.
    """
    make_empty = request.product_record.empty_array if format in ARRAY_FORMATS else request.product_record.empty_picture
    return encode(make_empty(request.options, *shape, lowest_ground_m), request.product_record, request.options, format, view)
