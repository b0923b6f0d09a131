"""Parse lengths as files write them: numbers with or without a unit."""

from __future__ import annotations

import re

from skugga.terrain.ground.vertical import unit_of_word
from skugga.terrain.level.parts import METRES_PER_UNIT

INCH_M = 0.0254

_NUMBER = r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:e[+-]?\d+)?"
_LENGTH = re.compile(rf"({_NUMBER})\s*([^\d\s.,+-][^\d]*?)?\.?")
_FEET_INCHES = re.compile(rf"(\d+)\s*(?:'|\u2032|ft)\s*({_NUMBER})\s*(?:\"|\u2033|in)")


def unit_m(word: str) -> float | None:
    """Return the length of a unit in metres; ``None`` for an unknown word."""
    unit = unit_of_word(word)
    return None if unit is None else METRES_PER_UNIT[unit]


def length_m(text: str, default_unit_m: float = 1.0) -> float:
    """Return the length that a text states, metres: ``12``, ``12,5``, ``12 m``, ``40 ft`` or ``7'4"``.

    A text without a unit is in units of ``default_unit_m`` metres. Raises ``ValueError`` for a text that is not a length.
    """
    normalized_text = text.strip().lower()
    feet = _FEET_INCHES.fullmatch(normalized_text)
    if feet is not None:
        return float(feet[1]) * METRES_PER_UNIT["ft"] + _number(feet[2]) * INCH_M
    length = _LENGTH.fullmatch(normalized_text)
    per_unit = None if length is None else unit_m(length[2]) if length[2] else default_unit_m
    if length is None or per_unit is None:
        raise ValueError(text)
    return _number(length[1]) * per_unit


def _number(text: str) -> float:
    """Return the number that a text states, with a decimal point or a decimal comma."""
    return float(text.replace(",", "."))
