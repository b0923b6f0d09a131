"""Colour ramps as text: the form that addresses of tiles and requests use."""

from __future__ import annotations

import re
from itertools import pairwise

from skugga.terrain.errors import InputError

ColorRamp = tuple[tuple[float, str], ...]
"""Pairs of a height in metres and an sRGB colour such as ``#b3c2a2``, with increasing heights."""

MIN_RAMP_HEIGHT_M, MAX_RAMP_HEIGHT_M = -12000.0, 10000.0
MAX_RAMP_COLORS = 32
MAX_RAMP_CHARACTERS = 640
"""Maximum length of a ramp as text: ``MAX_RAMP_COLORS`` of the longest pairs."""

ALLOWED_RAMP_TEXTS = (
    f"1 to {MAX_RAMP_COLORS} pairs HEIGHT:RRGGBB with increasing heights, {MIN_RAMP_HEIGHT_M:g} to {MAX_RAMP_HEIGHT_M:g} metres, "
    "such as 0:a9be98,1500:d9d2ae,4000:f4f4f4"
)

_PAIR = re.compile(r"(-?\d{1,5}(?:\.\d{1,3})?):#?([0-9a-fA-F]{6})")


def parse_ramp(text: str, name: str = "ramp") -> ColorRamp:
    """Return the colour ramp of a text such as ``0:a9be98,1500:d9d2ae``.

    A pair is a height in metres and a colour, with or without ``#``. Raises ``InputError``, which names the parameter ``name``.

    Examples
    --------
    >>> parse_ramp("0:a9be98,1500:d9d2ae")
    ((0.0, '#a9be98'), (1500.0, '#d9d2ae'))
    """
    pairs = [] if len(text) > MAX_RAMP_CHARACTERS else [_PAIR.fullmatch(part) for part in text.split(",")]
    ramp = tuple((float(pair[1]), f"#{pair[2].lower()}") for pair in pairs if pair is not None)
    heights = [height for height, _ in ramp]
    if (
        not 1 <= len(ramp) == len(pairs) <= MAX_RAMP_COLORS
        or not all(low < high for low, high in pairwise(heights))
        or not (heights[0] >= MIN_RAMP_HEIGHT_M and heights[-1] <= MAX_RAMP_HEIGHT_M)
    ):
        raise InputError(name, text, ALLOWED_RAMP_TEXTS)
    return ramp


def ramp_text(ramp: ColorRamp) -> str:
    """Return a colour ramp as text, so that equal ramps have equal texts. Heights are rounded to millimetres.

    Examples
    --------
    >>> ramp_text(((0.0, "#A9BE98"), (1500.5, "#d9d2ae")))
    '0:a9be98,1500.5:d9d2ae'
    """
    return ",".join(f"{round(height, 3) + 0.0:.3f}".rstrip("0").rstrip(".") + f":{color[1:].lower()}" for height, color in ramp)


def canonical_ramp_text(text: str) -> str:
    """Return the one spelling of a ramp as text. Raises ``InputError``."""
    return ramp_text(parse_ramp(text))
