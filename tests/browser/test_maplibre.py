"""MapLibre reads the service's TileJSON, and its heights as terrain in three dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from tests.api.conftest import Client
from tests.browser.map_clients import LEVEL, TIMES, MapClient, pixel_differences
from tests.browser.test_page_lines import CORNER, LIBRARY_BY_NAME, TERRAIN_HEADING, lines_of_page, run_line
from tests.browser.watched_page import WatchedPage

MAX_ZOOM = 14
CELLS_PER_DEG = 1200
ROUNDING_M = 0.01
"""The maximum zoom of the level's tiles, the nodes of its raster per degree, and the rounding of heights at points."""

PIXEL_ROUNDING_M = 1e-4
"""Rounding error from a longitude to a pixel."""


@pytest.fixture
def maplibre(map_client: MapClient) -> MapClient:
    """Return a MapLibre map centred on the corner."""
    map_client.open("maplibre")
    map_client.run(LIBRARY_BY_NAME["MapLibre"].create_map_script, lonLat=CORNER.lon_lat, zoom=CORNER.zoom)
    return map_client


@pytest.mark.parametrize("time", TIMES)
def test_maplibre_reads_tilejson(maplibre: MapClient, service: Client, time: str):
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
    tilejson = service.get(url).json()
    assert source == {key: tilejson[key] for key in source} and source["attribution"].startswith("Elevation: SRTM")
    assert pixel_differences(maplibre.pixels(), CORNER.tiles(service, time=time)).max() == 0


def pixel_centers() -> list[tuple[float, float]]:
    """Return longitude and latitude of pixels round the corner, at the maximum zoom, where tiles hold their heights themselves."""
    round_the_earth_px = 256 * 2**MAX_ZOOM
    middle = 256 * 2 ** (MAX_ZOOM - CORNER.zoom) * np.array([CORNER.column, CORNER.row])
    centers = []
    for column_offset in range(-50, 51, 25):
        for row_offset in range(-50, 51, 25):
            x, y = (middle + (column_offset + 0.5, row_offset + 0.5)) / round_the_earth_px
            centers.append((float(x) * 360 - 180, math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * float(y)))))))
    return centers


def heights_of_api(service: Client, points: Sequence[tuple[float, float]]) -> np.ndarray:
    """Return the heights of points from the service, rounded to a centimetre."""
    body = {"points": [{"lon": lon, "lat": lat} for lon, lat in points]}
    answer = service.post(f"/levels/{LEVEL}/point", json=body)
    assert answer.status_code == 200, answer.text
    return np.array([point["elevation_m"] for point in answer.json()["points"]])


def bilinear_heights_m(service: Client, points: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return heights of points, bilinear between the four nodes of the level's raster round each, and a tolerance.

    The tolerance bounds the difference of two triangles over the same nodes from that.
    """
    west, _, _, north = service.get(f"/levels/{LEVEL}").json()["bounds"]
    places = [((lon - west) * CELLS_PER_DEG - 0.5, (north - lat) * CELLS_PER_DEG - 0.5) for lon, lat in points]
    nodes = [
        (west + (math.floor(x) + right + 0.5) / CELLS_PER_DEG, north - (math.floor(y) + down + 0.5) / CELLS_PER_DEG)
        for x, y in places
        for down in (0, 1)
        for right in (0, 1)
    ]
    corners = heights_of_api(service, nodes).reshape(-1, 2, 2)
    shares = np.array([np.outer([1 - y % 1, y % 1], [1 - x % 1, x % 1]) for x, y in places])
    twist = corners[:, 0, 0] - corners[:, 0, 1] - corners[:, 1, 0] + corners[:, 1, 1]
    return (corners * shares).sum(axis=(1, 2)), np.abs(twist) / 4


@pytest.mark.parametrize(("encoding", "step_m"), [("terrarium", 1 / 256), ("terrain-rgb", 0.1)])
def test_maplibre_terrain_agrees_with_point_heights(
    maplibre: MapClient, service: Client, service_page: WatchedPage, encoding: str, step_m: float
):
    """Terrarium is the encoding of the page's line; MapLibre expects the other one of a source that names none.

    Tiles lie bilinearly between the nodes of the raster. Heights of points are those of the ground that casts shadows, which
    is made of triangles.
    """
    maplibre.run("({center}) => map.jumpTo({center, zoom: 16})", center=CORNER.lon_lat)
    if encoding == "terrarium":
        run_line(maplibre, lines_of_page(service_page)[TERRAIN_HEADING])
    else:
        maplibre.run(
            """({url}) => {
              map.addSource('heights', {type: 'raster-dem', url, tileSize: 256});
              map.setTerrain({source: 'heights'});
            }""",
            url=f"{maplibre.service_address}/levels/{LEVEL}/WebMercatorQuad/tilejson.json?layer={encoding}",
        )
    points = pixel_centers()
    on_map = maplibre.run(
        "async ({points}) => { await idle(); return points.map(point => map.queryTerrainElevation(point)); }", points=points
    )
    assert None not in on_map and np.ptp(on_map) > 50
    between, triangles_m = bilinear_heights_m(service, points)
    rounded_m = ROUNDING_M / 2 + step_m / 2 + PIXEL_ROUNDING_M
    assert np.abs(on_map - between).max() < rounded_m
    assert (np.abs(on_map - heights_of_api(service, points)) < ROUNDING_M / 2 + rounded_m + triangles_m).all()
