"""Ranking: the best candidate in hand-derived cases, and properties of any candidates."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.ranking import TIME_TIE_RATIO, CandidateFigures, best_candidate, relative_overshoot
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE

SMALL = CandidateFigures("small map", 10.0, 0.05, 0.0)
MIDDLE = CandidateFigures("middle map", 20.0, 0.02, 0.0)
LARGE = CandidateFigures("large map", 40.0, 0.004, 0.0)
LEAKY = CandidateFigures("leaky", 5.0, 0.01, 0.004)
NO_SHADOW = CandidateFigures("none", 0.0, 0.0, 0.0)
CANDIDATES = [SMALL, MIDDLE, LARGE, LEAKY, NO_SHADOW]

figures = st.builds(
    CandidateFigures, st.sampled_from(["a", "b", "c", "none"]), st.floats(0.01, 1e4), st.floats(0.0, 1.0), st.floats(0.0, 0.05)
)


@pytest.mark.parametrize(
    ("max_error", "max_ms", "winner", "met"),
    [
        (0.05, None, SMALL, True),  # the limit itself is allowed
        (0.03, None, MIDDLE, True),  # not the one with interior errors, though it is cheaper and its error is small
        (0.03, 20.0, MIDDLE, True),
        (0.03, 15.0, SMALL, False),  # within the time, no interior error beats a smaller error with interior errors
        (0.003, None, LARGE, False),
        (0.003, 25.0, MIDDLE, False),
        (0.0, 1.0, LEAKY, False),  # nothing is in time: this one overshoots by four times the limit, and the others overshoot more
    ],
)
def test_best_candidate_by_hand(max_error, max_ms, winner, met):
    verdict = best_candidate(CANDIDATES, max_error, max_ms)
    assert (verdict.winner, verdict.meets_target) == (winner, met)
    assert (verdict.missed_by is None) is met


def test_best_candidate_reports_the_miss_in_numbers():
    assert best_candidate(CANDIDATES, 0.003).missed_by == "an error of 0.40 %, 0.10 % more than 0.30 %"
    assert best_candidate([LEAKY], 0.03).missed_by == "an interior error of 0.40 %, 0.30 % more than 0.10 %"
    assert (
        best_candidate([SMALL], 0.04, 4.0).missed_by == "an error of 5.0 %, 1.0 % more than 4.0 %; 10 ms, 6.0 ms more than 4.0 ms"
    )


def test_best_candidate_breaks_time_ties_by_accuracy():
    close = CandidateFigures("close", 20.0 * TIME_TIE_RATIO, 0.01, 0.0)
    assert best_candidate([MIDDLE, close], 0.03).winner is close
    assert best_candidate([MIDDLE, CandidateFigures("later", 20.0 * TIME_TIE_RATIO + 0.1, 0.01, 0.0)], 0.03).winner is MIDDLE
    assert best_candidate([MIDDLE, close], 0.03, tie_ratio=1.0).winner is MIDDLE


def test_best_candidate_takes_none_only_if_alone():
    assert best_candidate([NO_SHADOW, CandidateFigures("b", 100.0, 1.0, 1.0)], 0.03).winner.name == "b"
    assert best_candidate([NO_SHADOW], 0.03).winner is NO_SHADOW
    with pytest.raises(ValueError, match="no candidates"):
        best_candidate([], 0.03)


@given(st.lists(figures, min_size=1, max_size=8), st.floats(0.0, 1.0), st.none() | st.floats(0.01, 1e4))
def test_best_candidate_meets_the_target_if_any_does(candidates, max_error, max_ms):
    verdict = best_candidate(candidates, max_error, max_ms)
    casting_candidates = [candidate for candidate in candidates if candidate.name != "none"] or candidates
    on_target = [candidate for candidate in casting_candidates if relative_overshoot(candidate, max_error, max_ms) == 0.0]
    assert verdict.meets_target is bool(on_target) is (verdict.missed_by is None)
    if on_target:
        assert verdict.winner in on_target and verdict.winner.ms <= TIME_TIE_RATIO * min(candidate.ms for candidate in on_target)
    elif max_ms is not None and any(candidate.ms <= max_ms for candidate in casting_candidates):
        assert verdict.winner.ms <= max_ms
        if any(candidate.ms <= max_ms and candidate.interior <= MAX_INTERIOR_SHARE for candidate in casting_candidates):
            assert verdict.winner.interior <= MAX_INTERIOR_SHARE
    else:
        assert relative_overshoot(verdict.winner, max_error, max_ms) == min(
            relative_overshoot(candidate, max_error, max_ms) for candidate in casting_candidates
        )


@given(st.lists(figures, min_size=1, max_size=8), st.floats(0.0, 1.0))
def test_best_candidate_is_independent_of_order(candidates, max_error):
    assert best_candidate(candidates, max_error) == best_candidate(candidates[::-1], max_error)
