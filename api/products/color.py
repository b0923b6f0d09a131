"""The product ``color``: shaded relief with cast shadows."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import Product, ProductInput, RasterProfile


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return RGBA, uint8 (rows, cols, 4), transparent without a surface. The sky of a perspective view is opaque."""
    color = product_input.required_picture.color
    assert color is not None
    alpha = np.where(product_input.required_picture.opaque_mask, np.uint8(255), np.uint8(0))
    return np.concatenate([color, alpha[..., None]], axis=-1)


PRODUCT = Product(
    name="color", description="shaded relief with cast shadows", formats=("png", "webp", "tif", "jpg"), compute=_compute,
    needs=frozenset({"color", "opacity", "reach"}), profile=lambda _: RasterProfile("uint8", 4, None),
    is_picture=True, is_display=True,
)  # fmt: skip
