"""Render legends of layers."""

from __future__ import annotations

from fastapi import Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.color_scale import LEGEND_MEDIA_TYPES, LegendFormat
from skugga.api.http.responses import REQUESTED_SUN_MAX_AGE_S, cache_headers, entity_tag, has_current_copy
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.products import products_with
from skugga.api.request import ProductRequest
from skugga.terrain.errors import InputError


async def legend_response(
    request: Request, served_level: ServedLevel, product_request: ProductRequest, format: LegendFormat, parameter: str = "layer"
) -> Response:
    """Return the legend of a product as a picture, or 304 if the client's copy is current.

    Raises ``InputError`` if the product has no legend. The error names ``parameter``.
    """
    color_scale = product_request.product_record.color_scale
    if color_scale is None:
        layers_with_legends = ", ".join(products_with(lambda product: product.color_scale))
        raise InputError(parameter, product_request.product, f"a layer with a legend ({layers_with_legends})")
    headers = cache_headers(entity_tag("legend", format, served_level.version, product_request.query()), REQUESTED_SUN_MAX_AGE_S)
    if has_current_copy(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    scale = await run_in_threadpool(color_scale, product_request.options, served_level.world)
    body = await run_in_threadpool(scale.legend, format)
    return Response(body, headers=headers, media_type=LEGEND_MEDIA_TYPES[format])
