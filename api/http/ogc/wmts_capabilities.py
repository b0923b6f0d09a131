"""Write the capabilities document of WMTS 1.0.0 (OGC 07-057r7, 7.1.1.2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from urllib.parse import quote, urlencode
from xml.etree.ElementTree import Element

from morecantile import TileMatrixSet
from pyproj import CRS

from skugga.api.http.ogc.ogc_requests import gis_formats, layer_name, layer_title, styles_of
from skugga.api.http.ogc.ogc_times import time_dimension
from skugga.api.http.ogc.ogc_xml import XLINK_NAMESPACE, XSI_NAMESPACE, add_element, format_numbers, lon_lat_box, xml_document
from skugga.api.http.parameters import DEFAULT_STYLE
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.matrices import matrix_set_of, tile_limits
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.products.product import MEDIA_TYPES
from skugga.terrain.geo.grid import crs_of_tiles

WMTS_VERSION = "1.0.0"


TIME_DIMENSION = "Time"
"""Name of the time dimension, and of its variable in URL templates."""

WMTS_SCHEMA_LOCATION = "http://www.opengis.net/wmts/1.0 http://schemas.opengis.net/wmts/1.0/wmtsGetCapabilities_response.xsd"


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
            "xmlns": "http://www.opengis.net/wmts/1.0", "xmlns:ows": "http://www.opengis.net/ows/1.1",
            "xmlns:xlink": XLINK_NAMESPACE,
            "xmlns:xsi": XSI_NAMESPACE, "xsi:schemaLocation": WMTS_SCHEMA_LOCATION, "version": WMTS_VERSION,
        },
    )  # fmt: skip
    service = add_element(root, "ows:ServiceIdentification")
    for tag, text in (
        ("Title", "Skugga"), ("Abstract", "Terrain with the sun's true cast shadows."), ("ServiceType", "OGC WMTS"),
        ("ServiceTypeVersion", WMTS_VERSION), ("Fees", "none"), ("AccessConstraints", "none"),
    ):  # fmt: skip
        add_element(service, f"ows:{tag}", text)
    _add_operations(root, base_url, document_url)
    contents = add_element(root, "Contents")
    for level in levels:
        for layer in MAP_PRODUCTS:
            _add_layer(contents, level, layer, base_url, year, time)
    for name in dict.fromkeys(name for level in levels for name in level.zooms):
        _add_matrix_set(contents, matrix_set_of(name), max(level.zooms[name].last for level in levels if name in level.zooms))
    add_element(root, "ServiceMetadataURL", xlink_href=document_url)
    return xml_document(root)


def _add_operations(root: Element, base_url: str, document_url: str) -> None:
    """Add the URLs of ``GetCapabilities`` and ``GetTile``, each for keys and values (KVP) and as RESTful URLs."""
    operations = add_element(root, "ows:OperationsMetadata")
    for name, rest_url in (("GetCapabilities", document_url), ("GetTile", f"{base_url}/levels/")):
        http = add_element(add_element(add_element(operations, "ows:Operation", name=name), "ows:DCP"), "ows:HTTP")
        for address, encoding in ((f"{base_url}/wmts?", "KVP"), (rest_url, "RESTful")):
            constraint = add_element(add_element(http, "ows:Get", xlink_href=address), "ows:Constraint", name="GetEncoding")
            add_element(add_element(constraint, "ows:AllowedValues"), "ows:Value", encoding)


def _add_layer(contents: Element, level: ServedLevel, layer: str, base_url: str, year: int, time: str | None) -> None:
    """Add one layer of a level, which lies on earth, to the document's contents.

    ``year`` is the year whose times are listed if the level's sun has no time. ``time`` is the default time; ``None``: the
    level's own.
    """
    assert level.bounds is not None
    west, south, east, north = lon_lat_box(level.bounds)
    element = add_element(contents, "Layer")
    add_element(element, "ows:Title", layer_title(level, layer))
    add_element(element, "ows:Abstract", layer_abstract(layer))
    box = add_element(element, "ows:WGS84BoundingBox")
    add_element(box, "ows:LowerCorner", format_numbers((west, south)))
    add_element(box, "ows:UpperCorner", format_numbers((east, north)))
    add_element(element, "ows:Identifier", layer_name(level, layer))
    address = f"{base_url}/levels/{quote(level.name)}"
    for name, description in styles_of(layer).items():
        style = add_element(element, "Style", **({"isDefault": "true"} if name == DEFAULT_STYLE else {}))
        add_element(style, "ows:Title", f"{description[:1].upper()}{description[1:]}")
        add_element(style, "ows:Identifier", name)
    if PRODUCTS[layer].color_scale is not None:
        add_element(style, "LegendURL", format="image/png", xlink_href=legend_url(level, layer, f"{base_url}/wms", year))
    for format in gis_formats(layer):
        add_element(element, "Format", MEDIA_TYPES[format])
    if PRODUCTS[layer].when != "none":
        times = time_dimension(level, layer, year, time)
        dimension = add_element(element, "Dimension")
        add_element(dimension, "ows:Identifier", TIME_DIMENSION)
        add_element(dimension, "ows:UOM", "ISO8601")
        add_element(dimension, "Default", times.default_value)
        for value in (times.default_value, times.extent):
            add_element(dimension, "Value", value)
    _add_matrix_set_links(element, level)
    query = "&".join(_query_parameters(layer))
    for format in gis_formats(layer):
        template = f"{address}/tiles/{{TileMatrixSet}}/{{TileMatrix}}/{{TileCol}}/{{TileRow}}.{format}"
        add_element(
            element, "ResourceURL", format=MEDIA_TYPES[format], resourceType="tile",
            template=f"{template}?{query}" if query else template,
        )  # fmt: skip


def legend_url(level: ServedLevel, layer: str, wms_url: str, year: int) -> str:
    """Return the URL of a layer's legend at the layer's default time.

    It is a WMS request, because QGIS adds keys of WMS to every legend URL. ``wms_url`` is the URL of the WMS. ``year`` has
    the default date of levels whose sun has no time.
    """
    query = {"SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetLegendGraphic", "FORMAT": "image/png"}
    query["LAYER"] = layer_name(level, layer)
    if PRODUCTS[layer].when != "none":
        query["TIME"] = time_dimension(level, layer, year).default_value
    return f"{wms_url}?{urlencode(query, safe='/:')}"


def layer_abstract(layer: str) -> str:
    """Return the description of a layer for capabilities: one sentence of plain text."""
    description = PRODUCTS[layer].description.replace("`", "")
    return f"{description[:1].upper()}{description[1:]}."


def _query_parameters(layer: str) -> Iterable[str]:
    """Yield the query parameters of a layer's tile URLs; style and time are variables of the URL template."""
    if layer != "color":
        yield f"layer={layer}"
    if len(styles_of(layer)) > 1:
        yield "style={Style}"
    if PRODUCTS[layer].when != "none":
        yield f"{'date' if PRODUCTS[layer].when == 'days' else 'time'}={{{TIME_DIMENSION}}}"


