"""Paths over ground: their height, also on a round earth, and rejected paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from skugga.terrain.errors import LevelError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, geocentric, transformer
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.ground.ground_path import GroundPath, path_over_ground
from skugga.terrain.level.motion import HeightReference
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING

UTM = "EPSG:32633"


@pytest.fixture
def ridge(write_raster) -> Path:
    """Write a raster of 1000 m a side in 10 m cells.

    A ridge of 100 m runs along the middle from south to north, on level ground at 50 m.
    """
    x = np.linspace(-495, 495, 100)
    heights = np.tile(50.0 + np.maximum(100.0 - np.abs(x), 0.0), (100, 1)).astype(np.float32)
    return write_raster(heights, ENGINEERING, -500.0, 500.0, 10.0)


def path_in(scene: Scene, *keys: tuple, loop: bool = False, above: HeightReference = "ground") -> GroundPath:
    """Return a path with keys (seconds, position). Positions are two or three coordinates."""
    timed_positions = [(seconds, (*place, 0.0) if len(place) == 2 else place) for seconds, place in keys]
    return path_over_ground(timed_positions, loop, above, Geolocator(scene.world, scene.elevation), "level.yaml: path", "position")


def test_path_height_is_relative_to_the_ground_or_the_sea(make_scene, ridge):
    scene = make_scene(ridge)
    keys = (0.0, (-200, 7, 20)), (10.0, (200, 7, 20))
    over_ground, over_sea = path_in(scene, *keys), path_in(scene, (0.0, (-200, 7, 260)), (10.0, (200, 7, 160)), above="sea")
    for seconds in np.linspace(-2.0, 12.0, 29):
        t = np.clip(seconds / 10.0, 0.0, 1.0)
        share = t * t * (3.0 - 2.0 * t)  # smoothstep: the path starts and stops slowly
        x = -200.0 + 400.0 * share
        ground = float(scene.elevation.ground_m(x, 7.0))
        ground_position, sea_position = over_ground.at_second(float(seconds)), over_sea.at_second(float(seconds))
        np.testing.assert_allclose(ground_position.point_earth_m, [x, 7.0, ground + 20.0], atol=1e-6)
        np.testing.assert_allclose(sea_position.point_earth_m, [x, 7.0, 260.0 - 100.0 * share], atol=1e-6)
        assert ground_position.above_ground_m == pytest.approx(20.0) and sea_position.above_ground_m == pytest.approx(
            260.0 - 100.0 * share - ground
        )
    for path in (over_ground, over_sea):
        path.check("path")


def test_path_height_over_water_is_relative_to_the_water(make_scene, ridge):
    scene = make_scene(ridge, water={"level": 80})
    assert path_in(scene, (0.0, (-300, 0, 2)), (9.0, (-200, 0, 2))).at_second(4.0).point_earth_m[2] == pytest.approx(82.0)


def test_path_through_a_ridge_is_rejected(make_scene, ridge):
    scene = make_scene(ridge)
    colliding_path = path_in(scene, (0.0, (-200, 0, 120)), (10.0, (200, 0, 120)), above="sea")
    with pytest.raises(LevelError) as caught:
        colliding_path.check("level.yaml: path")
    text = str(caught.value)
    assert text.startswith("level.yaml: path: at 120.00 m at second 4") and "under the ground, which is at 12" in text
    assert text.endswith(". Keep all of the path above the ground.") and "\n" not in text
    colliding_path.check("path", may_be_under_ground=True)
    path_in(scene, (0.0, (-200, 0, 60)), (5.0, (0, 0, 155)), (10.0, (200, 0, 60)), above="sea").check("path")


def test_path_off_the_terrain_is_rejected(make_scene, write_raster):
    """Rejected are a key outside the raster and a leg over ground without data that is too wide to be filled."""
    scene = make_scene(write_raster(np.zeros((40, 40), np.float32), ENGINEERING, -200.0, 200.0, 10.0, "small.tif"))
    with pytest.raises(LevelError, match=r"path\.1\.position: '\(500, 0, 3\)' .* within -200\.00, -200\.00, 200\.00, 200\.00"):
        path_in(scene, (0.0, (0, 0, 3)), (3.0, (500, 0, 3)))
    heights = np.zeros((20, 400), np.float32)
    heights[:, 120:280] = np.nan
    gap = make_scene(write_raster(heights, ENGINEERING, -2000.0, 100.0, 10.0, "gap.tif"))
    over = path_in(gap, (0.0, (-1500, 0, 3)), (10.0, (1500, 0, 3)))
    with pytest.raises(
        LevelError, match=r"^path: leaves the terrain at second [34]\.\d+\. Keep all of the path over the terrain\.$"
    ) as caught:
        over.check("path")
    assert "\n" not in str(caught.value)
    path_in(gap, (0.0, (-1500, 0, 3)), (10.0, (-1000, 0, 3))).check("path")


@pytest.mark.parametrize("seconds", [0.0, 5.0, 8.0])
def test_path_on_the_globe_keeps_its_height_between_far_keys(make_scene, write_raster, seconds):
    """The chord between keys 60 km apart lies 70 m below sea level. North is true north."""
    dem = write_raster(np.full((90, 90), 100.0, np.float32), UTM, 455000, 5045000, 1000)
    scene = make_scene(dem)
    start_lon_lat, end_lon_lat = (transformer(CRS(UTM), LONGITUDE_LATITUDE).transform(x, 5001000) for x in (470000, 530000))
    path = path_in(scene, (0.0, (*start_lon_lat, 30.0)), (10.0, (*end_lon_lat, 30.0)))
    point, up, above_m = path.at_second(seconds)
    lon, lat, height = scene.world.map_position(LONGITUDE_LATITUDE, point)
    assert height == pytest.approx(130.0, abs=1e-3) and above_m == pytest.approx(30.0)
    np.testing.assert_allclose(up, geocentric(lon, lat)[1], atol=1e-9)
    assert path.azimuth_deg(seconds) == pytest.approx(90.0, abs=0.5)
    if seconds == 5.0:
        assert lon == pytest.approx((start_lon_lat[0] + end_lon_lat[0]) / 2, abs=1e-6)


def test_path_across_the_antimeridian_is_the_short_one(make_scene, write_raster):
    dem = write_raster(np.full((20, 60), 10.0, np.float32), "EPSG:4326", 178.5, -16.0, 0.05)
    scene = make_scene(dem)
    path = path_in(scene, (0.0, (179.5, -16.5, 5.0)), (8.0, (-179.5, -16.5, 5.0)))
    path.check("path")
    lon, _, height = scene.world.map_position(LONGITUDE_LATITUDE, path.at_second(4.0).point_earth_m)
    assert abs(lon) == pytest.approx(180.0, abs=1e-6) and height == pytest.approx(15.0, abs=1e-2)


def test_azimuth_follows_the_direction_of_travel(make_scene, ridge):
    """Degrees clockwise from north: on the way, at both ends, and during a rest."""
    scene = make_scene(ridge)
    path = path_in(scene, (0.0, (-200, 0)), (5.0, (-200, 100)), (8.0, (-200, 100)), (20.0, (-150, 50)))
    for seconds, azimuth in ((-3.0, 0.0), (0.0, 0.0), (2.5, 0.0), (6.0, 0.0), (9.0, 135.0), (15.0, 135.0), (30.0, 135.0)):
        assert path.azimuth_deg(seconds) == pytest.approx(azimuth, abs=1e-4), seconds


def test_number_of_checked_samples_is_bounded(make_scene, ridge):
    path = path_in(make_scene(ridge), *((float(n), ((n % 2) * 400 - 200, n % 7)) for n in range(3000)))
    assert 2999 * 16 <= len(path.sample_times_s()) < 80_000
    assert path.sample_times_s()[[0, -1]].tolist() == [0.0, 2999.0]
