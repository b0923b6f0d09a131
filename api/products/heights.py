"""The products of heights: ``height`` as numbers, ``terrain-rgb`` and ``terrarium`` as colours for map clients."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import NEEDS_FRAME, HeightEncoding, Product, ProductInput, RasterProfile
from skugga.api.terrain_encodings import encode_terrain_rgb, encode_terrarium


def height_m(product_input: ProductInput) -> np.ndarray:
    """Return heights in metres, float32 (rows, cols): of the ground in a map, of the visible surface in a perspective view.

    Pixels without a surface are NaN.
    """
    return product_input.ground_height_m if product_input.picture is None else product_input.frame.height_m


def nodata_height_m(lowest_ground_m: float) -> float:
    """Return the height shown in pixels without data: the level's lowest ground, rounded down to whole metres.

    Data edges therefore show no tall cliff.
    """
    return float(np.floor(lowest_ground_m))


def encode_heights(heights_m: np.ndarray, nodata_m: float, encoding: HeightEncoding) -> np.ndarray:
    """Return heights (rows, cols) encoded as RGB, uint8 (rows, cols, 3). NaN becomes ``nodata_m``."""
    filled_m = np.where(np.isnan(heights_m), nodata_m, heights_m)
    return encode_terrain_rgb(filled_m) if encoding == "mapbox" else encode_terrarium(filled_m)


def _encoded_product(name: str, description: str, encoding: HeightEncoding) -> Product:
    """Return a product of heights in an encoding as colours. ``name`` and ``description`` are those of the product."""

    def compute(product_input: ProductInput) -> np.ndarray:
        return encode_heights(height_m(product_input), nodata_height_m(product_input.scene.height_range_m[0]), encoding)

    def empty(rows: int, cols: int, lowest_ground_m: float) -> np.ndarray:
        return encode_heights(np.full((rows, cols), np.nan), nodata_height_m(lowest_ground_m), encoding)

    return Product(
        name=name, description=description, formats=("png", "webp"), compute=compute, when="none", perspective_needs=NEEDS_FRAME,
        profile=lambda _: RasterProfile("uint8", 3, None), encoding=encoding, empty=empty,
    )  # fmt: skip


PRODUCTS = (
    Product(
        name="height", description="the ground's heights in metres", formats=("npy", "tif"), compute=height_m, when="none",
        perspective_needs=NEEDS_FRAME, unit="m",
    ),
    _encoded_product("terrain-rgb", "heights in Mapbox's encoding, for terrain in three dimensions", "mapbox"),
    _encoded_product("terrarium", "heights in Terrarium's encoding", "terrarium"),
)  # fmt: skip
