"""A known shortfall excuses a trial only up to its known size."""

from __future__ import annotations

from typing import Any

import pytest

from skugga.shadows.truth.metrics import MetricCoverage
from tests.hard_cases.cases import Case, Trial, short_as_known, told, untested
from tests.hard_cases.table import rows


@pytest.mark.parametrize(
    ("figures", "excused"),
    [
        ({"differ": 0.5, "basis": 0.0}, False),  # all bounds hold: nothing needs an excuse
        ({"differ": 1.5, "basis": 0.0}, True),
        ({"differ": 2.5, "basis": 0.0}, False),
        ({"differ": 1.5, "basis": 1.5}, False),
        ({"differ": float("nan"), "basis": 0.0}, False),
    ],
)
def test_a_shortfall_that_grows_or_is_new_fails(figures, excused):
    record = {"figures": figures, "bounds": {"differ": 1.0, "basis": 1.0}}
    assert short_as_known(record, {"differ": 2.0}) is excused


def test_sight_is_that_of_all_pictures_and_wrong_is_the_worst():
    found = told([MetricCoverage(1000, 900, 10, 1000), MetricCoverage(200, 0, 50, 250), MetricCoverage(10, 0, 10, 10)])
    assert found == {"wrong_cast": 0.2, "sees": 900 / 1210}
    assert told([MetricCoverage(10, 5, 10, 20), MetricCoverage(30, 0, 0, 30)]) == {"wrong_cast": 0.2, "sees": 0.125}, (
        "little in each: all together"
    )
    assert told([]) == told([MetricCoverage(0, 0, 3, 3)]) == {}


def record_of(folder: Any, sight: MetricCoverage, figure: str = "interior") -> dict[str, Any]:
    def measure(trial: Trial) -> dict[str, float]:
        trial.saw(figure, sight)
        return {"interior": 0.0, "gap_texels": 0.0}

    return Case("Z1", "", "", {"interior": 0.0, "gap_texels": 1.0}, measure).run("shadow_map", False, folder)


def test_a_figure_that_sees_no_shadow_is_marked_in_the_table(tmp_path):
    blind, seeing = (
        record_of(tmp_path, MetricCoverage(1000, 199, 990, 1000)),
        record_of(tmp_path, MetricCoverage(1000, 200, 3, 1000)),
    )
    assert untested(blind) == ["interior"] and not untested(seeing)
    cells = [[each["shadow_map"] for _, _, each in rows([record])] for record in (blind, seeing)]
    assert cells == [["0 (not tested: 99, 20)", "0"], ["0 (0.3, 20)", "0"]]


def test_who_judges_shadow_says_what_it_sees(tmp_path):
    with pytest.raises(AssertionError, match="interior.*judge the shadow"):
        record_of(tmp_path, MetricCoverage(1, 1, 0, 1), figure="another")
