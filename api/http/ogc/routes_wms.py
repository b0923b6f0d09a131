"""Serve WMS 1.3.0, the Web Map Service: capabilities, maps, feature info and legends."""

from __future__ import annotations

import json

from fastapi import APIRouter, Request, Response
from pyproj import CRS
from starlette.concurrency import run_in_threadpool

from skugga.api.errors import NotServedError
from skugga.api.http.ogc.ogc_requests import (
    KeyValuePairs,
    current_year,
    exception_response,
    format_of_media_type,
    layer_request,
    requested_sun,
    split_layer,
)
from skugga.api.http.ogc.ogc_times import default_date, requested_date
from skugga.api.http.ogc.ogc_xml import wms_exception
from skugga.api.http.ogc.wms_capabilities import (
    INFO_MEDIA_TYPES,
    MAP_MEDIA_TYPES,
    WMS_LAYERS,
    WMS_LEGEND_MEDIA_TYPES,
    WMS_VERSION,
    map_media_types,
    wms_capabilities,
)
from skugga.api.http.openapi_parts import WORK_ERROR_STATUSES, LevelPath, example_query, exception_docs, file_docs, ogc_parameters
from skugga.api.http.parameters import DEFAULT_STYLE
from skugga.api.http.points.point_documents import ReportRows, report_features, report_page, report_rows, report_text
from skugga.api.http.points.point_queries import resolve_current_time
from skugga.api.http.responses import base_url, document_response
from skugga.api.http.state.job_responses import job_response
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.state.service import Service, ServiceDep
from skugga.api.http.tiles.legends import legend_response
from skugga.api.http.tiles.map_extents import MapBounds, check_side, crs_code, crs_of_code, is_north_first, parse_bounds
from skugga.api.http.tiles.maps import MapQuery, map_response
from skugga.api.point.values import PointQuery
from skugga.api.products import PRODUCTS
from skugga.api.products.product import MEDIA_TYPES
from skugga.api.request import PictureRequest
from skugga.api.workers.jobs import PointJob
from skugga.terrain.errors import InputError, SkuggaError, UnsupportedError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer

router = APIRouter(tags=["map services"], default_response_class=Response)

WMS_OPERATIONS = "GetCapabilities, GetMap, GetFeatureInfo, GetLegendGraphic"

WMS_EXCEPTION_CODES = {
    "": "NoApplicableCode", "*": "InvalidParameterValue", "missing": "MissingParameterValue", "REQUEST": "OperationNotSupported",
    "LAYERS": "LayerNotDefined", "LAYER": "LayerNotDefined", "QUERY_LAYERS": "LayerNotDefined", "LEVEL": "LayerNotDefined",
    "STYLES": "StyleNotDefined", "STYLE": "StyleNotDefined", "CRS": "InvalidCRS", "FORMAT": "InvalidFormat",
    "INFO_FORMAT": "InvalidFormat", "I": "InvalidPoint", "J": "InvalidPoint", "TIME": "InvalidDimensionValue",
}  # fmt: skip
"""Exception codes by the wrong parameter (``exception_response`` explains the special keys).

They come from WMS 1.3.0, table E.1, or else from OWS Common."""


WMS_KEYS = ogc_parameters(
    SERVICE=("`WMS`, or nothing.", "WMS"),
    VERSION=("`1.3.0`, or nothing.", WMS_VERSION),
    REQUEST=(f"One of {WMS_OPERATIONS}.", "GetMap"),
    LAYERS=("Of a map: one layer, as level:layer.", "jacksboro:color"),
    QUERY_LAYERS=("Of `GetFeatureInfo`: one layer, as level:layer.", "jacksboro:color"),
    LAYER=("Of `GetLegendGraphic`: a layer, as level:sunhours.", "jacksboro:sunhours"),
    STYLES=("A style of the layer; `default`, or nothing: the level's own.", "default"),
    STYLE=("Of a legend: `default`, or nothing.", "default"),
    CRS=("A CRS by its code.", "CRS:84"),
    BBOX=("Four numbers, in the order of the CRS's own axes.", "8.38,47.48,8.49,47.55"),
    WIDTH=("Pixels.", "256"),
    HEIGHT=("Pixels.", "256"),
    I=("Of `GetFeatureInfo`: column of the pixel in the map, from the left.", "128"),
    J=("Of `GetFeatureInfo`: row of the pixel in the map, from the top.", "128"),
    INFO_FORMAT=(f"Of `GetFeatureInfo`: {', '.join(INFO_MEDIA_TYPES)}.", INFO_MEDIA_TYPES[0]),
    FORMAT=("A media type.", "image/png"),
    TRANSPARENT=("`TRUE`, or `FALSE`: then `BGCOLOR` is behind what has no data.", "TRUE"),
    BGCOLOR=("A colour.", "0xFFFFFF"),
    TIME=("An instant, or of hours of sun a date; without an offset in UTC.", "2024-10-21T16:30:00Z"),
    AZIMUTH=("With `ALTITUDE`, instead of `TIME`: degrees clockwise from true north.", "235"),
    ALTITUDE=("Apparent degrees above the horizon.", "22"),
)
WMS_EXAMPLE_QUERY = example_query("REQUEST", "LAYERS", "CRS", "BBOX", "WIDTH", "HEIGHT", "FORMAT")
WMS_DOCS = file_docs(
    "The capabilities, the map, the feature info, or the legend.",
    dict.fromkeys([*MAP_MEDIA_TYPES, "text/xml", *INFO_MEDIA_TYPES, *WMS_LEGEND_MEDIA_TYPES]),
) | exception_docs(*WORK_ERROR_STATUSES)


