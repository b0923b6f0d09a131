"""The times that requests name: rounded, so that clients whose clocks run on ask for the same pictures; ``current`` is now."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Any

from fastapi import Request
from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from skugga.api.http.answers import GIVEN_SUN_S
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import as_utc, check_date, check_times
from skugga.terrain.level.level import parse_sun
from skugga.terrain.level.parts import TIME_WORDS, SunSpec, time_of

CURRENT = "current"
"""The word for now."""

OWN_TIME = "default"
"""The word for the time of a level's own sun, whatever that is."""

TIME_HEADER = "X-Skugga-Time"
"""Says which time an answer is of, where a time was asked for."""

CURRENT_S = 60
"""How long an answer of now is fresh, at most."""

_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)


_DATE = re.compile("[0-9]{4}-[0-9]{2}-[0-9]{2}")


def _date(value: Any) -> Any:
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


def _time(value: Any) -> Any:
    try:
        return time_of(value) if isinstance(value, str) else value if value is None or isinstance(value, datetime) else time_of("")
    except ValueError:
        raise PydanticCustomError("datetime_parsing", "Input should be {words}", {"words": TIME_WORDS}) from None


PLAIN_DATE, PLAIN_TIME = BeforeValidator(_date), BeforeValidator(_time)
"""Of dates and times in ``Annotated``: what pydantic takes for one besides (seconds since 1970) is refused, and dates without a sun
are.
"""


@dataclass(frozen=True)
class AskedTime:
    """The time that an answer is of, and for how many seconds it is fresh; ``current``: what was asked for was now."""

    time: datetime
    fresh_s: int
    current: bool = False


def rounded_time(moment: datetime, grain_s: int) -> datetime:
    """The nearest multiple of so many seconds since the year 2000, UTC; 0 leaves it. A time in the middle goes up."""
    if grain_s == 0:
        return moment
    grain = timedelta(seconds=grain_s)
    try:
        return (_EPOCH + (moment - _EPOCH + grain / 2) // grain * grain).astimezone(moment.tzinfo)
    except OverflowError:  # at the end of all times: refused by whoever takes it
        return moment


def asked_sun(request: Request, time: str | None, azimuth: float | None, altitude: float | None, grain_s: int) -> SunSpec | None:
    """The sun of a request, with its time rounded; the request remembers that. Raises ``InputError``."""
    if time is not None and time.strip() == CURRENT:
        if azimuth is not None or altitude is not None:
            raise InputError("time", time, "either time, or azimuth and altitude")
        now = datetime.now(UTC)
        grain = timedelta(seconds=grain_s or 1)
        moment = _EPOCH + (now - _EPOCH) // grain * grain  # down: what has not been yet is not now
        left_s = int((moment + grain - now).total_seconds())
        request.state.asked_time = AskedTime(moment, max(min(left_s, CURRENT_S), 1), current=True)
        return SunSpec(time=moment)
    sun = parse_sun(None if time == OWN_TIME else time, azimuth, altitude)
    if sun is None or sun.time is None:
        return sun
    moment = rounded_time(sun.time, grain_s)
    check_times(as_utc([moment]))
    request.state.asked_time = AskedTime(moment, GIVEN_SUN_S)
    return SunSpec(time=moment)


def asked_time(request: Request) -> AskedTime | None:
    """The time that a request has named."""
    return getattr(request.state, "asked_time", None)


def is_of_now(request: Request) -> bool:
    """Whether the same address means another picture soon."""
    asked = asked_time(request)
    return asked is not None and asked.current


def quarter_hour() -> tuple[datetime, int]:
    """The quarter of an hour that now is in, and how many seconds of it are left: within one, no time zone's date changes."""
    now, quarter = datetime.now(UTC), timedelta(minutes=15)
    begin = _EPOCH + (now - _EPOCH) // quarter * quarter
    return begin, max(int((begin + quarter - now).total_seconds()), 1)


def fresh_for(request: Request, otherwise_s: int) -> int:
    """How many seconds an answer is fresh: of now less than the grain of time."""
    asked = asked_time(request)
    return asked.fresh_s if asked is not None and asked.current else otherwise_s


def time_headers(request: Request) -> dict[str, str]:
    """What an answer says of the time that it is of."""
    asked = asked_time(request)
    return {} if asked is None else {TIME_HEADER: asked.time.isoformat()}
