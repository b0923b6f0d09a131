"""The policies ``probe`` and ``measure``: draw the most promising candidates on the scene, and compare them with ground truth.

Models predict times and errors only roughly. Most of their deviation is common to all candidates of a scene. So an observation of
one candidate corrects the predictions of all (``skugga.selector.options``).

- The fastest candidate that is likely to meet the target (the limits of error and time) is drawn first. It takes the least time,
  and corrects what is expected of slower and safer ones.
- The leader is the candidate with the least expected loss. It is drawn next. Ground truth is computed at more and more points,
  until it is certain whether the leader meets the target. Then another candidate may lead, which is drawn next.
- When the leader has been drawn and decided, other candidates are drawn as long as their expected gain exceeds ``MIN_SAVING``.
- A probe ends if no candidate has such a gain, or when its time is spent. ``measure`` is a probe without a time limit.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from math import erf, exp, log, sqrt
from typing import Protocol

from skugga.selector.cost.error_model import log_error, log_interior
from skugga.selector.expected_loss import MAX_MISS_CHANCE_OF_LIKELY_OPTION, least_expected_loss
from skugga.selector.gaussian_estimate import GaussianEstimate
from skugga.selector.observation import Observation
from skugga.selector.options import LightOptions
from skugga.selector.ranking import relative_overshoot
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE

MIN_SAVING = 0.01
"""Minimum expected gain of a candidate that is drawn next.

It is a share of the leader's time, or of the leader's error if the leader misses the target.
"""

MIN_SAVING_UNLIMITED = 0.002
"""Minimum expected gain, as ``MIN_SAVING``, for probes without a time limit."""

TIME_NOISE = 0.12
"""Standard deviation of the logarithm of a time that a probe measures.

In 77 views of ``benchmarks/selection`` the logarithms of times of probes were compared with times measured in another hour. They
differ by 0.09 within a view, and by 0.14 overall.
"""

INTERVAL_Z = 1.96
"""Number of standard errors from a share to the limits of its 95 % interval."""

DECISION_Z, MIN_NOISE = 2.58, 1e-9
"""Minimum distance of an error from its limit, in standard errors, of a decided comparison (confidence 99 %).

