"""Horizon walk over ground with closed forms: walls, cones, rings; earth curvature, true north, pages and levels of detail."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Proj

from skugga.shadows.point import relief_pages
from skugga.shadows.point.horizon_walk import is_ground_occluded, relief_horizon
from skugga.shadows.point.place import place_at
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.geo.world import WGS84
from tests.shadows.point.ground import flat_world, middle_surroundings, offsets_from_middle

AZIMUTHS_DEG = np.arange(720) * 0.5


def elevation_deg(scene, place, azimuth_deg=AZIMUTHS_DEG) -> np.ndarray:
    """Return the horizon angles of the ground at a place, degrees, towards azimuths."""
    return np.degrees(np.arctan(relief_horizon(scene, place, azimuth_deg).tangent))


def test_horizon_of_a_wall(tmp_path, make_scene):
    east, _ = offsets_from_middle(81)
    scene = flat_world(tmp_path, make_scene, np.where(east == 200.0, 50.0, 0.0))
    place = middle_surroundings(scene).place
    facing = np.arange(-60.0, 61.0, 0.5)
    expected = np.degrees(np.arctan(50.0 * np.cos(np.radians(facing)) / 200.0))
    assert elevation_deg(scene, place, 90.0 + facing) == pytest.approx(expected, abs=1e-6)
    horizon = relief_horizon(scene, place, 90.0 + facing)
    assert horizon.distance_m == pytest.approx(200.0 / np.cos(np.radians(facing)), abs=1e-3)
    assert horizon.height_m == pytest.approx(50.0)
    assert elevation_deg(scene, place, np.arange(180.0, 361.0)) == pytest.approx(0.0, abs=1e-9)


def test_horizon_sinks_with_eye_height(tmp_path, make_scene):
    east, _ = offsets_from_middle(81)
    scene = flat_world(tmp_path, make_scene, np.where(east == 200.0, 50.0, 0.0))
    assert elevation_deg(scene, middle_surroundings(scene, 20.0).place, np.array([90.0])) == pytest.approx(
        np.degrees(np.arctan(30 / 200))
    )
    assert elevation_deg(scene, middle_surroundings(scene, 60.0).place, np.array([90.0])) == pytest.approx(
        np.degrees(np.arctan(-10 / 200))
    )


def test_horizon_inside_a_ring(tmp_path, make_scene):
    distance_m = np.hypot(*offsets_from_middle(201))
    scene = flat_world(tmp_path, make_scene, 100.0 * np.clip((distance_m - 600.0) / 100.0, 0.0, 1.0))
    assert elevation_deg(scene, middle_surroundings(scene).place) == pytest.approx(np.degrees(np.arctan(100 / 700)), abs=0.1)


def test_horizon_of_a_cone(tmp_path, make_scene):
    """From below its top, the horizon of a cone is the tangent to it. Towards the axis this is the apex."""
    east, north = offsets_from_middle(161)
    scene = flat_world(tmp_path, make_scene, np.maximum(100.0 - 0.5 * np.hypot(east, north - 400.0), 0.0))
    place = middle_surroundings(scene).place
    top = elevation_deg(scene, place, np.array([0.0, 180.0]))
    assert top == pytest.approx([np.degrees(np.arctan(100 / 400)), 0.0], abs=1e-9)
    tangent_deg = np.degrees(np.arcsin(200.0 / 400.0))
    assert (elevation_deg(scene, place, np.array([tangent_deg + 2.0, 360.0 - tangent_deg - 2.0])) < 1e-9).all()
    assert (elevation_deg(scene, place, np.array([tangent_deg - 3.0, 360.0 - tangent_deg + 3.0])) > 0.1).all()


def test_horizon_on_a_slope_is_the_slope(tmp_path, make_scene):
    east, north = offsets_from_middle(41)
    scene = flat_world(tmp_path, make_scene, 0.3 * east + 0.1 * north)
    azimuth = np.radians(AZIMUTHS_DEG)
    expected = np.degrees(np.arctan(0.3 * np.sin(azimuth) + 0.1 * np.cos(azimuth)))
    place = place_at(scene, (13.0, -4.0))
    assert place.ground_m == pytest.approx(0.3 * 13 - 0.1 * 4, abs=1e-5)
    horizon, uphill = elevation_deg(scene, place), expected > 8.0
    assert horizon[uphill] == pytest.approx(expected[uphill], abs=1e-4)
    # Elsewhere the level node beyond the border may stand over the slope.
    assert (horizon > expected - 1e-4).all() and (horizon < expected + 1.0).all()


def test_horizon_of_columns_has_vertical_walls(tmp_path, make_scene):
    east, _ = offsets_from_middle(81)
    scene = flat_world(tmp_path, make_scene, np.where(east == 200.0, 50.0, 0.0), terrain={"surface": "blocks"})
    assert elevation_deg(scene, middle_surroundings(scene).place, np.array([90.0])) == pytest.approx(
        np.degrees(np.arctan(50 / 195))
    )


def test_horizon_follows_the_earth_curvature(write_raster, make_scene):
    """The wall of 1000 m is 90 km away. The earth hides R (1 / cos(d / R) - 1) of it, less the part due to its lean."""
    heights = np.zeros((5, 500), np.float32)
    heights[:, -50:] = 1000.0
    scene = make_scene(write_raster(heights, "EPSG:32633", 400_000.0, 5_000_000.0, 200.0))
    x, y = 401_000.0, 5_000_000.0 - 500.0
    place = place_at(scene, (x, y), CRS.from_epsg(32633))
    foot = (400_000.0 + 450.5 * 200.0, y)
    lon, lat = Proj("EPSG:32633")(*foot, inverse=True)
    azimuth, _, distance = WGS84.inv(place.lon_deg, place.lat_deg, lon, lat)
    radius = 6_389_000.0  # radius of the ellipsoid towards the east, at 45 degrees north
    rise = (radius + 1000.0) * np.cos(distance / radius) - radius
    expected = np.degrees(np.arctan(rise / ((radius + 1000.0) * np.sin(distance / radius))))
    elevation = elevation_deg(scene, place, np.array([azimuth]))[0]
    assert elevation == pytest.approx(expected, abs=2e-4)
    assert elevation < np.degrees(np.arctan(1000.0 / distance)) - 0.35


def test_horizon_azimuth_counts_from_true_north(write_raster, make_scene):
    """At the rim of a wide zone grid north is 4 degrees off. The peak appears in the direction of the geodesic."""
    heights = np.zeros((201, 201), np.float32)
    heights[20, 100] = 3000.0
    x0, y0, crs = 90_000.0, 7_000_000.0, CRS.from_epsg(32633)
    scene = make_scene(write_raster(heights, "EPSG:32633", x0, y0, 100.0))
    observer_xy, peak_xy = ((x0 + 100.5 * 100.0, y0 - (row + 0.5) * 100.0) for row in (100, 20))
    place = place_at(scene, observer_xy, crs)
    lon, lat = Proj("EPSG:32633")(*peak_xy, inverse=True)
    azimuth, _, distance = WGS84.inv(place.lon_deg, place.lat_deg, lon, lat)
    assert abs((azimuth + 180) % 360 - 180) > 5.0
    azimuths = azimuth + np.arange(-100, 101) * 0.01
    horizon = relief_horizon(scene, place, azimuths)
    best = int(np.argmax(horizon.tangent))
    assert azimuths[best] == pytest.approx(azimuth, abs=0.01)
    assert horizon.distance_m[best] == pytest.approx(distance, abs=2.0)


def test_horizon_is_no_lower_than_any_node(tmp_path, make_scene, rough_heights):
    """The walk skips nodes. Every node of the rough ground is checked one by one against the horizon in its direction."""
    scene = flat_world(tmp_path, make_scene, rough_heights)
    place = middle_surroundings(scene, 3.0).place
    east, north = offsets_from_middle(len(rough_heights))
    distance_m = np.hypot(east, north)
    off_centre = distance_m > 0
    azimuth = np.degrees(np.arctan2(east[off_centre], north[off_centre])) % 360.0
    rise = (rough_heights[off_centre].astype(float) - place.eye_elevation_m) / distance_m[off_centre]
    horizon = relief_horizon(scene, place, azimuth)
    assert (horizon.tangent >= rise - 1e-9).all()
    assert (np.abs(horizon.tangent - rise) < 1e-9).sum() > 20  # and some nodes reach it
    above = horizon.tangent + 1e-9
    assert not is_ground_occluded(scene, place, azimuth, above).any()
    assert is_ground_occluded(scene, place, azimuth, horizon.tangent - 1e-9).all()


@pytest.fixture
def rough_heights() -> np.ndarray:
    """Random heights in metres (321, 321) with fine and coarse features."""
    rng = np.random.default_rng(5)
    fine_noise = rng.random((321, 321)) * 5.0
    coarse_noise = np.kron(rng.random((21, 21)) * 60.0, np.ones((16, 16)))[:321, :321]
    return (fine_noise + coarse_noise).astype(np.float32)


def test_horizon_reads_far_ground_at_coarser_levels(tmp_path, make_scene, rough_heights, monkeypatch):
    scene = flat_world(tmp_path, make_scene, rough_heights)
    place = middle_surroundings(scene, 55.0).place
    full_detail_deg = elevation_deg(scene, place)
    monkeypatch.setattr(relief_pages, "FULL_DETAIL_NODES", 64)
    reduced_detail_deg = elevation_deg(scene, place)
    assert 0.0 < np.abs(reduced_detail_deg - full_detail_deg).max() < 2.0
    assert {0, 1, 2} <= set(relief_pages.paged_relief(scene).levels)


def test_horizon_ignores_holes_and_place_at_refuses_them(tmp_path, make_scene):
    heights = np.full((9, 9), np.nan)
    heights[3:6, 3:6] = 7.0
    scene = flat_world(tmp_path, make_scene, heights)
    horizon = relief_horizon(scene, place_at(scene, (0.0, 0.0)), np.array([0.0]))
    assert horizon.tangent[0] <= 1e-6
    with pytest.raises(InputError, match="point: '1000,0' is not allowed. Allowed: a place on the level's data"):
        place_at(scene, (1000.0, 0.0))
    with pytest.raises(InputError, match="point"):
        place_at(scene, (35.0, 0.0))  # on the raster, in a hole
    with pytest.raises(InputError, match="height: '-1.0' is not allowed"):
        place_at(scene, (0.0, 0.0), height_m=-1.0)


def test_horizon_beyond_the_rim_is_the_border_s_ground(tmp_path, make_scene):
    """The ground goes on for one node at the border's height, as in maps. A wall across the raster hides what is beside it."""
    heights = np.zeros((9, 9))
    heights[2] = 20.0  # 20 m north of the middle row
    scene = flat_world(tmp_path, make_scene, heights)
    horizon = relief_horizon(scene, place_at(scene, (-40.0, 0.0)), np.array([270.0, 90.0, 340.0]))
    assert horizon.tangent[:2] == pytest.approx(0.0, abs=1e-12)
    assert horizon.tangent[2] == pytest.approx(np.cos(np.radians(20.0)))
    beyond = relief_horizon(scene, place_at(scene, (-45.0, 0.0)), np.array([270.0]))
    assert beyond.distance_m[0] == pytest.approx(5.0)


