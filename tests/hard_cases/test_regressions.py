"""Regression bounds of ``wrong_cast``: a cell that gets worse than its record fails, and so does one without a record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.truth.metrics import MetricCoverage
from tests.hard_cases.cases import coverage_summary
from tests.hard_cases.mutants.listing import hard_cases
from tests.hard_cases.regression_listing import REASONS, SECTION, as_markdown, largest_record, unexplained_cells
from tests.hard_cases.regressions import read_records, regressions, updated_records, write_records
from tests.hard_cases.table import section_of

DOCUMENT = Path(__file__).resolve().parents[2] / "docs/reports/hard-cases.md"


def trial(wrong_px: int, union_px: int = 1000, thorough: bool = False, algorithm: str = "shadow_map") -> dict[str, Any]:
    """Return the record of a trial with one picture."""
    sights = {"interior": coverage_summary([MetricCoverage(union_px, union_px, wrong_px, union_px)]), "edge_p95_px": {}}
    return {"id": "Z1", "algorithm": algorithm, "thorough": thorough, "sights": sights}


@pytest.mark.parametrize(
    ("wrong_px", "problem"),
    [
        (0, ""),
        (33, ""),  # 1.5 times 20, and 3 pixels
        (34, "wrong_cast of interior 0.034 over 1.5 times its record 0.02"),
        (500, "wrong_cast of interior 0.5 over 1.5 times its record 0.02"),
    ],
)
def test_wrong_cast_above_its_bound_is_a_regression(wrong_px, problem):
    assert regressions(trial(wrong_px), {"Z1": {"shadow_map": {"quick": {"interior": 0.02}}}}) == problem


def test_three_wrong_pixels_are_no_regression_from_zero():
    records = {"Z1": {"shadow_map": {"quick": {"interior": 0.0}}}}
    assert not regressions(trial(3), records) and regressions(trial(4), records)


def test_the_worst_picture_beyond_the_floor_counts():
    """Two of 100 pixels are the larger share, but 100 of 10,000 are the larger one beyond three pixels of each."""
    summary = coverage_summary([MetricCoverage(100, 100, 2, 100), MetricCoverage(10_000, 10_000, 100, 10_000)])
    assert summary["wrong_cast"] == 0.02 and summary["wrong_cast_beyond_floor"] == 0.0097


def test_a_cell_without_a_record_is_a_regression():
    records = {"Z1": {"shadow_map": {"quick": {"interior": 0.0}}}}
    for other in (trial(0, thorough=True), trial(0, algorithm="sweep"), trial(0) | {"id": "Z2"}):
        assert regressions(other, records) == "interior has no record of wrong_cast; --record-wrong-cast writes it"


def test_records_of_other_trials_are_kept(tmp_path):
    records = updated_records({}, [trial(20), trial(30, thorough=True)])
    assert records == {"Z1": {"shadow_map": {"quick": {"interior": 0.02}, "thorough": {"interior": 0.03}}}}
    write_records(updated_records(records, [trial(10)]), tmp_path / "records.json")
    assert read_records(tmp_path / "records.json") == updated_records(records, [trial(10)])
    assert read_records(tmp_path / "records.json")["Z1"]["shadow_map"]["thorough"] == {"interior": 0.03}


def test_records_are_of_cases_that_exist():
    cases = hard_cases()
    for case, cells in read_records().items():
        assert cells.keys() <= ALGORITHMS.keys()
        for values in (values for sizes in cells.values() for values in sizes.values()):
            assert values.keys() <= cases[case].bounds.keys(), case


def test_every_cell_over_two_per_cent_says_why():
    assert unexplained_cells(read_records(), REASONS) == []
    assert unexplained_cells({"Z1": {"sweep": {"quick": {"wrong": 0.021}}}}, REASONS) == [("Z1", "sweep")]


def test_every_reason_is_of_a_cell_over_two_per_cent():
    for case, *algorithms in REASONS:
        for algorithm in algorithms:
            assert largest_record(read_records(), case, algorithm) > 0.02, (case, algorithm)


def test_the_document_lists_the_regression_bounds():
    """``python -m tests.hard_cases.regression_listing docs/reports/hard-cases.md`` writes the list."""
    assert section_of(DOCUMENT, SECTION) == as_markdown(read_records(), REASONS)
