"""Who is to be taken where times and errors are only expected: the candidate with the least expected loss. Pure arithmetic.

A target that is missed is taken to cost ``MISS_PENALTY`` times what candidates that are likely to meet it cost in the median:
much as choices are judged (the PAR10 score of B. Bischl et al. 2016, "ASlib: A benchmark library for algorithm selection"), but
not by the slowest, which nobody would take. So some more time is spent where it does away with a chance to miss, and not much
more where it does away with little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

from skugga.selector.belief import logistic_chance_over
from skugga.selector.ranking import CandidateFigures, RankingResult, best, relative_overshoot
from skugga.shadows.registry import NO_SHADOWS

MISS_PENALTY = 10.0
"""What a missed target costs, in times what a candidate that is likely to meet it does."""

LIKELY_MISS_CHANCE = 0.5
"""A candidate that misses with no larger chance is taken to meet the target."""


@dataclass(frozen=True)
class Forecast:
    """A candidate's expected figures, the chance in [0, 1] that it misses the error that is asked for, and the scale of the
    logistic distribution of its time's logarithm about the one expected.
    """

    figures: CandidateFigures
    error_miss_chance: float
    time_spread: float

    def late_chance(self, max_ms: float | None) -> float:
        """The chance that it takes longer (``None``: no limit)."""
        return 0.0 if max_ms is None else logistic_chance_over(log(max(self.figures.ms, 1e-9) / max_ms), self.time_spread)

    def miss_chance(self, max_ms: float | None) -> float:
        """The chance that it misses the error or the time."""
        return 1.0 - (1.0 - self.error_miss_chance) * (1.0 - self.late_chance(max_ms))


def least_expected_loss(forecasts: Sequence[Forecast], max_error: float, max_ms: float | None = None) -> RankingResult:
    """The candidate to take.

    1. Where some are likely to meet the target: the one with the least expected time, a miss taken as ``MISS_PENALTY`` times their
       median.
    2. Else, where some are likely to keep to the time that is asked for: the one with the least expected overshoot, lateness taken
       in the same way.
    3. Else the nearest, as ``skugga.selector.ranking.best`` has it.

    ``none`` is only taken where there is nothing else. Raises ``ValueError`` where there is nothing at all.
    """
    candidates = [forecast for forecast in forecasts if forecast.figures.name != NO_SHADOWS] or list(forecasts)
    likely = [forecast for forecast in candidates if forecast.miss_chance(max_ms) <= LIKELY_MISS_CHANCE]
    if likely:
        miss_ms = MISS_PENALTY * sorted(forecast.figures.ms for forecast in likely)[len(likely) // 2]
        winner = min(
            likely,
            key=lambda forecast: (_expected(forecast.figures.ms, miss_ms, forecast.miss_chance(max_ms)), forecast.figures.name),
        )
        return RankingResult(winner.figures, True, None)
    in_time = [forecast for forecast in candidates if max_ms is not None and forecast.late_chance(max_ms) <= LIKELY_MISS_CHANCE]
    if not in_time:
        return best([forecast.figures for forecast in candidates], max_error, max_ms)
    over = {forecast.figures.name: relative_overshoot(forecast.figures, max_error) for forecast in in_time}
    missed = MISS_PENALTY * sorted(over.values())[len(over) // 2]
    nearest = min(
        in_time,
        key=lambda forecast: (
            _expected(over[forecast.figures.name], missed, forecast.late_chance(max_ms)),
            forecast.figures.ms,
        ),
    )
    return best([nearest.figures], max_error, max_ms)


def _expected(loss: float, missed: float, chance: float) -> float:
    return (1.0 - chance) * loss + chance * missed
