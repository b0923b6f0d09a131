"""Select the candidate with the least expected loss, if times and errors are uncertain. Pure arithmetic.

The target is a maximum error and a maximum time. The loss is the time, with a penalty for a missed target. A miss costs
``MISS_PENALTY`` times the median time of the candidates that are likely to meet the target. This follows the PAR10 score of
algorithm selection (B. Bischl et al. 2016, "ASlib: A benchmark library for algorithm selection"). PAR10 uses the slowest candidate
instead of the median. But a policy would not choose the slowest one. With this loss a slower candidate is chosen only if it lowers
the risk of a miss enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

from skugga.selector.gaussian_estimate import logistic_probability_over
from skugga.selector.ranking import CandidateFigures, RankingResult, best_candidate, relative_overshoot
from skugga.shadows.registry import NO_SHADOWS

MISS_PENALTY = 10.0
"""Loss of a missed target, in multiples of the median time of the candidates that are likely to meet it."""

MAX_MISS_CHANCE_OF_LIKELY_OPTION = 0.5
"""Maximum probability of a missed target of a candidate that counts as likely to meet it."""


@dataclass(frozen=True)
class Forecast:
    """Expected time and error of a candidate, with their uncertainty.

    Attributes
    ----------
    figures
        Expected time and errors.
    error_miss_chance
        Probability, in [0, 1], that the error exceeds its limit.
    time_spread
        Scale of the logistic distribution of the time's logarithm.
    """

    figures: CandidateFigures
    error_miss_chance: float
    time_spread: float

    def late_chance(self, max_ms: float | None) -> float:
        """Return the probability, in [0, 1], that the time exceeds ``max_ms``. ``None`` means no limit."""
        return 0.0 if max_ms is None else logistic_probability_over(log(max(self.figures.ms, 1e-9) / max_ms), self.time_spread)

    def miss_chance(self, max_ms: float | None) -> float:
        """Return the probability, in [0, 1], that the error or the time exceeds its limit.

        ``max_ms`` is the limit of the time; ``None`` means no limit.
        """
        return 1.0 - (1.0 - self.error_miss_chance) * (1.0 - self.late_chance(max_ms))


def least_expected_loss(forecasts: Sequence[Forecast], max_error: float, max_ms: float | None = None) -> RankingResult:
    """Return the candidate with the least expected loss.

    ``max_error`` is the limit of the error, in [0, 1], and ``max_ms`` that of the time, milliseconds; ``None`` means no limit.

    1. If some candidates are likely to meet the target: that with the least expected time among them. A miss counts as
       ``MISS_PENALTY`` times their median time.
    2. Otherwise, if some are likely to stay within the time limit: that with the least expected overshoot (excess of the error over
       its limit) among them. A late candidate counts as ``MISS_PENALTY`` times their median overshoot.
    3. Otherwise, the result of ``skugga.selector.ranking.best_candidate``.

    The algorithm ``none`` wins only if it is the only candidate. Raises ``ValueError`` without candidates.
    """
    candidates = [forecast for forecast in forecasts if forecast.figures.name != NO_SHADOWS] or list(forecasts)
    likely = [forecast for forecast in candidates if forecast.miss_chance(max_ms) <= MAX_MISS_CHANCE_OF_LIKELY_OPTION]
    if likely:
        miss_ms = MISS_PENALTY * sorted(forecast.figures.ms for forecast in likely)[len(likely) // 2]
        winner = min(
            likely,
            key=lambda forecast: (
                _expected_value(forecast.figures.ms, miss_ms, forecast.miss_chance(max_ms)),
                forecast.figures.name,
            ),
        )
        return RankingResult(winner.figures, True, None)
    in_time = [
        forecast
        for forecast in candidates
        if max_ms is not None and forecast.late_chance(max_ms) <= MAX_MISS_CHANCE_OF_LIKELY_OPTION
    ]
    if not in_time:
        return best_candidate([forecast.figures for forecast in candidates], max_error, max_ms)
    over = {forecast.figures.name: relative_overshoot(forecast.figures, max_error) for forecast in in_time}
    missed = MISS_PENALTY * sorted(over.values())[len(over) // 2]
    nearest = min(
        in_time,
        key=lambda forecast: (
            _expected_value(over[forecast.figures.name], missed, forecast.late_chance(max_ms)),
            forecast.figures.ms,
        ),
    )
    return best_candidate([nearest.figures], max_error, max_ms)


def _expected_value(loss: float, missed: float, chance: float) -> float:
    """Return the expected value of a loss that is ``missed`` with the probability ``chance``, in [0, 1], and ``loss`` otherwise."""
    return (1.0 - chance) * loss + chance * missed
