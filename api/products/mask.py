"""The product ``mask``: the classes shadow, lit and no surface."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import Product, ProductInput, RasterProfile
from skugga.api.products.visibility import NEEDS_VISIBILITY, visibility_of

MASK_SHADOW, MASK_NO_SURFACE, MASK_LIT = 0, 128, 255
"""Values of the classes. A pixel is in shadow if less than half of the light reaches it."""


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return the class of each pixel, uint8 (rows, cols): ``MASK_SHADOW``, ``MASK_LIT`` or ``MASK_NO_SURFACE``."""
    classes = np.where(visibility_of(product_input) < 0.5, MASK_SHADOW, MASK_LIT)
    return np.where(product_input.required_picture.valid, classes, MASK_NO_SURFACE).astype(np.uint8)


PRODUCT = Product(
    name="mask", description=f"gray: {MASK_SHADOW} shadow, {MASK_LIT} lit, {MASK_NO_SURFACE} no surface",
    formats=("png", "webp", "tif", "npy"), compute=_compute, needs=NEEDS_VISIBILITY,
    profile=lambda _: RasterProfile("uint8", 1, MASK_NO_SURFACE), is_smooth=False, is_picture=True,
)  # fmt: skip
