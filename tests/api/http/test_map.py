"""Maps of any extent, CRS and size."""

from __future__ import annotations

import io
import json
from datetime import UTC, datetime, timedelta

import httpx
import numpy as np
import pytest
from morecantile import tms
from PIL import Image
from pyproj import Transformer
from rasterio.io import MemoryFile

from skugga.api.color_scale import ColorScale
from skugga.api.http.tiles.map_extents import crs_code, crs_of_code, is_north_first, map_size, parse_bounds
from skugga.terrain.errors import InputError
from tests.api.conftest import CELL_M, CELLS, CORNER, ZOOM, Client
from tests.api.http.test_problems import check_problem

X, Y = CORNER
TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}"
MAP = "/levels/hills/map"
TILE_BBOX = ",".join(f"{value!r}" for value in tms.get("WebMercatorQuad").xy_bounds(X, Y, ZOOM))


def pixels(answer: httpx.Response) -> np.ndarray:
    """Return the picture of a successful response (rows, cols, channels)."""
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)))


@pytest.mark.parametrize("layer", ["color", "shadow", "mask", "terrain-rgb"])
def test_map_of_a_tile_extent_equals_the_tile(client: Client, layer: str):
    sun = {"azimuth": 221.5, "altitude": 17.25}
    query = {"bbox": TILE_BBOX, "crs": "EPSG:3857", "width": 256, "height": 256, "layer": layer, **sun}
    answer = client.get(f"{MAP}.png", params=query)
    assert np.array_equal(pixels(answer), pixels(client.get(f"{TILE}.png", params={"layer": layer, **sun})))
    if layer == "color":
        assert answer.headers["x-skugga-algorithm"] == "sweep" and "clipped" in answer.headers["x-skugga-caster-reach"]
        assert "map;desc=drawn" in answer.headers["server-timing"]
        cached_response = client.get(f"{MAP}.png", params=query)
        assert cached_response.content == answer.content and "map;desc=kept" in cached_response.headers["server-timing"]


def test_map_has_an_etag_before_it_is_drawn(client: Client):
    query = {"bbox": TILE_BBOX, "crs": "EPSG:3857", "width": 64, "height": 64, "layer": "shadow"}
    answer = client.get(f"{MAP}.png", params=query)
    before = client.service.pool.counters.jobs_answered
    not_modified = client.get(f"{MAP}.png", params=query, headers={"If-None-Match": answer.headers["etag"]})
    assert (not_modified.status_code, not_modified.content, client.service.pool.counters.jobs_answered) == (304, b"", before)
    tags = {
        client.get(f"{MAP}.png", params={**query, **changes}).headers["etag"]
        for changes in ({}, {"width": 65}, {"time": "2024-06-21T18:00:00Z"})
    }
    assert (
        len(tags) == 3 and client.get(f"{MAP}.png", params={**query, "time": "default"}).headers["etag"] == answer.headers["etag"]
    )


def test_adjacent_maps_join_without_a_seam(client: Client):
    """The maps lie off the tile grid, as those of WMS clients. They join because the plan depends on level and scale alone."""
    west, south, east, north = (float(value) for value in TILE_BBOX.split(","))
    west, east = west - 1000.3, east - 1000.3
    middle = (west + east) / 2
    half = {"crs": "EPSG:3857", "width": 96, "height": 192, "layer": "shadow"}
    full_map = pixels(client.get(f"{MAP}.png", params={**half, "bbox": f"{west},{south},{east},{north}", "width": 192}))
    parts = [
        pixels(client.get(f"{MAP}.png", params={**half, "bbox": f"{a},{south},{b},{north}"}))
        for a, b in ((west, middle), (middle, east))
    ]
    joined_maps = np.hstack(parts).astype(int)
    assert joined_maps.shape == full_map.shape and full_map[..., 3].std() > 30
    differing = np.abs(joined_maps - full_map).max(axis=2) > 2
    assert differing.mean() < 0.002 and not differing[:, 92:100].any(axis=0).all()


