"""Daily windows: clock times, days of 23 and 25 hours, solar noon, and invalid dates."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta, timezone
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from pyproj import CRS

from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import SOLAR, parse_date
from skugga.terrain.geo.daily_windows import daily_window, dates_of, solar_time_min, windows_between
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.geo.world import World

OSLO = ZoneInfo("Europe/Oslo")
APIA = ZoneInfo("Pacific/Apia")
LON, LAT = 10.75, 59.9


@pytest.fixture
def world() -> World:
    """World in degrees with its anchor at ``LON``, ``LAT``."""
    return World(CRS.from_epsg(4326), False, LON, LAT, LON, LAT, 1.0)


@pytest.mark.parametrize(("day", "hours"), [("2024-03-31", 23), ("2024-10-27", 25), ("2024-03-21", 24)])
def test_days_of_clock_changes_last_23_or_25_hours(world, day, hours):
    window = daily_window(date.fromisoformat(day), 0.0, 1440.0, OSLO, world)
    assert window.length_min == hours * 60
    assert window.clock_time_min(0.0) == 0.0
    assert window.clock_time_min(window.length_min) == 1440.0  # the clock has been put forward or back


@pytest.mark.parametrize(("day", "before_min", "by"), [("2024-03-31", 120.0, 60.0), ("2024-10-27", 180.0, -60.0)])
def test_the_clock_jumps_when_it_is_put_forward_or_back(world, day, before_min, by):
    window = daily_window(date.fromisoformat(day), 0.0, 1440.0, OSLO, world)
    assert window.clock_time_min(before_min - 0.01) == pytest.approx(before_min, abs=0.02)
    assert window.clock_time_min(before_min + 0.01) == pytest.approx(before_min + by, abs=0.02)


def test_a_window_starts_at_its_zone_s_clock_time(world):
    window = daily_window(date(2024, 6, 21), 8 * 60.0, 16 * 60.0, OSLO, world)
    assert (window.start, window.length_min, window.start_clock_min) == (datetime(2024, 6, 21, 6, tzinfo=UTC), 480.0, 480.0)
    offset_zone_window = daily_window(date(2024, 6, 21), 0.0, 1440.0, timezone(timedelta(hours=9)), world)
    assert (offset_zone_window.start, offset_zone_window.start_clock_min) == (datetime(2024, 6, 20, 15, tzinfo=UTC), 0.0)


def test_windows_handle_skipped_and_repeated_clock_times(world):
    skipped_window = daily_window(date(2024, 3, 31), 150.0, 240.0, OSLO, world)  # 02:30, which is 03:30 of summer time
    assert skipped_window.start == datetime(2024, 3, 31, 1, 30, tzinfo=UTC)
    assert skipped_window.clock_time_min(0.0) == 210.0
    repeated_window = daily_window(date(2024, 10, 27), 150.0, 151.0, OSLO, world)  # from the first 02:30 to the second 02:31
    assert repeated_window.length_min == 61.0


@pytest.mark.parametrize(("day", "hours"), [("2024-11-02", 24), ("2024-11-03", 25), ("2024-03-10", 23)])
def test_days_are_contiguous_where_midnight_repeats(world, day, hours):
    """In Havana clocks go back from 01:00 to 00:00, and forward from 00:00 to 01:00."""
    window = daily_window(date.fromisoformat(day), 0.0, 1440.0, ZoneInfo("America/Havana"), world)
    assert window.length_min == hours * 60


def test_a_date_that_a_calendar_omits_is_refused(world):
    with pytest.raises(
        InputError, match=r"date: '2011-12-30' is not allowed. Allowed: a day that the calendar of Pacific/Apia does not skip"
    ):
        daily_window(date(2011, 12, 30), 0.0, 1440.0, APIA, world)
    with pytest.raises(InputError, match=r"to: '2011-12-30'"):
        windows_between(world, date(2011, 12, 28), date(2011, 12, 30), 1, (0.0, 1440.0), APIA)


def test_dates_around_an_omitted_one_are_whole_days(world):
    """The calendar has three of four dates, so a mean over them includes no day without sun."""
    windows = windows_between(world, date(2011, 12, 28), date(2011, 12, 31), 1, (0.0, 1440.0), APIA)
    assert [window.date.day for window in windows] == [28, 29, 31]
    assert [window.length_min for window in windows] == [1440.0] * 3
    assert windows[1].start + timedelta(days=1) == windows[2].start


@pytest.mark.parametrize("readings", [(120.0, 180.0), (150.0, 180.0)])
def test_a_window_of_skipped_times_is_refused_or_omitted(world, readings):
    with pytest.raises(InputError, match=r"window: '02:[03]0-03:00' .* times that Europe/Oslo does not skip on 2024-03-31"):
        daily_window(date(2024, 3, 31), *readings, OSLO, world)
    windows = windows_between(world, date(2024, 3, 30), date(2024, 4, 1), 1, readings, OSLO)
    assert [window.date.day for window in windows] == [30, 1]


@pytest.mark.parametrize("day", [date(2024, 2, 11), date(2024, 11, 3), date(2024, 6, 21)])
def test_the_sun_stands_in_the_south_at_solar_noon(world, day):
    window = daily_window(day, 8 * 60.0, 16 * 60.0, SOLAR, world)
    noon = window.start + timedelta(minutes=window.length_min / 2)
    path = sun_path([noon, window.start], LON, LAT)
    assert path.azimuth_deg[0] == pytest.approx(180.0, abs=0.05)
    assert window.length_min == pytest.approx(480.0, abs=0.5)  # the equation of time changes by half a minute a day at most
    assert solar_time_min(window.start, LON, LAT) == pytest.approx(480.0, abs=0.01)


def test_solar_windows_of_many_dates_are_those_of_each(world):
    windows = windows_between(world, date(2024, 1, 1), date(2024, 12, 31), 33, (480.0, 960.0), SOLAR)
    assert windows == [daily_window(window.date, 480.0, 960.0, SOLAR, world) for window in windows]
    assert [window.date for window in windows] == dates_of(date(2024, 1, 1), date(2024, 12, 31), 33)


def test_solar_windows_share_calls_of_the_ephemeris(world, monkeypatch):
    calls = []
    monkeypatch.setattr("skugga.terrain.geo.daily_windows.sun_path", lambda *args: calls.append(1) or sun_path(*args))
    windows_between(world, date(2024, 1, 1), date(2024, 1, 20), 1, (0.0, 1440.0), SOLAR)
    assert len(calls) <= 6, "three iterations for each of the two times, not for each date"


def test_solar_time_follows_the_equation_of_time(world):
    november_offset_min, february_offset_min = (
        (daily_window(day, 720.0, 721.0, SOLAR, world).start.replace(tzinfo=None) - datetime(2024, day.month, day.day, 12))
        / timedelta(minutes=1) + 4.0 * LON
        for day in (date(2024, 11, 3), date(2024, 2, 11))
    )  # fmt: skip
    assert november_offset_min == pytest.approx(-16.4, abs=0.2)  # the year's extremes
    assert february_offset_min == pytest.approx(14.2, abs=0.2)


def test_dates_of_have_even_steps():
    assert dates_of(date(2024, 2, 26), date(2024, 3, 7), 3) == [
        date(2024, 2, 26),
        date(2024, 2, 29),
        date(2024, 3, 3),
        date(2024, 3, 6),
    ]
    assert dates_of(date(2024, 1, 1), date(2024, 1, 1), 1) == [date(2024, 1, 1)]


@pytest.mark.parametrize("text", ["2023-02-29", "2024-13-01", "soon", "21.3.2024"])
def test_parse_date_refuses_invalid_dates_in_one_line(text):
    with pytest.raises(InputError, match=rf"date: '{text}' is not allowed\. Allowed: a calendar date such as 2024-03-21"):
        parse_date("date", text)


def test_windows_and_dates_that_run_backwards_are_refused(world):
    with pytest.raises(InputError, match="window: '16:00-08:00'"):
        daily_window(date(2024, 3, 21), 960.0, 480.0, UTC, world)
    with pytest.raises(InputError, match="to: "):
        dates_of(date(2024, 3, 21), date(2024, 3, 20), 1)
    with pytest.raises(InputError, match="every: "):
        dates_of(date(2024, 3, 21), date(2024, 3, 22), 0)
    with pytest.raises(InputError, match="years"):
        daily_window(date(9999, 3, 21), 0.0, 960.0, UTC, world)


def test_a_pole_has_solar_time():
    pole = World(CRS.from_epsg(3413), False, 0.0, 0.0, -45.0, 90.0, 1.0)
    window = daily_window(date(2024, 6, 21), 0.0, 1440.0, SOLAR, pole)
    assert np.isclose(window.length_min, 1440.0, atol=0.6)


def test_solar_windows_of_many_dates_are_computed_together(world, monkeypatch):
    """They equal those of single dates, and the sun's positions are computed a few times, not for each date."""
    first, last = date(2024, 1, 1), date(2024, 12, 31)
    calls = []
    monkeypatch.setattr(
        "skugga.terrain.geo.daily_windows.sun_path", lambda *arguments: calls.append(len(arguments[0])) or sun_path(*arguments)
    )
    windows = windows_between(world, first, last, 1, (480.0, 960.0), SOLAR)
    assert calls == [366] * 6
    assert windows[::90] == [daily_window(window.date, 480.0, 960.0, SOLAR, world) for window in windows[::90]]
