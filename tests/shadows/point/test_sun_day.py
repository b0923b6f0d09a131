"""Sun hours of days and years at a point: level ground, ridges against rays every ten seconds, polar days and nights."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta

import numpy as np
import pytest

from skugga.shadows.point.clock import clock_of, solar_clock
from skugga.shadows.point.horizon import load_surroundings, sees_sun
from skugga.shadows.point.place import place_at
from skugga.shadows.point.sun_angles import sun_angles_at, sun_directions
from skugga.shadows.point.sun_day import sampled_sun_hours, sun_day
from skugga.shadows.point.sun_year import sun_year
from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import day_bounds
from skugga.terrain.geo.sun import apparent_sun_position

DAY = date(2024, 10, 21)


@pytest.fixture
def surroundings_at(write_raster, make_scene):
    """Return ``surroundings_at(heights, north)``: the surroundings of the middle of a raster of 50 m cells in UTM zone 33."""

    def place(heights: np.ndarray, north: float = 5_300_000.0, height_m: float = 0.0):
        side = len(heights)
        scene = make_scene(write_raster(heights.astype(np.float32), "EPSG:32633", 500_000.0, north, 50.0))
        middle = 500_000.0 + side * 25.0, north - side * 25.0
        return load_surroundings(scene, place_at(scene, middle, scene.elevation.crs, height_m))

    return place


def ridge_heights(seed: int = 1) -> np.ndarray:
    """Return heights in metres (121, 121) of a basin with rough ridges around its middle."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[0:121, 0:121]
    distance = np.hypot(rows - 60, cols - 60)
    return np.clip(distance - 20, 0, None) * 9.0 * (1 + 0.3 * np.sin(cols / 3.0) * np.cos(rows / 4.0)) + rng.random((121, 121))


def test_sun_day_over_level_ground_is_the_astronomical_day(surroundings_at):
    surroundings = surroundings_at(np.zeros((21, 21)))
    day = sun_day(surroundings, DAY, UTC)
    place = surroundings.place
    for moment in (day.sunrise, day.sunset):
        _, altitude, _ = apparent_sun_position(moment, place.lon_deg, place.lat_deg)
        assert altitude == pytest.approx(0.0, abs=0.02)
    assert day.first_sun == pytest.approx(day.sunrise, abs=timedelta(seconds=5))
    assert day.last_sun == pytest.approx(day.sunset, abs=timedelta(seconds=5))
    assert day.direct_sun_h == pytest.approx(day.daylight_h, abs=0.003) and day.hidden_sun_h < 0.003
    _, noon, _ = apparent_sun_position(day.noon, place.lon_deg, place.lat_deg)
    assert noon == pytest.approx(day.noon_altitude_deg, abs=0.01)
    assert day.remark is None and len(day.sunlit_intervals) == 1 and day.sunlit_intervals[0].occluder_before is None


def test_sun_day_behind_ridges_matches_rays_every_ten_seconds(surroundings_at):
    surroundings = surroundings_at(ridge_heights())
    day = sun_day(surroundings, DAY, UTC)
    begin = day_bounds(DAY, UTC)[0].timestamp()
    timestamps = begin + np.arange(0.0, 86400.0, 10.0)
    lit = sees_sun(surroundings, *sun_angles_at(surroundings.place, sun_directions(surroundings.scene.world, timestamps)))
    first, last = timestamps[np.flatnonzero(lit)[[0, -1]]]
    assert day.first_sun.timestamp() == pytest.approx(first, abs=15)
    assert day.last_sun.timestamp() == pytest.approx(last, abs=15)
    assert day.direct_sun_h == pytest.approx(lit.sum() * 10 / 3600, abs=0.02)
    assert day.hidden_sun_h > 1.0 and day.first_sun > day.sunrise and day.last_sun < day.sunset
    caster = day.sunlit_intervals[0].occluder_before
    assert caster.kind == "relief" and 1000 < caster.distance_m < 4500 and caster.height_m > 100
    assert sum(interval.hours for interval in day.sunlit_intervals) == pytest.approx(day.direct_sun_h, abs=0.002)
    assert sampled_sun_hours(surroundings, DAY, UTC) == pytest.approx(day.direct_sun_h, abs=0.1)


