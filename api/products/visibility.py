"""The product ``visibility``: the share of the light that reaches the point of each pixel."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import Product, ProductInput
from skugga.shadows.picture import Needs

NEEDS_VISIBILITY: Needs = frozenset({"visibility", "reach"})
"""Needs of a product that is computed from the visibility of one light, 0 to 1."""


def visibility_of(product_input: ProductInput) -> np.ndarray:
    """Return the visibility of the first light, float32 (rows, cols), NaN without a surface."""
    visibility = product_input.required_picture.visibility
    assert visibility is not None
    return visibility


PRODUCT = Product(
    name="visibility", description="the share of the light that reaches the ground, 0 to 1", formats=("npy", "tif"),
    compute=visibility_of, needs=NEEDS_VISIBILITY, unit="1",
)  # fmt: skip
