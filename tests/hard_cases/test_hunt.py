"""New situations in every long run: they are printed, and do not fail the run."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import pytest

from tests.hard_cases import test_properties
from tests.hard_cases.hunt import BATCH_EXAMPLES, hunt, hunt_for
from tests.hard_cases.table import FIND_PROPERTY
from tests.hard_cases.test_properties import ALGORITHMS

HUNT_S = 120.0
"""Seconds of drawing new situations."""


@pytest.mark.long
def test_new_situations_of_the_day(gl: Any, record_property: Callable[[str, object], None]) -> None:
    """The date is the seed, so that each day has its own situations, and a run can be repeated on the same day."""
    batches, finds = hunt_for(HUNT_S, int(datetime.now(UTC).strftime("%Y%m%d")))
    for find in finds:
        record_property(FIND_PROPERTY, find)
    assert min(batches.values()) >= 1


def test_a_hunt_reports_situations_over_their_bounds_and_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    figures = {"rotation_skew": 0.0, "condition": 1.0, "wrong beyond its reach": 0.5}
    monkeypatch.setattr(test_properties, "outcome", lambda trial, situation: figures)
    finds = hunt("sweep", BATCH_EXAMPLES, 1)
    assert len(finds) == BATCH_EXAMPLES and all("Situation(" in find and "sweep: " in find for find in finds)

    def fail(trial: Any, situation: Any) -> Any:
        raise ValueError("no ground")

    monkeypatch.setattr(test_properties, "outcome", fail)
    assert all("no ground" in find for find in hunt("sweep", BATCH_EXAMPLES, 1))
    figures["wrong beyond its reach"] = 0.0
    monkeypatch.setattr(test_properties, "outcome", lambda trial, situation: figures)
    assert hunt("sweep", BATCH_EXAMPLES, 1) == []
    assert hunt_for(0.0, 1) == (dict.fromkeys(ALGORITHMS, 1), [])
