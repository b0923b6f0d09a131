"""Daily time windows between two clock times, by a time zone, by UTC or by true solar time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta, tzinfo

import numpy as np

from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.clock import Clock, day_bounds
from skugga.terrain.geo.sun_path import check_date, sun_path
from skugga.terrain.geo.world import World

MINUTES_PER_DAY = 1440.0

MAX_DATES = 3700
"""A decade of dates."""

SOLAR_TIME_ITERATIONS = 3
"""Iterations that correct true solar time by the equation of time, which changes by half a minute a day."""


@dataclass(frozen=True)
class DailyWindow:
    """A time window on one date.

    Attributes
    ----------
    date
        The date.
    start
        Start of the window in UTC.
    length_min
        Length of the window in minutes.
    start_clock_min
        The clock time at the start, in minutes from midnight.
    minutes_to_change
        Minutes from the start to a change of the clock, as at the begin and the end of summer time.
    clock_advance_min
        Minutes by which this change puts the clock forward (negative: back); 0 without a change.
    """

    date: date
    start: datetime
    length_min: float
    start_clock_min: float
    minutes_to_change: float = 0.0
    clock_advance_min: float = 0.0

    def clock_time_min(self, elapsed_min: float) -> float:
        """Return the clock time ``elapsed_min`` minutes after the start, in minutes from midnight."""
        changed = self.clock_advance_min != 0.0 and elapsed_min >= self.minutes_to_change
        return self.start_clock_min + elapsed_min + (self.clock_advance_min if changed else 0.0)


def daily_window(day: date, start_min: float, end_min: float, clock: Clock, world: World) -> DailyWindow:
    """Return the window of a date between two clock times, in minutes from midnight (0 to 1440).

    A clock time that does not exist, as when summer time begins, is read with the UTC offset before the change. If a clock time
    occurs twice, a window starts at the first occurrence and ends at the second. 24:00 is the start of the next date.

    Raises ``InputError`` for invalid times, and where the clock skips the whole date or the whole window.
    """
    _check_clock_times(start_min, end_min)
    check_date(day)
    if isinstance(clock, str):
        return _solar_windows([day], start_min, end_min, world)[0]
    day_bounds(day, clock)
    start, end = _utc_start_and_end(day, start_min, end_min, clock)
    minutes = (end - start) / timedelta(minutes=1)
    if minutes <= 0.0:
        window_text = f"{clock_text(start_min)}-{clock_text(end_min)}"
        raise InputError("window", window_text, f"times that {clock} does not skip on {day.isoformat()}")
    before, after = _offset_min(start, clock), _offset_min(end - timedelta(seconds=1), clock)
    midnight = datetime.combine(day, time(), UTC)
    clock_min = (start - midnight) / timedelta(minutes=1) + before
    if before == after:
        return DailyWindow(day, start, minutes, clock_min)
    return DailyWindow(day, start, minutes, clock_min, _minutes_to_change(start, minutes, clock), after - before)


def dates_of(first: date, last: date, every_days: int) -> list[date]:
    """Return the dates from ``first`` to ``last``, both included, every ``every_days`` days.

    Raises ``InputError`` if ``last`` is before ``first`` or the step is below 1 day.
    """
    if last < first:
        raise InputError("to", last.isoformat(), f"{first.isoformat()} or later")
    if every_days < 1:
        raise InputError("every", every_days, "1 day or more")
    return [first + timedelta(days=n) for n in range(0, (last - first).days + 1, every_days)]


def parse_window(text: str) -> tuple[float, float]:
    """Return the two clock times of a window such as 08:00-16:00, in minutes from midnight. Raises ``InputError``."""
    match = re.fullmatch(r"(\d{1,2}):([0-5]\d)-(\d{1,2}):([0-5]\d)", text.strip(), re.ASCII)
    first, last = (int(match[n]) * 60 + int(match[n + 1]) for n in (1, 3)) if match else (-1, -1)
    if not 0 <= first < last <= MINUTES_PER_DAY:
        raise InputError("window", text, "a start time and a later end time of one day, such as 08:00-16:00, within 00:00-24:00")
    return float(first), float(last)


def windows_between(
    world: World, first: date, last: date, every_days: int, clock_times_min: tuple[float, float], clock: Clock
) -> list[DailyWindow]:
    """Return the windows of the dates from ``first`` to ``last``, every ``every_days`` days.

    ``clock_times_min`` are the clock times at which each window starts and ends, in minutes from midnight. The clock's calendar
    must have the first and the last date. Dates between them are omitted if the clock skips their whole window. Raises
    ``InputError``, also for ground that is not on the earth.
    """
    days = dates_of(first, last, every_days)
    if len(days) > MAX_DATES:
        raise InputError.over_limit("to", f"{len(days)} dates", str(MAX_DATES), "Choose an earlier date or a larger step")
    if world.off_earth_reason is not None:
        problem = Problem(f"'{first.isoformat()}' does not define the sun here, since {world.off_earth_reason}")
        raise InputError("date", problem, "Use a level on the earth")
    if not isinstance(clock, str):
        for name, day in (("date", first), ("to", last)):
            day_bounds(day, clock, name)
        days = [day for day in days if day == first or _has_window(day, *clock_times_min, clock)]
    if isinstance(clock, str):
        _check_clock_times(*clock_times_min)
        for day in days:
            check_date(day)
        return _solar_windows(days, *clock_times_min, world)
    return [daily_window(day, *clock_times_min, clock, world) for day in days]


def _check_clock_times(start_min: float, end_min: float) -> None:
    """Raise ``InputError`` unless clock times, in minutes from midnight, are a start and a later end."""
    if not 0.0 <= start_min < end_min <= MINUTES_PER_DAY:
        window = f"{clock_text(start_min)}-{clock_text(end_min)}"
        raise InputError("window", window, "a start time and a later end time, 00:00 to 24:00")


def clock_text(clock_min: float) -> str:
    """Return minutes from midnight as a clock time such as 08:30."""
    return f"{int(clock_min // 60):02d}:{int(clock_min % 60):02d}"


def _utc_start_and_end(day: date, start_min: float, end_min: float, zone: tzinfo) -> tuple[datetime, datetime]:
    """Return the start and the end in UTC of a window between two clock times, in minutes from midnight.

    The end is not after the start where the zone's clock skips the window.
    """
    return _zone_moment(day, start_min, zone, fold=0), _zone_moment(day, end_min, zone, fold=int(end_min < MINUTES_PER_DAY))


def _has_window(day: date, start_min: float, end_min: float, zone: tzinfo) -> bool:
    """Return whether a zone's clock has the window between two clock times, in minutes from midnight, on a date."""
    start, end = _utc_start_and_end(day, start_min, end_min, zone)
    return start < end


