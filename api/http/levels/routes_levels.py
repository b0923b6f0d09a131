"""Routes for levels, their TileJSON and legends."""

from __future__ import annotations

from html import escape
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.color_scale import LEGEND_MEDIA_TYPES, LegendFormat
from skugga.api.http.levels.level_page import level_page_response
from skugga.api.http.openapi_parts import LEVEL_ERROR_STATUSES, LevelPath, MatrixSetPath, example_query, file_docs, problem_docs
from skugga.api.http.parameters import TILE_PARAMETERS, allow_only_parameters, tile_query
from skugga.api.http.responses import JSON_MEDIA_TYPE, base_url, json_response, wants_html
from skugga.api.http.state.service import ServiceDep
from skugga.api.http.tiles.legends import legend_response
from skugga.api.http.tiles.tilejson import tilejson_response
from skugga.api.products.heights import nodata_height_m
from skugga.api.products.product import MapFormat
from skugga.api.products.sun_hours import PRODUCT_NAME as SUN_HOURS
from skugga.api.request import ProductRequest

router = APIRouter(tags=["levels"], responses=problem_docs(*LEVEL_ERROR_STATUSES))


@router.get(
    "/levels",
    summary="The levels",
    dependencies=[Depends(allow_only_parameters())],
    response_model=list[dict[str, Any]],
    responses=file_docs("All levels.", [JSON_MEDIA_TYPE]),
)
async def levels(request: Request, service: ServiceDep) -> Response:
    """Return every level: name, title, attribution, bounds in degrees, zooms, views, lights, layers, algorithms and sun.

    `view_kinds` has the kind of each view (`map` or `perspective`) and its width and height in pixels.
    `bounds`, `minzoom`, `maxzoom` and `time_zone` (of the centre, as Europe/Oslo) are null if the level is not on the earth.
    `sun_is_default` is true if the level names no sun: `sun` is then a low sun of its place.
    `warnings` are about possible faults of its files.
    """
    served_levels = await service.all_levels()
    return json_response(request, [level.summary() for level in served_levels])


@router.get(
    "/levels/{level}",
    summary="A level",
    dependencies=[Depends(allow_only_parameters())],
    response_model=dict[str, Any],
    responses=file_docs("The level, or its page.", [JSON_MEDIA_TYPE, "text/html"]),
)
async def level(request: Request, service: ServiceDep, level: LevelPath) -> Response:
    """Return one level, as in the list of levels. Browsers get its page."""
    served_level = await service.level(level)
    if wants_html(request):
        return await level_page_response(request, service, served_level, Vary="Accept")
    return json_response(request, served_level.summary(), Vary="Accept")


@router.get(
    "/levels/{level}/{tms}/tilejson.json",
    summary="TileJSON",
    dependencies=[Depends(allow_only_parameters("format", *TILE_PARAMETERS))],
    response_model=dict[str, Any],
    responses=file_docs("TileJSON.", [JSON_MEDIA_TYPE]),
)
async def tilejson(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    tms: MatrixSetPath,
    product_request: Annotated[ProductRequest, Depends(tile_query)],
    format: Annotated[MapFormat, Query(description="Of the tiles.", examples=["webp"])] = "png",
) -> Response:
    """Return TileJSON 3.0.0 for map clients. Its tiles have the parameters of the query.

    Beyond the standard, `skugga` has the `layer`, the `tile_matrix_set` and the `sun`: its `azimuth` and apparent
    `altitude` in degrees at the level's anchor, and its `time` if the sun has one. `sun` is null if the level has no sun, or if the
    layer covers many suns. A legend is included as a picture, and in `skugga.legend` as numbers, labels and colours. Layers of
    heights have their `encoding` and the `nodata_height` in metres, their value for pixels without data. MapLibre ignores the
    `encoding` here: its source needs it, too.
    """
    served_level = await service.level(level)
    zooms = served_level.zooms_in(tms)
    product = product_request.product_record
    sun = await run_in_threadpool(served_level.sun, product_request.sun) if product.when == "sun" else None
    sun_facts: dict[str, Any] | None = None
    if sun is not None:
        time_default = {} if sun.time is None else {"time": sun.time.isoformat()}
        sun_facts = {**time_default, "azimuth": sun.azimuth_deg, "altitude": sun.altitude_deg}
    assert served_level.bounds is not None  # it has zooms, so it has a place on earth
    query = product_request.query()
    address = f"{base_url(request, service.settings.public_url)}/levels/{quote(served_level.name)}"
    tiles = f"{address}/tiles/{tms}/{{z}}/{{x}}/{{y}}.{format}"
    extra_entries: dict[str, Any] = {} if product.encoding is None else {"encoding": product.encoding}
    skugga_entries: dict[str, Any] = {"layer": product.name, "tile_matrix_set": tms, "sun": sun_facts}
    if extra_entries:
        skugga_entries["nodata_height"] = nodata_height_m(served_level.lowest_ground_m)
    if product.color_scale is not None:
        scale = await run_in_threadpool(product.color_scale, product_request.options, served_level.world)
        picture = f"{address}/legend.png?{query}"
        extra_entries["legend"] = f'<img src="{escape(picture)}" alt="{escape(scale.title)}">'
        skugga_entries["legend"] = {
            "title": scale.title, "low": scale.low, "high": scale.high, "picture": picture, "entries": scale.entries(),
        }  # fmt: skip
    level_file = served_level.loaded.level
    return tilejson_response(
        request, level_file.title or served_level.name, level_file.attribution, f"{tiles}?{query}" if query else tiles,
        (zooms.first, zooms.last), served_level.bounds, {**extra_entries, "skugga": skugga_entries},
    )  # fmt: skip


@router.get(
    "/levels/{level}/legend.{format}",
    summary="A legend",
    dependencies=[Depends(allow_only_parameters(*TILE_PARAMETERS))],
    response_class=Response,
    responses=file_docs("The picture.", LEGEND_MEDIA_TYPES.values()),
    openapi_extra=example_query("date", layer=SUN_HOURS),
)
async def legend_of_tiles(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    format: Annotated[LegendFormat, Path(description="Of the picture.", examples=["png"])],
    product_request: Annotated[ProductRequest, Depends(tile_query)],
) -> Response:
    """Return the legend of a layer as a picture. Layers that are pictures have no legend."""
    served_level = await service.level(level)
    return await legend_response(request, served_level, product_request, format)
