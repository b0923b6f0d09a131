"""The policies ``probe`` and ``measure``: draw leading candidates on the scene and compare them with truth until one is confirmed.

Models know a scene only roughly, and most of their error is common to all candidates of a scene. So one observation corrects the
expectations of every candidate (``skugga.selector.options``).

- The leader, the candidate with the least expected loss, is drawn first. Truth is computed at more and more points until it decides
  whether the leader meets the target. Then the new leader is drawn, and so on.
- After the leader is confirmed, other candidates are drawn as long as their expected gain exceeds ``LEAST_SAVING``.
- A probe ends without such a candidate, or when its time is spent. ``measure`` is a probe without a time limit.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from math import erf, exp, log, sqrt
from typing import Protocol

from skugga.selector.belief import Belief
from skugga.selector.cost.error_model import log_error, log_interior
from skugga.selector.expected_loss import LIKELY_MISS_CHANCE, least_expected_loss
from skugga.selector.options import LightOptions
from skugga.selector.ranking import relative_overshoot
from skugga.selector.seen import Seen
from skugga.shadows.truth.metrics import MOST_INTERIOR

LEAST_SAVING = 0.03
"""Expected gain, at least, of a candidate that is drawn: a share of the leader's time, or of its error if it misses the target."""

LEAST_SAVING_UNLIMITED = 0.002
"""The same without a time limit."""

TIME_NOISE = 0.12
"""Standard deviation of the logarithm of a time that a probe measures.

In 77 views of ``benchmarks/selection`` the times of probes differ from those of rows measured in another hour by 0.09 within a view
and by 0.14 overall.
"""

SURE_Z = 1.96
"""Standard errors between a share and the limits of its 95 % interval."""

PLAIN_Z, LEAST_NOISE = 2.58, 1e-9
"""Standard errors between an error and its limit, at least, of a decided verdict (99 in 100 cases), and the least standard error.
"""


@dataclass(frozen=True)
class Proof:
    """Errors of a picture according to truth at points, with 95 % intervals.

    Attributes
    ----------
    error
        The error that targets limit, in [0, 1].
    low
        Lower limit of its interval.
    high
        Upper limit of its interval.
    interior
        Interior error, in [0, 1].
    interior_low
        Lower limit of its interval.
    interior_high
        Upper limit of its interval.
    points
        Number of points in cast shadow, or of blocks if coverage counts.
    """

    error: float
    low: float
    high: float
    interior: float
    interior_low: float
    interior_high: float
    points: int

    def decides(self, max_error: float) -> bool:
        """Return whether it is decided that a picture stays within ``max_error`` and ``MOST_INTERIOR``, or that it does not."""
        over = (log_error(self.error) - log_error(max_error)) / max(self._error_noise, LEAST_NOISE)
        inside_over = (log_interior(self.interior) - log_interior(MOST_INTERIOR)) / max(self._interior_noise, LEAST_NOISE)
        return max(over, inside_over) < -PLAIN_Z or over > PLAIN_Z or inside_over > PLAIN_Z

    @property
    def _error_noise(self) -> float:
        return (log_error(self.high) - log_error(self.low)) / (2.0 * SURE_Z)

    @property
    def _interior_noise(self) -> float:
        return (log_interior(self.interior_high) - log_interior(self.interior_low)) / (2.0 * SURE_Z)

    def seen(self, choice: str, ms: float) -> Seen:
        """Return this as an observation of a choice that took ``ms`` milliseconds."""
        return Seen(
            choice=choice, error=self.error, error_noise=self._error_noise, interior=self.interior,
            interior_noise=self._interior_noise, ms=ms, ms_noise=TIME_NOISE,
        )  # fmt: skip


class Prover(Protocol):
    """Draws a light's options, by number, and compares them with truth at points."""

    def elapsed_s(self) -> float:
        """Return the seconds since the start."""

    def draw(self, which: int) -> float | None:
        """Draw an option and return its milliseconds; ``None`` if its algorithm refuses the view."""

    def draw_s(self, ms: float) -> float:
        """Return the expected seconds to draw an option that takes ``ms`` milliseconds."""

    def proof(self, which: int) -> Proof:
        """Return the errors of a drawn option according to truth at the points so far."""

    def more_points_s(self) -> float | None:
        """Return the expected seconds to compute truth at more points; ``None`` if it is known at all points."""

    def more_points(self) -> None:
        """Request truth at more points."""


@dataclass(frozen=True, eq=False)
class LightProbe:
    """Result of a probe of a light.

    Attributes
    ----------
    options
        The options, corrected by the observations.
    drawn
        Milliseconds and proofs of the drawn options by number, in order.
    leader_before
        Number of the leader before the probe.
    seconds
        Time of the probe.
    confirmed
        Whether the probe ended because no candidate promised more, not because of its time limit.
    """

    options: LightOptions
    drawn: dict[int, tuple[float, Proof]]
    leader_before: int
    seconds: float
    confirmed: bool


