"""Scores of choices: losses, regret, and the closed share of the gap between single best and virtual best.

A row is a measured plan of a view. An instance is a view under a light with a target. The single best is the one choice with the
least mean loss over all views. The virtual best is the row with the least loss in each instance.

The loss of a row that meets the target is its milliseconds. Otherwise it is ten times the milliseconds of the slowest row that
meets the target. If no row meets the target, the loss is the overshoot. Losses are multiples of the virtual best's, so that a view
that takes seconds has the same weight as one that takes milliseconds. In strict scores a miss costs ten times the view's slowest
row instead, whichever rows meet the target (PAR10 with a fixed cutoff).

A target below ``NOISE_FLOORS`` times the error of truth's own sub-samples cannot be distinguished from a somewhat larger one. Such
instances are a class of their own (``is_decidable``), which counts neither in met targets nor in regret.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE

PAR_FACTOR = 10.0
"""Penalty of a missed target, as a multiple of the time of the slowest row that meets it."""

NOISE_FLOORS = 3.0
"""The smallest decidable target, as a multiple of truth's own noise."""

MIN_GAP = 0.10
"""Gap (difference of mean losses) between single best and virtual best up to which its closed share is not reported."""

WORST_COUNT = 5
"""The number of worst choices in the report."""

Figures = dict[str, Any]
"""A measured view's record, or a row (measured plan) of it, by key."""


@dataclass(frozen=True)
class Goal:
    """A target: the largest error (a share in [0, 1]) and, optionally, a limit of time.

    The limit ``time_share`` is a share of the way from the quickest to the slowest row of a view (measured plan), in logarithms of
    milliseconds. ``None`` is no limit.
    """

    name: str
    max_error: float
    time_share: float | None = None


GOALS = (
    Goal("10 %", 0.10), Goal("3 %", 0.03), Goal("1 %", 0.01), Goal("0.3 %", 0.003), Goal("most accurate in time", 1e-4, 0.4),
)  # fmt: skip
"""All targets of the evaluation, by decreasing error."""


@dataclass(frozen=True, eq=False)
class GoalInstance:
    """A measured view (``view``: its record) with a goal. ``max_ms`` is the limit of time in milliseconds; ``None`` for no limit.

    Names of rows (measured plans) describe their steps.
    """

    view: Figures
    goal: Goal
    max_ms: float | None

    @property
    def rows(self) -> dict[str, Figures]:
        """The view's measured plans by name."""
        return self.view["rows"]

    def error(self, name: str) -> float:
        """Return the error of a row that the view's targets limit, a share in [0, 1]."""
        return self.rows[name][self.view["error"]]

    @property
    def is_decidable(self) -> bool:
        """Whether the noise of truth is small enough to decide which rows meet the largest error."""
        return self.goal.max_error >= NOISE_FLOORS * self.view["noise_floor"]

    @property
    def can_be_met(self) -> bool:
        """Whether any row meets the target."""
        return any(map(self.meets, self.rows))

    def meets(self, name: str) -> bool:
        """Return whether a row meets both limits: the error (or the smallest decidable error) and the time."""
        max_error = max(self.goal.max_error, NOISE_FLOORS * self.view["noise_floor"])
        row = self.rows[name]
        return (
            self.error(name) <= max_error
            and row["interior"] <= MAX_INTERIOR_SHARE
            and (self.max_ms is None or row["ms"] <= self.max_ms)
        )

    def losses(self, strict: bool = False) -> dict[str, float]:
        """Return the loss of every row by its name, as a multiple of the least loss.

        ``strict`` uses the fixed cutoff of strict scores.
        """
        met = {name: row["ms"] for name, row in self.rows.items() if self.meets(name)}
        if met:
            cutoff = max(row["ms"] for row in self.rows.values()) if strict else max(met.values())
            loss_by_row = {name: met.get(name, PAR_FACTOR * cutoff) for name in self.rows}
        else:
            over = {name: self._overshoot(name) for name in self.rows}
            timely = {name: over[name] for name, row in self.rows.items() if self.max_ms is None or row["ms"] <= self.max_ms}
            loss_by_row = {name: timely.get(name, PAR_FACTOR * max(timely.values())) for name in self.rows} if timely else over
        min_loss = max(min(loss_by_row.values()), 1e-12)
        return {name: value / min_loss for name, value in loss_by_row.items()}

    @property
    def cheapest(self) -> str | None:
        """Name of the quickest row that meets the target; ``None`` if no row does."""
        return min(filter(self.meets, self.rows), key=lambda name: self.rows[name]["ms"], default=None)

    def share_of_best(self, ms: float) -> float:
        """Return ``ms`` as a multiple of the time of the quickest row that meets the target; 0 if no row does."""
        return ms / self.rows[self.cheapest]["ms"] if self.cheapest is not None else 0.0

    def _overshoot(self, name: str) -> float:
        """Return the largest ratio of a row's error, interior error or time to its limit; at least 0.001."""
        row = self.rows[name]
        late = 0.0 if self.max_ms is None else row["ms"] / self.max_ms
        return max(self.error(name) / self.goal.max_error, row["interior"] / MAX_INTERIOR_SHARE, late, 1e-3)


