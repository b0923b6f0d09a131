"""Write the capabilities document of WMS 1.3.0 (OGC 06-042, 7.2.4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element

from pyproj import CRS

from skugga.api.color_scale import LEGEND_MEDIA_TYPES, LEGEND_SIZE_PX
from skugga.api.http.ogc.ogc_requests import gis_formats, layer_name, layer_title, styles_of
from skugga.api.http.ogc.ogc_times import time_dimension
from skugga.api.http.ogc.ogc_xml import XLINK_NAMESPACE, XSI_NAMESPACE, add_element, format_numbers, lon_lat_box, xml_document
from skugga.api.http.ogc.wmts_capabilities import layer_abstract, legend_url
from skugga.api.http.request_times import DEFAULT_TIME
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.tiles.map_extents import bounds_in, crs_of_code, is_north_first
from skugga.api.products import PRODUCTS, products_with
from skugga.api.products.product import MEDIA_TYPES
from skugga.terrain.errors import InputError

WMS_VERSION = "1.3.0"

WMS_LAYERS = products_with(lambda product: product.encoding is None and "png" in product.map_formats)
"""Layers that WMS serves: those that map clients can show.

Heights encoded in colours are for tile clients, and clients cannot show floating point data."""

MAP_MEDIA_TYPES = ("image/png", "image/webp", "image/jpeg", "image/tiff")
INFO_MEDIA_TYPES = ("application/json", "text/html", "text/plain")
WMS_LEGEND_MEDIA_TYPES = tuple(LEGEND_MEDIA_TYPES.values())

COMMON_CRS = ("EPSG:3857", "EPSG:4326", "CRS:84")
"""CRSs that the capabilities list for every level. A request may use any other CRS that PROJ knows by its code."""

WMS_SCHEMA_LOCATION = "http://www.opengis.net/wms http://schemas.opengis.net/wms/1.3.0/capabilities_1_3_0.xsd"


def wms_capabilities(levels: Sequence[ServedLevel], base_url: str, wms_url: str, max_pixels: int, year: int) -> bytes:
    """Return the capabilities document of levels that lie on earth.

    Parameters
    ----------
    levels
        The levels.
    base_url, wms_url
        URLs of the whole service and of the WMS.
    max_pixels
        Maximum number of pixels of a map. Its square root is listed as the maximum of width and height.
    year
        The year whose times are listed for levels whose sun has no time.
    """
    root = Element(
        "WMS_Capabilities",
        {
            "xmlns": "http://www.opengis.net/wms", "xmlns:xlink": XLINK_NAMESPACE, "xmlns:xsi": XSI_NAMESPACE,
            "xsi:schemaLocation": WMS_SCHEMA_LOCATION,
            "version": WMS_VERSION,
        },
    )  # fmt: skip
    service = add_element(root, "Service")
    for tag, text in (("Name", "WMS"), ("Title", "Skugga"), ("Abstract", "Terrain with the sun's true cast shadows.")):
        add_element(service, tag, text)
    _add_online_resource(service, base_url)
    side = math.isqrt(max_pixels)  # a request may have a longer side if its other side is short enough
    for tag, value in (("Fees", "none"), ("AccessConstraints", "none"), ("LayerLimit", 1), ("MaxWidth", side), ("MaxHeight", side)):
        add_element(service, tag, value)
    capability = add_element(root, "Capability")
    # GetLegendGraphic is not listed: QGIS would ask for it for every layer. A layer with a legend has a LegendURL.
    request = add_element(capability, "Request")
    for name, media in (
        ("GetCapabilities", ("text/xml",)), ("GetMap", MAP_MEDIA_TYPES), ("GetFeatureInfo", INFO_MEDIA_TYPES),
    ):  # fmt: skip
        operation = add_element(request, name)
        for media_type in media:
            add_element(operation, "Format", media_type)
        _add_online_resource(add_element(add_element(add_element(operation, "DCPType"), "HTTP"), "Get"), f"{wms_url}?")
    add_element(add_element(capability, "Exception"), "Format", "XML")
    root_layer = add_element(capability, "Layer")
    add_element(root_layer, "Title", "Skugga")
    for code in COMMON_CRS:
        add_element(root_layer, "CRS", code)
    for level in levels:
        _add_level(root_layer, level, base_url, wms_url, year)
    return xml_document(root)


def crs_of_maps(level: ServedLevel) -> dict[str, CRS]:
    """Return the CRSs that the capabilities list for a level, by code: ``COMMON_CRS`` and that of the level's own maps."""
    authority_and_code = level.map_crs.to_authority()
    codes = [*COMMON_CRS, *([] if authority_and_code is None else [":".join(authority_and_code)])]
    return {code: crs_of_code({"CRS:84": "OGC:CRS84"}.get(code, code)) for code in dict.fromkeys(codes)}


