"""The product ``shadow``: black with the shadow as opacity, an overlay for other maps."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import Product, ProductInput, RasterProfile


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return RGBA, uint8 (rows, cols, 4): black with alpha 1 - visibility, transparent without a surface."""
    opacity = product_input.required_picture.opacity
    assert opacity is not None
    out = np.zeros((*opacity.shape, 4), np.uint8)
    out[..., 3] = opacity
    return out


PRODUCT = Product(
    name="shadow", description="black with the shadow as opacity", formats=("png", "webp", "tif"), compute=_compute,
    needs=frozenset({"color", "opacity", "reach"}), profile=lambda _: RasterProfile("uint8", 4, None), is_picture=True,
)  # fmt: skip
