"""Write the capabilities document of WMS 1.3.0 (OGC 06-042, 7.2.4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element

from pyproj import CRS

from skugga.api.color_scale import LEGEND_MEDIA_TYPES, LEGEND_SIZE_PX
from skugga.api.http.ogc.ogc_requests import gis_formats, layer_name, layer_title, styles_of
from skugga.api.http.ogc.ogc_times import time_dimension
from skugga.api.http.ogc.ogc_xml import XLINK, XSI, add, document, format_numbers, lon_lat_box
from skugga.api.http.ogc.wmts_capabilities import layer_abstract, legend_url
from skugga.api.http.request_times import DEFAULT_TIME
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.tiles.map_extents import bounds_in, crs_of_code, north_first
from skugga.api.products import PRODUCTS, products_with
from skugga.api.products.product import MEDIA_TYPES
from skugga.terrain.errors import InputError

WMS_VERSION = "1.3.0"

WMS_LAYERS = products_with(lambda product: product.encoding is None and "png" in product.map_formats)
"""Layers that WMS serves: those that map clients can show.

Heights encoded in colours are for tile clients, and clients cannot show floating point data."""

MAP_MEDIA = ("image/png", "image/webp", "image/jpeg", "image/tiff")
INFO_MEDIA = ("application/json", "text/html", "text/plain")
LEGEND_MEDIA = tuple(LEGEND_MEDIA_TYPES.values())

COMMON_CRS = ("EPSG:3857", "EPSG:4326", "CRS:84")
"""CRSs that the capabilities list for every level. A request may use any other CRS that PROJ knows by its code."""

SCHEMA_WMS = "http://www.opengis.net/wms http://schemas.opengis.net/wms/1.3.0/capabilities_1_3_0.xsd"


def wms_capabilities(levels: Sequence[ServedLevel], base_url: str, address: str, max_pixels: int, year: int) -> bytes:
    """Return the capabilities document of levels that lie on earth.

    Parameters
    ----------
    levels
        The levels.
    base_url, address
        URLs of the whole service and of the WMS.
    max_pixels
        Maximum number of pixels of a map. Its square root is listed as the maximum of width and height.
    year
        The year whose times are listed for levels whose sun has no time.
    """
    root = Element(
        "WMS_Capabilities",
        {
            "xmlns": "http://www.opengis.net/wms", "xmlns:xlink": XLINK, "xmlns:xsi": XSI, "xsi:schemaLocation": SCHEMA_WMS,
            "version": WMS_VERSION,
        },
    )  # fmt: skip
    service = add(root, "Service")
    for tag, text in (("Name", "WMS"), ("Title", "Skugga"), ("Abstract", "Terrain with the sun's true cast shadows.")):
        add(service, tag, text)
    _add_online_resource(service, base_url)
    side = math.isqrt(max_pixels)  # a request may have a longer side if its other side is short enough
    for tag, value in (("Fees", "none"), ("AccessConstraints", "none"), ("LayerLimit", 1), ("MaxWidth", side), ("MaxHeight", side)):
        add(service, tag, value)
    capability = add(root, "Capability")
    # GetLegendGraphic is not listed: QGIS would ask for it for every layer. A layer with a legend has a LegendURL.
    request = add(capability, "Request")
    for name, media in (
        ("GetCapabilities", ("text/xml",)), ("GetMap", MAP_MEDIA), ("GetFeatureInfo", INFO_MEDIA),
    ):  # fmt: skip
        operation = add(request, name)
        for media_type in media:
            add(operation, "Format", media_type)
        _add_online_resource(add(add(add(operation, "DCPType"), "HTTP"), "Get"), f"{address}?")
    add(add(capability, "Exception"), "Format", "XML")
    root_layer = add(capability, "Layer")
    add(root_layer, "Title", "Skugga")
    for code in COMMON_CRS:
        add(root_layer, "CRS", code)
    for level in levels:
        _add_level(root_layer, level, base_url, address, year)
    return document(root)


def crs_of_maps(level: ServedLevel) -> dict[str, CRS]:
    """Return the CRSs that the capabilities list for a level, by code: ``COMMON_CRS`` and that of the level's own maps."""
    authority_and_code = level.map_crs.to_authority()
    codes = [*COMMON_CRS, *([] if authority_and_code is None else [":".join(authority_and_code)])]
    return {code: crs_of_code({"CRS:84": "OGC:CRS84"}.get(code, code)) for code in dict.fromkeys(codes)}


def _add_level(root_layer: Element, level: ServedLevel, base_url: str, address: str, year: int) -> None:
    assert level.bounds is not None
    group = add(root_layer, "Layer")
    add(group, "Title", level.loaded.level.title or level.name)
    all_crs = crs_of_maps(level)
    for layer in WMS_LAYERS:
        element = add(group, "Layer", queryable="1")
        for tag, text in (
            ("Name", layer_name(level, layer)), ("Title", layer_title(level, layer)), ("Abstract", layer_abstract(layer))
        ):  # fmt: skip
            add(element, tag, text)
        for code in all_crs:
            add(element, "CRS", code)
        west, south, east, north = lon_lat_box(level.bounds)
        box = add(element, "EX_GeographicBoundingBox")
        for tag, edge in (
            ("westBoundLongitude", west), ("eastBoundLongitude", east), ("southBoundLatitude", south), ("northBoundLatitude", north)
        ):  # fmt: skip
            add(box, tag, format_numbers((edge,)))
        for code, crs in all_crs.items():
            _add_bounding_box(element, level, code, crs)
        if PRODUCTS[layer].when != "none":
            times = time_dimension(level, layer, year)
            default = {} if times.default == DEFAULT_TIME else {"default": times.default}
            add(element, "Dimension", times.span, name="time", units="ISO8601", **default)
        if level.loaded.level.attribution:
            add(add(element, "Attribution"), "Title", level.loaded.level.attribution)
        for name, description in styles_of(layer).items():
            style = add(element, "Style")
            add(style, "Name", name)
            add(style, "Title", f"{description[:1].upper()}{description[1:]}")
        if PRODUCTS[layer].color_scale is not None:
            legend = add(style, "LegendURL", width=str(LEGEND_SIZE_PX[0]), height=str(LEGEND_SIZE_PX[1]))
            add(legend, "Format", "image/png")
            _add_online_resource(legend, legend_url(level, layer, address, year))


def _add_bounding_box(element: Element, level: ServedLevel, code: str, crs: CRS) -> None:
    try:
        west, south, east, north = bounds_in(level, crs)
    except InputError:
        return
    edges = (south, west, north, east) if north_first(crs) else (west, south, east, north)
    values = dict(zip(("minx", "miny", "maxx", "maxy"), (format_numbers((edge,)) for edge in edges), strict=True))
    add(element, "BoundingBox", CRS=code, **values)


def _add_online_resource(parent: Element, address: str) -> None:
    add(parent, "OnlineResource", xlink_type="simple", xlink_href=address)


def map_media_types(layer: str) -> str:
    """Return the media types of a layer's maps, separated by commas."""
    return ", ".join(MEDIA_TYPES[format] for format in gis_formats(layer))