def test_utm_map_has_the_right_georeference(client: Client):
    """The GeoTIFF's transform puts the valid pixels on the raster's square, whose centre and side are known by arithmetic."""
    answer = client.get(f"{MAP}.tif", params={"layer": "visibility", "crs": "EPSG:32632", "width": 120})
    with MemoryFile(answer.content) as file, file.open() as dataset:
        assert (dataset.crs.to_epsg(), dataset.dtypes, dataset.width) == (32632, ("float32",), 120)
        values, transform = dataset.read(1), dataset.transform
    assert 0.01 < np.isnan(values).mean() < 0.2  # the UTM bounds of a Web Mercator square hold nodata in the corners
    to_mercator = Transformer.from_crs(32632, 3857, always_xy=True)
    rows, cols = np.nonzero(np.isfinite(values))
    x, y = to_mercator.transform(*(transform @ (cols + 0.5, rows + 0.5)))
    corner = tms.get("WebMercatorQuad").xy_bounds(X, Y, ZOOM)
    half = CELLS * CELL_M / 2
    assert np.abs(x - corner.left).max() < half + 1 and np.abs(y - corner.top).max() < half + 1
    assert np.abs(x - corner.left).max() > half - 200 and np.abs(y - corner.top).max() > half - 200


def test_map_defaults_come_from_the_level(client: Client):
    answer = client.get(f"{MAP}.png", params={"width": 100})
    assert pixels(answer).shape[1] == 100
    with MemoryFile(client.get(f"{MAP}.tif", params={"height": 50, "layer": "mask"}).content) as file, file.open() as dataset:
        assert dataset.height == 50 and dataset.nodata == 128
        assert dataset.crs.to_epsg() == 3857  # the raster's CRS
    assert pixels(client.get("/levels/site/map.png", params={"width": 64})).shape == (64, 64, 3)  # all pixels are valid: no alpha


@pytest.mark.parametrize(("bbox", "crs"), [("0,0,1000,1000", "EPSG:3857"), ("100,-40,101,-39", "OGC:CRS84")])
def test_map_off_the_data_is_empty(client: Client, bbox: str, crs: str):
    query = {"bbox": bbox, "crs": crs, "width": 32, "height": 32}
    assert not pixels(client.get(f"{MAP}.png", params=query)).any()
    assert (pixels(client.get(f"{MAP}.jpg", params=query)) == 255).all()
    with MemoryFile(client.get(f"{MAP}.tif", params={**query, "layer": "visibility"}).content) as file, file.open() as dataset:
        assert np.isnan(dataset.read(1)).all()
        np.testing.assert_allclose(dataset.bounds, [float(value) for value in bbox.split(",")], rtol=1e-9)


def test_map_of_the_whole_world_is_answered(client: Client):
    """The level is far smaller than a pixel; the request succeeds whatever that pixel shows."""
    world = {"bbox": "-180,-90,180,90", "crs": "EPSG:4326", "width": 256, "height": 128}
    assert pixels(client.get(f"{MAP}.png", params=world)).shape == (128, 256, 4)


def test_sun_hours_map_agrees_with_points(client: Client):
    """The legend's colours are read back as hours, and compared with the hours of direct sun at points."""
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    lon, lat, side = (west + east) / 2, (south + north) / 2, 0.016
    bbox = f"{lon - side},{lat - side},{lon + side},{lat + side}"
    query = {"bbox": bbox, "crs": "OGC:CRS84", "width": 64, "height": 64, "layer": "sunhours", "date": "2024-12-21"}
    map_pixels = pixels(client.get(f"{MAP}.png", params=query))
    assert map_pixels.shape == (64, 64, 4) and (map_pixels[..., 3] == 255).all()
    legend = client.get("/levels/hills/WebMercatorQuad/tilejson.json?layer=sunhours&date=2024-12-21").json()["skugga"]["legend"]
    hours = np.linspace(legend["low"], legend["high"], 256)
    colors = ColorScale("", "inferno", legend["low"], legend["high"], ()).to_rgba(hours[None])[0].astype(int)
    rows, cols = (item.ravel() for item in np.mgrid[4:64:14, 4:64:14])
    points = [
        {"lon": lon - side + (col + 0.5) * side / 32, "lat": lat + side - (row + 0.5) * side / 32}
        for row, col in zip(rows, cols, strict=True)
    ]
    answer = client.post("/levels/hills/point", json={"points": points, "time": "2024-12-21T12:00:00+01:00"}).json()
    direct = np.array([item["direct_h"] for item in answer["points"]])
    hours_by_color = hours[np.abs(colors - map_pixels[rows, cols][:, None].astype(int)).sum(axis=2).argmin(axis=1)]
    assert np.corrcoef(hours_by_color, direct)[0, 1] > 0.9 and direct.std() > 0.5


