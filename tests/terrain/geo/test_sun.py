"""The sun: published positions, one direction for the whole earth, axes at every place."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from skugga.terrain.errors import InputError
from skugga.terrain.geo.light_space import light_space
from skugga.terrain.geo.sun import apparent_sun_position, azimuth_and_altitude, direction_enu, sun_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, geocentric
from skugga.terrain.level.parts import SunSpec


def world_at(lon: float, lat: float) -> World:
    """Return a world in degrees with its anchor at a longitude and latitude."""
    return World(CRS.from_epsg(4326), False, lon, lat, lon, lat)


def test_position_agrees_with_the_algorithm_s_published_example():
    """Reda & Andreas (2004), table A5.1: Golden, Colorado, 17 October 2003, 12:30:30 local standard time.

    Their azimuth is 194.34024 degrees; their zenith of 50.11162 holds at 1830.14 m and 820 hPa, where refraction is a
    fifth weaker than at sea level: 0.003 degrees.
    """
    azimuth, altitude, _ = apparent_sun_position(datetime.fromisoformat("2003-10-17T12:30:30-07:00"), -105.1786, 39.742476)
    assert azimuth == pytest.approx(194.34024, abs=0.001)
    assert altitude == pytest.approx(90.0 - 50.11162, abs=0.005)


def test_refraction_raises_the_low_sun():
    """Refraction is about 29 minutes of arc at the horizon and 5 at 10 degrees (Saemundsson's formula)."""
    from pandas import DatetimeIndex
    from pvlib.solarposition import spa_python

    time = datetime.fromisoformat("2024-03-20T17:30:00+00:00")
    _, apparent, lift = apparent_sun_position(time, 0.0, 50.0)
    true = float(spa_python(DatetimeIndex([time]), 50.0, 0.0)["elevation"].iloc[0])
    saemundsson = 1.02 / np.tan(np.radians(true + 10.3 / (true + 5.11))) / 60.0
    assert 1.0 < true < 12.0
    assert apparent - true == pytest.approx(saemundsson, abs=0.01)


@given(
    st.floats(-180, 180), st.floats(-89.9, 89.9), st.floats(0, 360, exclude_max=True), st.floats(-2, 89.99)
)  # fmt: skip
def test_sun_angles_survive_the_earth_fixed_direction(lon, lat, azimuth, altitude):
    world = world_at(lon, lat)
    sun = sun_of(SunSpec(azimuth=azimuth, altitude=altitude), world)
    angles = azimuth_and_altitude(sun.to_sun_earth, world.earth_from_anchor)
    assert angles[1] == pytest.approx(altitude, abs=1e-6)
    assert (angles[0] - azimuth + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-6 / np.cos(np.radians(altitude)))


def test_one_direction_gives_the_sun_s_angles_at_every_place():
    """The sun is in the zenith at one place. A quarter of the earth away it stands on the horizon."""
    world = world_at(10.0, 0.0)
    sun = sun_of(SunSpec(azimuth=0, altitude=90), world)
    for lon, altitude in ((10.0, 90.0), (55.0, 45.0), (100.0, 0.0), (-80.0, 0.0), (190.0, -90.0)):
        rotation = world.earth_from_enu(*geocentric(np.float64(lon), np.float64(0.0)))
        assert azimuth_and_altitude(sun.to_sun_earth, rotation)[1] == pytest.approx(altitude, abs=1e-9)


@pytest.mark.parametrize("year", [1, 1677, 2262, 9999])
def test_years_out_of_range_are_refused_by_name(year):
    with pytest.raises(InputError, match="time.*1678 to 2261"):
        apparent_sun_position(datetime.fromisoformat(f"{year:04d}-06-01T12:00:00+00:00"), 0, 0)


def test_a_flat_world_has_no_time():
    world = World(CRS.from_epsg(32633), True, 0.0, 0.0)
    with pytest.raises(InputError, match="engineering CRS"):
        sun_of(SunSpec(time="2024-06-01T12:00:00+00:00"), world)


@given(st.floats(-360, 720), st.floats(-90, 90))
def test_light_space_is_orthonormal_for_every_sun(azimuth, altitude):
    world = world_at(15.0, 47.0)
    light = light_space(world, sun_of(SunSpec(azimuth=azimuth, altitude=altitude), world))
    rotation = light.light_from_earth
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12
    sun = sun_of(SunSpec(azimuth=azimuth, altitude=altitude), world).to_sun_earth
    np.testing.assert_allclose(rotation @ sun, [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize(("azimuth", "altitude"), [(0, 90), (90, 0), (180, 0), (270, 45), (0, 0)])
def test_light_space_is_continuous_in_the_sun(azimuth, altitude):
    world = world_at(15.0, 47.0)
    first_basis, second_basis = (
        light_space(world, sun_of(SunSpec(azimuth=azimuth, altitude=min(altitude + d, 90)), world)).light_from_earth
        for d in (0.0, -1e-6)
    )
    assert np.abs(first_basis - second_basis).max() < 1e-7


def test_towards_sun_m_is_measured_along_the_ground():
    world = world_at(15.0, 47.0)
    sun = sun_of(SunSpec(azimuth=90, altitude=30), world)
    light = light_space(world, sun)
    east = world.anchor_earth_m + world.earth_from_anchor @ np.array([1000.0, 500.0, 0.0])
    assert light.horizontal_sunward_m(light.points_from_earth(east)) == pytest.approx(1000.0, abs=1e-6)


def test_direction_enu_at_the_compass_points():
    np.testing.assert_allclose(direction_enu(90, 0), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(direction_enu(0, 0), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(direction_enu(0, 90), [0, 0, 1], atol=1e-15)


def test_geocentric_points_agree_with_proj():
    from pyproj import Transformer

    rng = np.random.default_rng(1)
    lon, lat = rng.uniform(-180, 180, 200), rng.uniform(-90, 90, 200)
    expected = np.stack(Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, 0 * lon), -1)
    point, up = geocentric(lon, lat)
    np.testing.assert_allclose(point, expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(up, axis=-1), 1.0)
    assert LONGITUDE_LATITUDE.is_geographic
