"""The clocks by which a place's day is told: a time zone's, UTC, or the sun's own."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta, timezone, tzinfo

from skugga.terrain.geo.clock import clock_named


def clock_of(name: str, lon_deg: float | None, day: date) -> tzinfo:
    """The clock of a name. ``solar`` is true solar time at a longitude on a day: at 12:00 the sun is in the south, or in the north.

    Raises ``InputError`` for a name that is no clock's.
    """
    clock = clock_named("clock", name)
    return solar_clock(lon_deg or 0.0, day) if isinstance(clock, str) else clock


def solar_clock(lon_deg: float, day: date) -> timezone:
    """True solar time at a longitude, by the equation of time at its noon: right to half a minute all day."""
    noon = datetime(day.year, day.month, day.day, 12, tzinfo=UTC) - timedelta(hours=lon_deg / 15.0)
    minutes = 4.0 * lon_deg + equation_of_time_min(noon)
    return timezone(timedelta(seconds=round(60.0 * minutes)), "solar")


def equation_of_time_min(moment: datetime) -> float:
    """By how many minutes a sundial is ahead of mean time."""
    import pandas
    from pvlib.solarposition import spa_python

    return float(spa_python(pandas.DatetimeIndex([moment]), 0.0, 0.0)["equation_of_time"].iloc[0])
