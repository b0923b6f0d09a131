"""MapLibre reads TileJSON as it is, and heights as ground in three dimensions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from tests.api.conftest import Client
from tests.browser.map_clients import LEVEL, TIMES, Corner, MapClient, difference
from tests.browser.test_page_lines import MAPS, lines_of_page, run_line
from tests.browser.watched_page import WatchedPage

CORNER = Corner("WebMercatorQuad", 12)


@pytest.fixture
def maplibre(map_client: MapClient) -> MapClient:
    """A map that looks at the corner."""
    map_client.open("maplibre")
    map_client.run(MAPS["MapLibre"].make, lonLat=CORNER.lon_lat, zoom=CORNER.zoom)
    return map_client


@pytest.mark.parametrize("time", TIMES)
def test_tilejson_is_a_source_of_tiles(maplibre: MapClient, service: Client, time: str):
    url = f"{maplibre.service_address}/levels/{LEVEL}/WebMercatorQuad/tilejson.json?time={time}"
    source = maplibre.run(
        """async ({url}) => {
          map.addSource('skugga', {type: 'raster', url, tileSize: 256});
          map.addLayer({id: 'skugga', type: 'raster', source: 'skugga'});
          await idle();
          const {attribution, bounds, minzoom, maxzoom} = map.getSource('skugga');
          return {attribution, bounds, minzoom, maxzoom};
        }""",
        url=url,
    )
    told = service.get(url).json()
    assert source == {key: told[key] for key in source} and source["attribution"].startswith("Elevation: SRTM")
    assert difference(maplibre.pixels(), CORNER.tiles(service, time=time)).max() == 0


def heights_of_map(maplibre: MapClient, points: Sequence[tuple[float, float]]) -> np.ndarray:
    """The heights of points on the map's ground, once it is there."""
    heights = maplibre.run("async ({points}) => { await idle(); return points.map(p => map.queryTerrainElevation(p)); }", points=points)
    assert None not in heights
    return np.array(heights)


@pytest.mark.parametrize("source", ["the page's line", "terrain-rgb"])
def test_heights_are_ground(maplibre: MapClient, service: Client, own_page: WatchedPage, source: str):
    lon, lat = CORNER.lon_lat
    maplibre.run("({center}) => map.jumpTo({center, zoom: 14})", center=(lon, lat))
    if source == "terrain-rgb":
        # What MapLibre takes heights for that say nothing else.
        url = f"{maplibre.service_address}/levels/{LEVEL}/WebMercatorQuad/tilejson.json?layer=terrain-rgb"
        maplibre.run(
            "({url}) => { map.addSource('heights', {type: 'raster-dem', url, tileSize: 256}); map.setTerrain({source: 'heights'}); }",
            url=url,
        )
    else:
        run_line(maplibre, lines_of_page(own_page)["MapLibre, in three dimensions"])
    points = [(lon + east, lat + south) for east in np.linspace(-0.008, 0.008, 5) for south in np.linspace(-0.006, 0.006, 5)]
    on_map = heights_of_map(maplibre, points)
    asked = {"points": [{"lon": lon, "lat": lat} for lon, lat in points]}
    answer = service.post(f"/levels/{LEVEL}/points", json=asked)
    assert answer.status_code == 200, answer.text
    print(answer.text[:600])
    elevations = np.array([point["elevation_m"] for point in answer.json()["points"]])
    print(on_map, elevations)
    assert np.ptp(elevations) > 50
    assert np.abs(on_map - elevations).max() < 0.5
