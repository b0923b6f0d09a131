"""Heights of footprints from attributes in their file: the attributes' names, units, and heights of floors above the ground."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skugga.terrain.errors import SourceError
from skugga.terrain.geo.vectors import Features
from skugga.terrain.ground.length_text import length_m
from skugga.terrain.level.parts import METRES_PER_UNIT

STOREY_M = 3.0
"""Height of a storey, for files that count storeys (OpenStreetMap's usual value)."""

HEIGHT_NAMES = ("height_m", "height", "building:height", "bldg_height", "render_height", "measured_height", "hauteur")
HEIGHT_FT_NAMES = ("height_ft", "building:height_ft", "bldg_height_ft")
STOREY_NAMES = ("building:levels", "levels", "num_floors", "floors", "storeys", "stories")
BASE_NAMES = ("min_height", "building:min_height", "base_height", "render_min_height")
BASE_STOREY_NAMES = ("building:min_level", "min_level", "min_floor")
"""Attribute names of OpenStreetMap, Overture, map tiles and agencies. Case, spaces and punctuation do not matter."""

MISSING_WORDS = ("", "-", "nan", "none", "null", "na", "n/a", "unknown")


def _normalized(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.lower())


_METRES_PER_UNIT_BY_NAME = {
    **{_normalized(name): 1.0 for name in (*HEIGHT_NAMES, *BASE_NAMES)},
    **{_normalized(name): METRES_PER_UNIT["ft"] for name in HEIGHT_FT_NAMES},
    **{_normalized(name): STOREY_M for name in (*STOREY_NAMES, *BASE_STOREY_NAMES)},
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
    """Return those of the attribute ``names`` that hold building heights: lengths first, then counts of storeys."""
    return _recognised_names(names, (*HEIGHT_NAMES, *HEIGHT_FT_NAMES, *STOREY_NAMES))


def base_attributes(names: Sequence[str]) -> tuple[str, ...]:
    """Return those of the attribute ``names`` that hold the height of a building's lowest part above the ground."""
    return _recognised_names(names, (*BASE_NAMES, *BASE_STOREY_NAMES))


def matching_attribute(name: str, names: Sequence[str]) -> str:
    """Return the attribute of ``names`` that ``name`` means.

    It is the one with exactly this name, else the only one that differs just in case and punctuation. If neither exists, it is
    ``name`` itself.
    """
    matches = _recognised_names(names, (name,))
    return matches[0] if name not in names and len(matches) == 1 else name


def footprint_heights(features: Features, tops: Sequence[str], bases: Sequence[str]) -> FootprintHeights:
    """Read building heights from the attributes ``tops``, and heights of floors from the attributes ``bases``.

    For each feature the first attribute with a value above 0 counts. Raises ``SourceError`` if ``tops`` hold text but no length.
    """
    top, base = _first_lengths(features, tops, "heights"), _first_lengths(features, bases, "base heights")
    if top.invalid and not (top.values_m > 0.0).any():
        raise SourceError(
            features.name, f"{top.invalid[0]}, which is not a length", "Use numbers, or lengths such as 12 m or 40 ft"
        )
    warnings = [f"{text}{more_text}: ignored, not a length" for text, more_text in (*top.invalid_summary, *base.invalid_summary)]
    return FootprintHeights(top.values_m, np.nan_to_num(base.values_m), (*top.notes, *base.notes), tuple(warnings))


@dataclass(frozen=True, eq=False)
class _Lengths:
    """Lengths of features.

    Attributes
    ----------
    values_m
        float64 (n,), metres; NaN without a value above 0.
    notes
        Attributes that were used, in words.
    invalid
        Texts that are not lengths, with their attributes and features.
    """

    values_m: np.ndarray
    notes: list[str]
    invalid: list[str]

    @property
    def invalid_summary(self) -> list[tuple[str, str]]:
        more_text = f", and {len(self.invalid) - 1} more" if len(self.invalid) > 1 else ""
        return [(self.invalid[0], more_text)] if self.invalid else []


def _first_lengths(features: Features, attributes: Sequence[str], subject: str) -> _Lengths:
    lengths = _Lengths(np.full(len(features.geometry), np.nan), [], [])
    for attribute in attributes:
        values_m, invalid = _lengths_m(features, attribute)
        lengths.invalid.extend(f"{attribute} = {features.attributes[attribute][row]} at {features.label(row)}" for row in invalid)
        is_new = np.isnan(lengths.values_m) & (values_m > 0.0)
        lengths.values_m[is_new] = values_m[is_new]
        if is_new.any():
            lengths.notes.append(f"{subject}: {is_new.sum()} of {len(is_new)} footprints from {_attribute_text(attribute)}")
    return lengths


def _attribute_text(attribute: str) -> str:
    factor = _METRES_PER_UNIT_BY_NAME.get(_normalized(attribute), 1.0)
    unit = {STOREY_M: f" ({STOREY_M:g} m a storey)", METRES_PER_UNIT["ft"]: " (feet)"}
    return f"the attribute '{attribute}'{unit.get(factor, '')}"


def _lengths_m(features: Features, attribute: str) -> tuple[np.ndarray, list[int]]:
    """Return an attribute's values in metres, float64 (n,), NaN without a value, and the rows whose text is not a length."""
    values, factor = features.attributes[attribute], _METRES_PER_UNIT_BY_NAME.get(_normalized(attribute), 1.0)
    if values.dtype.kind in "iufb":
        return values.astype(np.float64) * factor, []
    lengths_m, invalid = np.full(len(values), np.nan), []
    for row, value in enumerate(values):
        if value is None or str(value).strip().lower() in MISSING_WORDS:
            continue
        try:
            lengths_m[row] = length_m(str(value), factor)
        except ValueError:
            invalid.append(row)
    return lengths_m, invalid


def _recognised_names(names: Sequence[str], recognised: Sequence[str]) -> tuple[str, ...]:
    """Return those of ``names`` that occur in ``recognised``, in its order. Case and punctuation do not matter."""
    order = {_normalized(name): n for n, name in reversed(list(enumerate(recognised)))}
    matches = sorted((order[_normalized(name)], n) for n, name in enumerate(names) if _normalized(name) in order)
    return tuple(names[n] for _, n in matches)
