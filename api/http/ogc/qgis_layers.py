"""Write a level as a QGIS layer definition file, which users drag into the QGIS window."""

from __future__ import annotations

from urllib.parse import quote, urlencode
from xml.etree.ElementTree import Element, indent, tostring

from skugga.api.http.ogc.ogc_requests import layer_name, layer_title
from skugga.api.http.ogc.ogc_times import time_dimension
from skugga.api.http.ogc.ogc_xml import add_element
from skugga.api.http.ogc.wmts_capabilities import TIME_DIMENSION
from skugga.api.http.parameters import DEFAULT_STYLE
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevel
from skugga.api.matrices import matrix_set_of
from skugga.api.products.sun_hours import PRODUCT_NAME as SUN_HOURS
from skugga.terrain.geo.grid import crs_of_tiles

QGIS_LAYERS = ("color", "shadow", SUN_HOURS)
"""Layers of the file. The first one has a tick in QGIS's list of layers, so QGIS shows it at once."""

HEIGHTS_TITLE = "heights"


def qgis_layers(level: ServedLevel, base_url: str, year: int) -> bytes:
    """Return the layers of a level that lies on earth, as a QGIS layer definition.

    The file has WMTS layers, whose time QGIS's temporal controller changes. It also has heights as Terrarium tiles, for QGIS's
    three-dimensional view. Levels whose sun has no time get their default date in ``year``.
    """
    root = Element("qlr")
    tree = add_element(root, "layer-tree-group")
    group = add_element(tree, "layer-tree-group", name=level.loaded.level.title or level.name, checked="Qt::Checked", expanded="1")
    layers = add_element(root, "maplayers")
    for number, layer in enumerate(QGIS_LAYERS):
        _add_layer(
            group,
            layers,
            f"skugga_{level.name}_{layer}",
            layer_title(level, layer),
            _wmts_source(level, layer, base_url, year),
            _crs_of(qgis_matrix_set(level)),
            number == 0,
        )
    if DEFAULT_MATRIX_SET in level.zooms:
        _add_layer(
            group,
            layers,
            f"skugga_{level.name}_{HEIGHTS_TITLE}",
            layer_title(level, HEIGHTS_TITLE),
            _heights_source(level, base_url),
            _crs_of(DEFAULT_MATRIX_SET),
            False,
        )
    indent(root)
    return b"<!DOCTYPE qgis-layer-definition>\n" + tostring(root, encoding="utf-8") + b"\n"


def qgis_matrix_set(level: ServedLevel) -> str:
    """Return the name of the tile matrix set for a level in QGIS: ``DEFAULT_MATRIX_SET`` if it covers the level, else the first."""
    return DEFAULT_MATRIX_SET if DEFAULT_MATRIX_SET in level.zooms else next(iter(level.zooms))


def _crs_of(matrix_set: str) -> str:
    """Return the code of a tile matrix set's CRS, such as ``EPSG:3857``."""
    return ":".join(crs_of_tiles(matrix_set_of(matrix_set)).to_authority() or ("EPSG", "3857"))


def _wmts_source(level: ServedLevel, layer: str, base_url: str, year: int) -> str:
    """Return the URI of a WMTS layer for QGIS's data provider ``wms``."""
    return urlencode(
        {
            "crs": _crs_of(qgis_matrix_set(level)), "dpiMode": "7", "format": "image/png", "layers": layer_name(level, layer),
            "styles": DEFAULT_STYLE,
            "tileDimensions": f"{TIME_DIMENSION}={time_dimension(level, layer, year).default_value}",
            "tileMatrixSet": qgis_matrix_set(level),
            "url": f"{base_url}/levels/{quote(level.name)}/WMTSCapabilities.xml",
        },
        safe=":/",
    )  # fmt: skip


def _heights_source(level: ServedLevel, base_url: str) -> str:
    """Return the URI of a level's Terrarium tiles for QGIS's data provider ``wms``."""
    zooms = level.zooms[DEFAULT_MATRIX_SET]
    template = f"{base_url}/levels/{quote(level.name)}/tiles/{DEFAULT_MATRIX_SET}/{{z}}/{{x}}/{{y}}.png?layer=terrarium"
    options = {"type": "xyz", "interpretation": "terrariumterrain", "zmin": zooms.first, "zmax": zooms.last, "url": template}
    return urlencode(options, safe=":/{}")


def _add_layer(group: Element, layers: Element, layer_id: str, title: str, source: str, crs: str, is_checked: bool) -> None:
    """Add a raster layer to the file: to the tree of layers ``group``, and its source to the list ``layers``.

    ``source`` is the URI of the layer for QGIS's data provider ``wms``. ``crs`` is a code such as ``EPSG:3857``.
    ``is_checked`` says whether QGIS shows the layer at once.
    """
    add_element(
        group, "layer-tree-layer", id=layer_id, name=title, source=source, providerKey="wms",
        checked="Qt::Checked" if is_checked else "Qt::Unchecked", expanded="1",
    )  # fmt: skip
    layer = add_element(layers, "maplayer", type="raster")
    for tag, text in (("id", layer_id), ("datasource", source), ("layername", title), ("provider", "wms")):
        add_element(layer, tag, text)
    add_element(
        add_element(add_element(layer, "srs"), "spatialrefsys"), "authid", crs
    )  # QGIS reads the CRS from here, not from the data source
