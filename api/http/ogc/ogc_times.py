"""Times as map clients of the Open Geospatial Consortium's services ask for them, and the times that they are told of."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

from skugga.api.http.moments import CURRENT, OWN_TIME
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.products import PRODUCTS
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import as_utc, check_date, check_times
from skugga.terrain.level.level import parse_sun

OFFERED_STEP = timedelta(minutes=10)
"""Between the times that clients are told of. Any other time is served as well; ``current`` is, but advertised
nowhere.
"""

EQUINOX = 3, 21
"""Month and day that clients are told of where a level's sun has no time."""

_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_OFFSET = re.compile(r"(Z|z|[+\- ]\d\d:?\d\d)$")


def instant_asked(text: str | None, lon_deg: float) -> str | None:
    """The instant (ISO 8601 with an offset) that a TIME asks for; ``None`` for the level's own sun; ``current`` stays.

    Without an offset it is in UTC; a date is its noon by the sun at a longitude; of an interval its begin. What is none of these is
    left as it is, for ``skugga.terrain.level.level.parse_sun`` to refuse.
    """
    if text is None or text.strip().lower() in ("", OWN_TIME):
        return None
    begin = text.strip().partition("/")[0]
    if begin.lower() == CURRENT:
        return CURRENT
    if _DATE.fullmatch(begin):
        try:
            noon = datetime.combine(date.fromisoformat(begin), datetime.min.time(), UTC) + timedelta(hours=12.0 - lon_deg / 15.0)
        except (ValueError, OverflowError):
            return begin
        return _written(noon.replace(microsecond=0))
    return begin if _OFFSET.search(begin) else f"{begin}Z"


def date_asked(text: str | None, default: date) -> date:
    """The date that a TIME of a layer of whole dates asks for. Raises ``InputError``."""
    if text is None or text.strip().lower() in ("", OWN_TIME):
        return default
    try:
        day = date.fromisoformat(text.strip()[:10])
    except ValueError:
        raise InputError("time", text, "a date, as 2024-03-21") from None
    check_date(day, "time")
    return day


@dataclass(frozen=True)
class TimeDimension:
    """What clients are told of a layer's times: the default, and all of them as one ``begin/end/period``."""

    default: str
    span: str


def time_dimension(level: ServedLevel, layer: str, year: int, asked: str | None = None) -> TimeDimension:
    """The times of a layer that changes with the sun.

    The default is the level's own time, or, where its sun has angles alone, ``default``; of hours of sun it is the date of that, or
    the equinox. The others are those of its year, or of ``year``: the sun of any other is the same to a fraction of a degree. They
    are counted so that the level's own time is among them: a time listed beside them QGIS takes for their begin. With ``asked``,
    that is the default. Raises ``InputError``.
    """
    own, day = own_time(level), default_date(level, year)
    if PRODUCTS[layer].when == "days":
        default = date_asked(None if asked == CURRENT else asked, day).isoformat()
        return TimeDimension(default, f"{day.year}-01-01/{day.year}-12-31/P1D")
    first = datetime(day.year, 1, 1, tzinfo=UTC) + _past_step(own)
    last = datetime(day.year + 1, 1, 1, tzinfo=UTC) + _past_step(own) - OFFERED_STEP
    span = f"{_written(first)}/{_written(last)}/PT{OFFERED_STEP.seconds // 60}M"
    default = OWN_TIME if own is None else _written(own.astimezone(UTC))
    return TimeDimension(_default_asked(asked, level.world.anchor_lon_deg) or default, span)


def _default_asked(text: str | None, lon_deg: float) -> str | None:
    instant = instant_asked(text, lon_deg)
    sun = None if instant == CURRENT else parse_sun(instant, None, None)
    if sun is None or sun.time is None:
        return instant
    check_times(as_utc([sun.time]))
    return _written(sun.time.astimezone(UTC))


def own_time(level: ServedLevel) -> datetime | None:
    """The time of a level's own sun, where it has one."""
    sun = level.loaded.level.sun
    return None if sun is None or sun == "none" else sun.time


def default_date(level: ServedLevel, year: int) -> date:
    """The date of a level's own sun by its own offset, else the equinox of a year."""
    own = own_time(level)
    return date(year, *EQUINOX) if own is None else own.date()


def _past_step(own: datetime | None) -> timedelta:
    """How long a time is past a whole multiple of the step, in whole seconds."""
    return timedelta(seconds=0 if own is None else int(own.timestamp()) % OFFERED_STEP.seconds)


def _written(moment: datetime) -> str:
    return f"{moment.replace(tzinfo=None).isoformat(timespec='seconds')}Z"
