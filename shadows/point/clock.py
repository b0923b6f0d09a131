"""The clocks for a day at a point: a time zone, UTC, or true solar time."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta, timezone, tzinfo

from skugga.terrain.geo.clock import parse_clock


def clock_of(name: str, lon_deg: float | None, day: date) -> tzinfo:
    """Return the clock with a name: ``solar``, UTC or a time zone.

    ``solar`` is true solar time at the longitude ``lon_deg`` in degrees (``None`` counts as 0) on a day, by which the sun is due
    south or due north at 12:00. Raises ``InputError`` for an unknown name.
    """
    clock = parse_clock("clock", name)
    return solar_clock(lon_deg or 0.0, day) if isinstance(clock, str) else clock


def solar_clock(lon_deg: float, day: date) -> timezone:
    """Return true solar time at a longitude in degrees, as a fixed offset from UTC for one day.

    The offset uses the equation of time at noon, and is accurate to half a minute all day.
    """
    noon = datetime(day.year, day.month, day.day, 12, tzinfo=UTC) - timedelta(hours=lon_deg / 15.0)
    minutes = 4.0 * lon_deg + equation_of_time_min(noon)
    return timezone(timedelta(seconds=round(60.0 * minutes)), "solar")


def equation_of_time_min(moment: datetime) -> float:
    """Return the minutes by which a sundial is ahead of mean solar time at a moment."""
    import pandas
    from pvlib.solarposition import spa_python

    return float(spa_python(pandas.DatetimeIndex([moment]), 0.0, 0.0)["equation_of_time"].iloc[0])
