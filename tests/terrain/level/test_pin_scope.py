"""Scopes of pins: the first matching pin applies, and a pin that can never apply is an error."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.errors import LevelError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.pin_scope import PinScope, covered_pins, uncovered_altitudes

BASE_LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [50, 50], "cells": [5, 5]}}, "sun": {"azimuth": 200, "altitude": 35},
    "views": {"village": {"kind": "map"}},
}  # fmt: skip
SWEEP_PIN = {"algorithm": "sweep"}


def load_pinned_shadows(path, *pins, **keys):
    """Return the ``shadows`` of a level with pins."""
    path.write_text(json.dumps({**BASE_LEVEL, **keys, "shadows": {"pins": pins}}))
    return load_level(path).level.shadows


@pytest.mark.parametrize(
    ("pins", "words"),
    [
        ([{"view": "vilage", **SWEEP_PIN}], ("shadows.pins.0.view: 'vilage'", "map, village")),
        ([SWEEP_PIN | {"view": "map"}, {"view": "x", **SWEEP_PIN}], ("shadows.pins.1.view: 'x'", "map, village")),
        ([{"sun_altitude_deg": [20, 20], **SWEEP_PIN}], ("shadows.pins.0.sun_altitude_deg: '[20, 20]'", "minimum < maximum")),
        ([{"sun_altitude_deg": [30, 20], **SWEEP_PIN}], ("shadows.pins.0.sun_altitude_deg: '[30, 20]'", "minimum < maximum")),
        ([{"sun_altitude_deg": [30, 95], **SWEEP_PIN}], ("shadows.pins.0.sun_altitude_deg.1: '95'", "90")),
        ([{"sun_altitude": [30, 95], **SWEEP_PIN}],
         ("shadows.pins.0.sun_altitude: unknown key", "Did you mean 'sun_altitude_deg'")),
        ([{"max_error": 0.1, **SWEEP_PIN}], ("shadows.pins.0.max_error: unknown key", "map_size")),
        ([{"view": "map"}], ("shadows.pins.0:", "at least one setting of algorithm, map_size")),
        ([{"algorithm": {"lamp": "sweep"}}], ("shadows.pins.0.algorithm", "lamp", "a light (sun)")),
        ([SWEEP_PIN, {"view": "map", "map_size": 512}], ("shadows.pins.1: 'view map'", "shadows.pins.0 (all views)")),
        (
            [{"sun_altitude_deg": suns, **SWEEP_PIN} for suns in ([0, 20], [20, 90], [5, 60])],
            ("shadows.pins.2: 'all views, sun 5 to 60 degrees high'", "shadows.pins.0", "shadows.pins.1"),
        ),
        ([{"view": "map", **SWEEP_PIN}, {"view": "village", **SWEEP_PIN}, SWEEP_PIN], ("shadows.pins.2", ("shadows.pins.1 "
            "(view village)"))),
    ],
)  # fmt: skip
def test_invalid_pin_is_a_single_error(tmp_path, pins, words):
    with pytest.raises(LevelError) as error:
        load_pinned_shadows(tmp_path / "mine.yaml", *pins)
    text = str(error.value)
    assert "\n" not in text and text.count("mine.yaml") == 1
    for word in words:
        assert word in text


def test_first_matching_pin_applies(tmp_path):
    shadows = load_pinned_shadows(
        tmp_path / "mine.yaml",
        {"view": "village", "sun_altitude_deg": [5, 20], **SWEEP_PIN},
        {"view": "village", "map_size": 512},
        SWEEP_PIN,
    )
    numbers = [shadows.pin_number("village", altitude) for altitude in (4.9, 5, 12, 20, 20.1, None)]
    assert numbers == [1, 0, 0, 0, 1, 1] and shadows.pin_number("map", 12) == 2
    assert shadows.pins[1].settings == {"map_size": 512}


def test_pin_without_a_range_applies_without_a_sun(tmp_path):
    path, pins = tmp_path / "mine.yaml", ({"sun_altitude_deg": [-90, 90], **SWEEP_PIN}, {"map_size": 512})
    assert load_pinned_shadows(path, *pins, sun="none").pin_number("map", None) == 1
    with pytest.raises(LevelError, match=r"shadows\.pins\.1"):  # with a sun, the first pin always matches
        load_pinned_shadows(path, *pins)


scopes = st.builds(
    PinScope,
    view=st.sampled_from([None, "map", "village"]),
    sun_altitude_deg=st.none() | st.tuples(st.integers(-9, 9), st.integers(-9, 9)).filter(lambda r: r[0] < r[1]).map(
        lambda r: (10.0 * r[0], 10.0 * r[1])
    ),
)  # fmt: skip


@given(st.lists(scopes, max_size=6), st.booleans())
def test_covered_pins_are_those_that_never_apply(pins, has_no_sun):
    """Compare with brute force over all views, with sun altitudes between all range limits."""
    suns = [*np.arange(-89.0, 90.0, 2.0), *([None] if has_no_sun else [])]
    first = {
        (view, sun): next((number for number, pin in enumerate(pins) if pin.applies_to(view, sun)), None)
        for view in ("map", "village")
        for sun in suns
    }
    vain = {number for number, _ in covered_pins(pins, ("map", "village"), has_no_sun)}
    assert vain == set(range(len(pins))) - set(first.values())
    for (view, sun), number in first.items():
        for index in range(len(pins)) if sun is not None else ():
            assert any(low <= sun <= high for low, high in uncovered_altitudes(pins, index, view)) == (index == number)
