"""What is known to fall short is excused as far as it is known, and nothing else is."""

from __future__ import annotations

import pytest

from tests.hard_cases.cases import short_as_known


@pytest.mark.parametrize(
    ("figures", "excused"),
    [
        ({"differ": 0.5, "basis": 0.0}, False),  # all holds: nothing is to be excused
        ({"differ": 1.5, "basis": 0.0}, True),
        ({"differ": 2.5, "basis": 0.0}, False),
        ({"differ": 1.5, "basis": 1.5}, False),
        ({"differ": float("nan"), "basis": 0.0}, False),
    ],
)
def test_a_shortfall_that_grows_or_is_new_fails(figures, excused):
    record = {"figures": figures, "bounds": {"differ": 1.0, "basis": 1.0}}
    assert short_as_known(record, {"differ": 2.0}) is excused
