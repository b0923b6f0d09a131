"""Colour ramps as text: one spelling, one clear error, bounded length."""

import pytest

from skugga.terrain.color_ramp import MAX_RAMP_COLORS, canonical_ramp_text, parse_ramp, ramp_text
from skugga.terrain.errors import InputError

WIDEST = ",".join(f"{-12000.0 + 100.5 * number:.3f}:#aabb{number:02x}" for number in range(MAX_RAMP_COLORS))


def test_a_ramp_survives_its_text():
    ramp = ((-300.0, "#0a0b0c"), (0.0, "#ffffff"), (8848.86, "#a9be98"))
    assert parse_ramp(ramp_text(ramp)) == ramp
    assert len(parse_ramp(WIDEST)) == MAX_RAMP_COLORS


@pytest.mark.parametrize("text", ["0:A9BE98,1500:d9d2ae", "-0:#a9be98,1500.0:#D9D2AE", "0.000:a9be98,01500:d9d2ae"])
def test_equal_ramps_have_one_spelling(text):
    assert canonical_ramp_text(text) == "0:a9be98,1500:d9d2ae"


@pytest.mark.parametrize(
    "text",
    [
        "", "viridis", "0", "0:white", "0:a9be9", "0:a9be98;1:000000", "0:a9be98,", "100:a9be98,0:000000", "0:a9be98,0:000000",
        "-12001:a9be98", "10001:a9be98", "nan:a9be98", "1e3:a9be98", " 0:a9be98", f"{WIDEST},10000:000000", "0:a9be98" * 1000,
    ],
)  # fmt: skip
def test_a_wrong_ramp_names_the_form(text):
    with pytest.raises(InputError, match=r"ramp: .*HEIGHT:RRGGBB.*0:a9be98,1500:d9d2ae"):
        parse_ramp(text)
