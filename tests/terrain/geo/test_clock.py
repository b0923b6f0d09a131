"""Names of clocks: valid names, the nearest spelling of invalid ones, days that a calendar omits, and clocks of places."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest

from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import day_bounds, has_day, parse_clock, time_zone_at

APIA = ZoneInfo("Pacific/Apia")


@pytest.mark.parametrize(
    ("name", "hours"),
    [
        ("+02:00", 2.0), ("+2", 2.0), ("+0200", 2.0), ("UTC+2", 2.0), ("GMT+2", 2.0), ("utc-03:30", -3.5), ("UTC 2", 2.0),
        (" 02:00", 2.0), ("+5:45", 5.75), ("+545", 5.75), ("+1030", 10.5), ("\N{MINUS SIGN}3", -3.0), ("UTC + 9", 9.0),
    ],
)  # fmt: skip
def test_parse_clock_accepts_offsets(name, hours):
    assert parse_clock("clock", name).utcoffset(None) == timedelta(hours=hours)


@pytest.mark.parametrize(
    ("name", "zone"),
    [("europe/oslo", "Europe/Oslo"), ("AMERICA/New York", "America/New_York"), ("gmt", "GMT"), (" Asia/Kolkata ", "Asia/Kolkata")],
)
def test_parse_clock_ignores_the_case_of_zones(name, zone):
    assert str(parse_clock("clock", name)) == zone


def test_parse_clock_keeps_posix_zones_of_opposite_sign():
    """POSIX counts west of Greenwich: ``Etc/GMT+2`` lies two hours behind, ``GMT+2`` ahead."""
    moment = datetime(2024, 1, 1, tzinfo=UTC)
    assert moment.astimezone(parse_clock("clock", "Etc/GMT+2")).utcoffset() == timedelta(hours=-2)


@pytest.mark.parametrize(
    ("name", "expected_text"),
    [
        ("Oslo", r"Europe/Oslo \(did you mean Europe/Oslo\?\)"), ("Europe/Olso", r"\(did you mean Europe/Oslo"),
        ("kolkata", "Asia/Kolkata"),
        ("new york", "America/New_York"), ("", r"clock: '' .*solar, utc, an offset such as \+02:00"), ("  ", "solar, utc"),
        ("+24:00", "solar, utc"), ("+05:75", "solar, utc"), ("CEST", r"Europe/Oslo\.$"), ("../etc", r"Europe/Oslo\.$"),
    ],
)  # fmt: skip
def test_parse_clock_refuses_unknown_names_in_one_line(name, expected_text):
    with pytest.raises(InputError, match=expected_text) as caught:
        parse_clock("clock", name)
    assert "\n" not in str(caught.value)


def test_a_day_that_samoa_omitted_has_no_bounds():
    assert not has_day(date(2011, 12, 30), APIA)
    with pytest.raises(
        InputError, match="to: '2011-12-30' is not allowed. Allowed: a day that the calendar of Pacific/Apia does not skip"
    ):
        day_bounds(date(2011, 12, 30), APIA, "to")
    (_, last), (first, _) = (day_bounds(date(2011, 12, day), APIA) for day in (29, 31))
    assert last.astimezone(UTC) == first.astimezone(UTC) == datetime(2011, 12, 30, 10, tzinfo=UTC)


@pytest.mark.parametrize(
    ("lon_deg", "lat_deg", "zone"),
    [
        (8.4, 47.5, "Europe/Zurich"),
        (-3.7, 40.4, "Europe/Madrid"),
        (-84.2, 36.3, "America/New_York"),
        (-104.0, 39.7, "America/Denver"),
        (85.3, 27.7, "Asia/Kathmandu"),
        (360.0 + 8.4, 47.5, "Europe/Zurich"),
        (-180.5, -16.6, "Pacific/Fiji"),
    ],
)
def test_time_zone_is_that_of_the_place(lon_deg: float, lat_deg: float, zone: str):
    """The zone is not that of the meridian: Madrid keeps the clock of Berlin. Longitudes wrap around the earth."""
    assert time_zone_at(lon_deg, lat_deg) == zone