def instances_of(views: Iterable[Figures], goals: Sequence[Goal] = GOALS) -> list[GoalInstance]:
    """Return every view with every goal. Views with fewer than two rows are omitted, because they offer no choice."""
    result = []
    for view in views:
        ms = [row["ms"] for row in view["rows"].values()]
        for goal in goals if len(ms) > 1 else ():
            limit = (
                None if goal.time_share is None else float(f"{min(ms) ** (1 - goal.time_share) * max(ms) ** goal.time_share:.3g}")
            )
            result.append(GoalInstance(view, goal, limit))
    return result


@dataclass(frozen=True)
class PolicyScore:
    """Scores of a policy: means over some instances, as the page shows them.

    A regret is a loss minus the least loss of the instance, in multiples of the least loss.
    """

    instances: int
    """Number of instances."""
    met: float
    """Share of the instances with a feasible target in which the policy's row meets it."""
    met_interval: tuple[float, float]
    """The 95 % interval of ``met`` over resampled terrains."""
    regret: float
    """Mean regret."""
    regret_interval: tuple[float, float]
    """The 95 % interval of ``regret`` over resampled terrains."""
    regret_median: float
    regret_p95: float
    regret_met: float
    """The mean regret of the choices that met their target."""
    needless_interior_error_share: float
    """Share of instances in which the chosen row has an interior error above ``MAX_INTERIOR_SHARE``, although another row met the
    target without one."""
    single: float
    """Mean loss of the single best."""
    single_met: float
    """Share of the instances with a feasible target that the single best meets."""
    gap_closed: float | None
    """Share of the gap between single best and virtual best that the policy closes, at most 1. ``None`` if the gap is at most
    ``MIN_GAP``."""
    worst: list[tuple[str, str, str, float]]
    """View, goal, chosen row and regret of the worst choices."""


def score_choices(
    instances: Sequence[GoalInstance],
    choices: Mapping[tuple[str, str], str],
    single: Mapping[tuple[str, str], str],
    own_ms: Callable[[GoalInstance], float] = lambda instance: 0.0,
    strict: bool = False,
) -> PolicyScore:
    """Score the rows that a policy chose, and compare them with the one choice that is best over all views.

    ``choices`` and ``single`` hold the name of the chosen row (measured plan) by names of view and goal. ``own_ms`` returns the
    milliseconds that the policy takes to choose. With ``strict`` a miss costs ten times the slowest row of the view, whichever rows
    meet the target.
    """
    losses = [instance.losses(strict) for instance in instances]
    keys = [(instance.view["name"], instance.goal.name) for instance in instances]
    selection_losses = [instance.share_of_best(own_ms(instance)) for instance in instances]
    policy_losses = np.array([loss[choices[key]] for loss, key in zip(losses, keys, strict=True)]) + selection_losses
    best = np.array([loss[single[key]] for loss, key in zip(losses, keys, strict=True)])
    can = np.array([instance.can_be_met for instance in instances])
    met = np.array([instance.meets(choices[key]) for instance, key in zip(instances, keys, strict=True)])
    single_met = np.array([instance.meets(single[key]) for instance, key in zip(instances, keys, strict=True)])
    dirty = [
        able and instance.rows[choices[key]]["interior"] > MAX_INTERIOR_SHARE
        for instance, key, able in zip(instances, keys, can, strict=True)
    ]
    regret, gap = policy_losses - 1.0, float(best.mean() - 1.0)
    worst = sorted(zip(regret, keys, strict=True), reverse=True)[:WORST_COUNT]
    terrain = np.array([instance.view["terrain"] for instance in instances])
    return PolicyScore(
        len(instances), _mean(met[can]), _interval(met[can], terrain[can]), _mean(regret), _interval(regret, terrain),
        float(np.median(regret)), float(np.quantile(regret, 0.95)), _mean(regret[met]), float(np.mean(dirty)), _mean(best),
        _mean(single_met[can]), None if gap <= MIN_GAP else float((best.mean() - policy_losses.mean()) / gap),
        [(view, goal, choices[view, goal], float(one_regret)) for one_regret, (view, goal) in worst],
    )  # fmt: skip


