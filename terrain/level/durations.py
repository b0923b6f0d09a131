"""Lengths of time as people write them: a number and a unit, as 90s, 15m, 1h or 1d."""

from __future__ import annotations

import re
from datetime import timedelta

DURATION_WORDS = "a number and s, m, h or d, as 15m"
"""What a length of time has to be."""

_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days"}


def parse_duration(text: str) -> timedelta:
    """A length of time from its text, 0 or more, to a microsecond. Raises ``ValueError``."""
    found = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,6})?)([smhd])", text.strip())
    if found is None:
        raise ValueError(DURATION_WORDS)
    return timedelta(**{_UNITS[found[2]]: float(found[1])})
