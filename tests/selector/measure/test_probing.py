"""Probing of candidates with known true figures: which are drawn, what is learnt, which is chosen, and when probing ends."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.selector.choices import Choice
from skugga.selector.cost.error_model import ExpectedErrors, SharedErrors, packaged_model
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.selector.measure.point_truth import wilson_interval
from skugga.selector.measure.probing import ErrorMeasurement, expected_gain, leader_of, probe_options
from skugga.selector.options import LightOptions, PredictedChoice
from skugga.shadows.plan import Step
from skugga.terrain.level.level import SUN

SHARED = SharedVariance(view=0.5, family=0.25)
MODEL = packaged_model().model_copy(
    update={"time_spread": 0.2, "shared": SharedErrors(error=SHARED, interior=SHARED, time=SHARED)}
)  # fmt: skip

ALGORITHMS = ("shadow_map", "shadow_volume", "hybrid", "sweep")


@dataclass(frozen=True)
class Candidate:
    """A candidate: expected and true figures."""

    expected_ms: float
    expected_error: float
    ms: float
    error: float
    interior: float = 0.0
    refused: bool = False


@dataclass
class FakeProber:
    """A prober that returns prescribed figures and records its calls."""

    candidates: list[Candidate]
    points: int = 1000
    steps: int = 4
    seconds: float = 0.0
    drawn: list[int] = field(default_factory=list)
    step: int = 0
    measured: list[tuple[int, int]] = field(default_factory=list)

    def elapsed_s(self) -> float:
        return self.seconds

    def draw_s(self, index: int, ms: float) -> float:
        return ms / 1000.0

    def draw(self, index: int) -> float | None:
        self.drawn.append(index)
        self.seconds += self.draw_s(index, self.candidates[index].ms)
        return None if self.candidates[index].refused else self.candidates[index].ms

    def measurement(self, index: int) -> ErrorMeasurement:
        self.measured.append((index, self.step))
        candidate, count = self.candidates[index], self.points * 2**self.step
        if self.step == self.steps:
            return ErrorMeasurement(
                candidate.error, candidate.error, candidate.error, candidate.interior, candidate.interior, candidate.interior, count
            )
        limits = wilson_interval(round(candidate.error * count), count)
        return ErrorMeasurement(
            candidate.error,
            *limits,
            candidate.interior,
            *wilson_interval(round(10 * candidate.interior * count), 10 * count),
            count,
        )

    def add_points_s(self) -> float | None:
        return None if self.step == self.steps else 0.1 * 2**self.step

    def add_points(self) -> None:
        self.seconds += 0.1 * 2**self.step
        self.step += 1


def options_of(candidates: list[Candidate]) -> LightOptions:
    """Return options, each a family by itself, whose errors are uncertain."""
    options = [
        PredictedChoice(
            Choice(f"c{number}", {"relief": ALGORITHMS[number % 4]}),
            (Step(SUN, ("relief",), ALGORITHMS[number % 4], None),),
            candidate.expected_ms,
            ExpectedErrors(candidate.expected_error / 5.0, candidate.expected_error, 0.0, 0.4, 0.4),
        )
        for number, candidate in enumerate(candidates)
    ]
    return LightOptions.expected(options, MODEL)


def probe(
    candidates: list[Candidate], max_error: float, max_ms: float | None = None, budget_s: float | None = None, **prober_fields
):
    """Probe fake candidates. Return the index of the preferred one, the result of the probe, and the fake prober.

    ``max_error`` and ``max_ms`` are the target, and ``budget_s`` is the time limit of the probe; ``None`` is no limit.
    """
    prober = FakeProber(candidates, **prober_fields)
    outcome = probe_options(options_of(candidates), prober, max_error, max_ms, budget_s)
    return leader_of(outcome.options, max_error, max_ms), outcome, prober


def test_probe_confirms_a_leader_that_meets_its_forecast():
    winner, outcome, prober = probe(
        [Candidate(10.0, 0.005, 10.0, 0.005), Candidate(100.0, 0.001, 100.0, 0.001)], 0.03, budget_s=3.0
    )
    assert (winner, prober.drawn, outcome.confirmed, prober.step) == (0, [0], True, 0)


def test_probe_replaces_a_leader_that_misses():
    winner, outcome, prober = probe([Candidate(10.0, 0.005, 10.0, 0.08), Candidate(30.0, 0.001, 30.0, 0.001)], 0.03, budget_s=3.0)
    assert (winner, prober.drawn, outcome.confirmed, outcome.initial_leader) == (1, [0, 1], True, 0)


def test_probe_draws_the_fastest_likely_candidate_first():
    """The risk of a miss makes the slow candidate the leader. The fast one is drawn first, and its picture settles the choice."""
    candidates = [Candidate(400.0, 0.02, 400.0, 0.01), Candidate(1000.0, 0.0001, 1000.0, 0.0001), Candidate(100.0, 0.3, 100.0, 0.3)]
    winner, outcome, prober = probe(candidates, 0.03, budget_s=3.0)
    assert outcome.initial_leader == 1 and (winner, prober.drawn, outcome.confirmed) == (0, [0], True)
    worse = [Candidate(400.0, 0.02, 400.0, 0.05), *candidates[1:]]
    assert probe(worse, 0.03, budget_s=3.0)[0] == 1


def test_probe_raises_expected_errors_of_related_candidates():
    """Three expect 1 % to 2 %.

    The first has ten times as much; by the shared variance the others are expected to have more, too.
    """
    candidates = [Candidate(10.0, 0.01, 10.0, 0.1), Candidate(12.0, 0.015, 12.0, 0.15), Candidate(60.0, 0.0005, 60.0, 0.0005)]
    before = options_of(candidates)
    _, outcome, _ = probe(candidates, 0.03, budget_s=0.0)
    assert [outcome.options.figures(index).error > 1.5 * before.figures(index).error for index in (0, 1)] == [True, True]


def test_probe_adds_points_until_the_interval_decides():
    """For 2.8 % of a thousand points the interval is 1.9 to 4.0 %: no verdict on 3 %. All points give a verdict."""
    winner, outcome, prober = probe(
        [Candidate(10.0, 0.005, 10.0, 0.028), Candidate(500.0, 0.001, 500.0, 0.001)], 0.03, budget_s=30.0
    )
    assert winner == 0 and prober.step == 4 and outcome.confirmed
    _, short_outcome, prober = probe(
        [Candidate(10.0, 0.005, 10.0, 0.028), Candidate(500.0, 0.001, 500.0, 0.001)], 0.03, budget_s=0.15
    )
    assert prober.step == 1 and not short_outcome.confirmed


def test_probe_compares_only_the_undecided_candidate_at_more_points():
    """The first one meets 3 % at a thousand points. The second, which saves half of its time, needs more; all points decide it."""
    winner, _, prober = probe([Candidate(100.0, 0.002, 100.0, 0.002), Candidate(40.0, 0.05, 50.0, 0.0285)], 0.03)
    assert winner == 1 and prober.drawn == [0, 1]
    assert prober.measured == [(0, 0), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4)]


def test_probe_compares_an_undecided_candidate_at_points_that_were_added_for_another():
    """The second candidate needed all points. The first one, undecided at a thousand, is compared at them without adding any."""
    winner, _, prober = probe([Candidate(50.0, 0.02, 50.0, 0.033), Candidate(60.0, 0.02, 60.0, 0.028)], 0.03)
    assert winner == 1
    assert prober.measured == [(0, 0), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4), (0, 4)]


def test_probe_draws_one_candidate_then_respects_the_budget():
    candidates = [Candidate(500.0, 0.005, 500.0, 0.08), Candidate(900.0, 0.001, 900.0, 0.001)]
    winner, outcome, prober = probe(candidates, 0.03, budget_s=0.1)
    assert prober.drawn == [0] and not outcome.confirmed
    assert winner == 1  # a candidate that was measured to miss loses to one that is expected to meet the target


def test_probe_drops_a_candidate_that_refuses_the_view():
    candidates = [Candidate(10.0, 0.005, 10.0, 0.005, refused=True), Candidate(30.0, 0.001, 30.0, 0.001)]
    winner, outcome, prober = probe(candidates, 0.03, budget_s=3.0)
    assert (winner, prober.drawn, sorted(outcome.drawn)) == (1, [0, 1], [1])
    refused_only = [Candidate(10.0, 0.005, 10.0, 0.005, refused=True)]
    assert probe_options(options_of(refused_only), FakeProber(refused_only), 0.03).options.numbers == []


def test_probe_tries_a_much_faster_candidate():
    """The second candidate is expected to miss 1 % but meets it. Without a budget, probing finds it."""
    candidates = [Candidate(100.0, 0.002, 100.0, 0.002), Candidate(10.0, 0.02, 10.0, 0.008)]
    assert probe(candidates, 0.01)[0] == 1


def test_probe_seeks_the_most_accurate_within_the_time():
    candidates = [Candidate(10.0, 0.02, 10.0, 0.02), Candidate(20.0, 0.018, 20.0, 0.002), Candidate(90.0, 0.0, 90.0, 0.0)]
    assert probe(candidates, 1e-4, 50.0)[0] == 1


def test_expected_gain_of_known_candidates_is_the_time_saved():
    candidates = [Candidate(100.0, 0.001, 100.0, 0.001), Candidate(60.0, 0.001, 60.0, 0.001)]
    options = options_of(candidates)
    for index, candidate in enumerate(candidates):
        options = options.with_observations(
            [
                ErrorMeasurement(candidate.error, candidate.error, candidate.error, 0.0, 0.0, 0.0, 1000).to_observation(
                    f"c{index}", candidate.ms
                )
            ]
        )
    assert expected_gain(options, 1, 0, 0.01, None) == pytest.approx(0.4, abs=0.01)
    assert expected_gain(options, 0, 1, 0.01, None) == pytest.approx(0.0, abs=1e-3)


candidate_lists = st.lists(
    st.builds(Candidate, st.floats(1, 500), st.floats(0, 0.3), st.floats(1, 500),
              st.floats(0, 0.3), st.sampled_from([0.0, 0.0, 0.01])),
    min_size=1, max_size=8,
)  # fmt: skip


@settings(deadline=None)
@given(
    candidate_lists,
    st.sampled_from([0.1, 0.03, 0.01, 0.003]),
    st.none() | st.floats(5, 300),
    st.sampled_from([0.0, 0.3, 3.0, None]),
)
def test_probe_prefers_a_likely_candidate_to_a_measured_miss(candidates, max_error, max_ms, budget_s):
    winner, outcome, prober = probe(candidates, max_error, max_ms, budget_s)
    assert len(set(prober.drawn)) == len(prober.drawn) >= 1
    forecasts = outcome.options.forecasts(max_error)
    if forecasts[winner].miss_chance(max_ms) > 0.5:
        assert all(forecast.miss_chance(max_ms) > 0.5 for forecast in forecasts)
    if budget_s is not None and len(prober.drawn) > 1:
        assert (
            prober.seconds <= budget_s + max(candidate.ms for candidate in candidates) / 1000.0
        )  # a draw may take longer than forecast


@settings(deadline=None)
@given(candidate_lists, st.sampled_from([0.1, 0.03, 0.01]))
def test_probe_without_a_budget_chooses_a_measured_candidate(candidates, max_error):
    winner, outcome, _ = probe(candidates, max_error)
    assert winner in outcome.drawn
    candidate = candidates[winner]
    if candidate.error > max_error or candidate.interior > 0.001:  # then no drawn candidate meets the target
        assert all(candidates[index].error > max_error or candidates[index].interior > 0.001 for index in outcome.drawn)
