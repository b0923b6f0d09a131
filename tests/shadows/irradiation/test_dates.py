"""Dates and periods of irradiation: names, numbers, weights, and the mean days of months."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from skugga.shadows.irradiation.dates import MEAN_DAYS, Dates, Per, all_dates, mean_days
from skugga.terrain.geo.clock import SOLAR, Clock, parse_clock
from skugga.terrain.geo.daily_windows import windows_between
from skugga.terrain.geo.world import World


@pytest.fixture
def earth_world() -> World:
    """The world round a place at 10 degrees east and 47 north."""
    return World(CRS.from_epsg(4326), False, 10.0, 47.0, 10.0, 47.0, 1.0)


def days(world: World, first: date, last: date, per: Per = "period", clock: Clock = SOLAR) -> Dates:
    """Return whole days as dates."""
    return all_dates(windows_between(world, first, last, 1, (0.0, 1440.0), clock), per)


@pytest.mark.parametrize(
    ("per", "names"),
    [
        ("period", ["2023-01-30 to 2023-02-02"]),
        ("month", ["2023-01", "2023-02"]),
        ("day", ["2023-01-30", "2023-01-31", "2023-02-01", "2023-02-02"]),
    ],
)
def test_periods_have_names(earth_world, per, names):
    dates = days(earth_world, date(2023, 1, 30), date(2023, 2, 2), per)
    assert [period.name for period in dates.periods] == names
    assert [len(month.windows) for month in dates.months()] == [2, 2]


@pytest.mark.parametrize("clock", ["solar", "utc", "+05:30"])
def test_hours_are_those_of_the_clock(earth_world, clock):
    dates = days(earth_world, date(2023, 6, 20), date(2023, 6, 21), "hour", parse_clock("clock", clock))
    names = [period.name for period in dates.periods]
    assert len(names) == 48 and names[0] == "2023-06-20 00:00" and names[29] == "2023-06-21 05:00"
    starts = np.array([period.start for period in dates.periods])
    moments = starts + np.timedelta64(30, "m")
    np.testing.assert_array_equal(dates.period_numbers(moments), np.arange(48))
    np.testing.assert_array_equal(dates.date_numbers(moments), np.repeat([0, 1], 24))


def test_moments_count_the_days_that_their_date_stands_for(earth_world):
    windows = windows_between(earth_world, date(2023, 1, 1), date(2023, 1, 3), 1, (0.0, 1440.0), SOLAR)
    dates = Dates(tuple(windows), (2.0, 3.0, 5.0))
    noon = np.array([np.datetime64(window.start.replace(tzinfo=None), "us") for window in windows]) + np.timedelta64(12, "h")
    np.testing.assert_array_equal(dates.days_represented(noon[[2, 0, 1]]), [5.0, 2.0, 3.0])


def test_a_year_has_the_mean_days_of_klein():
    weights = mean_days(date(2023, 1, 1), date(2023, 12, 31))
    assert [day.day for day in weights] == list(MEAN_DAYS) and sum(weights.values()) == 365.0
    assert list(weights.values())[1] == 28.0


@given(st.dates(date(1995, 1, 1), date(2030, 1, 1)), st.integers(0, 800))
def test_mean_days_stand_for_all_days(first, length):
    last = date.fromordinal(first.toordinal() + length)
    weights = mean_days(first, last)
    assert sum(weights.values()) == length + 1
    assert all(first <= day <= last for day in weights)
    assert len({(day.year, day.month) for day in weights}) == len(weights)