@router.get("/wms", summary="WMS", responses=WMS_DOCS, openapi_extra=WMS_KEYS | WMS_EXAMPLE_QUERY)
async def wms(request: Request, service: ServiceDep) -> Response:
    """Answer `REQUEST=GetCapabilities`, `GetMap`, `GetFeatureInfo` or `GetLegendGraphic`.

    Layers are named level:layer. The sun comes from `TIME`, or from `AZIMUTH` and `ALTITUDE`. Extents have the axis order of the
    CRS: latitude first in EPSG:4326.
    """
    return await _respond(request, service, None)


@router.get("/levels/{level}/wms", summary="WMS of a level", responses=WMS_DOCS, openapi_extra=WMS_KEYS | WMS_EXAMPLE_QUERY)
async def wms_of_level(request: Request, service: ServiceDep, level: LevelPath) -> Response:
    """Answer the same requests. The capabilities list this level alone."""
    return await _respond(request, service, level)


async def _respond(request: Request, service: Service, level: str | None) -> Response:
    """Answer a WMS request by its operation. ``level`` restricts capabilities to one level; errors become XML exceptions."""
    try:
        parameters = KeyValuePairs(request)
        operation = parameters.require("REQUEST", f"Use one of {WMS_OPERATIONS}")
        if (parameters.get("SERVICE") or "WMS").upper() != "WMS":
            raise InputError("SERVICE", parameters.get("SERVICE"), "WMS")
        if operation.lower() == "getcapabilities":  # any VERSION is accepted, and answered in 1.3.0 (6.2.4)
            return await _capabilities_response(request, service, level)
        if operation.lower() != "getlegendgraphic" and (parameters.get("VERSION") or WMS_VERSION) != WMS_VERSION:
            raise InputError("VERSION", parameters.get("VERSION"), WMS_VERSION)
        match operation.lower():
            case "getmap":
                return await _map_response(request, service, parameters)
            case "getfeatureinfo":
                return await _feature_info_response(request, service, parameters)
            case "getlegendgraphic":
                return await _legend_response(request, service, parameters)
        raise InputError("REQUEST", operation, WMS_OPERATIONS)
    except SkuggaError as error:
        return exception_response(request, error, WMS_EXCEPTION_CODES, wms_exception)


async def _capabilities_response(request: Request, service: Service, level: str | None) -> Response:
    """Return the capabilities of one level (``None``: of all levels that lie on earth).

    Raises ``UnsupportedError`` off the earth.
    """
    levels = await run_in_threadpool(service.levels.current_levels) if level is None else [await service.level(level)]
    if level is not None and (off_earth_reason := levels[0].world.off_earth_reason) is not None:
        raise UnsupportedError("level", level, f"{off_earth_reason}, so the level has no map on earth")
    levels_on_earth = [served_level for served_level in levels if served_level.world.off_earth_reason is None]
    base = base_url(request, service.settings.public_url)
    address = f"{base}/wms" if level is None else f"{base}{request.url.path}"
    body = await run_in_threadpool(
        wms_capabilities, levels_on_earth, base, address, service.settings.max_snapshot_pixels, current_year()
    )  # fmt: skip
    return document_response(request, body, "text/xml")


async def _requested_layer(service: Service, parameters: KeyValuePairs, parameter: str) -> tuple[ServedLevel, str]:
    """Return the level and the layer that the key ``parameter`` of a request names. Raises ``NotServedError`` or ``InputError``."""
    name = parameters.require(parameter, "Give one layer, such as LEVEL:color")
    if "," in name:
        raise NotServedError(
            parameter, f"{parameter}: several layers in one map. Use one layer: LayerLimit of the capabilities is 1."
        )
    level_name, layer = split_layer(parameter, name)
    if layer not in WMS_LAYERS:
        raise NotServedError(parameter, f"{parameter}: layer {layer} is not served by WMS. Use tiles or WMTS.")
    level = await service.level(level_name)
    if level.world.off_earth_reason is not None:
        raise UnsupportedError(parameter, name, f"{level.world.off_earth_reason}, so the level has no map on earth")
    return level, layer


def _requested_extent(parameters: KeyValuePairs) -> tuple[str, CRS, MapBounds, tuple[int, int]]:
    """Return a request's CRS code, CRS, bounds in that CRS, and (width, height) in pixels. Raises ``InputError``."""
    code = crs_code(parameters.require("CRS", "Give a CRS, such as EPSG:3857"))
    crs = crs_of_code(code)
    bounds = parse_bounds(parameters.require("BBOX", "Give four numbers"), "BBOX", is_north_first(crs))
    width, height = (check_side(name, parameters.require_integer(name)) for name in ("WIDTH", "HEIGHT"))
    return code, crs, bounds, (width, height)


