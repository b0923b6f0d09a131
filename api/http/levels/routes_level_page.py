"""Routes for pages of levels, layer files for QGIS, and code snippets for map clients."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from skugga.api.http.levels.level_page import level_page_response, snippets
from skugga.api.http.ogc.ogc_requests import current_year
from skugga.api.http.ogc.qgis_layers import qgis_layers
from skugga.api.http.openapi_parts import LEVEL_ERROR_STATUSES, LevelPath, file_docs, problem_docs
from skugga.api.http.parameters import TILE_PARAMETERS, allow_only_parameters, tile_query
from skugga.api.http.responses import base_url, document_response, json_response
from skugga.api.http.state.service import ServiceDep
from skugga.api.request import ProductRequest
from skugga.terrain.errors import UnsupportedError

router = APIRouter(tags=["levels"], responses=problem_docs(*LEVEL_ERROR_STATUSES), default_response_class=Response)

NO_PARAMETERS = [Depends(allow_only_parameters())]

QLR_MEDIA_TYPE = "application/x-qgis-layer-definition"


@router.get(
    "/levels/{level}.html", summary="A level as a page", responses=file_docs("The page.", ["text/html"]), dependencies=NO_PARAMETERS
)
async def page_of_level(request: Request, service: ServiceDep, level: LevelPath) -> Response:
    """Return a page with the level's picture, facts, and lines to copy into MapLibre, Leaflet, OpenLayers, QGIS and others."""
    return await level_page_response(request, service, await service.level(level))


@router.get(
    "/levels/{level}.qlr",
    summary="A level's layers for QGIS",
    responses=file_docs("The file.", [QLR_MEDIA_TYPE]),
    dependencies=NO_PARAMETERS,
)
async def qgis_layers_of_level(request: Request, service: ServiceDep, level: LevelPath) -> Response:
    """Return a layer file to drag into QGIS: shaded relief, shadows and hours of sun by WMTS with times, and heights."""
    served_level = await service.level(level)
    if not served_level.zooms:
        raise UnsupportedError(
            "level",
            level,
            f"{served_level.world.off_earth_reason or 'it lies outside of all tile matrix sets'}, so it has no tiles",
        )
    base = base_url(request, service.settings.public_url)
    return document_response(request, await run_in_threadpool(qgis_layers, served_level, base, current_year()), QLR_MEDIA_TYPE)


class ClientLines(BaseModel):
    """Lines to copy into a map client."""

    client: str
    text: str


@router.get(
    "/levels/{level}/lines.json",
    summary="Lines for map clients",
    response_model=list[ClientLines],
    responses=file_docs("The lines.", ["application/json"]),
    dependencies=[Depends(allow_only_parameters(*TILE_PARAMETERS))],
    response_class=JSONResponse,
)
async def lines_of_level(
    request: Request, service: ServiceDep, level: LevelPath, product_request: Annotated[ProductRequest, Depends(tile_query)]
) -> Response:
    """Return lines to copy into MapLibre, Leaflet, OpenLayers, QGIS, GDAL and others, as on the level's page.

    Lines for XYZ tiles include the parameters of the query.
    """
    served_level = await service.level(level)
    if served_level.world.off_earth_reason is not None:
        raise UnsupportedError("level", level, f"{served_level.world.off_earth_reason}, so it has no tiles")
    lines = snippets(served_level, base_url(request, service.settings.public_url), product_request)
    return json_response(request, [{"client": client, "text": text} for client, text in lines])