@pytest.mark.parametrize(
    ("query", "parameter", "expected_text"),
    [
        ("bbox=1,2,3", "bbox", "four numbers"),
        ("bbox=3,2,1,4", "bbox", "west < east"),
        ("bbox=8.3,47.4,8.5,47.6", "bbox", "lies outside of the level, whose maps are in EPSG:3857. For degrees add crs=OGC:CRS84"),
        ("bbox=a,b,c,d", "bbox", "four numbers"),
        ("bbox=0,0,nan,4", "bbox", "four numbers"),
        ("crs=%2Bproj%3Dutm%20%2Bzone%3D32%20%2Bnadgrids%3Dhouse.tif", "crs", "by its code"),
        ("crs=house.prj", "crs", "by its code"),
        ("crs=EPSG:999999", "crs", "by its code"),
        ("crs=EPSG:4978", "crs", "projected or geographic"),
        ("width=0", "width", "1 to"),
        ("width=100000", "width", "1 to"),
        ("width=4000&height=4000", "size", "SKUGGA_MAX_SNAPSHOT_PIXELS"),
        ("width=1000&height=10", "size", "as long as wide"),
        ("layer=depth", "layer", "visibility"),
        ("layer=visibility", "format", "tif"),
        ("colour=red", "colour", "bbox"),
    ],
)
def test_map_names_wrong_parameters(client: Client, query: str, parameter: str, expected_text: str):
    problem = check_problem(client.get(f"{MAP}.png?{query}"), 422, "invalid_parameter", parameter)
    assert expected_text in problem["detail"]


def test_engineering_level_refuses_a_crs(client: Client):
    check_problem(client.get("/levels/site/map.png?crs=EPSG:3857"), 422, "invalid_parameter", "crs")


def test_current_time_is_fresh_for_at_most_its_grain(client: Client):
    for address in (f"{TILE}.png?layer=mask&time=current", f"{MAP}.png?time=current&width=9"):
        answer = client.get(address)
        assert answer.status_code == 200 and 1 <= int(answer.headers["cache-control"].rpartition("=")[2]) <= 60
        assert abs(datetime.fromisoformat(answer.headers["x-skugga-time"]) - datetime.now(UTC)) < timedelta(minutes=3)
    assert json.loads(client.get(f"{TILE}.png?time=currently").content)["parameter"] == "time"


# -- without a service


def test_crs_codes_and_axis_order():
    spellings = ("epsg:3857", "3857", "CRS:84", "urn:ogc:def:crs:EPSG::2193", "urn:ogc:def:crs:OGC:1.3:CRS84")
    assert [crs_code(text) for text in spellings] == ["EPSG:3857", "EPSG:3857", "OGC:CRS84", "EPSG:2193", "OGC:CRS84"]
    codes = ("EPSG:4326", "OGC:CRS84", "EPSG:3857", "EPSG:2193", "EPSG:3035", "EPSG:32661", "EPSG:5041", "EPSG:3031")
    assert [code for code in codes if is_north_first(crs_of_code(code))] == ["EPSG:4326", "EPSG:2193", "EPSG:3035", "EPSG:32661"]
    with pytest.raises(InputError, match="by its code"):
        crs_code("EPSG:3857 +type=crs")


def test_parse_bounds_and_map_size():
    assert parse_bounds("1,2,3,4") == (1, 2, 3, 4)
    assert parse_bounds("47,8,48,10", is_south_first=True) == (8, 47, 10, 48)
    assert map_size(None, None, 2.0) == (1024, 512) and map_size(None, None, 0.5) == (512, 1024)
    assert map_size(300, None, 2.0) == (300, 150) and map_size(None, 300, 2.0) == (600, 300) and map_size(30, 20, 9.0) == (30, 20)
