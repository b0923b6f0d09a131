"""The product ``cosi``: the cosine of the sun's angle of incidence."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import Product, ProductInput


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return the cosine of the sun's angle of incidence on a map's ground, float32 (rows, cols); NaN without ground."""
    from skugga.shadows.sunlit_ground import cosine_of_incidence

    return cosine_of_incidence(product_input.scene, product_input.map_view)


PRODUCT = Product(
    name="cosi", description="the cosine of the sun's angle of incidence on the ground", formats=("tif", "npy"), compute=_compute,
    view_kinds=("map",), unit="1",
)  # fmt: skip
