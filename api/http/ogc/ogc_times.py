"""Parse the TIME of WMS and WMTS requests, and list the times of the capabilities."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

from skugga.api.http.request_times import CURRENT_TIME, DEFAULT_TIME
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.products import PRODUCTS
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import as_utc, check_date, check_times
from skugga.terrain.level.level import parse_sun

LISTED_TIME_STEP = timedelta(minutes=10)
"""Step between the times that the capabilities list.

Any other time is served, too. The word ``current`` is served, but never listed."""

EQUINOX_MONTH_DAY = 3, 21
"""Month and day of the default date of a level whose sun has no time."""

# Words for the allowed values of TIME in error messages.
ALLOWED_INSTANTS = "a date, an ISO 8601 time such as 2024-10-21T16:30:00Z, an interval of these, or current"

_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_OFFSET = re.compile(r"(Z|z|[+\- ]\d\d:?\d\d)$")


def requested_instant(text: str | None, lon_deg: float) -> str | None:
    """Return the instant that a TIME means: ISO 8601 with an offset, ``current``, or ``None`` for the level's own sun.

    A time without an offset is in UTC. A date means its solar noon at the longitude ``lon_deg``. An interval means its begin.
    Raises ``InputError`` for any other text.
    """
    if text is None or text.strip().lower() in ("", DEFAULT_TIME):
        return None
    begin = text.strip().partition("/")[0]
    if begin.lower() == CURRENT_TIME:
        return CURRENT_TIME
    if _DATE.fullmatch(begin):
        try:
            noon = datetime.combine(date.fromisoformat(begin), datetime.min.time(), UTC) + timedelta(hours=12.0 - lon_deg / 15.0)
        except (ValueError, OverflowError):
            raise InputError("time", text, ALLOWED_INSTANTS) from None
        return _iso_utc(noon.replace(microsecond=0))
    instant = begin if _OFFSET.search(begin) else f"{begin}Z"
    try:
        parse_sun(instant, None, None)
    except InputError:
        raise InputError("time", text, ALLOWED_INSTANTS) from None
    return instant


def requested_date(text: str | None, default: date) -> date:
    """Return the date of a TIME for a layer of whole dates; ``default`` without a TIME. Raises ``InputError``."""
    if text is None or text.strip().lower() in ("", DEFAULT_TIME):
        return default
    try:
        day = date.fromisoformat(text.strip()[:10])
    except ValueError:
        raise InputError("time", text, "a date, such as 2024-03-21") from None
    check_date(day, "time")
    return day


@dataclass(frozen=True)
class TimeDimension:
    """The time dimension of a layer in capabilities.

    Attributes
    ----------
    default_value
        The default time or date in ISO 8601, or the word ``default``.
    extent
        All times or dates, as ``begin/end/period`` in ISO 8601.
    """

    default_value: str
    extent: str


def time_dimension(level: ServedLevel, layer: str, year: int, default_time: str | None = None) -> TimeDimension:
    """Return the time dimension of a layer that changes with the sun.

    - The default is ``default_time`` if given, else the time of the level's own sun. For a sun without a time it is ``default``.
    - For a layer of whole dates the default is the date of ``default_time`` or of the level's sun, or else the equinox of ``year``.
    - The extent is one year: that of the level's sun, or else ``year``. In other years the sun differs by a fraction of a degree.
    - The steps of the extent include the time of the level's sun. QGIS takes a time listed beside an extent for its begin.

    Raises ``InputError``.
    """
    sun_time, day = level_sun_time(level), default_date(level, year)
    if PRODUCTS[layer].when == "days":
        default = requested_date(None if default_time == CURRENT_TIME else default_time, day).isoformat()
        return TimeDimension(default, f"{day.year}-01-01/{day.year}-12-31/P1D")
    first = datetime(day.year, 1, 1, tzinfo=UTC) + _step_offset(sun_time)
    last = datetime(day.year + 1, 1, 1, tzinfo=UTC) + _step_offset(sun_time) - LISTED_TIME_STEP
    span = f"{_iso_utc(first)}/{_iso_utc(last)}/PT{LISTED_TIME_STEP.seconds // 60}M"
    default = DEFAULT_TIME if sun_time is None else _iso_utc(sun_time.astimezone(UTC))
    return TimeDimension(_requested_default_time(default_time, level.world.anchor_lon_deg) or default, span)


def _requested_default_time(text: str | None, lon_deg: float) -> str | None:
    """Return the requested default time in UTC; ``current`` stays, and ``None`` means the time of the level's own sun.

    ``text`` is the TIME of the request. A date means its solar noon at the longitude ``lon_deg``. Raises ``InputError``.
    """
    instant = requested_instant(text, lon_deg)
    sun = None if instant == CURRENT_TIME else parse_sun(instant, None, None)
    if sun is None or sun.time is None:
        return instant
    check_times(as_utc([sun.time]))
    return _iso_utc(sun.time.astimezone(UTC))


def level_sun_time(level: ServedLevel) -> datetime | None:
    """Return the time of a level's own sun; ``None`` for a sun that is given by angles, and without a sun."""
    sun = level.loaded.level.sun
    return None if sun is None or sun == "none" else sun.time


def default_date(level: ServedLevel, year: int) -> date:
    """Return the date of a level's own sun, in the UTC offset of its time; for a sun without a time the equinox of ``year``."""
    sun_time = level_sun_time(level)
    return date(year, *EQUINOX_MONTH_DAY) if sun_time is None else sun_time.date()


def _step_offset(sun_time: datetime | None) -> timedelta:
    """Return a time modulo ``LISTED_TIME_STEP``, in whole seconds; 0 for ``None``."""
    return timedelta(seconds=0 if sun_time is None else int(sun_time.timestamp()) % LISTED_TIME_STEP.seconds)


def _iso_utc(moment: datetime) -> str:
    """Return a time that is in UTC as ISO 8601 text, to the second, with a final ``Z``."""
    return f"{moment.replace(tzinfo=None).isoformat(timespec='seconds')}Z"
