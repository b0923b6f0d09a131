"""The summary of a comparison: correct grammar, no empty statements, every figure from the rows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.api.report.summary import algorithm_family, format_summary
from skugga.selector.formatting import format_duration, format_list, format_percent
from skugga.selector.measure.compare import Comparison, ComparisonRow
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.terrain.geo.camera import PerspectiveView

ROWS, COLS = 6, 8
VIEW = PerspectiveView(np.zeros(3), np.eye(3), 10.0, -2.5, -3.5, 1.0, ROWS, COLS)


def figures(name: str, ms: float, error: float, **extra_figures: Any) -> dict[str, Any]:
    """Return figures of a row for both kinds of casters. The algorithm is the name up to its first hyphen."""
    algorithm = name.partition("-")[0]
    zeros = dict.fromkeys(("wrong", "false_shadow", "missed_shadow", "edge_mean", "edge_p95", "edge_mean_m", "edge_p95_m"), 0.0)
    return {
        "name": name,
        "algorithm": {"sun": {"relief": algorithm, "meshes": algorithm}},
        "settings": {} if algorithm == "none" else {"sun": {"relief": {"map_size": 64}, "meshes": {"map_size": 64}}},
        **zeros,
        "wrong_cast": error,
        "soft_error": error,
        "coverage": 0.0,
        "interior": 0.0,
        "interior_parts": 0,
        "interior_sees": 0.8,
        "boundary": 0.0,
        "bytes": 1_200_000,
        "counters": {"triangles": 1234, "draws": 0},
        "notes": [],
        "ms_median": ms,
        "ms_p95": ms,
        "runs": 5,
        "cold": False,
        "stages": {"depth map": 0.25 * ms, "visibility": 0.7 * ms},
        "pareto": False,
        "pareto_soft": False,
    } | extra_figures  # fmt: skip


def comparison(*rows: dict[str, Any], **overrides: Any) -> Comparison:
    """Return a comparison of rows that are right everywhere. The front is that of time against the chosen error."""
    error = overrides.get("error", "wrong_cast")
    keys = [(f["ms_median"], f[error]) for f in rows]
    for f, key in zip(rows, keys, strict=True):
        f["pareto"] = not any(other != key and other[0] <= key[0] and other[1] <= key[1] for other in keys)
    dark, lit = np.zeros((ROWS, COLS), np.uint8), np.full((ROWS, COLS), 255, np.uint8)
    lit[:, COLS // 2 :] = dark[:, COLS // 2 :]
    nowhere = np.zeros((ROWS, COLS), bool)
    comparison_rows = [
        ComparisonRow(f, np.full_like(lit, 255) if f["name"] == "none" else lit, nowhere.copy(), nowhere.copy()) for f in rows
    ]
    result = Comparison(VIEW, "sun", comparison_rows, ~nowhere, "wrong_cast", 0.02, 0.25, 0.001, 0.0, [])
    return replace(result, **overrides)


NONE_FIGURES = figures("none", 0.0, 1.0)


@pytest.mark.parametrize("rows", [[], [NONE_FIGURES]], ids=["no rows", "none alone"])
def test_summary_is_empty_where_nothing_casts(rows: list[dict[str, Any]]) -> None:
    assert format_summary(comparison(*rows)) == []


def test_a_single_casting_row_is_reported_as_the_only_one() -> None:
    assert format_summary(comparison(NONE_FIGURES, figures("sweep", 40.0, 0.0123))) == [
        "sweep is the only one that casts shadows here: 1.2 % of the cast shadow wrong, in 40 ms."
    ]


def test_summary_has_the_extremes_and_each_halving() -> None:
    fast, middle, best = (
        figures(f"shadow_map-{k}", *time_and_error)
        for k, time_and_error in enumerate([(10.0, 0.08), (20.0, 0.035), (100.0, 0.001)])
    )
    middle_row = figures("shadow_map-3", 15.0, 0.06)  # on the front, but less than a halving
    assert format_summary(comparison(NONE_FIGURES, best, middle_row, middle, fast)) == [
        "The fastest is shadow_map-0: 8.0 % of the cast shadow wrong, in 10 ms.",
        "The most accurate is shadow_map-2: 0.10 % of the cast shadow wrong, in 100 ms, 10 times the time.",
        "Halving the error from 8.0 % costs 2.0 times the time (shadow_map-0 to shadow_map-1).",
        "Bringing the error from 3.5 % down to 0.10 % costs 5.0 times the time (shadow_map-1 to shadow_map-2).",
    ]


def test_none_is_never_the_fastest() -> None:
    summary_text = " ".join(format_summary(comparison(NONE_FIGURES, figures("sweep", 40.0, 0.01), figures("hybrid", 80.0, 0.001))))
    assert "fastest is sweep" in summary_text and "none" not in summary_text


def test_errors_up_to_three_noise_floors_are_exact() -> None:
    rows = figures("sweep", 10.0, 0.02), figures("hybrid", 20.0, 0.0029), figures("shadow_volume", 30.0, 0.0)
    sentences = format_summary(comparison(*rows, noise_floor=0.001))
    assert "2 rows are exact within the noise of truth; the fastest of them is hybrid, in 20 ms, 2.0 times the time." in sentences
    assert "Bringing the error from 2.0 % down to the noise of truth costs 2.0 times the time (sweep to hybrid)." in sentences
    assert not any("hybrid to shadow_volume" in text for text in sentences)
    assert "The most accurate is shadow_volume" in " ".join(format_summary(comparison(*rows, noise_floor=0.0009))), (
        "an error of 2.9 e-3 is more than 3 noise floors of 0.9 e-3"
    )


@pytest.mark.parametrize(("count", "others_clause"), [(2, "; 1 more is as accurate"), (3, "; 2 more are as accurate")])
def test_exact_rows_are_reported_with_the_fastest(count: int, others_clause: str) -> None:
    sentences = format_summary(comparison(*(figures(f"sweep-{k}", 10.0 + k, 0.0) for k in range(count))))
    assert sentences == [
        f"sweep-0 is both the fastest and the most accurate: exact within the noise of truth, in 10 ms{others_clause}."
    ]


@pytest.mark.parametrize(
    ("further_interior_errors", "expected_start"),
    [
        ([], "sweep has interior errors, although its error is small: 0.20 % of"),
        ([0.004], "sweep and hybrid have interior errors, although their error is small: up to 0.40 % of"),
    ],
)
def test_interior_errors_of_accurate_rows_are_reported(further_interior_errors: list[float], expected_start: str) -> None:
    rows = [
        figures("sweep", 10.0, 0.01, interior=0.002),
        *(figures("hybrid", 20.0, 0.005, interior=i) for i in further_interior_errors),
    ]
    plainly_wrong = figures("planar", 5.0, 0.4, interior=0.3)
    aliased = figures("shadow_map", 30.0, 0.004, interior=MAX_INTERIOR_SHARE)
    sentences = [text for text in format_summary(comparison(*rows, plainly_wrong, aliased)) if "interior errors" in text]
    assert len(sentences) == 1 and sentences[0].startswith(expected_start)


@pytest.mark.parametrize(
    ("dominated_algorithms", "expected_start"),
    [(["hybrid"], "hybrid serves this view, but is"), (["hybrid", "planar"], "hybrid and planar serve this view, but are")],
)
def test_algorithms_never_on_the_front_are_listed(dominated_algorithms: list[str], expected_start: str) -> None:
    rows = figures("sweep", 10.0, 0.01), figures("shadow_map-64", 50.0, 0.001), figures("shadow_map-32", 60.0, 0.02)
    sentences = [
        text
        for text in format_summary(comparison(*rows, *(figures(name, 70.0, 0.05) for name in dominated_algorithms)))
        if "never" in text
    ]
    assert len(sentences) == 1 and sentences[0].startswith(expected_start), "shadow_map is on the front by one of its settings"


def test_none_on_the_front_lists_no_dominated_algorithms() -> None:
    rows = comparison(figures("none", 0.0, 0.0), figures("sweep", 10.0, 0.0), figures("hybrid", 20.0, 0.1))
    assert not any("never" in text for text in format_summary(rows))


def test_the_summary_names_its_error_metric() -> None:
    row = figures("sweep", 10.0, 0.5, coverage=0.031)
    assert "3.1 % difference in shadow share" in format_summary(comparison(row, error_metric="coverage"))[0]


def test_soft_edges_are_reported_if_another_row_is_best() -> None:
    hard, soft = figures("shadow_map-1", 10.0, 0.01, soft_error=0.04), figures("shadow_map-sun", 50.0, 0.02, soft_error=0.005)
    sentences = format_summary(comparison(hard, soft))
    assert "Nearest to the soft edges of truth is shadow_map-sun: 0.50 % soft error, in 50 ms." in sentences
    assert not any("soft edges" in text for text in format_summary(comparison(hard, figures("sweep", 5.0, 0.2))))


@pytest.mark.parametrize(
    ("ms", "soft_front", "expected_start"),
    [
        (5.0, False, "The default, sweep, is on the front by wrong_cast:"),
        (20.0, True, "The default, sweep, is on the front by soft_error:"),
        (20.0, False, "Better than the default, sweep, in no more time is hybrid."),
    ],
)
def test_default_algorithm_is_compared_with_pareto_front(ms: float, soft_front: bool, expected_start: str) -> None:
    default = figures("sweep", ms, 0.03, pareto_soft=soft_front)
    sentences = [
        text
        for text in format_summary(comparison(default, figures("hybrid", 10.0, 0.01), default_row_name="sweep"))
        if "default" in text
    ]
    assert len(sentences) == 1 and sentences[0].startswith(expected_start)


def test_the_algorithm_family_is_that_of_one_light() -> None:
    row = figures("mixed", 1.0, 0.0)
    row["algorithm"] = {
        "sun": {"relief": "sweep", "meshes": "shadow_volume", "forest": "sweep"},
        "lamp": {"relief": "shadow_map", "meshes": "none"},
        "dark": {"relief": "none"},
    }
    assert [algorithm_family(row, light) for light in ("sun", "lamp", "dark", "moon")] == [
        "sweep + shadow_volume",
        "shadow_map",
        "none",
        "none",
    ]


@given(
    st.lists(
        st.tuples(st.sampled_from([0.0, 1e-3, 5.0, 5.0, 4000.0]), st.sampled_from([0.0, 1e-9, 0.004, 0.02, 1.0])),
        min_size=1,
        max_size=6,
    ),
    st.sampled_from([0.0, 0.001, 0.4]),
    st.sampled_from(["wrong_cast", "coverage"]),
)
def test_any_times_and_errors_give_finite_sentences(rows: list[Any], floor: float, error: str) -> None:
    row_figures = [figures(f"sweep-{k}", ms, error_share, coverage=error_share) for k, (ms, error_share) in enumerate(rows)]
    sentences = format_summary(comparison(NONE_FIGURES, *row_figures, noise_floor=floor, error_metric=error))
    assert sentences and all(text.endswith(".") and "nan" not in text and "inf" not in text for text in sentences)
    assert len(sentences) == len(set(sentences))


@given(st.floats(1e-7, 1.0))
def test_shares_are_written_to_two_digits(share: float) -> None:
    text = format_percent(share)
    if share < 1e-5:
        assert text == "under 0.001 %"
    else:
        assert "e" not in text and math.isclose(float(text.removesuffix(" %")), 100.0 * share, rel_tol=0.051)


def test_percentages_and_durations_have_units() -> None:
    assert [format_percent(x) for x in (0.0, 0.0012, 0.09996, 0.5, 1.0)] == ["0 %", "0.12 %", "10 %", "50 %", "100 %"]
    assert [format_duration(x) for x in (0.0, 0.4249, 9.96, 435.4, 999.6, 2100.0)] == [
        "0 ms",
        "0.42 ms",
        "10 ms",
        "435 ms",
        "1.0 s",
        "2.1 s",
    ]


def test_long_lists_end_with_a_count() -> None:
    assert [format_list(list("abcde"[:n])) for n in range(1, 6)] == [
        "a",
        "a and b",
        "a, b and c",
        "a, b, c and d",
        "a, b, c and 2 others",
    ]
