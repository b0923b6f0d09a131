"""The registry of products, the pictures and rasters that Skugga computes.

To add a product, add a module to this folder that defines ``PRODUCT``, or several ``PRODUCTS``. Commands and HTTP import this
package to list the products' names. So that this is fast, modules import their renderers only when they compute.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from pkgutil import iter_modules

from skugga.api.products.product import PICTURE_FORMATS, Product
from skugga.terrain.errors import InputError

LEADING_PRODUCTS = "color", "shadow", "mask", "visibility", "height", "terrain-rgb", "terrarium"
"""Products that come first in lists. Other products follow by name, then the layers of render passes."""


def _products() -> Iterator[Product]:
    """Yield the products that the modules of this folder define."""
    for module in iter_modules(__path__, f"{__name__}."):
        product_module = import_module(module.name)
        yield from getattr(product_module, "PRODUCTS", ())
        if hasattr(product_module, "PRODUCT"):
            yield product_module.PRODUCT


def _sort_key(product: Product) -> tuple[bool, int, str]:
    """Return the key by which products are sorted in lists."""
    return (
        product.pass_layer is not None,
        LEADING_PRODUCTS.index(product.name) if product.name in LEADING_PRODUCTS else len(LEADING_PRODUCTS),
        product.name,
    )


PRODUCTS: dict[str, Product] = {each.name: each for each in sorted(_products(), key=_sort_key)}
"""All products by name."""


def products_with(predicate: Callable[[Product], object]) -> tuple[str, ...]:
    """Return the names of the products that fulfil a condition."""
    return tuple(name for name, product in PRODUCTS.items() if predicate(product))


VIEW_PRODUCTS = products_with(lambda each: each.view_formats)
"""Products that HTTP serves as views."""

MAP_PRODUCTS = products_with(lambda each: each.map_formats)
"""Products that HTTP serves as tiles and maps."""

RASTER_PRODUCTS = products_with(lambda each: each.is_raster)
"""Products that can be written as rasters of any size."""

SEED_PRODUCTS = products_with(lambda each: each.when != "days" and set(each.map_formats) & set(PICTURE_FORMATS))
"""Products that ``skugga seed`` computes. Products of whole dates are excluded: each tile depends on too much ground."""


def product_named(name: str, allowed_names: tuple[str, ...] | None = None, parameter_name: str = "layer") -> Product:
    """Return a product by its name, which must be among ``allowed_names`` (default: any).

    Raises ``InputError``, which names the parameter ``parameter_name``.
    """
    if name not in PRODUCTS or (allowed_names is not None and name not in allowed_names):
        raise InputError(parameter_name, name, ", ".join(PRODUCTS if allowed_names is None else allowed_names))
    return PRODUCTS[name]


def product_table() -> str:
    """Return the Markdown table of products for the documentation: name, description, formats and options."""
    rows = [
        f"| `{product.name}` | {product.description} | {', '.join(product.map_formats) or 'rasters only'} | "
        f"{', '.join(f'`{name}`' for name in product.options.model_fields) or '-'} |"
        for product in PRODUCTS.values()
        if product.map_formats or product.is_raster
    ]
    return "\n".join(("| product | shows | formats | options |", "| --- | --- | --- | --- |", *rows, ""))
