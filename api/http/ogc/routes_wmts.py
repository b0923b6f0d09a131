"""Serve WMTS 1.0.0, the Web Map Tile Service: capabilities, and tiles by keys and values (KVP).

Clients of RESTful WMTS fetch tiles from the routes of ``routes_tiles``.
"""

from __future__ import annotations

from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.http.ogc.ogc_requests import (
    KeyValuePairs,
    current_year,
    exception_response,
    format_of_media_type,
    layer_request,
    split_layer,
)
from skugga.api.http.ogc.ogc_xml import ows_exception
from skugga.api.http.ogc.wmts_capabilities import WMTS_VERSION, wmts_capabilities
from skugga.api.http.openapi_parts import (
    LEVEL_ERROR_STATUSES,
    WORK_ERROR_STATUSES,
    LevelPath,
    example_query,
    exception_docs,
    file_docs,
    ogc_parameters,
)
from skugga.api.http.parameters import DEFAULT_STYLE
from skugga.api.http.responses import base_url, document_response
from skugga.api.http.state.service import Service, ServiceDep
from skugga.api.http.tiles.tile_docs import EMPTY_TILE_DOCS
from skugga.api.http.tiles.tile_responses import tile_response
from skugga.api.matrices import matrix_set_of
from skugga.api.products.product import MEDIA_TYPES
from skugga.terrain.errors import InputError, SkuggaError, UnsupportedError

router = APIRouter(tags=["map services"], default_response_class=Response)

WMTS_EXCEPTION_CODES = {
    "": "NoApplicableCode", "*": "InvalidParameterValue", "missing": "MissingParameterValue", "REQUEST": "OperationNotSupported",
    "VERSION": "VersionNegotiationFailed", "ACCEPTVERSIONS": "VersionNegotiationFailed",
    "X": "TileOutOfRange", "Y": "TileOutOfRange",
}  # fmt: skip
"""Exception codes by the wrong parameter (``exception_response`` explains the special keys).

They come from OWS Common 1.1.0, table 27, and WMTS 1.0.0, table 24."""


DEFAULT_TIME_PARAMETER = ogc_parameters(
    TIME=("Default time of all layers; by default each layer has the time of its level.", "2024-10-21T16:30:00Z")
)


@router.get(
    "/wmts/1.0.0/WMTSCapabilities.xml",
    summary="WMTS capabilities",
    responses=file_docs("The document.", ["text/xml"]) | exception_docs(422, 500),
    openapi_extra=DEFAULT_TIME_PARAMETER,
)
async def wmts_of_all(request: Request, service: ServiceDep) -> Response:
    """Return the capabilities of all levels that lie on earth.

    They list a WMTS layer for each level and layer, every tile matrix set, and the times.
    """
    return await _capabilities_response(request, service, None)


@router.get(
    "/levels/{level}/WMTSCapabilities.xml",
    summary="WMTS capabilities of a level",
    responses=file_docs("The document.", ["text/xml"]) | exception_docs(*LEVEL_ERROR_STATUSES),
    openapi_extra=DEFAULT_TIME_PARAMETER,
)
async def wmts_of_level(request: Request, service: ServiceDep, level: LevelPath) -> Response:
    """Return the capabilities of one level.

    A `time` becomes the default time of all layers, for clients that cannot ask for another one.
    """
    return await _capabilities_response(request, service, level)


WMTS_KEYS = ogc_parameters(
    SERVICE=("`WMTS`, or nothing.", "WMTS"),
    VERSION=("`1.0.0`, or nothing.", WMTS_VERSION),
    REQUEST=("`GetCapabilities` or `GetTile`; the other keys are of tiles.", "GetTile"),
    LAYER=("As level:layer.", "jacksboro:color"),
    STYLE=("A style of the layer; `default`, or nothing: the level's own.", DEFAULT_STYLE),
    TILEMATRIXSET=("A tile matrix set by its name.", "WebMercatorQuad"),
    TILEMATRIX=("A matrix of the set: mostly the zoom.", "11"),
    TILEROW=("Row of the tile, from the north.", "800"),
    TILECOL=("Column of the tile, from the west.", "544"),
    FORMAT=("A media type.", "image/png"),
    TIME=("An instant; without an offset in UTC.", "2024-10-21T16:30:00Z"),
    AZIMUTH=("With `ALTITUDE`, instead of `TIME`: degrees clockwise from true north.", "235"),
    ALTITUDE=("Apparent degrees above the horizon.", "22"),
)


