"""Choice by the least expected loss: known figures, and properties of all candidates."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.expected_loss import MAX_MISS_CHANCE_OF_LIKELY_OPTION, MISS_PENALTY, Forecast, least_expected_loss
from skugga.selector.ranking import CandidateFigures

TIME_SPREAD = 0.2


def forecast(name: str, ms: float, chance: float, error: float = 0.005, interior: float = 0.0) -> Forecast:
    """Return the forecast of a candidate. ``chance`` is the probability that its error exceeds the target."""
    return Forecast(CandidateFigures(name, ms, error, interior), chance, TIME_SPREAD)


def late_chance(ms: float, max_ms: float | None) -> float:
    """Return the probability that a candidate of ``ms`` milliseconds exceeds ``max_ms``."""
    return forecast("a candidate", ms, 0.0).late_chance(max_ms)


def test_least_expected_loss_trades_time_for_certainty():
    """A miss costs ten times the median of 150 ms: 100 * 0.9 + 1500 * 0.1 = 240 and 100 * 0.98 + 1500 * 0.02 = 128, against 150."""
    sure = forecast("sure", 150.0, 0.0)
    assert least_expected_loss([forecast("quick", 100.0, 0.10), sure], 0.01).winner.name == "sure"
    assert least_expected_loss([forecast("quick", 100.0, 0.02), sure], 0.01).winner.name == "quick"
    slow = forecast("slow", 1e5, 0.0)
    assert (
        least_expected_loss([forecast("quick", 100.0, 0.02), sure, slow], 0.01).winner.name == "quick"
    )  # a candidate that nobody would choose does not change the median


def test_least_expected_loss_excludes_likely_misses():
    verdict = least_expected_loss(
        [
            forecast("quick", 1e-3, MAX_MISS_CHANCE_OF_LIKELY_OPTION + 0.01, error=0.02),
            forecast("sure", 1e6, MAX_MISS_CHANCE_OF_LIKELY_OPTION),
        ],
        0.01,
    )
    assert (verdict.winner.name, verdict.meets_target) == ("sure", True)


def test_least_expected_loss_reports_the_miss_of_the_nearest():
    verdict = least_expected_loss([forecast("far", 1.0, 1.0, error=0.3), forecast("near", 9.0, 0.9, error=0.02)], 0.01)
    assert (verdict.winner.name, verdict.meets_target) == ("near", False)
    assert verdict.missed_by == "an error of 2.0 %, 1.0 % more than 1.0 %"


def test_least_expected_loss_takes_the_most_accurate_in_time():
    slow, quick, rough = forecast("slow", 500.0, 0.9, 0.01), forecast("quick", 20.0, 0.9, 0.02), forecast("rough", 10.0, 0.9, 0.3)
    assert least_expected_loss([slow, quick, rough], 1e-4, 50.0).winner.name == "quick"
    assert least_expected_loss([slow, quick, rough], 1e-4).winner.name == "slow"


def test_least_expected_loss_avoids_likely_lateness():
    at_the_limit, below = forecast("at the limit", 50.0, 0.9, 0.010), forecast("below", 30.0, 0.9, 0.012)
    assert least_expected_loss([at_the_limit, below], 1e-4, 50.0).winner.name == "below"


def test_least_expected_loss_penalises_by_the_median_overshoot():
    """Lateness costs ten times the median overshoot, 99: 8.9 * 0.75 + 99 * 0.25 for the best one, against 299.9 for the quick one.

    With ten times the largest overshoot, the best one would come to 756.
    """
    quick, near, best = forecast("quick", 5.0, 1.0, 0.3), forecast("near", 40.0, 1.0, 0.010), forecast("best", 40.0, 1.0, 0.009)
    limit = 40.0 * 3.0**TIME_SPREAD  # where the probability to be late is a quarter
    assert late_chance(40.0, limit) == pytest.approx(0.25)
    assert least_expected_loss([quick, near, best], 1e-4, limit).winner.name == "best"


def test_least_expected_loss_takes_the_nearest_if_all_are_late():
    verdict = least_expected_loss([forecast("a", 300.0, 0.0), forecast("b", 200.0, 0.0)], 0.01, 10.0)
    assert (verdict.winner.name, verdict.meets_target) == ("b", False)
    assert "190 ms more than 10 ms" in verdict.missed_by


def test_least_expected_loss_takes_none_only_if_alone():
    none_forecast = forecast("none", 0.0, 0.0, error=0.0)
    assert least_expected_loss([none_forecast, forecast("map", 50.0, 1.0, error=0.5)], 0.01).winner.name == "map"
    assert least_expected_loss([none_forecast], 0.01).winner.name == "none"
    with pytest.raises(ValueError, match="no candidates"):
        least_expected_loss([], 0.01)


def test_late_chance_is_one_half_at_the_limit():
    assert late_chance(50.0, None) == 0.0
    assert late_chance(50.0, 50.0) == pytest.approx(0.5)
    assert late_chance(40.0, 50.0) == pytest.approx(1.0 / (1.0 + 1.25 ** (1.0 / TIME_SPREAD)))


forecasts = st.lists(
    st.tuples(st.floats(0.1, 1e4), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.01)), min_size=1, max_size=12
).map(
    lambda rows: [
        Forecast(CandidateFigures(f"c{k}", ms, error, inside), chance, TIME_SPREAD)
        for k, (ms, chance, error, inside) in enumerate(rows)
    ]
)


@given(forecasts, st.floats(1e-4, 0.2), st.none() | st.floats(0.1, 1e4))
def test_least_expected_loss_is_minimal(candidates, max_error, max_ms):
    verdict = least_expected_loss(candidates, max_error, max_ms)
    likely_candidates = [candidate for candidate in candidates if candidate.miss_chance(max_ms) <= MAX_MISS_CHANCE_OF_LIKELY_OPTION]
    chosen = next(candidate for candidate in candidates if candidate.figures == verdict.winner)
    assert not likely_candidates or chosen in likely_candidates
    miss_cost = (
        MISS_PENALTY * sorted([candidate.figures.ms for candidate in likely_candidates] or [0.0])[len(likely_candidates) // 2]
    )

    def loss(candidate: Forecast) -> float:
        chance = candidate.miss_chance(max_ms)
        return (1.0 - chance) * candidate.figures.ms + chance * miss_cost

    assert all(loss(chosen) <= loss(candidate) * (1 + 1e-9) for candidate in likely_candidates)


@given(forecasts, st.floats(1e-4, 0.2), st.sampled_from([0.25, 0.5, 2.0, 1024.0]))
def test_least_expected_loss_ignores_the_unit_of_time(candidates, max_error, factor):
    scaled_candidates = [
        Forecast(
            CandidateFigures(candidate.figures.name, candidate.figures.ms * factor,
                             candidate.figures.error, candidate.figures.interior),
            candidate.error_miss_chance, candidate.time_spread
        )
              for candidate in candidates]  # fmt: skip
    assert least_expected_loss(candidates, max_error).winner.name == least_expected_loss(scaled_candidates, max_error).winner.name