def _add_level(root_layer: Element, level: ServedLevel, base_url: str, wms_url: str, year: int) -> None:
    """Add the layers of a level, which lies on earth, as a group to ``root_layer``.

    ``year`` is the year whose times are listed if the level's sun has no time.
    """
    assert level.bounds is not None
    group = add_element(root_layer, "Layer")
    add_element(group, "Title", level.loaded.level.title or level.name)
    all_crs = crs_of_maps(level)
    for layer in WMS_LAYERS:
        element = add_element(group, "Layer", queryable="1")
        for tag, text in (
            ("Name", layer_name(level, layer)), ("Title", layer_title(level, layer)), ("Abstract", layer_abstract(layer))
        ):  # fmt: skip
            add_element(element, tag, text)
        for code in all_crs:
            add_element(element, "CRS", code)
        west, south, east, north = lon_lat_box(level.bounds)
        box = add_element(element, "EX_GeographicBoundingBox")
        for tag, edge in (
            ("westBoundLongitude", west), ("eastBoundLongitude", east), ("southBoundLatitude", south), ("northBoundLatitude", north)
        ):  # fmt: skip
            add_element(box, tag, format_numbers((edge,)))
        for code, crs in all_crs.items():
            _add_bounding_box(element, level, code, crs)
        if PRODUCTS[layer].when != "none":
            times = time_dimension(level, layer, year)
            default = {} if times.default_value == DEFAULT_TIME else {"default": times.default_value}
            add_element(element, "Dimension", times.extent, name="time", units="ISO8601", **default)
        if level.loaded.level.attribution:
            add_element(add_element(element, "Attribution"), "Title", level.loaded.level.attribution)
        for name, description in styles_of(layer).items():
            style = add_element(element, "Style")
            add_element(style, "Name", name)
            add_element(style, "Title", f"{description[:1].upper()}{description[1:]}")
        if PRODUCTS[layer].color_scale is not None:
            legend = add_element(style, "LegendURL", width=str(LEGEND_SIZE_PX[0]), height=str(LEGEND_SIZE_PX[1]))
            add_element(legend, "Format", "image/png")
            _add_online_resource(legend, legend_url(level, layer, wms_url, year))


def _add_bounding_box(element: Element, level: ServedLevel, code: str, crs: CRS) -> None:
    """Add the bounds of a level in a CRS, in the axis order of the CRS; add nothing if the CRS cannot express them.

    ``code`` is the code of the CRS in the document.
    """
    try:
        west, south, east, north = bounds_in(level, crs)
    except InputError:
        return
    edges = (south, west, north, east) if is_north_first(crs) else (west, south, east, north)
    values = dict(zip(("minx", "miny", "maxx", "maxy"), (format_numbers((edge,)) for edge in edges), strict=True))
    add_element(element, "BoundingBox", CRS=code, **values)


def _add_online_resource(parent: Element, url: str) -> None:
    """Add a link to a URL as an ``OnlineResource`` element."""
    add_element(parent, "OnlineResource", xlink_type="simple", xlink_href=url)


def map_media_types(layer: str) -> str:
    """Return the media types of a layer's maps, separated by commas."""
    return ", ".join(MEDIA_TYPES[format] for format in gis_formats(layer))
