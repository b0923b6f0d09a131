"""Lengths in texts: units, decimal commas, and invalid lengths."""

from __future__ import annotations

import pytest

from skugga.terrain.ground.length_text import length_m, unit_m


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("12", 12.0), ("12.5", 12.5), ("12,5", 12.5), (" 12 m ", 12.0), ("12m", 12.0), ("12 Metres", 12.0), ("40 ft", 12.192),
        ("40'", 12.192), ("7'4\"", 2.2352), ("12 feet", 3.6576), ("-3", -3.0), ("1e2", 100.0), ("25 dm", 2.5), ("250 cm", 2.5),
        ("3937 US survey foot", 1200.0), (".5 m", 0.5), ("12 m.", 12.0),
    ],
)  # fmt: skip
def test_length_m_reads_units_and_decimal_commas(text, metres):
    assert length_m(text) == pytest.approx(metres, rel=1e-12)


def test_length_m_uses_the_default_unit():
    assert length_m("10", 0.3048) == pytest.approx(3.048) and length_m("10 m", 0.3048) == 10.0


@pytest.mark.parametrize("text", ["", "tall", "12-15", "1.200,5", "12 storeys", "~12", "nan", "inf", "m"])
def test_length_m_rejects_invalid_lengths(text):
    with pytest.raises(ValueError):
        length_m(text)


def test_unit_m_knows_decimetres_and_no_furlongs():
    assert unit_m("Decimetre") == 0.1 and unit_m("FT") == 0.3048 and unit_m("furlong") is None