def test_horizon_across_the_antimeridian_and_at_a_pole(write_raster, make_scene):
    """In degrees, a grid's columns continue at 180 degrees and crowd at a pole. A ridge keeps its place."""
    heights = np.zeros((101, 101), np.float32)
    heights[:, 60] = 500.0
    scene = make_scene(write_raster(heights, "EPSG:4326", 179.5, 60.5, 0.01))
    place = place_at(scene, (-180.0 + 0.005, 60.0 - 0.005))
    _, _, distance = WGS84.inv(place.lon_deg, place.lat_deg, place.lon_deg + 0.1, place.lat_deg)
    east = relief_horizon(scene, place, np.array([90.0]))
    assert east.distance_m[0] == pytest.approx(distance, rel=1e-3) and east.tangent[0] > 0.08
    cap = make_scene(write_raster(np.full((20, 360), 100.0, np.float32), "EPSG:4326", -180.0, 90.0, (1.0, 0.1), name="cap.tif"))
    flat = relief_horizon(cap, place_at(cap, (10.0, 89.9)), AZIMUTHS_DEG[::16])
    assert np.degrees(np.arctan(flat.tangent)) == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("name", ["sierra_30m_albers.tif", "zion_srtm_4326.tif"])
def test_horizon_of_real_mountains_matches_rays(shared_data, make_scene, name):
    """Embree's rays miss slightly above the horizon and hit slightly below it: far ridges, grids turned by 14 degrees."""
    scene = make_scene(shared_data / "mountain" / name)
    grid, elevation = relief_pages.paged_relief(scene).grid, scene.elevation
    x, y = (float(v) for v in elevation.xy(0.61 * elevation.rows, 0.47 * elevation.cols))
    place = place_at(scene, (x, y), elevation.crs, height_m=2.0)
    frame = scene.world.frame_near(elevation.crs, x, y)
    rays = RayScene([scene.surface(grid).window(-1, -1, elevation.rows + 2, elevation.cols + 2, frame).with_rim.sheet])
    horizon = elevation_deg(scene, place)
    start = np.repeat(frame.points_from_earth(place.eye_earth_m)[None], len(horizon), axis=0)
    for offset_deg, is_hidden in ((0.02, False), (-0.02, True)):
        enu = np.stack([direction_enu(*angles) for angles in zip(AZIMUTHS_DEG, horizon + offset_deg, strict=True)])
        blocked = rays.is_blocked(start, frame.directions_from_earth(enu @ place.earth_from_enu.T))
        assert (blocked == is_hidden).mean() > 0.998


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_horizon_of_a_diagonal_ridge_has_no_gaps(tmp_path, make_scene, sign):
    """The ridge is one node wide. Quads are cut along their higher diagonal, so that no line of sight passes between its nodes."""
    east, north = offsets_from_middle(81)
    scene = flat_world(tmp_path, make_scene, np.where(sign * east + north == 300.0, 50.0, 0.0))
    offset_deg = np.arange(-20.0, 20.5, 0.7)
    expected = np.degrees(np.arctan(50.0 * np.cos(np.radians(offset_deg)) / (300.0 / np.sqrt(2.0))))
    assert elevation_deg(scene, middle_surroundings(scene).place, sign * 45.0 + offset_deg) == pytest.approx(expected, abs=1e-6)
    assert place_at(scene, (sign * 145.0, 155.0)).ground_m == pytest.approx(50.0)
    assert place_at(scene, (sign * 142.0, 152.0)).ground_m == pytest.approx(50.0 - 50.0 * 0.6, abs=1e-4)