def probed(
    prior: LightOptions,
    prover: Prover,
    max_error: float,
    max_ms: float | None = None,
    budget_s: float | None = None,
    on_step: Callable[[int], None] = lambda drawn: None,
) -> LightProbe:
    """Probe the options of a light.

    At least one option is drawn, even without time. ``on_step(drawn)`` is called after each. No choice remains if the algorithms
    refuse all options.
    """
    drawn_ms: dict[int, float] = {}
    least_gain = LEAST_SAVING if budget_s is not None else LEAST_SAVING_UNLIMITED
    leader_before = leader_of(prior, max_error, max_ms)

    def has_time(seconds: float) -> bool:
        return budget_s is None or not drawn_ms or prover.elapsed_s() + seconds <= budget_s

    while True:
        proofs = {which: prover.proof(which) for which in drawn_ms}
        now = prior.after(proof.seen(prior.options[which].choice.name, drawn_ms[which]) for which, proof in proofs.items())
        leader = leader_of(now, max_error, max_ms) if now.numbers else None
        more_s = prover.more_points_s() if drawn_ms else None
        open_ones = {which for which, proof in proofs.items() if more_s is not None and not proof.decides(max_error)}
        if leader in proofs:
            gains = _gains(now, leader, (set(now.numbers) - set(drawn_ms)) | open_ones, max_error, max_ms)
            following = leader if leader in open_ones else _most(gains, least_gain)
        else:
            following = leader
            if leader is not None and more_s is not None and more_s < prover.draw_s(now.figures(leader).ms):
                opened = _most(_gains(now, leader, open_ones, max_error, max_ms), least_gain)
                following = leader if opened is None else opened
        step_s = 0.0 if following is None else prover.draw_s(now.figures(following).ms)
        if following is not None and following in drawn_ms:
            assert more_s is not None
            step_s = more_s
        if following is None or not has_time(step_s):
            drawn = {which: (ms, proofs[which]) for which, ms in drawn_ms.items()}
            return LightProbe(now, drawn, leader_before, prover.elapsed_s(), leader in proofs and following is None)
        if following in drawn_ms:
            prover.more_points()
            continue
        ms = prover.draw(following)
        if ms is None:
            prior = replace(prior, refused=prior.refused | {following})
        else:
            drawn_ms[following] = ms
            on_step(len(drawn_ms))


def leader_of(options: LightOptions, max_error: float, max_ms: float | None) -> int:
    """Return the number of the option with the least expected loss."""
    return options.number(least_expected_loss(options.forecasts(max_error), max_error, max_ms).winner.name)


def _gains(options: LightOptions, leader: int, others: Collection[int], max_error: float, max_ms: float | None) -> dict[int, float]:
    """Return the expected gains of other options over the leader."""
    return {which: expected_gain(options, which, leader, max_error, max_ms) for which in sorted(others) if which != leader}


def _most(gains: Mapping[int, float], least_gain: float) -> int | None:
    """Return the option with the largest gain, if it exceeds ``least_gain``. Of equal gains the first option counts."""
    best = max(gains, key=lambda which: (gains[which], -which), default=None)
    return best if best is not None and gains[best] > least_gain else None


def expected_gain(options: LightOptions, which: int, leader: int, max_error: float, max_ms: float | None) -> float:
    """Return the expected gain of an option over the leader.

    The gain is a share of the leader's time, or of its error if the leader misses the target. A worse result counts as a gain of 0,
    because the leader is kept then.
    """
    its, first = (options.forecast(number, max_error) for number in (which, leader))
    meets = 1.0 - its.miss_chance(max_ms)
    if first.miss_chance(max_ms) <= LIKELY_MISS_CHANCE:
        return meets * _expected_saving(options.time, which, log(max(first.figures.ms, 1e-9)))
    # An option that meets a target which the leader misses has the largest gain; otherwise the smaller error counts.
    in_time = 1.0 - its.late_chance(max_ms)
    over = relative_overshoot(first.figures, max_error, max_ms)
    nearer = _expected_saving(options.error, which, log_error(first.figures.error)) if over > 0.0 else 0.0
    return max(meets, in_time * nearer)


def _expected_saving(belief: Belief, which: int, than_log: float) -> float:
    """Return the expected relative saving of a log-normal value against another one, whose logarithm is ``than_log``.

    A larger value saves 0. The formula is that of a put option's price (F. Black and M. Scholes, 1973).
    """
    mean, sd = float(belief.mean[which]) - than_log, sqrt(max(float(belief.covariance[which, which]), 0.0))
    if sd == 0.0:
        return max(1.0 - exp(min(mean, 0.0)), 0.0)
    return _normal_below(-mean / sd) - exp(min(mean + sd * sd / 2.0, 50.0)) * _normal_below(-mean / sd - sd)


def _normal_below(z: float) -> float:
    return 0.5 * (1.0 + erf(z / sqrt(2.0)))
