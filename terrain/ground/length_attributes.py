"""Read lengths of features, such as heights, from attributes in usual names, spellings and units."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.errors import SourceError
from skugga.terrain.geo.vectors import Features
from skugga.terrain.ground.length_text import length_m
from skugga.terrain.level.parts import METRES_PER_UNIT

MISSING_WORDS = ("", "-", "nan", "none", "null", "na", "n/a", "unknown")


class AttributeUnit(NamedTuple):
    """Unit of an attribute's numbers.

    Attributes
    ----------
    metres
        Length of the unit, metres.
    text
        The unit in words, for notes; empty for metres.
    """

    metres: float
    text: str = ""


METRE = AttributeUnit(1.0)

_FOOT = AttributeUnit(METRES_PER_UNIT["ft"], "feet")

SUFFIX_UNITS = {
    "m": METRE, "ft": _FOOT, "feet": _FOOT, "dm": AttributeUnit(METRES_PER_UNIT["dm"], "decimetres"),
    "cm": AttributeUnit(METRES_PER_UNIT["cm"], "centimetres"),
}  # fmt: skip
"""Units by the last word of an attribute's name, such as ``height_ft``."""

NamedUnits = Mapping[str, AttributeUnit]
"""Units by attribute name, in the order of preference. Case, spaces and punctuation of names do not matter."""


def with_unit_suffixes(names: Sequence[str]) -> dict[str, AttributeUnit]:
    """Return the units of attribute names: metres for ``names``, and for each name with a suffix the unit of the suffix."""
    suffixed = {f"{name}_{suffix}": unit for suffix, unit in SUFFIX_UNITS.items() for name in names}
    return {**dict.fromkeys(names, METRE), **suffixed}


def recognised_attributes(names: Sequence[str], recognised: Iterable[str]) -> tuple[str, ...]:
    """Return those of ``names`` that occur in ``recognised``, in its order. Case, spaces and punctuation do not matter."""
    order = {_normalized(name): n for n, name in reversed(list(enumerate(recognised)))}
    matches = sorted((order[_normalized(name)], n) for n, name in enumerate(names) if _normalized(name) in order)
    return tuple(names[n] for _, n in matches)


def matching_attribute(name: str, names: Sequence[str]) -> str:
    """Return the attribute of ``names`` that ``name`` means.

    It is the one with exactly this name, else the only one that differs just in case and punctuation. If neither exists, it is
    ``name`` itself.
    """
    matches = recognised_attributes(names, (name,))
    return matches[0] if name not in names and len(matches) == 1 else name


@dataclass(frozen=True, eq=False)
class AttributeLengths:
    """Lengths of features from their attributes.

    Attributes
    ----------
    values_m
        float64 (n,), metres; NaN without a value above 0.
    notes
        Attributes that were used, in words.
    invalid_texts
        Values that are not lengths, with their attributes and features, in words.
    has_values
        Whether any feature has a value, even 0 or one that is not a length.
    """

    values_m: np.ndarray
    notes: tuple[str, ...]
    invalid_texts: tuple[str, ...]
    has_values: bool

    @property
    def warnings(self) -> tuple[str, ...]:
        """Values that were ignored, in words."""
        more_text = f", and {len(self.invalid_texts) - 1} more" if len(self.invalid_texts) > 1 else ""
        return (f"{self.invalid_texts[0]}{more_text}: ignored, not a length",) if self.invalid_texts else ()


def attribute_lengths(
    features: Features, attributes: Sequence[str], units: NamedUnits, subject: str, feature_noun: str = "features"
) -> AttributeLengths:
    """Read a length of each feature from the first of its ``attributes`` with a value above 0.

    Parameters
    ----------
    features
        The features, with the attributes.
    attributes
        Names of attributes, in the order of preference.
    units
        Units of attributes. The numbers of other attributes are in metres.
    subject, feature_noun
        Names of the lengths and of the features in notes, such as "heights" and "footprints".
    """
    unit_by_name = {_normalized(name): unit for name, unit in units.items()}
    lengths_m, notes, invalid, has_values = np.full(len(features.geometry), np.nan), [], [], False
    for attribute in attributes:
        unit = unit_by_name.get(_normalized(attribute), METRE)
        values_m, invalid_rows = _lengths_m(features.attributes[attribute], unit.metres)
        invalid += [f"{attribute} = {features.attributes[attribute][row]} at {features.label(row)}" for row in invalid_rows]
        has_values = has_values or len(invalid_rows) > 0 or bool(np.isfinite(values_m).any())
        is_new = np.isnan(lengths_m) & (values_m > 0.0)
        lengths_m[is_new] = values_m[is_new]
        if is_new.any():
            unit_text = f" ({unit.text})" if unit.text else ""
            notes.append(f"{subject}: {is_new.sum()} of {len(is_new)} {feature_noun} from the attribute '{attribute}'{unit_text}")
    return AttributeLengths(lengths_m, tuple(notes), tuple(invalid), has_values)


def check_lengths(source: str, lengths: AttributeLengths) -> None:
    """Raise ``SourceError`` for lengths of a file if its attributes have values, but none of them is a length above 0."""
    if lengths.invalid_texts and np.isnan(lengths.values_m).all():
        raise SourceError(
            source, f"{lengths.invalid_texts[0]}, which is not a length", "Use numbers, or lengths such as 12 m or 40 ft"
        )


def _normalized(name: str) -> str:
    """Return the name of an attribute in lower case, without spaces and punctuation."""
    return re.sub(r"[\W_]+", "", name.lower())


def _lengths_m(values: np.ndarray, unit_m: float) -> tuple[np.ndarray, list[int]]:
    """Return an attribute's values in metres, float64 (n,), NaN without a value, and the rows whose text is not a length."""
    if values.dtype.kind in "iuf":
        return values.astype(np.float64) * unit_m, []
    lengths_m, invalid_rows = np.full(len(values), np.nan), []
    for row, value in enumerate(values):
        if value is None or str(value).strip().lower() in MISSING_WORDS:
            continue
        try:
            lengths_m[row] = length_m(str(value), unit_m)
        except ValueError:
            invalid_rows.append(row)
    return lengths_m, invalid_rows
