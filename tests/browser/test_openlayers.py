"""OpenLayers reads WMS and WMTS by their capabilities, with times."""

from __future__ import annotations

from datetime import datetime, timedelta
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from tests.api.conftest import Client
from tests.browser.map_clients import LEVEL, TIMES, WINDOW_PX, MapClient, TileCorner, fetch_picture, pixel_differences

CORNERS = [TileCorner("WebMercatorQuad", 12), TileCorner("WGS1984Quad", 11)]
"""In metres, and in degrees with latitude first."""

SHOW_SCRIPT = """() => {
  window.drawn = map => new Promise(resolve => { map.once('rendercomplete', resolve); map.render(); });
  window.show = (layer, {projection, center, resolution}) => {
    window.map = new ol.Map({target: 'map', controls: [], layers: [layer], view: new ol.View({projection, center, resolution})});
    return drawn(map);
  };
}"""


@pytest.fixture(params=CORNERS, ids=lambda corner: corner.projection)
def corner(request: pytest.FixtureRequest) -> TileCorner:
    """Return the corner that the map is centred on."""
    return request.param


@pytest.fixture
def openlayers(map_client: MapClient) -> MapClient:
    """Return the page of OpenLayers, opened."""
    map_client.open("openlayers")
    map_client.page.evaluate(SHOW_SCRIPT)
    return map_client


def view_options(corner: TileCorner) -> dict[str, object]:
    """Return a view of the four tiles, pixel for pixel."""
    return {"projection": corner.projection, "center": corner.center, "resolution": corner.resolution}


def assert_pictures_differ(picture: np.ndarray, other: np.ndarray) -> None:
    """Assert that two pictures show different times."""
    assert (pixel_differences(picture, other) > 32).mean() > 0.2


def test_openlayers_reads_wmts_capabilities(openlayers: MapClient, service: Client, corner: TileCorner):
    dimensions = openlayers.run(
        """async ({address, layer, matrixSet, view}) => {
          const capabilities = new ol.format.WMTSCapabilities().read(await (await fetch(address)).text());
          const options = ol.source.WMTS.optionsFromCapabilities(capabilities, {layer, matrixSet});
          window.source = new ol.source.WMTS(options);
          await show(new ol.layer.Tile({source}), view);
          return options.dimensions;
        }""",
        address=f"{openlayers.service_address}/levels/{LEVEL}/WMTSCapabilities.xml",
        layer=f"{LEVEL}:color",
        matrixSet=corner.tms,
        view=view_options(corner),
    )
    assert dimensions == {"Time": "2024-10-21T21:45:00Z"}
    assert pixel_differences(openlayers.pixels(), corner.tiles(service)).max() == 0

    pictures = []
    for time in TIMES:
        openlayers.run("({Time}) => { source.updateDimensions({Time}); return drawn(map); }", Time=time)
        pictures.append(openlayers.pixels())
        assert pixel_differences(pictures[-1], corner.tiles(service, time=time)).max() == 0
    assert_pictures_differ(*pictures)


def test_openlayers_reads_wms_capabilities(openlayers: MapClient, service: Client, corner: TileCorner):
    times = openlayers.run(
        """async ({address, layer, view}) => {
          const capabilities = new ol.format.WMSCapabilities().read(await (await fetch(address)).text());
          const found = capabilities.Capability.Layer.Layer[0].Layer.find(each => each.Name === layer);
          const url = capabilities.Capability.Request.GetMap.DCPType[0].HTTP.Get.OnlineResource;
          window.source = new ol.source.ImageWMS({url, params: {LAYERS: found.Name}, ratio: 1});
          await show(new ol.layer.Image({source}), view);
          return found.Dimension.filter(each => each.name === 'time').map(each => each.values);
        }""",
        address=f"{openlayers.service_address}/levels/{LEVEL}/wms?SERVICE=WMS&REQUEST=GetCapabilities",
        layer=f"{LEVEL}:color",
        view=view_options(corner),
    )
    (span,) = times
    begin, end, period = span.split("/")
    assert period == "PT10M" and begin < min(TIMES) < max(TIMES) < end
    for time in TIMES:
        since = datetime.fromisoformat(time) - datetime.fromisoformat(begin)
        assert not since % timedelta(minutes=10), "the capabilities advertise the time"

    pictures = []
    for time in TIMES:
        openlayers.run("({TIME}) => { source.updateParams({TIME}); return drawn(map); }", TIME=time)
        pictures.append(openlayers.pixels())
        bbox, side = ",".join(map(repr, corner.bounds)), str(WINDOW_PX)
        crs = {"EPSG:4326": "OGC:CRS84"}.get(corner.projection, corner.projection)
        expected = fetch_picture(service, f"/levels/{LEVEL}/map.png", bbox=bbox, crs=crs, width=side, height=side, time=time)
        assert pixel_differences(pictures[-1], expected).max() == 0
    assert_pictures_differ(*pictures)

    query = parse_qs(urlsplit(openlayers.requested_urls[-1]).query)
    assert (query["VERSION"], query["CRS"], query["TIME"]) == (["1.3.0"], [corner.projection], [TIMES[-1]])
    west, south, _, _ = corner.bounds
    first = [south, west] if corner.projection == "EPSG:4326" else [west, south]
    assert [float(edge) for edge in query["BBOX"][0].split(",")[:2]] == pytest.approx(first)


def test_openlayers_shows_the_legends(openlayers: MapClient):
    """The legends are those that the capabilities name, and the one that OpenLayers requests by itself."""
    legends = openlayers.run(
        """async ({wms, wmts, layer}) => {
          const read = async (format, address) => format.read(await (await fetch(address)).text());
          const maps = (await read(new ol.format.WMSCapabilities(), wms)).Capability;
          const ofMaps = maps.Layer.Layer[0].Layer.find(each => each.Name === layer).Style[0].LegendURL[0];
          const tiles = (await read(new ol.format.WMTSCapabilities(), wmts)).Contents;
          const ofTiles = tiles.Layer.find(each => each.Identifier === layer).Style[0].LegendURL[0];
          const url = maps.Request.GetMap.DCPType[0].HTTP.Get.OnlineResource;
          const asked = new ol.source.ImageWMS({url, params: {LAYERS: layer}}).getLegendUrl(50);
          return Promise.all([ofMaps.OnlineResource, ofTiles.href, asked].map(async address => {
            const picture = new Image();
            picture.crossOrigin = 'anonymous';
            picture.src = address;
            await picture.decode();
            const {naturalWidth: width, naturalHeight: height} = picture;
            const canvas = new OffscreenCanvas(width, height).getContext('2d');
            canvas.drawImage(picture, 0, 0);
            const colors = new Set(new Uint32Array(canvas.getImageData(0, 0, width, height).data.buffer)).size;
            return {address, size: [width, height], told: ofMaps.size, colors};
          }));
        }""",
        wms=f"{openlayers.service_address}/levels/{LEVEL}/wms?SERVICE=WMS&REQUEST=GetCapabilities",
        wmts=f"{openlayers.service_address}/levels/{LEVEL}/WMTSCapabilities.xml",
        layer=f"{LEVEL}:sunhours",
    )
    assert len({legend["address"] for legend in legends}) >= 2
    assert "REQUEST=GetLegendGraphic" in legends[-1]["address"]
    for legend in legends:
        assert legend["size"] == legend["told"]
        assert legend["colors"] > 100, "the legend shows a scale of many colours"
