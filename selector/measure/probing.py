"""The policies ``probe`` and ``measure``: the leading candidates drawn on the scene and held against truth at points, until one is
confirmed.

Models know a scene from afar, and much of what they are off by is common to all that could be drawn of it. So one look at the
scene corrects what is expected of every candidate (``skugga.selector.options``). Who leads is drawn; truth is asked for at more and
more points until it is plain whether it keeps to the target; whoever leads then is drawn, and so on. When the leader is confirmed,
others are tried as long as they promise to be better by more than ``LEAST_SAVING``. A probe ends when nothing does, or when its
time is spent: more time, better choices. ``measure`` is a probe without a limit of time.
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
"""Share of the leader's time (of its error, where it misses the target) by which a candidate must promise to be better before it is
drawn ..."""

LEAST_SAVING_UNLIMITED = 0.002
"""... and where there is no limit of time."""

TIME_NOISE = 0.12
"""The standard deviation of the logarithm of a time that was measured in a probe: of 77 views of ``benchmarks/selection`` the times
of probes and those of rows, of another hour, differ by 0.09 within a view and by 0.14 in all.
"""

SURE_Z = 1.96
"""Standard errors between a share and the limits of its interval."""

PLAIN_Z, LEAST_NOISE = 2.58, 1e-9
"""A verdict is plain from so many standard errors on (99 in 100 cases)."""


@dataclass(frozen=True)
class Proof:
    """What truth at points says of a picture: its error as targets count it, and what is wrong inside, each with the limits between
    which it lies in 95 of 100 cases; on how many points in cast shadow that was seen.
    """

    error: float
    low: float
    high: float
    interior: float
    interior_low: float
    interior_high: float
    points: int

    def decides(self, max_error: float) -> bool:
        """Whether it is plain that a picture keeps to an error and to ``MOST_INTERIOR``, or that it does not."""
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
        """The same of a choice, with the milliseconds that it took."""
        return Seen(
            choice=choice, error=self.error, error_noise=self._error_noise, interior=self.interior,
            interior_noise=self._interior_noise, ms=ms, ms_noise=TIME_NOISE,
        )  # fmt: skip


class Prover(Protocol):
    """Draws a light's options, by number, and holds them against truth at points."""

    def elapsed_s(self) -> float:
        """Seconds since it began."""

    def draw(self, which: int) -> float | None:
        """Draw an option; its milliseconds. ``None`` where its algorithm refuses the view after all."""

    def draw_s(self, ms: float) -> float:
        """How long it takes to draw what takes so many milliseconds, seconds."""

    def proof(self, which: int) -> Proof:
        """What truth at the points so far says of an option that was drawn."""

    def more_points_s(self) -> float | None:
        """How long it would take to ask truth at more points; ``None`` where all of them are known."""

    def more_points(self) -> None:
        """Ask truth at more points."""


@dataclass(frozen=True, eq=False)
class LightProbe:
    """What a probe of a light came to: what is believed now, milliseconds and proofs of the options drawn, in order, who would have
    been taken without it, and how long it took. ``confirmed``: it ended because nothing promised more, not for want of time.
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
    """Probe the options of a light. At least one is drawn, whatever the time; ``on_step(drawn)`` is called after each. Where all of
    them are refused nothing is left to choose.
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
    """Who would be taken by what is believed."""
    return options.number(least_expected_loss(options.forecasts(max_error), max_error, max_ms).winner.name)


def _gains(options: LightOptions, leader: int, others: Collection[int], max_error: float, max_ms: float | None) -> dict[int, float]:
    """By how much others promise to be better than a leader."""
    return {which: expected_gain(options, which, leader, max_error, max_ms) for which in sorted(others) if which != leader}


def _most(gains: Mapping[int, float], least_gain: float) -> int | None:
    """Who promises most, if that is enough; of equal ones the first."""
    best = max(gains, key=lambda which: (gains[which], -which), default=None)
    return best if best is not None and gains[best] > least_gain else None


def expected_gain(options: LightOptions, which: int, leader: int, max_error: float, max_ms: float | None) -> float:
    """By which share of the leader's time, or of its error where it misses the target, an option is expected to be better: of that
    which would then be taken, 0 where it is worse.
    """
    its, first = (options.forecast(number, max_error) for number in (which, leader))
    meets = 1.0 - its.miss_chance(max_ms)
    if first.miss_chance(max_ms) <= LIKELY_MISS_CHANCE:
        return meets * _expected_saving(options.time, which, log(max(first.figures.ms, 1e-9)))
    # What meets a target that the leader misses is worth more than anything else; else the smaller error is.
    in_time = 1.0 - its.late_chance(max_ms)
    over = relative_overshoot(first.figures, max_error, max_ms)
    nearer = _expected_saving(options.error, which, log_error(first.figures.error)) if over > 0.0 else 0.0
    return max(meets, in_time * nearer)


def _expected_saving(belief: Belief, which: int, than_log: float) -> float:
    """The expected share by which a value is less than another one, given by its logarithm; 0 where it is more: of a log-normal
    distribution (as the price of a put option by F. Black and M. Scholes, 1973).
    """
    mean, sd = float(belief.mean[which]) - than_log, sqrt(max(float(belief.covariance[which, which]), 0.0))
    if sd == 0.0:
        return max(1.0 - exp(min(mean, 0.0)), 0.0)
    return _normal_below(-mean / sd) - exp(min(mean + sd * sd / 2.0, 50.0)) * _normal_below(-mean / sd - sd)


def _normal_below(z: float) -> float:
    return 0.5 * (1.0 + erf(z / sqrt(2.0)))
