"""Durations as text: a number and a unit, such as 90s, 15m, 1h or 1d."""

from __future__ import annotations

import re
from datetime import timedelta

ALLOWED_DURATIONS = "a number and a unit, s, m, h or d, such as 15m"
"""The allowed durations, for messages."""

_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days"}


def parse_duration(text: str) -> timedelta:
    """Parse a duration of 0 or more, with a resolution of a microsecond. Raises ``ValueError`` for any other text."""
    match = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,6})?)([smhd])", text.strip())
    if match is None:
        raise ValueError(ALLOWED_DURATIONS)
    return timedelta(**{_UNITS[match[2]]: float(match[1])})
