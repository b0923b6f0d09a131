import json

import numpy as np
import pytest
from morecantile import tms as registered
from pyproj import CRS

from skugga.api.errors import NotServedError
from skugga.api.matrices import (
    ZoomRange,
    check_tile,
    finest_detail_m,
    is_quadtree_zoom,
    matrix_set_of,
    served_matrix_sets,
    shows_no_data,
    zoom_range,
)
from skugga.terrain.geo.world import World

MERCATOR = registered.get("WebMercatorQuad")


def world(lon: float, lat: float) -> World:
    """Return a world in degrees with its anchor at a longitude and latitude."""
    return World(CRS.from_epsg(4326), False, lon, lat, lon, lat)


def square_bounds(lon: float, lat: float, half: float) -> tuple[float, float, float, float]:
    """Return west, south, east and north of a square with sides of 2 ``half``, degrees."""
    return lon - half, lat - half, lon + half, lat + half


def test_served_matrix_sets_are_plain_grids_of_256_px():
    matrix_sets = served_matrix_sets()
    assert {"WebMercatorQuad", "WGS1984Quad", "EuropeanETRS89_LAEAQuad"} <= set(matrix_sets)
    assert not {"CDB1GlobalGrid", "GNOSISGlobalGrid"} & set(matrix_sets)  # tiles of other sizes; rows of varying width


def test_an_unknown_matrix_set_error_lists_the_known_ones():
    with pytest.raises(NotServedError, match="WebMercatorQuad") as caught:
        matrix_set_of("Nowhere")
    assert caught.value.name == "tms"


@pytest.mark.parametrize("lat", [0.0, 46.0, 70.0])
def test_zooms_follow_from_size_on_the_ground(lat: float):
    half = 0.2
    zooms = zoom_range(MERCATOR, world(8.0, lat), square_bounds(8.0, lat, half), cell_m=25.0)
    assert zooms is not None
    pixel_m = 40_075_016.7 / 256 / 2.0 ** np.array([zooms.first, zooms.last - 3]) * np.cos(np.radians(lat))
    long_side_m = 2 * half * 111_000
    assert 0.35 < long_side_m / (256 * pixel_m[0]) < 0.72
    assert 0.7 < pixel_m[1] / 25.0 < 1.42


def test_objects_add_finer_zooms(write_raster, make_scene, tmp_path):
    """Zooms of terrain alone end three zooms past its cells. With trees and houses they end where an object of 10 m has 20
    pixels.
    """
    raster = write_raster(np.zeros((60, 60), np.float32), "EPSG:32633", 450_000.0, 6_000_000.0, 30.0)
    place = {"type": "Point", "coordinates": [14.249, 54.142]}
    (tmp_path / "tree.geojson").write_text(json.dumps({
        "type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": place}],
    }))  # fmt: skip
    forest, meshes = [{"source": str(tmp_path / "tree.geojson")}], [{"generate": "rocks", "at": [14.249, 54.142]}]
    last = {}
    for name, keys in {"bare": {}, "forest": {"forest": forest}, "meshes": {"meshes": meshes}}.items():
        scene = make_scene(raster, **keys)
        zooms = zoom_range(MERCATOR, scene.world, scene.bounds_lon_lat, finest_detail_m(scene))
        assert zooms is not None
        last[name] = zooms.last
    pixel_m = {name: 40_075_016.7 / 256 / 2.0**zoom * np.cos(np.radians(54.142)) for name, zoom in last.items()}
    assert 30.0 / 8.0 / 1.42 < pixel_m["bare"] < 30.0 / 8.0 * 1.42
    assert pixel_m["forest"] == pixel_m["meshes"] and 14.0 < 10.0 / pixel_m["forest"] < 29.0
    fine_scene = make_scene(write_raster(np.zeros((60, 60), np.float32), "EPSG:32633", 450_000.0, 6_000_000.0, 1.0), forest=[])
    assert finest_detail_m(fine_scene) == pytest.approx(1.0, rel=0.01)


def test_zooms_end_with_the_matrix_set():
    zooms = zoom_range(MERCATOR, world(8.0, 46.0), square_bounds(8.0, 46.0, 1e-4), cell_m=1e-3)
    assert zooms == ZoomRange(zooms.first, MERCATOR.maxzoom)


