"""Tiles: which block holds one, how it is cut from it, and its bytes."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from api.http.matrices import BLOCK_TILES, TILE_PX
from api.layers import LAYERS, encode_picture, picture_layer
from api.workers.jobs import RenderedBlock
from terrain.cache import MIB, cached
from terrain.errors import InputError

LOSSY_QUALITY = 90
"""Of JPEG, and of WebP where a picture is to be looked at and not to be computed with."""


def block_of_tile(x: int, y: int) -> tuple[int, int]:
    """Block (x, y) of a zoom that holds a tile of it."""
    return x // BLOCK_TILES, y // BLOCK_TILES


def cut(block: RenderedBlock, x: int, y: int, layer: str, tiles: int = 1) -> np.ndarray:
    """A picture layer of ``tiles`` x ``tiles`` tiles of a block, (x, y) being the north-western one in its matrix.

    The tiles must lie in one block.
    """
    row, col = (index % BLOCK_TILES * TILE_PX for index in (y, x))
    return picture_layer(block.part(row, col, tiles * TILE_PX), layer)


def check_format(layer: str, format: str) -> None:
    """Raise ``InputError`` where a format cannot hold a layer."""
    formats = LAYERS[layer].formats
    if format not in formats:
        raise InputError("format", format, f"{', '.join(formats)} for layer {layer}")


def encode(array: np.ndarray, layer: str, format: str) -> bytes:
    """The bytes of a picture. Layers to compute with are without loss; JPEG has white where there is no surface."""
    if LAYERS[layer].to_look_at and format == "webp":
        return _save(Image.fromarray(array), "WEBP", quality=LOSSY_QUALITY, method=2)
    if format == "jpg":
        ground = Image.new("RGB", array.shape[1::-1], "white")
        image = Image.fromarray(array)
        ground.paste(image, mask=image.getchannel("A"))
        return _save(ground, "JPEG", quality=LOSSY_QUALITY)
    return encode_picture(array, f".{format}")


@cached("process", 4 * MIB)
def empty_tile(layer: str, format: str, tiles: int = 1) -> bytes:
    """A tile without a surface."""
    side = tiles * TILE_PX
    nothing = RenderedBlock(
        np.zeros((side, side, 3), np.uint8), np.full((side, side), np.nan, np.float32), np.zeros((side, side), np.uint8),
        "", "none", (), 0.0, 0.0, False, "",
    )  # fmt: skip
    return encode(picture_layer(nothing, layer), layer, format)


def _save(image: Image.Image, kind: str, **options: int) -> bytes:
    out = io.BytesIO()
    image.save(out, kind, **options)
    return out.getvalue()
