"""Dates, and the clocks that days and times of day are told by."""

from __future__ import annotations

import re
from datetime import UTC, date, timedelta, timezone, tzinfo
from typing import Literal
from zoneinfo import ZoneInfo

from terrain.errors import Fault, InputError

Clock = tzinfo | Literal["solar"]
"""A zone, or true solar time, at whose noon the sun stands in the meridian."""

SOLAR: Literal["solar"] = "solar"

CLOCK_WORDS = "solar, utc, an offset as +02:00, or a time zone as Europe/Oslo"

_OFFSET = re.compile(r"([+-])(\d\d):?(\d\d)")


def clock_named(parameter: str, text: str) -> Clock:
    """The clock of a name. A ``+`` of an offset that arrived as a space is understood. Raises ``InputError``, which names the
    parameter.
    """
    name = text.strip()
    if name.lower() == SOLAR:
        return SOLAR
    if name.lower() in ("utc", "z"):
        return UTC
    offset = _OFFSET.fullmatch(f"+{name}" if text.startswith(" ") else name)
    if offset is not None and int(offset[2]) < 24 and int(offset[3]) < 60:
        ahead = timedelta(hours=int(offset[2]), minutes=int(offset[3]))
        return timezone(-ahead if offset[1] == "-" else ahead)
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, LookupError):
        raise InputError(parameter, text, CLOCK_WORDS) from None


def time_zone_at(lon_deg: float, lat_deg: float) -> str | None:
    """Return the IANA time zone that is kept at a place, as Europe/Oslo; ``None`` where none is known."""
    import tzfpy  # its borders take 35 MB

    return tzfpy.get_tz((lon_deg + 180.0) % 360.0 - 180.0, lat_deg) or None


def date_of(name: str, text: str) -> date:
    """A date from its text, as 2024-03-21. Raises ``InputError``, also for a date that there is not."""
    try:
        return date.fromisoformat(text.strip())
    except ValueError:
        raise InputError(name, Fault(f"'{text}' is no date"), "a date of the calendar, as 2024-03-21") from None