async def _map_response(request: Request, service: Service, parameters: KeyValuePairs) -> Response:
    """Return the answer to ``GetMap``, a picture or a GeoTIFF. Raises ``SkuggaError``."""
    level, layer = await _requested_layer(service, parameters, "LAYERS")
    code, _, bounds, size = await run_in_threadpool(_requested_extent, parameters)
    format = format_of_media_type(parameters.require("FORMAT", "Give a media type, such as image/png"))
    if format not in PRODUCTS[layer].map_formats:
        raise InputError("FORMAT", MEDIA_TYPES[format], f"{map_media_types(layer)} for layer {layer}")
    product_request = await run_in_threadpool(layer_request, request, level, layer, parameters, "STYLES")
    is_transparent = (parameters.get("TRANSPARENT") or "FALSE").upper() == "TRUE"
    background = None if is_transparent else _parse_background(parameters.get("BGCOLOR") or "0xFFFFFF")
    return await map_response(request, service, level, MapQuery(bounds, code, size, product_request, format, background))


def _parse_background(text: str) -> str:
    """Return the six upper-case hexadecimal digits of a BGCOLOR such as ``0xFFFFFF``. Raises ``InputError``."""
    digits = text[2:].upper() if text[:2].lower() == "0x" else ""
    if len(digits) != 6 or set(digits) - set("0123456789ABCDEF"):
        raise InputError("BGCOLOR", text, "0xRRGGBB")
    return digits


async def _feature_info_response(request: Request, service: Service, parameters: KeyValuePairs) -> Response:
    """Return the answer to ``GetFeatureInfo``: the sun report of the point at the centre of the pixel (I, J).

    Raises ``SkuggaError``.
    """
    level, layer = await _requested_layer(service, parameters, "QUERY_LAYERS")
    _, crs, (west, south, east, north), (width, height) = await run_in_threadpool(_requested_extent, parameters)
    col, row = (parameters.require_integer(name) for name in ("I", "J"))
    for name, pixel, count in (("I", col, width), ("J", row, height)):
        if pixel >= count:
            raise InputError(name, pixel, f"pixels of the map, 0 to {count - 1}")
    media_type = parameters.get("INFO_FORMAT") or INFO_MEDIA_TYPES[0]
    if media_type not in INFO_MEDIA_TYPES:
        raise InputError("INFO_FORMAT", media_type, ", ".join(INFO_MEDIA_TYPES))
    x, y = west + (col + 0.5) * (east - west) / width, north - (row + 0.5) * (north - south) / height
    lon, lat = transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
    is_of_days = PRODUCTS[layer].when == "days"
    day = requested_date(parameters.get("TIME"), default_date(level, current_year())) if is_of_days else None
    sun = None if is_of_days else requested_sun(request, level, parameters)
    if not (abs(lon) <= 540.0 and abs(lat) <= 90.0):
        remark, is_json = "this pixel shows no place on earth", media_type == "application/json"
        text = report_features(None, {"remark": remark}) if is_json else _info_text([("Remark", remark)], media_type)
        return Response(text, headers={"Cache-Control": "no-store"}, media_type=media_type)
    point, max_age_s = resolve_current_time(PointQuery(lon=lon, lat=lat, date=day), sun)
    job = PointJob(level=level.key, query=point, request=PictureRequest(sun=sun))

    def write_info(body: bytes) -> bytes:
        report = json.loads(body)
        if media_type == "application/json":
            return report_features((report["lon"], report["lat"]), report).encode()
        return _info_text(report_rows(report), media_type).encode()

    return await job_response(request, service, job, level.name, "info", media_type, max_age_s, write_info)


def _info_text(rows: ReportRows, media_type: str) -> str:
    """Return the rows of a report as an HTML page or as plain text."""
    return report_page(rows) if media_type == "text/html" else report_text(rows)


async def _legend_response(request: Request, service: Service, parameters: KeyValuePairs) -> Response:
    """Return the answer to ``GetLegendGraphic``, a picture. Raises ``SkuggaError``."""
    level, layer = await _requested_layer(service, parameters, "LAYER")
    if parameters.get("STYLE") not in (None, DEFAULT_STYLE):
        raise InputError("STYLE", parameters.get("STYLE"), f"{DEFAULT_STYLE}, or no STYLE")
    media_type = parameters.get("FORMAT") or WMS_LEGEND_MEDIA_TYPES[0]
    if media_type not in WMS_LEGEND_MEDIA_TYPES:
        raise InputError("FORMAT", media_type, ", ".join(WMS_LEGEND_MEDIA_TYPES))
    format = "svg" if media_type == WMS_LEGEND_MEDIA_TYPES[1] else "png"
    product_request = await run_in_threadpool(layer_request, request, level, layer, parameters, "STYLE")
    return await legend_response(request, level, product_request, format, "LAYER")  # type: ignore[arg-type]