def test_no_zooms_elsewhere_on_earth():
    tennessee = square_bounds(-84.2, 36.3, 0.2)
    assert zoom_range(registered.get("NZTM2000Quad"), world(-84.2, 36.3), tennessee, 30.0) is None
    assert zoom_range(MERCATOR, world(0.0, 89.0), square_bounds(0.0, 89.0, 0.5), 30.0) is None


def test_no_zooms_lost_at_the_antimeridian():
    assert zoom_range(MERCATOR, world(180.0, -17.0), (179.8, -17.2, 180.2, -16.8), 30.0) is not None


def test_the_error_of_an_outside_tile_names_its_index():
    zooms = ZoomRange(9, 14)
    check_tile(MERCATOR, zooms, 9, 511, 0)
    for zxy, name in (((8, 0, 0), "z"), ((15, 0, 0), "z"), ((9, 512, 0), "x"), ((9, 0, -1), "y")):
        with pytest.raises(NotServedError) as caught:
            check_tile(MERCATOR, zooms, *zxy)
        assert caught.value.name == name


def test_quadtree_levels_are_recognized():
    assert is_quadtree_zoom(MERCATOR, 10)
    assert not is_quadtree_zoom(MERCATOR, MERCATOR.maxzoom)
    assert not is_quadtree_zoom(registered.get("CanadianNAD83_LCC"), 5)


def tiles_with_data(data: tuple[float, float, float, float], zoom: int) -> set[tuple[int, int]]:
    """Return column and row of the tiles of a zoom that show a part of ``data``: west, south, east and north, degrees."""
    count = 2**zoom
    return {(x, y) for x in range(count) for y in range(count) if not shows_no_data(MERCATOR, zoom, x, y, data)}


def test_tiles_off_the_data_are_recognized():
    data = square_bounds(8.0, 46.0, 2.0)
    assert tiles_with_data(data, 6) == {(tile.x, tile.y) for tile in MERCATOR.tiles(*data, zooms=6)}


def test_data_across_the_antimeridian_is_on_both_sides():
    east, west = (
        MERCATOR.tiles(178.0, -18.0, 179.9, -16.0, zooms=6),
        MERCATOR.tiles(-179.9, -18.0, -178.0, -16.0, zooms=6),
    )
    assert tiles_with_data((178.0, -18.0, 182.0, -16.0), 6) == {(tile.x, tile.y) for tiles in (east, west) for tile in tiles}


def test_a_tile_over_the_pole_is_not_empty():
    polar = registered.get("UPSArcticWGS84Quad")
    tile = polar.tile(0.0, 89.99, 5)
    assert not shows_no_data(polar, 5, tile.x, tile.y, (-180.0, 85.0, 180.0, 90.0))


@pytest.mark.parametrize("seed", range(20))
def test_no_tile_with_data_is_ever_skipped(seed: int):
    random = np.random.default_rng(seed)
    lon, lat, half = random.uniform(-180, 180), random.uniform(-80, 80), 10 ** random.uniform(-3, 0.7)
    west, south, east, north = square_bounds(lon, lat, half)
    zoom = int(random.integers(3, 16))
    for _ in range(50):
        place = random.uniform(west, east), float(np.clip(random.uniform(south, north), -84, 84))
        tile = MERCATOR.tile((place[0] + 180) % 360 - 180, place[1], zoom)
        if not south <= place[1] <= north:
            continue
        assert not shows_no_data(MERCATOR, zoom, tile.x, tile.y, (west, south, east, north))


def test_a_tile_across_the_antimeridian_has_both_sides():
    zealand = registered.get("NZTM2000Quad")
    tile = zealand.tile(179.9, -40.0, 5)
    assert all(
        (tile.x, tile.y) == (other_tile.x, other_tile.y) for other_tile in (zealand.tile(lon, -40.0, 5) for lon in (179.0, -179.0))
    )
    for data in ((178.9, -40.1, 179.1, -39.9), (-179.1, -40.1, -178.9, -39.9), (180.9, -40.1, 181.1, -39.9)):
        assert not shows_no_data(zealand, 5, tile.x, tile.y, data)
    assert shows_no_data(zealand, 5, tile.x, tile.y, (0.0, -40.1, 0.2, -39.9))
