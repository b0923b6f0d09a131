"""Serve snapshots: a view of a level as one picture."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from skugga.api.http.numbers import PLAIN_DECIMAL
from skugga.api.http.openapi_parts import LevelPath, example_query, file_docs
from skugga.api.http.parameters import (
    PICTURE_PARAMETERS,
    LayerQuery,
    ViewQuery,
    allow_only_parameters,
    check_pixels,
    parse_size,
    picture_query,
)
from skugga.api.http.responses import DEFAULT_SUN_MAX_AGE_S, REQUESTED_SUN_MAX_AGE_S
from skugga.api.http.state.job_responses import job_response
from skugga.api.http.state.service import ServiceDep
from skugga.api.http.tiles.tile_docs import JPEG_LAYERS, PICTURE_DOCS
from skugga.api.http.views.cameras import CAMERA_PARAMETERS, camera_query
from skugga.api.products import PRODUCTS, VIEW_PRODUCTS, product_named
from skugga.api.products.product import MEDIA_TYPES, PictureFormat
from skugga.api.request import PictureRequest, ProductRequest
from skugga.api.workers.jobs import SnapshotJob
from skugga.selector.formatting import format_list
from skugga.terrain.errors import InputError
from skugga.terrain.level.parts import PerspectiveSpec

router = APIRouter(
    tags=["snapshots"], responses=PICTURE_DOCS | file_docs("The picture.", MEDIA_TYPES.values()), default_response_class=Response
)

REQUEST_VIEW_NAME = "request"
"""Name of a view that the query defines, instead of a view of the level. Plans and jobs contain it."""

SINGLE_LIGHT_LAYERS = format_list([f"`{name}`" for name in VIEW_PRODUCTS if not PRODUCTS[name].is_display], max_items=len(PRODUCTS))
"""Names of layers that show the shadow of one light, as a phrase for descriptions."""


@router.get(
    "/levels/{level}/snapshot.{format}",
    summary="A view of a level",
    dependencies=[
        Depends(allow_only_parameters("view", *CAMERA_PARAMETERS, "size", "layer", "light", "seconds", *PICTURE_PARAMETERS))
    ],
    openapi_extra=example_query("size"),
)
async def snapshot(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    format: Annotated[
        PictureFormat, Path(description=f"PNG and WebP are lossless; JPEG is for {JPEG_LAYERS} alone.", examples=["png"])
    ],
    picture_request: Annotated[PictureRequest, Depends(picture_query)],
    camera: Annotated[PerspectiveSpec | None, Depends(camera_query)],
    view: ViewQuery = None,
    size: Annotated[
        str | None, Query(max_length=20, description="WxH in pixels; default: the view's own.", examples=["256x256"])
    ] = None,
    layer: LayerQuery = "color",
    light: Annotated[
        str | None,
        Query(
            max_length=100,
            description=f"The light that {SINGLE_LIGHT_LAYERS} show; default: the sun, else the first.",
            examples=["sun"],
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        PLAIN_DECIMAL,
        Query(
            ge=-1e9,
            le=1e9,
            allow_inf_nan=False,
            description="Clock of casters, lamps and clouds that move; default: the level's.",
            examples=[0],
        ),
    ] = None,
) -> Response:
    """Draw a map view or perspective view of a level.

    The view is one of the level, changed by the query, or one that the query defines by `eye` and `target`. In a level file these
    are lists, as `eye: [8.43, 47.5, 300]`.
    """
    served_level = await service.level(level)
    product = product_named(layer, VIEW_PRODUCTS)
    if format not in product.view_formats:
        raise InputError("format", format, f"{', '.join(product.view_formats)} for layer {layer}")
    if camera is not None and view is not None:
        raise InputError.conflict("view", "eye and target")
    name = REQUEST_VIEW_NAME if camera is not None else served_level.view_named(view)
    given_size = None if size is None else parse_size(size)
    pixels = given_size or (served_level.view_sizes[name] if camera is None else camera.size)
    if pixels is not None:
        check_pixels(pixels, service.settings.max_snapshot_pixels)
    lights = served_level.lights(picture_request.sun)
    if light is not None and light not in lights:
        raise InputError("light", light, ", ".join(lights))
    job = SnapshotJob(
        level=served_level.key, view=name, camera=camera, format=format, size=given_size,
        light=None if product.is_display else light, seconds=seconds,
        request=ProductRequest(product=layer, **dict(picture_request)),
    )  # fmt: skip
    max_age_s = DEFAULT_SUN_MAX_AGE_S if picture_request.sun is None else REQUESTED_SUN_MAX_AGE_S
    return await job_response(request, service, job, level, "snapshot", MEDIA_TYPES[format], max_age_s)
