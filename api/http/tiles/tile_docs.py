"""Documented responses (OpenAPI) that the routes of tiles, maps and snapshots share."""

from __future__ import annotations

from skugga.api.http.openapi_parts import WORK_ERROR_STATUSES, ResponseDocs, file_docs, problem_docs
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.products.product import MEDIA_TYPES
from skugga.selector.formatting import format_list

PICTURE_DOCS: ResponseDocs = {
    **file_docs(
        "The picture. `X-Skugga-Caster-Reach` is the distance towards the sun in which casters were searched.", MEDIA_TYPES.values()
    ),
    **problem_docs(*WORK_ERROR_STATUSES),
}

EMPTY_TILE_DOCS: ResponseDocs = {204: {"description": "No data there, where `SKUGGA_EMPTY_TILE` is 204."}}

DATA_LAYERS = format_list([f"`{name}`" for name in MAP_PRODUCTS if not PRODUCTS[name].is_display], max_items=len(PRODUCTS))
"""Names of layers whose pixels are data, not colours for display, as a phrase for descriptions."""

JPEG_LAYERS = format_list([f"`{name}`" for name in MAP_PRODUCTS if "jpg" in PRODUCTS[name].formats], max_items=len(PRODUCTS))
"""Names of layers that are available as JPEG, as a phrase for descriptions."""
