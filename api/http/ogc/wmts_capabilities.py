"""Write the capabilities document of WMTS 1.0.0 (OGC 07-057r7, 7.1.1.2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from urllib.parse import quote, urlencode
from xml.etree.ElementTree import Element

from morecantile import TileMatrixSet
from pyproj import CRS

from skugga.api.http.ogc.ogc_requests import gis_formats, layer_name, layer_title, styles_of
from skugga.api.http.ogc.ogc_times import time_dimension
from skugga.api.http.ogc.ogc_xml import XLINK, XSI, add, document, format_numbers, lon_lat_box
from skugga.api.http.parameters import DEFAULT_STYLE
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.matrices import matrix_set_of, tile_limits
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.products.product import MEDIA_TYPES
from skugga.terrain.geo.grid import crs_of_tiles

WMTS_VERSION = "1.0.0"


TIME = "Time"
"""Name of the time dimension, and of its variable in URL templates."""

SCHEMA_WMTS = "http://www.opengis.net/wmts/1.0 http://schemas.opengis.net/wmts/1.0/wmtsGetCapabilities_response.xsd"


def wmts_capabilities(levels: Sequence[ServedLevel], base_url: str, document_url: str, year: int, time: str | None = None) -> bytes:
    """Return the capabilities document of levels that lie on earth.

    Parameters
    ----------
    levels
        The levels.
    base_url, document_url
        URLs of the whole service and of this document.
    year
        The year whose times are listed for levels whose sun has no time.
    time
        The default time of all layers; ``None``: each level's own.

    Raises
    ------
    InputError
        ``time`` is invalid.
    """
    root = Element(
        "Capabilities",
        {
            "xmlns": "http://www.opengis.net/wmts/1.0", "xmlns:ows": "http://www.opengis.net/ows/1.1", "xmlns:xlink": XLINK,
            "xmlns:xsi": XSI, "xsi:schemaLocation": SCHEMA_WMTS, "version": WMTS_VERSION,
        },
    )  # fmt: skip
    service = add(root, "ows:ServiceIdentification")
    for tag, text in (
        ("Title", "Skugga"), ("Abstract", "Terrain with the sun's true cast shadows."), ("ServiceType", "OGC WMTS"),
        ("ServiceTypeVersion", WMTS_VERSION), ("Fees", "none"), ("AccessConstraints", "none"),
    ):  # fmt: skip
        add(service, f"ows:{tag}", text)
    _add_operations(root, base_url, document_url)
    contents = add(root, "Contents")
    for level in levels:
        for layer in MAP_PRODUCTS:
            _add_layer(contents, level, layer, base_url, year, time)
    for name in dict.fromkeys(name for level in levels for name in level.zooms):
        _add_matrix_set(contents, matrix_set_of(name), max(level.zooms[name].last for level in levels if name in level.zooms))
    add(root, "ServiceMetadataURL", xlink_href=document_url)
    return document(root)


def _add_operations(root: Element, base_url: str, document_url: str) -> None:
    operations = add(root, "ows:OperationsMetadata")
    for name, rest_url in (("GetCapabilities", document_url), ("GetTile", f"{base_url}/levels/")):
        http = add(add(add(operations, "ows:Operation", name=name), "ows:DCP"), "ows:HTTP")
        for address, encoding in ((f"{base_url}/wmts?", "KVP"), (rest_url, "RESTful")):
            constraint = add(add(http, "ows:Get", xlink_href=address), "ows:Constraint", name="GetEncoding")
            add(add(constraint, "ows:AllowedValues"), "ows:Value", encoding)


def _add_layer(contents: Element, level: ServedLevel, layer: str, base_url: str, year: int, time: str | None) -> None:
    assert level.bounds is not None
    west, south, east, north = lon_lat_box(level.bounds)
    element = add(contents, "Layer")
    add(element, "ows:Title", layer_title(level, layer))
    add(element, "ows:Abstract", layer_abstract(layer))
    box = add(element, "ows:WGS84BoundingBox")
    add(box, "ows:LowerCorner", format_numbers((west, south)))
    add(box, "ows:UpperCorner", format_numbers((east, north)))
    add(element, "ows:Identifier", layer_name(level, layer))
    address = f"{base_url}/levels/{quote(level.name)}"
    for name, description in styles_of(layer).items():
        style = add(element, "Style", **({"isDefault": "true"} if name == DEFAULT_STYLE else {}))
        add(style, "ows:Title", f"{description[:1].upper()}{description[1:]}")
        add(style, "ows:Identifier", name)
    if PRODUCTS[layer].color_scale is not None:
        add(style, "LegendURL", format="image/png", xlink_href=legend_url(level, layer, f"{base_url}/wms", year))
    for format in gis_formats(layer):
        add(element, "Format", MEDIA_TYPES[format])
    if PRODUCTS[layer].when != "none":
        times = time_dimension(level, layer, year, time)
        dimension = add(element, "Dimension")
        add(dimension, "ows:Identifier", TIME)
        add(dimension, "ows:UOM", "ISO8601")
        add(dimension, "Default", times.default)
        for value in (times.default, times.span):
            add(dimension, "Value", value)
    _add_matrix_set_links(element, level)
    query = "&".join(_query_parameters(layer))
    for format in gis_formats(layer):
        template = f"{address}/tiles/{{TileMatrixSet}}/{{TileMatrix}}/{{TileCol}}/{{TileRow}}.{format}"
        add(
            element, "ResourceURL", format=MEDIA_TYPES[format], resourceType="tile",
            template=f"{template}?{query}" if query else template,
        )  # fmt: skip


def legend_url(level: ServedLevel, layer: str, wms_url: str, year: int) -> str:
    """Return the URL of a layer's legend at the layer's default time.

    It is a WMS request, because QGIS adds keys of WMS to every legend URL.
    """
    query = {"SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetLegendGraphic", "FORMAT": "image/png"}
    query["LAYER"] = layer_name(level, layer)
    if PRODUCTS[layer].when != "none":
        query["TIME"] = time_dimension(level, layer, year).default
    return f"{wms_url}?{urlencode(query, safe='/:')}"


def layer_abstract(layer: str) -> str:
    """Return the description of a layer for capabilities: one sentence of plain text."""
    description = PRODUCTS[layer].description.replace("`", "")
    return f"{description[:1].upper()}{description[1:]}."


def _query_parameters(layer: str) -> Iterable[str]:
    if layer != "color":
        yield f"layer={layer}"
    if len(styles_of(layer)) > 1:
        yield "style={Style}"
    if PRODUCTS[layer].when != "none":
        yield f"{'date' if PRODUCTS[layer].when == 'days' else 'time'}={{{TIME}}}"


def _add_matrix_set_links(element: Element, level: ServedLevel) -> None:
    assert level.data_bounds is not None
    for name, zooms in level.zooms.items():
        link = add(element, "TileMatrixSetLink")
        add(link, "TileMatrixSet", name)
        limits = add(link, "TileMatrixSetLimits")
        for zoom in range(zooms.first, zooms.last + 1):
            matrix_set = matrix_set_of(name)
            row_and_col_limits = tile_limits(matrix_set, zoom, level.data_bounds)
            matrix_limits = add(limits, "TileMatrixLimits")
            add(matrix_limits, "TileMatrix", matrix_set.matrix(zoom).id)
            for tag, value in zip(("MinTileRow", "MaxTileRow", "MinTileCol", "MaxTileCol"), row_and_col_limits, strict=True):
                add(matrix_limits, tag, value)


def _add_matrix_set(contents: Element, matrix_set: TileMatrixSet, last_zoom: int) -> None:
    """Add the definition of a tile matrix set, with its matrices up to ``last_zoom``.

    ``last_zoom`` is the last zoom that any level serves. GDAL and QGIS read the resolution of the data from the finest matrix in
    the document, even if a layer's limits exclude it.
    """
    element = add(contents, "TileMatrixSet")
    add(element, "ows:Identifier", matrix_set.id)
    add(element, "ows:SupportedCRS", crs_urn(crs_of_tiles(matrix_set)))
    if matrix_set.wellKnownScaleSet is not None:
        well_known = str(matrix_set.wellKnownScaleSet).rpartition("/")[2]
        add(element, "WellKnownScaleSet", f"urn:ogc:def:wkss:OGC:1.0:{well_known}")
    for zoom in range(matrix_set.minzoom, last_zoom + 1):
        matrix = matrix_set.matrix(zoom)
        matrix_element = add(element, "TileMatrix")
        add(matrix_element, "ows:Identifier", matrix.id)
        add(matrix_element, "ScaleDenominator", format_numbers((matrix.scaleDenominator,)))
        add(matrix_element, "TopLeftCorner", format_numbers(matrix.pointOfOrigin))  # in the axis order of the CRS
        for tag, value in (
            ("TileWidth", matrix.tileWidth), ("TileHeight", matrix.tileHeight), ("MatrixWidth", matrix.matrixWidth),
            ("MatrixHeight", matrix.matrixHeight),
        ):  # fmt: skip
            add(matrix_element, tag, value)


def crs_urn(crs: CRS) -> str:
    """Return the URN of a CRS (OGC 07-092r1)."""
    authority, code = crs.to_authority() or ("EPSG", "0")
    return f"urn:ogc:def:crs:{authority}:{'1.3' if authority == 'OGC' else ''}:{code}"