@router.get(
    "/wmts",
    summary="WMTS by keys and values",
    responses=file_docs("The tile, or the document.", [*MEDIA_TYPES.values(), "text/xml"])
    | EMPTY_TILE_DOCS
    | exception_docs(*WORK_ERROR_STATUSES),
    openapi_extra=WMTS_KEYS | example_query("REQUEST", "LAYER", "TILEMATRIXSET", "TILEMATRIX", "TILEROW", "TILECOL", "FORMAT"),
)
async def wmts_by_keys(request: Request, service: ServiceDep) -> Response:
    """Answer `REQUEST=GetCapabilities` or `GetTile`.

    `GetTile` takes `LAYER` (as level:layer), `STYLE`, `TILEMATRIXSET`, `TILEMATRIX`, `TILEROW`, `TILECOL`, `FORMAT` and `TIME`.
    `AZIMUTH` and `ALTITUDE` may replace the time.
    """
    try:
        parameters = KeyValuePairs(request)
        operation = parameters.require("REQUEST", "Use one of GetCapabilities, GetTile")
        if (parameters.get("SERVICE") or "WMTS").upper() != "WMTS":
            raise InputError("SERVICE", parameters.get("SERVICE"), "WMTS")
        for name in ("VERSION", "ACCEPTVERSIONS"):
            if WMTS_VERSION not in (parameters.get(name) or WMTS_VERSION).split(","):
                raise InputError(name, parameters.get(name), WMTS_VERSION)
        match operation.lower():
            case "getcapabilities":
                return await _capabilities_response(request, service, None)
            case "gettile":
                return await _tile_response(request, service, parameters)
        raise InputError("REQUEST", operation, "GetCapabilities, GetTile")
    except SkuggaError as error:
        return exception_response(request, error, WMTS_EXCEPTION_CODES, ows_exception)


async def _tile_response(request: Request, service: Service, parameters: KeyValuePairs) -> Response:
    """Return the answer to ``GetTile``, a picture. Raises ``SkuggaError``."""
    level_name, layer = split_layer("LAYER", parameters.require("LAYER", "Give a layer, such as LEVEL:color"))
    matrix_set = parameters.require("TILEMATRIXSET", "Give a tile matrix set, such as WebMercatorQuad")
    tile_matrix_set = matrix_set_of(matrix_set)
    matrices = {matrix.id: zoom for zoom, matrix in enumerate(tile_matrix_set.tileMatrices, tile_matrix_set.minzoom)}
    matrix = parameters.require("TILEMATRIX", f"Give a matrix of the set {matrix_set}")
    if matrix not in matrices:
        raise InputError("TILEMATRIX", matrix, ", ".join(matrices))
    tile = matrices[matrix], parameters.require_integer("TILECOL"), parameters.require_integer("TILEROW")
    format = format_of_media_type(parameters.require("FORMAT", "Give a media type, such as image/png"))
    level = await service.level(level_name)
    if level.world.off_earth_reason is not None:
        raise UnsupportedError("LAYER", f"{level_name}:{layer}", f"{level.world.off_earth_reason}, so the level has no tiles")
    product_request = await run_in_threadpool(layer_request, request, level, layer, parameters, "STYLE")
    return await tile_response(request, service, level_name, matrix_set, tile, 1, format, product_request)


async def _capabilities_response(request: Request, service: Service, level: str | None) -> Response:
    """Return the capabilities document of a level (``None``: of all levels), or an error as an XML exception."""
    try:
        levels = await run_in_threadpool(service.levels.current_levels) if level is None else [await service.level(level)]
        levels_on_earth = [served_level for served_level in levels if served_level.zooms]
        if level is not None and not levels_on_earth:
            reason = levels[0].world.off_earth_reason or "the level lies outside of all tile matrix sets"
            raise UnsupportedError("level", level, f"{reason}, so it has no tiles")
        base = base_url(request, service.settings.public_url)
        all_levels_url = f"{base}/wmts/{WMTS_VERSION}/WMTSCapabilities.xml"
        address = all_levels_url if level is None else f"{base}/levels/{quote(level)}/WMTSCapabilities.xml"
        body = await run_in_threadpool(
            wmts_capabilities, levels_on_earth, base, address, current_year(), KeyValuePairs(request).get("TIME")
        )
        return document_response(request, body, "text/xml")
    except SkuggaError as error:
        return exception_response(request, error, WMTS_EXCEPTION_CODES, ows_exception)