def _add_matrix_set_links(element: Element, level: ServedLevel) -> None:
    """Add the tile matrix sets of a level, with the rows and columns of the tiles that have data at each zoom."""
    assert level.data_bounds is not None
    for name, zooms in level.zooms.items():
        link = add_element(element, "TileMatrixSetLink")
        add_element(link, "TileMatrixSet", name)
        limits = add_element(link, "TileMatrixSetLimits")
        for zoom in range(zooms.first, zooms.last + 1):
            matrix_set = matrix_set_of(name)
            row_and_col_limits = tile_limits(matrix_set, zoom, level.data_bounds)
            matrix_limits = add_element(limits, "TileMatrixLimits")
            add_element(matrix_limits, "TileMatrix", matrix_set.matrix(zoom).id)
            for tag, value in zip(("MinTileRow", "MaxTileRow", "MinTileCol", "MaxTileCol"), row_and_col_limits, strict=True):
                add_element(matrix_limits, tag, value)


def _add_matrix_set(contents: Element, matrix_set: TileMatrixSet, last_zoom: int) -> None:
    """Add the definition of a tile matrix set, with its matrices up to ``last_zoom``.

    ``last_zoom`` is the last zoom that any level serves. GDAL and QGIS read the resolution of the data from the finest matrix in
    the document, even if a layer's limits exclude it.
    """
    element = add_element(contents, "TileMatrixSet")
    add_element(element, "ows:Identifier", matrix_set.id)
    add_element(element, "ows:SupportedCRS", crs_urn(crs_of_tiles(matrix_set)))
    if matrix_set.wellKnownScaleSet is not None:
        well_known = str(matrix_set.wellKnownScaleSet).rpartition("/")[2]
        add_element(element, "WellKnownScaleSet", f"urn:ogc:def:wkss:OGC:1.0:{well_known}")
    for zoom in range(matrix_set.minzoom, last_zoom + 1):
        matrix = matrix_set.matrix(zoom)
        matrix_element = add_element(element, "TileMatrix")
        add_element(matrix_element, "ows:Identifier", matrix.id)
        add_element(matrix_element, "ScaleDenominator", format_numbers((matrix.scaleDenominator,)))
        add_element(matrix_element, "TopLeftCorner", format_numbers(matrix.pointOfOrigin))  # in the axis order of the CRS
        for tag, value in (
            ("TileWidth", matrix.tileWidth), ("TileHeight", matrix.tileHeight), ("MatrixWidth", matrix.matrixWidth),
            ("MatrixHeight", matrix.matrixHeight),
        ):  # fmt: skip
            add_element(matrix_element, tag, value)


def crs_urn(crs: CRS) -> str:
    """Return the URN of a CRS (OGC 07-092r1)."""
    authority, code = crs.to_authority() or ("EPSG", "0")
    return f"urn:ogc:def:crs:{authority}:{'1.3' if authority == 'OGC' else ''}:{code}"
