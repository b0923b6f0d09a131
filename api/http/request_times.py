"""Parse the times of requests.

Times are rounded, so that clients whose clocks differ slightly request the same picture. The word ``current`` means now.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Any

from fastapi import Request
from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from skugga.api.http.responses import REQUESTED_SUN_MAX_AGE_S
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import as_utc, check_date, check_times
from skugga.terrain.level.level import parse_sun
from skugga.terrain.level.parts import ALLOWED_TIMES, SunSpec, parse_time

CURRENT_TIME = "current"
"""The value of ``time`` that means now."""

DEFAULT_TIME = "default"
"""The value of ``time`` that means the level's own sun."""

TIME_HEADER = "X-Skugga-Time"
"""Response header with the rounded time, present if the request has a time."""

MAX_CURRENT_AGE_S = 60
"""Upper bound in seconds of the freshness lifetime of an answer for ``current``."""

_ROUNDING_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
"""The time from which multiples of the rounding interval are counted."""


_DATE = re.compile("[0-9]{4}-[0-9]{2}-[0-9]{2}")


def _parse_date(value: Any) -> Any:
    """Return a date from ISO 8601 text; ``None`` and dates stay. Raises a pydantic error for other values."""
    if value is None or isinstance(value, date):
        return value
    try:
        day = date.fromisoformat(value) if isinstance(value, str) and _DATE.fullmatch(value) else None
    except ValueError:
        day = None
    if day is None:
        raise PydanticCustomError("date_parsing", "Input should be a date of the calendar, as 2024-03-21")
    try:
        check_date(day)
    except InputError as error:
        raise PydanticCustomError("date_range", "Input should be {years}", {"years": error.allowed}) from None
    return day


def _parse_time(value: Any) -> Any:
    """Return a time from ISO 8601 text with an offset; ``None`` and times stay. Raises a pydantic error for other values."""
    try:
        return (
            parse_time(value)
            if isinstance(value, str)
            else value
            if value is None or isinstance(value, datetime)
            else parse_time("")
        )
    except ValueError:
        raise PydanticCustomError("datetime_parsing", "Input should be {words}", {"words": ALLOWED_TIMES}) from None


PLAIN_DATE, PLAIN_TIME = BeforeValidator(_parse_date), BeforeValidator(_parse_time)
"""Pydantic validators of dates and times, for ``Annotated``.

They reject numbers, which pydantic would read as seconds since 1970. ``PLAIN_DATE`` also rejects dates for which the sun's position
cannot be calculated.
"""


@dataclass(frozen=True)
class RequestTime:
    """The time of a request's sun.

    Attributes
    ----------
    time : datetime
        The rounded time, with its UTC offset.
    max_age_s : int
        Freshness lifetime of the answer in seconds.
    requests_current_time : bool
        Whether the request asked for now.
    """

    time: datetime
    max_age_s: int
    requests_current_time: bool = False


def rounded_time(moment: datetime, interval_s: int) -> datetime:
    """Return a time rounded to the nearest multiple of ``interval_s`` seconds since 2000-01-01 UTC.

    Midpoints are rounded up. An ``interval_s`` of 0 leaves the time unchanged.
    """
    if interval_s == 0:
        return moment
    interval = timedelta(seconds=interval_s)
    try:
        return (_ROUNDING_EPOCH + (moment - _ROUNDING_EPOCH + interval / 2) // interval * interval).astimezone(moment.tzinfo)
    except OverflowError:  # beyond the last datetime: callers reject that time
        return moment


def request_sun(
    request: Request, time: str | None, azimuth: float | None, altitude: float | None, interval_s: int
) -> SunSpec | None:
    """Return the sun of a request with its time rounded; ``None`` means the level's own sun.

    ``time`` is rounded to multiples of ``interval_s`` seconds, and ``current`` is rounded down. The rounded time is also stored as
    ``request.state.request_time``. Raises ``InputError``.
    """
    if time is not None and time.strip() == CURRENT_TIME:
        if azimuth is not None or altitude is not None:
            raise InputError.conflict("time", "azimuth and altitude")
        now = datetime.now(UTC)
        interval = timedelta(seconds=interval_s or 1)
        moment = _ROUNDING_EPOCH + (now - _ROUNDING_EPOCH) // interval * interval  # rounded down: now is never in the future
        left_s = int((moment + interval - now).total_seconds())
        request.state.request_time = RequestTime(moment, max(min(left_s, MAX_CURRENT_AGE_S), 1), requests_current_time=True)
        return SunSpec(time=moment)
    sun = parse_sun(None if time == DEFAULT_TIME else time, azimuth, altitude)
    if sun is None or sun.time is None:
        return sun
    moment = rounded_time(sun.time, interval_s)
    check_times(as_utc([moment]))
    request.state.request_time = RequestTime(moment, REQUESTED_SUN_MAX_AGE_S)
    return SunSpec(time=moment)


def request_time(request: Request) -> RequestTime | None:
    """Return the time that ``request_sun`` has stored for a request; ``None`` if the request has no time."""
    return getattr(request.state, "request_time", None)


def requests_current_time(request: Request) -> bool:
    """Return whether a request asks for ``current``. Its address then means another picture soon."""
    stored_time = request_time(request)
    return stored_time is not None and stored_time.requests_current_time


def current_quarter_hour() -> tuple[datetime, int]:
    """Return the begin of the present quarter of an hour in UTC, and the whole seconds until its end (at least 1).

    Time zones differ from UTC by multiples of a quarter of an hour, so midnight never falls inside one.
    """
    now, quarter = datetime.now(UTC), timedelta(minutes=15)
    start = _ROUNDING_EPOCH + (now - _ROUNDING_EPOCH) // quarter * quarter
    return start, max(int((start + quarter - now).total_seconds()), 1)


def freshness_s(request: Request, default_age_s: int) -> int:
    """Return the freshness lifetime in seconds: for ``current`` until it means another rounded time, else ``default_age_s``."""
    stored_time = request_time(request)
    return stored_time.max_age_s if stored_time is not None and stored_time.requests_current_time else default_age_s


def time_headers(request: Request) -> dict[str, str]:
    """Return the response header ``TIME_HEADER`` with the rounded time of a request; empty if it has no time."""
    stored_time = request_time(request)
    return {} if stored_time is None else {TIME_HEADER: stored_time.time.isoformat()}
