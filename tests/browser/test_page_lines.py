"""Map clients run the lines of a level's page unchanged."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from tests.api.conftest import Client
from tests.browser.map_clients import LEVEL, MapClient, TileCorner, pixel_differences
from tests.browser.watched_page import WatchedPage

CORNER = TileCorner("WebMercatorQuad", 12)


@dataclass(frozen=True)
class Library:
    """How a library creates the ``map`` that the lines use, and how it waits until all is drawn."""

    page: str
    create_map_script: str
    wait_script: str


LIBRARY_BY_NAME = {
    "MapLibre": Library(
        "maplibre",
        # Its zooms refer to tiles of 512 pixels.
        """({lonLat, zoom}) => {
          window.map = new maplibregl.Map({container: 'map', center: lonLat, zoom: zoom - 1, attributionControl: false,
            fadeDuration: 0, style: {version: 8, sources: {}, layers: []}});
          window.idle = () => new Promise(resolve => { map.once('idle', resolve); map.triggerRepaint(); });
          return map.once('load').then(() => null);
        }""",
        "() => idle()",
    ),
    "Leaflet": Library(
        "leaflet",
        """({lonLat: [lon, lat], zoom}) => {
          window.map = L.map('map', {center: [lat, lon], zoom, zoomControl: false, attributionControl: false,
            fadeAnimation: false});
        }""",
        """() => new Promise(resolve => map.eachLayer(layer => layer.isLoading() ? layer.once('load', resolve) : resolve()))""",
    ),
    "OpenLayers": Library(
        "openlayers",
        """({lonLat, zoom}) => {
          window.map = new ol.Map({target: 'map', controls: [], view: new ol.View({center: ol.proj.fromLonLat(lonLat), zoom})});
        }""",
        "() => new Promise(resolve => { map.once('rendercomplete', resolve); map.render(); })",
    ),
}

FLAT_HEADINGS = ["MapLibre", "Leaflet", "OpenLayers", "OpenLayers, by WMTS"]
"""Headings of lines that show flat tiles."""

TERRAIN_HEADING = "MapLibre, in three dimensions"
"""The heading of the line that ``test_maplibre.py`` tests."""


def lines_of_page(service_page: WatchedPage) -> dict[str, str]:
    """Return the lines of the level's page by heading, as a person copies them."""
    service_page.page.goto(f"/levels/{LEVEL}.html")
    headings = service_page.page.locator("h2").all_inner_texts()
    return dict(zip(headings, service_page.page.locator("pre").all_inner_texts(), strict=True))


def run_line(client: MapClient, line: str) -> None:
    """Run a line on a map client's page as in a module, where it may ``await``."""
    client.run("({line}) => new (async () => {}).constructor(line)().then(() => null)", line=line)


def test_all_lines_for_pages_are_tested(service_page: WatchedPage):
    lines = lines_of_page(service_page)
    assert {heading for heading in lines if heading.partition(",")[0] in LIBRARY_BY_NAME} == {*FLAT_HEADINGS, TERRAIN_HEADING}


def test_level_page_shows_its_picture(service_page: WatchedPage):
    service_page.page.goto(f"/levels/{LEVEL}.html", wait_until="load")
    assert service_page.page.locator("img").evaluate("picture => picture.naturalWidth") > 500


@pytest.mark.parametrize("heading", FLAT_HEADINGS)
def test_page_line_shows_the_level(service_page: WatchedPage, map_client: MapClient, service: Client, heading: str):
    line = lines_of_page(service_page)[heading]
    library = LIBRARY_BY_NAME[heading.partition(",")[0]]
    map_client.open(library.page)
    map_client.run(library.create_map_script, lonLat=CORNER.lon_lat, zoom=CORNER.zoom)
    run_line(map_client, line)
    map_client.run(library.wait_script)
    assert pixel_differences(map_client.pixels(), CORNER.tiles(service)).max() == 0
