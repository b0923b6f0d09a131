"""What a trial's record says: coverage of the cast shadow, and the worst picture."""

from __future__ import annotations

from typing import Any

import pytest

from skugga.shadows.truth.metrics import MetricCoverage
from tests.hard_cases.cases import Case, Trial, coverage_summary, untested_figures
from tests.hard_cases.table import rows


def test_sight_is_that_of_all_pictures_and_wrong_is_the_worst():
    summary = coverage_summary(
        [MetricCoverage(1000, 900, 10, 1000), MetricCoverage(200, 0, 50, 250), MetricCoverage(10, 0, 10, 10)]
    )
    assert summary == {"wrong_cast": 0.2, "wrong_cast_beyond_floor": 47 / 250, "sees": 900 / 1210}
    assert coverage_summary([MetricCoverage(10, 5, 10, 20), MetricCoverage(30, 0, 0, 30)]) == {
        "wrong_cast": 0.2, "wrong_cast_beyond_floor": 0.14, "sees": 0.125,
    }, "little in each: all together"  # fmt: skip
    assert coverage_summary([]) == coverage_summary([MetricCoverage(0, 0, 3, 3)]) == {}


def case_record(folder: Any, coverage: MetricCoverage, figure: str = "interior") -> dict[str, Any]:
    """Return the record of a case that measures nothing but the coverage of one figure."""

    def measure(trial: Trial) -> dict[str, float]:
        trial.record_coverage(figure, coverage)
        return {"interior": 0.0, "gap_texels": 0.0}

    return Case("Z1", "", "", {"interior": 0.0, "gap_texels": 1.0}, measure).run("shadow_map", False, folder)


def test_a_figure_that_sees_no_shadow_is_marked_in_the_table(tmp_path):
    low_coverage, enough_coverage = (
        case_record(tmp_path, MetricCoverage(1000, 199, 990, 1000)),
        case_record(tmp_path, MetricCoverage(1000, 200, 3, 1000)),
    )
    assert untested_figures(low_coverage) == ["interior"] and not untested_figures(enough_coverage)
    cells = [
        [text_by_algorithm["shadow_map"] for _, _, text_by_algorithm in rows([record])]
        for record in (low_coverage, enough_coverage)
    ]
    assert cells == [["0 (not tested: 99, 20)", "0"], ["0 (0.3, 20)", "0"]]


def test_who_judges_shadow_says_what_it_sees(tmp_path):
    with pytest.raises(AssertionError, match="interior.*judge shadow, but coverage is recorded for"):
        case_record(tmp_path, MetricCoverage(1, 1, 0, 1), figure="another")