``MIN_NOISE`` is a lower bound of the standard error.
"""


@dataclass(frozen=True)
class ErrorMeasurement:
    """Errors of a picture against ground truth at sample points, with 95 % confidence intervals.

    Attributes
    ----------
    error
        The error that is compared with the requested limit ``max_error``, in [0, 1].
    low
        Lower limit of the interval of ``error``.
    high
        Upper limit of the interval of ``error``.
    interior
        Share of points that are wrong far from shadow edges, in [0, 1].
    interior_low
        Lower limit of the interval of ``interior``.
    interior_high
        Upper limit of the interval of ``interior``.
    points
        Number of sample points in cast shadow. If ``error`` is a difference of coverage, the number of blocks of pixels.
    """

    error: float
    low: float
    high: float
    interior: float
    interior_low: float
    interior_high: float
    points: int

    def decides(self, max_error: float) -> bool:
        """Return whether the sample points suffice to tell if the errors stay within ``max_error`` and ``MAX_INTERIOR_SHARE``."""
        over = (log_error(self.error) - log_error(max_error)) / max(self._error_noise, MIN_NOISE)
        inside_over = (log_interior(self.interior) - log_interior(MAX_INTERIOR_SHARE)) / max(self._interior_noise, MIN_NOISE)
        return max(over, inside_over) < -DECISION_Z or over > DECISION_Z or inside_over > DECISION_Z

    @property
    def _error_noise(self) -> float:
        """Standard deviation of the logarithm of ``error`` (``log_error``), from its interval."""
        return (log_error(self.high) - log_error(self.low)) / (2.0 * INTERVAL_Z)

    @property
    def _interior_noise(self) -> float:
        """Standard deviation of the logarithm of ``interior`` (``log_interior``), from its interval."""
        return (log_interior(self.interior_high) - log_interior(self.interior_low)) / (2.0 * INTERVAL_Z)

    def to_observation(self, choice: str, ms: float) -> Observation:
        """Convert this to an observation of the choice named ``choice``, which took ``ms`` milliseconds."""
        return Observation(
            choice=choice, error=self.error, error_noise=self._error_noise, interior=self.interior,
            interior_noise=self._interior_noise, ms=ms, ms_noise=TIME_NOISE,
        )  # fmt: skip


class OptionProber(Protocol):
    """Draws the options (choices of algorithms and settings) for a light, and compares them with truth at sample points.

    Options are identified by their indices in ``LightOptions.options``.
    """

    def elapsed_s(self) -> float:
        """Return the seconds since the start of the probe."""

    def draw(self, option_index: int) -> float | None:
        """Draw an option and return its time in milliseconds; ``None`` if its algorithm cannot draw the view."""

    def draw_s(self, option_index: int, ms: float) -> float:
        """Return the expected seconds to draw an option of which one drawing takes ``ms`` milliseconds."""

    def measurement(self, option_index: int) -> ErrorMeasurement:
        """Return the errors of a drawn option against truth, at all sample points that were requested so far."""

    def add_points_s(self) -> float | None:
        """Return the expected seconds to compute truth at more points; ``None`` if it is known at all points."""

    def add_points(self) -> None:
        """Request truth at more sample points for the following measurements."""


@dataclass(frozen=True, eq=False)
class LightProbe:
    """Result of a probe (a test of the options for one light on the scene).

    Attributes
    ----------
    options
        The options, with predictions corrected by the observations.
    drawn
        Milliseconds and error measurement of each drawn option by its number, in the order of drawing.
    initial_leader
        Number of the best option before the probe.
    seconds
        Duration of the probe.
    confirmed
        Whether the probe ended because no other option promised a gain, and not because of its time limit.
    """

    options: LightOptions
    drawn: dict[int, tuple[float, ErrorMeasurement]]
    initial_leader: int
    seconds: float
    confirmed: bool


def probe_options(
    prior: LightOptions,
    prober: OptionProber,
    max_error: float,
    max_ms: float | None = None,
    budget_s: float | None = None,
    on_step: Callable[[int], None] = lambda drawn: None,
) -> LightProbe:
    """Draw the most promising options for a light, compare them with truth, and return the corrected options.

    ``prior`` holds the options with their predictions. ``max_error`` and ``max_ms`` are the limits of error and time. ``budget_s``
    is the time limit of the probe in seconds; ``None`` means no limit. At least one option is drawn, whatever the limit.
    ``on_step(drawn)`` is called after each drawing, with the number of drawn options. If algorithms refuse to draw all options,
    none remains in the result. ``prober`` draws the options and measures their errors.
    """
    drawn_ms: dict[int, float] = {}
    measurements: dict[int, ErrorMeasurement] = {}
    measured_stage: dict[int, int] = {}
    stage = 0  # how often points were added
    least_gain = MIN_SAVING if budget_s is not None else MIN_SAVING_UNLIMITED
    initial_leader = leader_of(prior, max_error, max_ms)

    def has_time(seconds: float) -> bool:
        return budget_s is None or not drawn_ms or prober.elapsed_s() + seconds <= budget_s

    while True:
        posterior = prior.with_observations(
            measurement.to_observation(prior.options[option_index].choice.name, drawn_ms[option_index])
            for option_index, measurement in measurements.items()
        )
        leader = leader_of(posterior, max_error, max_ms) if posterior.numbers else None
        add_points_s = prober.add_points_s() if drawn_ms else None
        undecided = {
            option_index
            for option_index, measurement in measurements.items()
            if (add_points_s is not None or measured_stage[option_index] < stage) and not measurement.decides(max_error)
        }
        if leader in measurements:
            gains = _gains(posterior, leader, (set(posterior.numbers) - set(drawn_ms)) | undecided, max_error, max_ms)
            next_option = leader if leader in undecided else _largest_gain(gains, least_gain)
        else:
            next_option = leader
            if (
                leader is not None
                and add_points_s is not None
                and add_points_s < prober.draw_s(leader, posterior.figures(leader).ms)
            ):
                best_undecided = _largest_gain(_gains(posterior, leader, undecided, max_error, max_ms), least_gain)
                next_option = leader if best_undecided is None else best_undecided
        if not drawn_ms and leader is not None:
            next_option = _fastest_likely(posterior, leader, max_error, max_ms)
        step_s = 0.0 if next_option is None else prober.draw_s(next_option, posterior.figures(next_option).ms)
        if next_option is not None and next_option in drawn_ms:
            step_s = (add_points_s or 0.0) if measured_stage[next_option] == stage else 0.0
        if next_option is None or not has_time(step_s):
            drawn = {option_index: (ms, measurements[option_index]) for option_index, ms in drawn_ms.items()}
            return LightProbe(posterior, drawn, initial_leader, prober.elapsed_s(), leader in measurements and next_option is None)
        if next_option in drawn_ms:
            if measured_stage[next_option] == stage:
                prober.add_points()
                stage += 1
        else:
            ms = prober.draw(next_option)
            if ms is None:
                prior = replace(prior, refused=prior.refused | {next_option})
                continue
            drawn_ms[next_option] = ms
            on_step(len(drawn_ms))
        # Other drawn options keep what fewer points have shown: to compare all of them again would take time from the next step.
        measurements[next_option], measured_stage[next_option] = prober.measurement(next_option), stage


def leader_of(options: LightOptions, max_error: float, max_ms: float | None) -> int:
    """Return the number of the option with the least expected loss: its index in ``LightOptions.options``.

    ``max_error`` and ``max_ms`` are the limits of error, in [0, 1], and of time, milliseconds; ``None`` is no time limit.
    """
    return options.number(least_expected_loss(options.forecasts(max_error), max_error, max_ms).winner.name)


def _fastest_likely(options: LightOptions, leader: int, max_error: float, max_ms: float | None) -> int:
    """Return the number of the fastest option that is likely to meet the target; ``leader`` if none is.

    ``max_error``, in [0, 1], and ``max_ms``, milliseconds, are the limits of error and time; ``None`` is no time limit.
    """
    likely = [
        option_index
        for option_index in options.numbers
        if options.options[option_index].choice.name != NO_SHADOWS
        and options.forecast(option_index, max_error).miss_chance(max_ms) <= MAX_MISS_CHANCE_OF_LIKELY_OPTION
    ]
    return min(likely, key=lambda option_index: options.figures(option_index).ms, default=leader)


def _gains(
    options: LightOptions, leader: int, option_numbers: Collection[int], max_error: float, max_ms: float | None
) -> dict[int, float]:
    """Return the expected gains over the leader (``expected_gain``) of options by number.

    ``option_numbers`` are their numbers.
    """
    return {
        option_index: expected_gain(options, option_index, leader, max_error, max_ms)
        for option_index in sorted(option_numbers)
        if option_index != leader
    }


def _largest_gain(gains: Mapping[int, float], least_gain: float) -> int | None:
    """Return the number of the option with the largest gain; ``None`` if that is at most ``least_gain``.

    Of several options with the same gain it is the first one.
    """
    best = max(gains, key=lambda option_index: (gains[option_index], -option_index), default=None)
    return best if best is not None and gains[best] > least_gain else None


def expected_gain(options: LightOptions, option_index: int, leader: int, max_error: float, max_ms: float | None) -> float:
    """Return the expected gain of option ``option_index`` over the leader, the best option so far, in [0, 1].

    The gain is the share of the leader's time that the option saves. If the leader misses the target, it is the share of the
    leader's error. A result that is worse than the leader's counts as 0, because the leader remains the choice then.
    """
    candidate, leader_forecast = (options.forecast(number, max_error) for number in (option_index, leader))
    meets = 1.0 - candidate.miss_chance(max_ms)
    if leader_forecast.miss_chance(max_ms) <= MAX_MISS_CHANCE_OF_LIKELY_OPTION:
        return meets * _expected_saving(options.time, option_index, log(max(leader_forecast.figures.ms, 1e-9)))
    # If the leader misses the target, to meet it counts as a gain of 1. Otherwise the gain is the reduction of the error.
    in_time = 1.0 - candidate.late_chance(max_ms)
    over = relative_overshoot(leader_forecast.figures, max_error, max_ms)
    nearer = _expected_saving(options.error, option_index, log_error(leader_forecast.figures.error)) if over > 0.0 else 0.0
    return max(meets, in_time * nearer)


def _expected_saving(estimate: GaussianEstimate, option_index: int, than_log: float) -> float:
    """Return the expected relative saving of a log-normal value against a known value, whose logarithm is ``than_log``.

    The log-normal value is the error or the time, of which ``estimate`` is the distribution, of candidate ``option_index``. A
    larger value counts as a saving of 0. The formula is that of a put option's price (F. Black and M. Scholes, 1973).
    """
    mean, sd = float(estimate.mean[option_index]) - than_log, sqrt(max(float(estimate.covariance[option_index, option_index]), 0.0))
    if sd == 0.0:
        return max(1.0 - exp(min(mean, 0.0)), 0.0)
    return _normal_below(-mean / sd) - exp(min(mean + sd * sd / 2.0, 50.0)) * _normal_below(-mean / sd - sd)


def _normal_below(z: float) -> float:
    """Return the probability, in [0, 1], that a standard normal variable is below ``z``."""
    return 0.5 * (1.0 + erf(z / sqrt(2.0)))