def _zone_moment(day: date, clock_min: float, zone: tzinfo, fold: int) -> datetime:
    """Return the moment in UTC of a clock time, in minutes from midnight.

    ``fold`` selects the first or the second occurrence of a clock time (PEP 495). A clock time that the zone skips is read with the
    UTC offset before the change.
    """
    days, rest_min = divmod(clock_min, MINUTES_PER_DAY)
    wall_time = datetime.combine(day, time()) + timedelta(days=days, minutes=rest_min)
    moment = wall_time.replace(tzinfo=zone, fold=fold).astimezone(UTC)
    if moment.astimezone(zone).replace(tzinfo=None) != wall_time:  # skipped by the clock
        moment = wall_time.replace(tzinfo=zone, fold=0).astimezone(UTC)
    return moment


def _offset_min(moment: datetime, zone: tzinfo) -> float:
    """Return the UTC offset of a zone at a moment, in minutes."""
    offset = moment.astimezone(zone).utcoffset()
    assert offset is not None
    return offset / timedelta(minutes=1)


def _minutes_to_change(start: datetime, length_min: float, zone: tzinfo) -> float:
    """Return the minutes from ``start`` to the only change of a zone's UTC offset within the next ``length_min`` minutes."""
    before = _offset_min(start, zone)
    low, high = 0, int(np.ceil(length_min))
    while high - low > 1:
        middle = (low + high) // 2
        if _offset_min(start + timedelta(minutes=middle), zone) == before:
            low = middle
        else:
            high = middle
    return float(high)


def _solar_windows(days: Sequence[date], start_min: float, end_min: float, world: World) -> list[DailyWindow]:
    """Return the windows of dates between two times of true solar time, in minutes from midnight."""
    starts, ends = (_solar_moments(days, minutes, world) for minutes in (start_min, end_min))
    lengths_min = ((ends - starts) / np.timedelta64(1, "m")).tolist()
    return [
        DailyWindow(day, start.replace(tzinfo=UTC), length_min, start_min)
        for day, start, length_min in zip(days, starts.tolist(), lengths_min, strict=True)
    ]


def _solar_moments(days: Sequence[date], clock_min: float, world: World) -> np.ndarray:
    """Return the moments of dates at which the true solar time at the anchor is ``clock_min``, datetime64[us] in UTC (n,).

    ``clock_min`` is in minutes from midnight. The anchor is the centre of the level's bounds. All dates share the calls of the
    sun's ephemeris, which takes milliseconds for one moment as for hundreds.
    """
    lon, lat = world.anchor_lon_deg, float(np.clip(world.anchor_lat_deg, -89.0, 89.0))
    moments = np.array(days, "datetime64[D]").astype("datetime64[us]") + _microseconds(clock_min - 4.0 * lon)
    for _ in range(SOLAR_TIME_ITERATIONS):
        error_min = _solar_times_min(moments, lon, lat) - clock_min
        moments -= _microseconds((error_min + MINUTES_PER_DAY / 2) % MINUTES_PER_DAY - MINUTES_PER_DAY / 2)
    return moments


def _microseconds(minutes: float | np.ndarray) -> np.ndarray:
    """Return minutes as timedelta64[us]."""
    return np.rint(np.asarray(minutes) * 60e6).astype("timedelta64[us]")


def solar_time_min(moment: datetime, lon_deg: float, lat_deg: float) -> float:
    """Return the true solar time of a moment at a position, in minutes from midnight."""
    return float(_solar_times_min([moment], lon_deg, lat_deg)[0])


def _solar_times_min(moments: Sequence[datetime] | np.ndarray, lon_deg: float, lat_deg: float) -> np.ndarray:
    """Return the true solar times (n,) of moments at a position, in minutes from midnight.

    It is 720 when the sun crosses the meridian, and a minute is a quarter of a degree of hour angle. The hour angle H follows from
    tan H = sin A / (cos A sin lat + tan h cos lat), with the azimuth A from south and the altitude h without refraction.
    """
    path = sun_path(moments, lon_deg, lat_deg)
    azimuth, lat = np.radians(path.azimuth_deg - 180.0), np.radians(lat_deg)
    altitude = np.radians(path.altitude_deg - path.refraction_deg)
    hour = np.arctan2(
        np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude) * np.sin(lat) + np.sin(altitude) * np.cos(lat)
    )
    solar_min: np.ndarray = (np.degrees(hour) * 4.0 + MINUTES_PER_DAY / 2) % MINUTES_PER_DAY
    return solar_min
