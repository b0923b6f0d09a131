"""Heights of footprints from their attributes: names, units, and the base heights of buildings above the ground."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skugga.terrain.errors import SourceError
from skugga.terrain.geo.vectors import Features
from skugga.terrain.ground.length_text import length_m
from skugga.terrain.level.parts import METRES_PER_UNIT

LEVEL_M = 3.0
"""Height of a storey, for files that count storeys (OpenStreetMap's usual value)."""

HEIGHT_NAMES = ("height_m", "height", "building:height", "bldg_height", "render_height", "measured_height", "hauteur")
HEIGHT_FT_NAMES = ("height_ft", "building:height_ft", "bldg_height_ft")
LEVEL_NAMES = ("building:levels", "levels", "num_floors", "floors", "storeys", "stories")
BASE_NAMES = ("min_height", "building:min_height", "base_height", "render_min_height")
BASE_LEVEL_NAMES = ("building:min_level", "min_level", "min_floor")
"""Attribute names of OpenStreetMap, Overture, map tiles and agencies. Case, spaces and punctuation do not matter."""

MISSING_WORDS = ("", "-", "nan", "none", "null", "na", "n/a", "unknown")


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.lower())


_FACTORS = {
    **{_plain(name): 1.0 for name in (*HEIGHT_NAMES, *BASE_NAMES)},
    **{_plain(name): METRES_PER_UNIT["ft"] for name in HEIGHT_FT_NAMES},
    **{_plain(name): LEVEL_M for name in (*LEVEL_NAMES, *BASE_LEVEL_NAMES)},
}


@dataclass(frozen=True, eq=False)
class FootprintHeights:
    """Heights of features.

    Attributes
    ----------
    top_m
        float64 (n,): height of the top above the ground, metres; NaN if unknown.
    base_m
        float64 (n,): height of the lowest part above the ground, metres; 0 for a building on the ground.
    notes
        Attributes that were used, in words.
    warnings
        Values that were ignored, in words.
    """

    top_m: np.ndarray
    base_m: np.ndarray
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def height_attributes(names: Sequence[str]) -> tuple[str, ...]:
    """Return the attributes of building heights: lengths first, then counts of storeys."""
    return _matching(names, (*HEIGHT_NAMES, *HEIGHT_FT_NAMES, *LEVEL_NAMES))


def base_attributes(names: Sequence[str]) -> tuple[str, ...]:
    """Return the attributes of the base heights of buildings."""
    return _matching(names, (*BASE_NAMES, *BASE_LEVEL_NAMES))


def spelt_like(name: str, names: Sequence[str]) -> str:
    """Return the attribute with a name, else the only one that differs just in case and punctuation, else the name itself."""
    alike = _matching(names, (name,))
    return alike[0] if name not in names and len(alike) == 1 else name


def footprint_heights(features: Features, tops: Sequence[str], bases: Sequence[str]) -> FootprintHeights:
    """Read heights from the attributes ``tops``, and base heights from the attributes ``bases``.

    The first attribute with a value above 0 counts for each feature. Raises ``SourceError`` if ``tops`` hold text but no length.
    """
    top, base = _first_said(features, tops, "heights"), _first_said(features, bases, "base heights")
    if top.unread and not (top.values_m > 0.0).any():
        raise SourceError(features.name, f"{top.unread[0]}, which is not a length", "Use numbers, or lengths such as 12 m or 40 ft")
    warnings = [f"{said}{more}: ignored, not a length" for said, more in (*top.told_unread, *base.told_unread)]
    return FootprintHeights(top.values_m, np.nan_to_num(base.values_m), (*top.notes, *base.notes), tuple(warnings))


@dataclass(frozen=True, eq=False)
class _Said:
    """Lengths of features.

    Attributes
    ----------
    values_m
        float64 (n,), metres; NaN without a value above 0.
    notes
        Attributes that were used, in words.
    unread
        Texts that are not lengths, with their attributes and features.
    """

    values_m: np.ndarray
    notes: list[str]
    unread: list[str]

    @property
    def told_unread(self) -> list[tuple[str, str]]:
        more = f", and {len(self.unread) - 1} more" if len(self.unread) > 1 else ""
        return [(self.unread[0], more)] if self.unread else []


def _first_said(features: Features, attributes: Sequence[str], what: str) -> _Said:
    said = _Said(np.full(len(features.geometry), np.nan), [], [])
    for attribute in attributes:
        values_m, unread = _lengths_m(features, attribute)
        said.unread.extend(f"{attribute} = {features.attributes[attribute][row]} at {features.label(row)}" for row in unread)
        new = np.isnan(said.values_m) & (values_m > 0.0)
        said.values_m[new] = values_m[new]
        if new.any():
            said.notes.append(f"{what}: {new.sum()} of {len(new)} footprints from {_spelling(attribute)}")
    return said


def _spelling(attribute: str) -> str:
    factor = _FACTORS.get(_plain(attribute), 1.0)
    unit = {LEVEL_M: f" ({LEVEL_M:g} m a storey)", METRES_PER_UNIT["ft"]: " (feet)"}
    return f"the attribute '{attribute}'{unit.get(factor, '')}"


def _lengths_m(features: Features, attribute: str) -> tuple[np.ndarray, list[int]]:
    """Return an attribute as metres, float64 (n,), NaN without a value, and the rows whose text is not a length."""
    values, factor = features.attributes[attribute], _FACTORS.get(_plain(attribute), 1.0)
    if values.dtype.kind in "iufb":
        return values.astype(np.float64) * factor, []
    lengths_m, unread = np.full(len(values), np.nan), []
    for row, value in enumerate(values):
        if value is None or str(value).strip().lower() in MISSING_WORDS:
            continue
        try:
            lengths_m[row] = length_m(str(value), factor)
        except ValueError:
            unread.append(row)
    return lengths_m, unread


def _matching(names: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the names that are known, in the order of ``known``."""
    order = {_plain(name): n for n, name in reversed(list(enumerate(known)))}
    found = sorted((order[_plain(name)], n) for n, name in enumerate(names) if _plain(name) in order)
    return tuple(names[n] for _, n in found)
