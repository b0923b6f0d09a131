"""Build the page of a level: its picture, its facts, and code snippets for map clients."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from urllib.parse import quote

from fastapi import Request, Response

from skugga.api.http.ogc.ogc_requests import layer_name
from skugga.api.http.responses import base_url, document_response
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevel
from skugga.api.http.state.service import Service
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.request import ProductRequest

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title>
<link rel="icon" href="data:,">
<link rel="alternate" type="application/json" href="{name}">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; background: #fff; }}
img {{ max-width: 100%; max-height: 70vh; height: auto; background: #eee; }}
th {{ text-align: left; vertical-align: top; padding-right: 1.5rem; font-weight: 600; white-space: nowrap; }}
pre {{ background: #f4f4f2; padding: .6rem .8rem; overflow-x: auto; user-select: all; font-size: 14px; }}
h2 {{ margin-top: 2rem; }}
</style>
</head>
<body>
<h1>{title}</h1>
<p><img src="{picture}" alt="{title}, seen from above"></p>
<table>
{facts}
</table>
{snippets}
<p><a href="../">All levels, on a map</a> · <a href="../docs">interface</a></p>
</body>
</html>
"""


def level_page(level: ServedLevel, base_url: str) -> str:
    """Return the HTML page of a level. Its links are relative to ``/levels/``; ``base_url`` is the service's public URL."""
    name = quote(level.name)
    is_off_earth = level.world.off_earth_reason is not None
    return _PAGE.format(
        title=escape(level.loaded.level.title or level.name),
        name=name,
        picture=f"{name}/snapshot.webp?view=map" if is_off_earth else f"{name}/map.webp",
        facts="\n".join(f"<tr><th>{escape(key)}</th><td>{value}</td></tr>" for key, value in _fact_rows(level)),
        snippets="\n".join(
            f"<h2>{escape(title)}</h2>\n<pre>{escape(text)}</pre>"
            for title, text in (() if is_off_earth else snippets(level, base_url))
        ),
    )


def snippets(level: ServedLevel, base_url: str, product_request: ProductRequest | None = None) -> Iterator[tuple[str, str]]:
    """Yield pairs of a map client's name and a code snippet that adds the level to it.

    ``base_url`` is the service's public URL. Tile URLs in the snippets carry the query of ``product_request``, by default none.
    Clients of WMTS and WMS choose layer and time themselves.
    """
    assert level.bounds is not None
    query = "" if product_request is None else product_request.query()
    query_suffix = query and f"?{query}"
    address = f"{base_url}/levels/{quote(level.name)}"
    wmts, wms = f"{address}/WMTSCapabilities.xml", f"{address}/wms"
    attribution = (level.loaded.level.attribution or "").replace("\\", "\\\\").replace("'", "\\'")
    west, south, east, north = level.bounds
    if DEFAULT_MATRIX_SET in level.zooms:
        zooms = level.zooms[DEFAULT_MATRIX_SET]
        tiles = f"{address}/tiles/{DEFAULT_MATRIX_SET}/{{z}}/{{x}}/{{y}}"
        picture = f"{tiles}.png{query_suffix}"
        tilejson = f"{address}/{DEFAULT_MATRIX_SET}/tilejson.json{query_suffix}"
        yield (
            "MapLibre",
            f"map.addSource('skugga', {{type: 'raster', url: '{tilejson}', tileSize: 256}});\n"
            "map.addLayer({id: 'skugga', type: 'raster', source: 'skugga'});",
        )
        yield (
            "MapLibre, in three dimensions",
            f"map.addSource('heights', {{type: 'raster-dem', tiles: ['{tiles}.png?layer=terrarium'], encoding: 'terrarium', "
            f"tileSize: 256, minzoom: {zooms.first}, maxzoom: {zooms.last}}}); map.setTerrain({{source: 'heights'}});",
        )
        yield (
            "Leaflet",
            f"L.tileLayer('{picture}', {{minZoom: {zooms.first}, maxZoom: {zooms.last}, "
            f"bounds: [[{south:.6g}, {west:.6g}], [{north:.6g}, {east:.6g}]], attribution: '{attribution}'}}).addTo(map);",
        )
        yield (
            "OpenLayers",
            f"map.addLayer(new ol.layer.Tile({{source: new ol.source.XYZ({{url: '{picture}', minZoom: {zooms.first}, "
            f"maxZoom: {zooms.last}, attributions: '{attribution}'}})}}));",
        )
        yield (
            "OpenLayers, by WMTS",
            f"const capabilities = new ol.format.WMTSCapabilities().read(await (await fetch('{wmts}')).text());\n"
            f"const options = ol.source.WMTS.optionsFromCapabilities(capabilities, {{layer: '{layer_name(level, 'color')}', "
            f"matrixSet: '{DEFAULT_MATRIX_SET}'}});\n"
            "map.addLayer(new ol.layer.Tile({source: new ol.source.WMTS(options)}));",
        )
        yield (
            "ipyleaflet",
            f"m.add(ipyleaflet.TileLayer(url='{picture}', min_zoom={zooms.first}, max_zoom={zooms.last}, "
            f"attribution='{attribution}'))",
        )
        yield "QGIS, XYZ tiles", picture
    yield "QGIS and ArcGIS, WMTS with times", wmts
    yield "WMS", f"{wms}?SERVICE=WMS&REQUEST=GetCapabilities"
    yield "GDAL", f'gdal_translate "WMTS:{wmts},layer={layer_name(level, "color")}" level.tif'