BOOTSTRAP_DRAWS = 2000
"""The number of bootstrap draws of terrains for intervals."""


def _interval(values: np.ndarray, terrain: np.ndarray) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the mean of ``values`` (n,). ``terrain`` (n,) has the name of each value's terrain.

    Each draw takes as many terrains as there are, with repetition. Views of one terrain are not independent (B. Efron, Bootstrap
    methods: another look at the jackknife, 1979).
    """
    names = np.unique(terrain)
    if not len(names):
        return 0.0, 0.0
    sums = np.array([values[terrain == name].sum() for name in names], np.float64)
    counts = np.array([(terrain == name).sum() for name in names], np.float64)
    draws = np.random.default_rng(0).integers(0, len(names), (BOOTSTRAP_DRAWS, len(names)))
    means = sums[draws].sum(axis=1) / counts[draws].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def _mean(values: np.ndarray) -> float:
    """Return the mean of values; 0 without any."""
    return float(values.mean()) if values.size else 0.0


def equivalent_row(choice: str, view: Figures) -> str | None:
    """Return the name of the row that a choice amounts to in a view; ``None`` if no row does.

    Options of the choice that do not apply in the view are dropped: cascades, map sizes, or a sweep of level ground.
    """
    company, *settings = choice.split()
    swept = next((name for name, row in view["rows"].items() if row["algorithms"] == ["sweep"]), None)
    if company.startswith("sweep") and choice not in view["picks"] and swept is not None:
        return swept  # only relief casts here: the other options of the choice have no effect
    single_algorithm = company.removeprefix("sweep+").removeprefix("shadow_map+")
    for candidate in (company, single_algorithm, company.split("+")[0]):
        for end in range(len(settings), -1, -1):
            for words in ([candidate, *settings[:end]], [candidate, *settings[:end], "x1"]):
                if (name := " ".join(words)) in view["picks"]:
                    return view["picks"][name]
    return None


def single_best(training: Sequence[GoalInstance]) -> str:
    """Return the name of the choice with the least mean loss over the instances. A choice that cannot be drawn counts as a miss."""
    names = sorted({name for instance in training for name in instance.view["picks"] if not name.startswith("rules ")})
    losses = [(instance, instance.losses()) for instance in training]

    def mean(choice: str) -> float:
        rows = [(equivalent_row(choice, instance.view), loss) for instance, loss in losses]
        return float(np.mean([PAR_FACTOR * max(loss.values()) if row is None else loss[row] for row, loss in rows]))

    return min(names, key=mean)


def marginal_values(instances: Sequence[GoalInstance], algorithms: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return two figures on the value of each algorithm, by its name.

    The first is the increase of the virtual best's mean loss without the algorithm. The second is the share of instances whose best
    row uses it.
    """
    result = {}
    for algorithm in algorithms:
        losses_without, best = [], []
        for instance in instances:
            losses = instance.losses()
            rest = [loss for name, loss in losses.items() if algorithm not in instance.rows[name]["algorithms"]]
            losses_without.append(min(rest, default=PAR_FACTOR * max(losses.values())))
            best.append(algorithm in instance.rows[min(losses, key=losses.__getitem__)]["algorithms"])
        result[algorithm] = float(np.mean(losses_without) - 1.0), float(np.mean(best))
    return result
