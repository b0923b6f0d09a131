"""Clocks and calendar dates: time zones, UTC offsets and true solar time."""

from __future__ import annotations

import difflib
import re
from datetime import UTC, date, datetime, timedelta, timezone, tzinfo
from typing import Literal
from zoneinfo import ZoneInfo, available_timezones

from skugga.terrain.errors import InputError

Clock = tzinfo | Literal["solar"]
"""A time zone, or true solar time, at whose noon the sun crosses the meridian."""

SOLAR: Literal["solar"] = "solar"

ALLOWED_CLOCKS = "solar, utc, an offset such as +02:00, or a time zone such as Europe/Oslo"

_UTC_OFFSET = re.compile(r"(?:(?:utc|gmt)\s*)?([+-])\s*(\d{1,2}?)(?::?([0-5]\d))?", re.IGNORECASE | re.ASCII)
"""A UTC offset, with or without UTC or GMT before it. It does not match ``Etc/GMT+2``, a zone two hours behind UTC."""

_PLUS_AS_SPACE = re.compile(r"^((?:utc|gmt)?) (?=\d)", re.IGNORECASE | re.ASCII)
"""The text before a plus sign that arrived as a space, as in URLs."""

MAX_SUGGESTIONS = 3
"""Maximum number of zones that an error suggests for an unknown name."""

MIN_SUGGESTION_LETTERS = 5
"""Minimum length of a name for suggestions. Shorter names resemble too many others: EST resembles CEST, which is six hours away."""


def parse_clock(parameter: str, text: str) -> Clock:
    """Return the time zone or UTC offset that a text names, or ``SOLAR``.

    Accepts letters of either case, short offsets (``+2``, ``UTC+2``) and a ``+`` that arrived as a space. Raises ``InputError``,
    which names the parameter and zones with a similar spelling.
    """
    name = text.strip()
    if name.lower() == SOLAR:
        return SOLAR
    if name.lower() in ("utc", "z"):
        return UTC
    offset = _UTC_OFFSET.fullmatch(_PLUS_AS_SPACE.sub(r"\1+", text.rstrip().replace("\u2212", "-"), count=1).strip())
    if offset is not None and int(offset[2]) < 24:
        offset_from_utc = timedelta(hours=int(offset[2]), minutes=int(offset[3] or 0))
        return timezone(-offset_from_utc if offset[1] == "-" else offset_from_utc)
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, LookupError):
        pass
    zones = {zone.lower(): zone for zone in available_timezones()}
    zone_name = zones.get(re.sub(r"\s+", "_", name.lower()))
    if zone_name is not None:
        return ZoneInfo(zone_name)
    suggestions = ", ".join(_similar_zones(name.lower(), zones))
    raise InputError(parameter, text, f"{ALLOWED_CLOCKS}{f' (did you mean {suggestions}?)' if suggestions else ''}")


def _similar_zones(name: str, zones: dict[str, str]) -> list[str]:
    """Return the time zones of the city in a name, or else time zones with a similar spelling.

    ``name`` is in lower case. ``zones`` maps names in lower case to the proper names.
    """
    city = re.sub(r"\s+", "_", name.rpartition("/")[2])
    matches = [zone for zone in sorted(zones) if zone.rpartition("/")[2] == city and "/" in zone]
    if not matches and len(name) >= MIN_SUGGESTION_LETTERS:
        by_city = {zone.rpartition("/")[2]: zone for zone in sorted(zones, reverse=True)}
        matches = difflib.get_close_matches(name, zones, MAX_SUGGESTIONS, cutoff=0.8)
        matches += [by_city[similar_city] for similar_city in difflib.get_close_matches(city, by_city, 1, cutoff=0.8)]
    return [zones[zone] for zone in dict.fromkeys(matches)][:MAX_SUGGESTIONS]


def day_bounds(day: date, clock: tzinfo, parameter: str = "date") -> tuple[datetime, datetime]:
    """Return the midnights at which a day begins and ends. Raises ``InputError`` for a day that the clock's calendar skips."""
    first = datetime(day.year, day.month, day.day, tzinfo=clock)
    following = day + timedelta(days=1)
    end = datetime(following.year, following.month, following.day, tzinfo=clock)
    if end.astimezone(UTC) <= first.astimezone(UTC):
        raise InputError(parameter, day.isoformat(), f"a day that the calendar of {clock} does not skip")
    return first, end


def has_day(day: date, clock: tzinfo) -> bool:
    """Return whether a clock's calendar has a day. Samoa's has no 30 December 2011."""
    try:
        day_bounds(day, clock)
    except InputError:
        return False
    return True


def time_zone_at(lon_deg: float, lat_deg: float) -> str | None:
    """Return the IANA time zone of a position, such as Europe/Oslo; ``None`` if it is unknown."""
    import tzfpy  # imported here: its borders take 35 MB of memory

    return tzfpy.get_tz((lon_deg + 180.0) % 360.0 - 180.0, lat_deg) or None


def parse_date(name: str, text: str) -> date:
    """Return the date of a text such as 2024-03-21. Raises ``InputError``, also for a date that does not exist."""
    try:
        return date.fromisoformat(text.strip())
    except ValueError:
        raise InputError(name, text, "a calendar date such as 2024-03-21") from None
