"""Tiles of a drawn block: where they lie in it, and their bytes."""

from __future__ import annotations

import io
from dataclasses import dataclass, field, replace

import numpy as np
from PIL import Image

from skugga.api.layers import LAYERS, LOSSY_QUALITY, MapFormat, encode_picture, encoded_heights, geotiff, map_layer, npy
from skugga.api.sun_hours_layer import SUN_HOURS_LAYER
from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import InputError
from skugga.terrain.geo.grid import BLOCK_PX, TILE_PX, MapView

BLOCK_TILES = BLOCK_PX // TILE_PX

ARRAY_FORMATS = ("tif", "npy")
"""Formats that a tile without a surface has, too: a TIFF says where it lies, and either may be of floating point."""

NOT_ASKED = np.zeros((0, 0), np.float32)
"""What stands for the visibility at pixels' own points where nobody asked."""

Place = tuple[int, int]
"""Row and column of a tile in its block, among tiles of its size."""


@dataclass(frozen=True, eq=False)
class PicturedBlock:
    """A drawn block, or a part of it: ``color`` (rows, cols, 3) uint8, ``opacity`` (rows, cols) uint8 of the shadow as it is shown,
    ``there`` bool (rows, cols), where there is a surface; ``visibility`` float32 (rows, cols) at pixels' own points, NaN off the
    surface: empty where nobody asked.
    """

    color: np.ndarray
    opacity: np.ndarray
    there: np.ndarray
    visibility: np.ndarray = field(default_factory=lambda: NOT_ASKED)

    @property
    def opaque(self) -> np.ndarray:
        """Where the colour means something."""
        return self.there

    def part(self, row: int, col: int, side: int) -> PicturedBlock:
        """The square part of a block whose first pixel is (row, col)."""
        pixels = slice(row, row + side), slice(col, col + side)
        return replace(
            self, color=self.color[pixels], opacity=self.opacity[pixels], there=self.there[pixels],
            visibility=self.visibility[pixels],
        )  # fmt: skip


def place_in_block(x: int, y: int, tiles: int) -> tuple[Place, Place]:
    """Block (x, y) of a zoom that holds a tile of it, or ``tiles`` x ``tiles`` of them, and where there that lies."""
    return (x // BLOCK_TILES, y // BLOCK_TILES), (y % BLOCK_TILES // tiles, x % BLOCK_TILES // tiles)


def encoded_tiles(
    block: PicturedBlock, layer: str, format: MapFormat, tiles: int = 1, view: MapView | None = None
) -> dict[Place, bytes]:
    """The bytes of all pictures of ``tiles`` x ``tiles`` tiles in a block, each in ``format``; ``view`` is where a TIFF lies."""
    side = tiles * TILE_PX
    out = {}
    for row in range(BLOCK_TILES // tiles):
        for col in range(BLOCK_TILES // tiles):
            part = block.part(row * side, col * side, side)
            here = None if view is None else view.part(row * side, col * side, side, side)
            shown = format in ARRAY_FORMATS or part.there.any()
            out[row, col] = encoded_part(part, layer, format, here) if shown else empty_tile(layer, format, tiles)
    return out


def cut_tiles(array: np.ndarray, layer: str, format: MapFormat, tiles: int, view: MapView) -> dict[Place, bytes]:
    """The bytes of all parts of ``tiles`` x ``tiles`` tiles of a block's layer; ``view`` is where the block lies."""
    side = tiles * TILE_PX
    out = {}
    for row in range(BLOCK_TILES // tiles):
        for col in range(BLOCK_TILES // tiles):
            part = np.ascontiguousarray(array[row * side : (row + 1) * side, col * side : (col + 1) * side])
            out[row, col] = encode(part, layer, format, view.part(row * side, col * side, side, side))
    return out


def map_formats_of(layer: str) -> tuple[MapFormat, ...]:
    """The formats that tiles of a layer are served in."""
    return ("png", "webp") if layer == SUN_HOURS_LAYER else LAYERS[layer].map_formats


def check_format(layer: str, format: str) -> None:
    """Raise ``InputError`` where a format cannot hold a layer."""
    formats = map_formats_of(layer)
    if format not in formats:
        raise InputError("format", format, f"{', '.join(formats)} for layer {layer}")


def encoded_part(part: PicturedBlock, layer: str, format: str, view: MapView | None = None) -> bytes:
    """The bytes of a layer of a part of a block, which lies where a ``view`` does."""
    if LAYERS[layer].to_look_at and format not in ARRAY_FORMATS and part.opaque.all():
        return encode(part.color, layer, format, view)  # no alpha is made that would go again
    return encode(map_layer(part, layer), layer, format, view)


def encode(array: np.ndarray, layer: str, format: str, view: MapView | None = None) -> bytes:
    """The bytes of a layer of a map. Layers to compute with are without loss; JPEG has white where there is no surface. What is to
    be looked at has no alpha where nothing is transparent, but in a TIFF, which lies where the ``view`` does.
    """
    if layer == SUN_HOURS_LAYER:
        return encode_picture(array, f".{format}")
    if format == "tif":
        return geotiff(array, view, LAYERS[layer].nodata)
    if format == "npy":
        return npy(array)
    if LAYERS[layer].to_look_at and array.shape[2] == 4 and (array[..., 3] == 255).all():
        array = array[..., :3]
    if LAYERS[layer].to_look_at and format == "webp":
        out = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(array)).save(out, "WEBP", quality=LOSSY_QUALITY, method=2)
        return out.getvalue()
    if format == "jpg" and array.shape[2] == 4:
        picture = Image.fromarray(array)
        opaque = Image.new("RGB", picture.size, "white")
        opaque.paste(picture, mask=picture.getchannel("A"))
        array = np.asarray(opaque)
    return encode_picture(array, f".{format}")


@cached("process", 4 * MIB)
def empty_tile(layer: str, format: str, tiles: int = 1, nodata_m: float = 0.0) -> bytes:
    """A tile without a surface; of heights, one that has ``nodata_m`` everywhere. Not as a TIFF: that has a place."""
    return encode(empty_layer(layer, tiles * TILE_PX, tiles * TILE_PX, nodata_m), layer, format)


def empty_layer(layer: str, rows: int, cols: int, nodata_m: float) -> np.ndarray:
    """A layer of a map without a surface; of heights, ``nodata_m`` is told where numbers have no NaN."""
    if layer == SUN_HOURS_LAYER:
        return np.zeros((rows, cols, 4), np.uint8)
    encoding = LAYERS[layer].encoding
    if encoding is not None:
        return encoded_heights(np.full((rows, cols), np.nan), nodata_m, encoding)
    return map_layer(_nothing(rows, cols), layer)


def _nothing(rows: int, cols: int) -> PicturedBlock:
    """A map without a surface."""
    missing, none = np.full((rows, cols), np.nan, np.float32), np.zeros((rows, cols), np.uint8)
    return PicturedBlock(np.zeros((rows, cols, 3), np.uint8), none, none.astype(np.bool_), missing)
