"""Heights of footprints from attributes in their file: the attributes' names, units, and heights of floors above the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skugga.terrain.geo.vectors import Features
from skugga.terrain.ground.length_attributes import (
    METRE,
    AttributeUnit,
    attribute_lengths,
    check_lengths,
    recognised_attributes,
    with_unit_suffixes,
)

STOREY_UNIT = AttributeUnit(3.0, "3 m a storey")
"""Height of a storey, for files that count storeys (OpenStreetMap's usual value)."""

HEIGHT_ATTRIBUTES = ("height", "building:height", "bldg_height", "render_height", "measured_height", "hauteur")
STOREY_ATTRIBUTES = ("building:levels", "levels", "num_floors", "floors", "storeys", "stories")
BASE_HEIGHT_ATTRIBUTES = ("min_height", "building:min_height", "base_height", "render_min_height")
BASE_STOREY_ATTRIBUTES = ("building:min_level", "min_level", "min_floor")
"""Attribute names of OpenStreetMap, Overture, map tiles and agencies."""

HEIGHT_UNITS = {"height_m": METRE, **with_unit_suffixes(HEIGHT_ATTRIBUTES), **dict.fromkeys(STOREY_ATTRIBUTES, STOREY_UNIT)}
BASE_UNITS = {**with_unit_suffixes(BASE_HEIGHT_ATTRIBUTES), **dict.fromkeys(BASE_STOREY_ATTRIBUTES, STOREY_UNIT)}
"""Units by attribute name: of heights, and of the heights of floors."""


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
    return recognised_attributes(names, HEIGHT_UNITS)


def base_attributes(names: Sequence[str]) -> tuple[str, ...]:
    """Return those of the attribute ``names`` that hold the height of a building's lowest part above the ground."""
    return recognised_attributes(names, BASE_UNITS)


def footprint_heights(
    features: Features, top_attribute_names: Sequence[str], base_attribute_names: Sequence[str]
) -> FootprintHeights:
    """Read building heights from the attributes ``top_attribute_names``, and heights of floors from the attributes
    ``base_attribute_names``.

    For each feature the first attribute with a value above 0 counts. Raises ``SourceError`` if ``top_attribute_names`` hold text
    but no length.
    """
    units = {**HEIGHT_UNITS, **BASE_UNITS}
    top = attribute_lengths(features, top_attribute_names, units, "heights", "footprints")
    base = attribute_lengths(features, base_attribute_names, units, "base heights", "footprints")
    check_lengths(features.name, top)
    notes, warnings = (*top.notes, *base.notes), (*top.warnings, *base.warnings)
    return FootprintHeights(top.values_m, np.nan_to_num(base.values_m), notes, warnings)