def test_sun_year_agrees_with_its_days(surroundings_at):
    surroundings = surroundings_at(ridge_heights())
    year = sun_year(surroundings, 2024, UTC)
    assert len(year.days) == 366 and (year.direct_sun_h <= year.daylight_h).all()
    for number in (0, 171, 294):
        day = sun_day(surroundings, year.days[number], UTC)
        assert year.direct_sun_h[number] == pytest.approx(day.direct_sun_h, abs=0.1)
        assert year.daylight_h[number] == pytest.approx(day.daylight_h, abs=0.1)


def test_sun_day_of_polar_day_and_night(surroundings_at):
    surroundings = surroundings_at(np.zeros((21, 21)), north=8_700_000.0)
    polar_night = sun_day(surroundings, date(2024, 12, 21), UTC)
    assert (
        polar_night.sunrise is polar_night.sunset is polar_night.first_sun is None
        and polar_night.daylight_h == polar_night.direct_sun_h == 0.0
    )
    assert polar_night.remark == "polar night: the sun stays below the level horizon all day"
    polar_day = sun_day(surroundings, date(2024, 6, 21), UTC)
    assert (
        polar_day.sunrise is None and polar_day.daylight_h == pytest.approx(24.0) and polar_day.direct_sun_h == pytest.approx(24.0)
    )
    assert polar_day.remark == "polar day: the sun does not set"


def test_sun_day_in_a_pit_has_no_sun(surroundings_at):
    heights = np.full((41, 41), 5000.0)
    heights[20, 20] = 0.0
    day = sun_day(surroundings_at(heights), date(2024, 12, 21), UTC)
    assert day.sunlit_intervals == () and day.first_sun is None and day.hidden_sun_h == pytest.approx(day.daylight_h)
    assert day.remark == "the sun rises, but terrain or objects hide it all day"


def test_clock_of_offsets_zones_and_invalid_names():
    assert clock_of("utc", None, DAY) is UTC
    assert clock_of("+05:30", None, DAY).utcoffset(None) == timedelta(hours=5, minutes=30)
    assert clock_of(" 02:00", None, DAY).utcoffset(None) == timedelta(hours=2)  # a plus sign that URL decoding turned into a space
    assert clock_of("-03:30", None, DAY).utcoffset(None) == -timedelta(hours=3, minutes=30)
    oslo = clock_of("Europe/Oslo", None, DAY)
    assert datetime(2024, 7, 1, tzinfo=oslo).utcoffset() == timedelta(hours=2)
    first, following = day_bounds(date(2024, 10, 27), oslo)
    assert following.astimezone(UTC) - first.astimezone(UTC) == timedelta(hours=25)
    for name in ("Mars", "../etc", "", "+25:00"):
        with pytest.raises(InputError, match="clock"):
            clock_of(name, None, DAY)


def test_sun_day_refuses_a_date_missing_from_the_calendar(surroundings_at):
    """Samoa skipped 30 December 2011. The sun is up for 13 hours on the days before and after."""
    surroundings, apia = surroundings_at(np.zeros((41, 41))), clock_of("Pacific/Apia", None, DAY)
    with pytest.raises(
        InputError, match="date: '2011-12-30' is not allowed. Allowed: a day that the calendar of Pacific/Apia does not skip"
    ):
        sun_day(surroundings, date(2011, 12, 30), apia)
    with pytest.raises(InputError, match="date: '2011-12-30'"):
        sampled_sun_hours(surroundings, date(2011, 12, 30), apia)
    year = sun_year(surroundings, 2011, apia)
    assert len(year.days) == len(year.daylight_h) == 364 and date(2011, 12, 30) not in year.days
    assert year.daylight_h.min() > 6.0
    assert year.daylight_h[-1] == pytest.approx(sun_day(surroundings, date(2011, 12, 31), apia).daylight_h, abs=0.1)


def test_solar_clock_noon_has_the_sun_in_the_south():
    clock = solar_clock(13.4, DAY)
    azimuth, _, _ = apparent_sun_position(datetime(2024, 10, 21, 12, tzinfo=clock), 13.4, 52.5)
    assert azimuth == pytest.approx(180.0, abs=0.1)


def test_sun_day_refuses_a_flat_world(tmp_path, make_scene):
    from tests.shadows.point.ground import flat_world, middle_surroundings

    surroundings = middle_surroundings(flat_world(tmp_path, make_scene, np.zeros((9, 9))))
    with pytest.raises(InputError, match="an engineering CRS is not georeferenced"):
        sun_day(surroundings, DAY, UTC)
    with pytest.raises(InputError, match="an engineering CRS is not georeferenced"):
        sun_year(surroundings, 2024, UTC)