def _fact_rows(level: ServedLevel) -> Iterator[tuple[str, str]]:
    """Yield the rows of the page's table of facts: a heading as text and a value as HTML."""
    name, level_file = quote(level.name), level.loaded.level
    if level.bounds is not None:
        west, south, east, north = level.bounds
        yield "Bounds", f"{west:.5f}, {south:.5f}, {east:.5f}, {north:.5f} (west, south, east, north; degrees)"
        yield "Own maps", escape(level.map_crs.name)
    yield "Lowest ground", f"{level.lowest_ground_m:.0f} m"
    if level_file.sun is not None and level_file.sun != "none":
        sun = level_file.sun
        angles = f"azimuth {sun.azimuth:g}°, altitude {sun.altitude:g}°" if sun.time is None else sun.time.isoformat()
        yield "Own sun", escape(angles)
    if DEFAULT_MATRIX_SET in level.zooms:
        zooms = level.zooms[DEFAULT_MATRIX_SET]
        yield "Zooms", f"{zooms.first} to {zooms.last} of {DEFAULT_MATRIX_SET}"
        yield "Tile matrix sets", escape(", ".join(level.zooms))
        yield "Layers", "; ".join(_layer_link(name, layer) for layer in MAP_PRODUCTS if PRODUCTS[layer].when == "sun")
    views = [view for view, size in level.view_sizes.items() if size is not None]
    yield "Views", ", ".join(f'<a href="{name}/snapshot.png?view={quote(view)}">{escape(view)}</a>' for view in views)
    if level.world.off_earth_reason is None:
        yield "For QGIS", f'<a href="{name}.qlr">{escape(level.name)}.qlr</a>, to drag into its window'
    if level_file.attribution:
        yield "Attribution", escape(level_file.attribution)
    for warning in level.warnings:
        yield "Warning", escape(warning)


def _layer_link(level_name: str, layer: str) -> str:
    """Return an HTML link to a map of a layer of a level."""
    suffix = "png" if "png" in PRODUCTS[layer].map_formats else "tif"
    return f'<a href="{level_name}/map.{suffix}?layer={layer}">{layer}</a>'


async def level_page_response(request: Request, service: Service, level: ServedLevel, **headers: str) -> Response:
    """Return the page of a level as a response, or 304 if the client's copy is current."""
    page = level_page(level, base_url(request, service.settings.public_url))
    return document_response(request, page.encode(), "text/html", **headers)
