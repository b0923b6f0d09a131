"""The policy ``measure``: a short list of candidates, drawn on the view with fewer pixels, held against truth; the winner is taken.

Errors are those of the full view's pixels (``selector.measure.thinned``), but for chance, and times are drawn out from two
thinned views. So whoever leads is drawn on all pixels, and leads on only if that confirms it: no candidate wins on few pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selector.measure.against_truth import View
from selector.measure.trials import Candidate, Probe, Trial, part_of, probe_of
from selector.picks import Pick, Wishes
from selector.planner.planner import choose
from selector.portfolio import portfolio
from selector.winning import Figures, Verdict, best, overshoot
from selector.words import duration, percent
from shadows.plan import Plan, Predicted, Reasoned
from terrain.describe import describe
from terrain.facts.descriptor import Descriptor
from terrain.level.level import AlgorithmName, CasterKind, Shadows, override
from terrain.scene import Scene

UNSURE = 1.5
"""Times that are drawn out from thinned views are right to this factor, mostly, and so is the share that is wrong inside."""

CLOSE = 1.25
"""Who comes as close as this to the winner's time is timed again."""

RUNS = 2
"""So many times."""

LEAST_MS = 1e-3
"""What a light is left of the time at least."""


@dataclass(frozen=True)
class Measured:
    """What was measured for a light: on what, the trials, and the candidates that were not tried."""

    probe: Probe
    trials: tuple[Trial, ...]
    not_tried: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class Wanted:
    """A target; ``max_ms`` is for the lights together."""

    max_error: float
    max_ms: float | None = None

    @classmethod
    def of(cls, asked: Shadows) -> Wanted:
        return cls(asked.max_error, asked.max_ms)


def measured_plan(
    scene: Scene,
    view: View,
    name: str = "map",
    overrides: dict[str, Any] | None = None,
    *,
    wishes: Wishes | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> Plan:
    """The plan of a scene's view whose algorithms and settings won on the view itself; ``on_step(done, total)`` is called as the
    work goes on. What the level or the request asks for is kept: only the rest is chosen.

    Where no candidate meets the target the nearest is taken, and the plan says by how much it misses. Raises ``InputError`` and
    ``UnsupportedError`` as ``selector.planner.planner.choose`` does, ``RenderError`` where a candidate fails.
    """
    wishes = wishes or scene.loaded.level
    wanted = Wanted.of(override(wishes.shadows, overrides or {}))
    descriptor = describe(scene, view, name)
    measured = measured_rows(scene, view, name, overrides, wishes=wishes, wanted=wanted, on_step=on_step)
    measured = confirmed(measured, wanted)
    verdicts = winners(measured, wanted)
    won = {light: _trial_of(measured[light], verdict.winner.name) for light, verdict in verdicts.items()}
    picks = {light: _reasoned(measured[light], trial, verdicts[light].met, wanted) for light, trial in won.items()}
    plan = choose(descriptor, wishes, overrides, picks, _rejected(measured, wanted))
    missed = [f"{light}: {verdict.missed_by}" for light, verdict in verdicts.items() if verdict.missed_by]
    reasons = [Reasoned(name="target missed", reason="; ".join(missed))] if missed else []
    reasons += [*plan.reasons, *(Reasoned(name=f"{light}: measured", reason=_said(view, its)) for light, its in measured.items())]
    predicted = Predicted(
        ms=sum(trial.figures.ms for trial in won.values()),
        wrong=max((trial.wrong for trial in won.values()), default=0.0),
        wrong_cast=max((trial.figures.error for trial in won.values()), default=0.0),
    )
    target = plan.target.model_copy(update={"met": not missed})
    return plan.model_copy(update={"policy": "measure", "predicted": predicted, "target": target, "reasons": reasons})


def measured_rows(
    scene: Scene,
    view: View,
    name: str = "map",
    overrides: dict[str, Any] | None = None,
    *,
    wishes: Wishes | None = None,
    wanted: Wanted | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> dict[str, Measured]:
    """The candidates of each light that casts shadows, measured on the view with fewer pixels: all of them, or with a target
    (``wanted``) those that could win. One measurement serves any number of targets (``winners``).
    """
    wishes = wishes or scene.loaded.level
    descriptor = describe(scene, view, name)
    found = {light: its for light, its in candidates_of(descriptor, wishes, overrides).items() if its}
    total, done = sum(map(len, found.values())), 0
    rows = {}
    for light, its in found.items():
        probe = probe_of(scene, view, light, its[0].plan, descriptor.pixel_m)
        trials: list[Trial] = []
        for ladder in _ladders(its):
            for candidate in ladder:
                done += 1
                if wanted is None or not _decided(candidate, trials, wanted):
                    trials.append(probe.trial(candidate))
                if on_step is not None:
                    on_step(done, total)
        rows[light] = Measured(probe, tuple(trials), _without(its, trials))
    return rows


def _without(candidates: Sequence[Candidate], trials: Sequence[Trial]) -> tuple[Candidate, ...]:
    """The candidates that were not tried."""
    tried = {trial.figures.name for trial in trials}
    return tuple(one for one in candidates if one.pick.name not in tried)


def candidates_of(descriptor: Descriptor, wishes: Wishes, overrides: dict[str, Any] | None = None) -> dict[str, list[Candidate]]:
    """By light, what is to be measured: the portfolio as far as it is free, no two that come to the same plan."""
    plain = choose(descriptor, wishes, overrides, picks={})
    out: dict[str, list[Candidate]] = {}
    for light, per_kind in plain.algorithm.items():
        casting: set[CasterKind] = {kind for kind, algorithm in per_kind.items() if algorithm != "none"}
        unlike: dict[str, Candidate] = {}
        for pick in portfolio(descriptor, light, casting) if casting else []:
            plan = choose(descriptor, wishes, overrides, picks={light: pick})
            unlike.setdefault(repr((plan.algorithm[light], plan.settings.get(light))), Candidate(light, pick, plan))
        out[light] = list(unlike.values())
    return out


def winners(measured: Mapping[str, Measured], wanted: Wanted) -> dict[str, Verdict]:
    """Who wins for each light. Of the time for all lights each one, the first first, may take what the others can do without."""
    verdicts: dict[str, Verdict] = {}
    for light, rows in measured.items():
        verdicts[light] = _winner(rows.trials, wanted, _left_ms(measured, wanted, verdicts))
    return verdicts


def confirmed(measured: Mapping[str, Measured], wanted: Wanted) -> dict[str, Measured]:
    """The same rows, those that lead drawn on all pixels until one of them leads on; who comes near to it is timed again.

    What a light turns out to need changes what is left for the others, so that they are gone through until nobody new leads.
    """
    out, verdicts, drawn = dict(measured), dict[str, Verdict](), True
    while drawn:
        verdicts, drawn = {}, False
        for light in measured:
            max_ms = _left_ms(out, wanted, verdicts)
            while not (leader := _leader(out[light], wanted, max_ms)).on_all:
                whole = _with(out[light], out[light].probe.drawn_on_all(leader.candidate))
                out[light], drawn = _tried_further(whole, wanted), True
            verdicts[light] = _winner(out[light].trials, wanted, max_ms)
    for light, verdict in verdicts.items():
        for trial in out[light].trials:
            if trial.on_all and verdict.winner.ms / CLOSE <= trial.figures.ms <= CLOSE * verdict.winner.ms:
                out[light] = _with(out[light], out[light].probe.timed(trial, RUNS))
    return out


def _with(rows: Measured, new: Trial) -> Measured:
    """Rows with a trial in the place of what was known of its candidate."""
    return replace(rows, trials=tuple(new if old.figures.name == new.figures.name else old for old in rows.trials))


def _tried_further(rows: Measured, wanted: Wanted) -> Measured:
    """Rows with trials of what had been left out because of a smaller map that turned out to be worse than it had seemed."""
    trials = list(rows.trials)
    for candidate in sorted(rows.not_tried, key=_map_size):
        if not _decided(candidate, trials, wanted):
            trials.append(rows.probe.trial(candidate))
    return replace(rows, trials=tuple(trials), not_tried=_without(rows.not_tried, trials))


def _winner(trials: Sequence[Trial], wanted: Wanted, max_ms: float | None) -> Verdict:
    """Who wins; of those that were drawn on all pixels, if any were."""
    return best([one.figures for one in trials if one.on_all] or [one.figures for one in trials], wanted.max_error, max_ms)


def _leader(rows: Measured, wanted: Wanted, max_ms: float | None) -> Trial:
    """Who would win, if those that were drawn on few pixels turned out as good as they may."""
    name = best([one.figures if one.on_all else _hoped(one) for one in rows.trials], wanted.max_error, max_ms).winner.name
    return _trial_of(rows, name)


def _hoped(trial: Trial) -> Figures:
    its = trial.figures
    return replace(its, ms=its.ms / UNSURE, error=max(its.error - trial.spread, 0.0), interior=its.interior / UNSURE)


def _left_ms(measured: Mapping[str, Measured], wanted: Wanted, verdicts: Mapping[str, Verdict]) -> float | None:
    """The time that is left for the next light, when those with a verdict have theirs and those after it the least they need."""
    if wanted.max_ms is None:
        return None
    later = list(measured.values())[len(verdicts) + 1 :]
    taken_ms = sum(verdict.winner.ms for verdict in verdicts.values())
    taken_ms += sum(min(trial.figures.ms for trial in rows.trials) for rows in later)
    return max(wanted.max_ms - taken_ms, LEAST_MS)


def _ladders(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Candidates that differ in the size of their maps alone, smallest first, by what they have in common."""
    ladders: dict[tuple[object, ...], list[Candidate]] = {}
    for candidate in sorted(candidates, key=_map_size):
        ladders.setdefault(candidate.ladder, []).append(candidate)
    return list(ladders.values())


def _map_size(candidate: Candidate) -> int:
    return candidate.pick.settings.get("map_size", 0)


def _at_most(trial: Trial) -> Figures:
    return replace(trial.figures, error=trial.figures.error + trial.spread)


def _decided(candidate: Candidate, trials: Sequence[Trial], wanted: Wanted) -> bool:
    """Whether smaller maps of the same kind show that a candidate cannot win: errors fall with the size, and times grow."""
    smaller = [trial.figures for trial in trials if trial.candidate.ladder == candidate.ladder]
    accurate = [one.figures for one in trials if overshoot(_at_most(one), wanted.max_error) <= 0.0]
    in_time = [one for one in accurate if wanted.max_ms is None or one.ms <= wanted.max_ms]
    least_ms = min((one.ms for one in in_time), default=np.inf)
    return any(one in accurate or one.ms > UNSURE * least_ms for one in smaller)


def _trial_of(rows: Measured, name: str) -> Trial:
    return next(trial for trial in rows.trials if trial.figures.name == name)


def _reasoned(rows: Measured, trial: Trial, met: bool, wanted: Wanted) -> Pick:
    """The winner's pick, with what was measured of it as the reason."""
    pick, limit = trial.candidate.pick, percent(wanted.max_error)
    limit += "" if wanted.max_ms is None else f" within {wanted.max_ms:g} ms"
    verdict = f"the cheapest that keeps to {limit}" if met else f"the nearest to {limit}"
    why = f"measured: {_words(rows, trial.figures)}, {verdict}"
    return replace(pick, why=dict.fromkeys([*pick.algorithm, *pick.settings], why))


def _rejected(measured: Mapping[str, Measured], wanted: Wanted) -> dict[AlgorithmName, str]:
    """What the best trial of each algorithm under the first light came to."""
    its: dict[AlgorithmName, list[Trial]] = {}
    rows = next(iter(measured.values()), None)
    for trial in rows.trials if rows else ():
        for name in {step.algorithm for step in trial.candidate.steps}:
            its.setdefault(name, []).append(trial)
    bests = {name: _winner(trials, wanted, wanted.max_ms).winner for name, trials in its.items()}
    return {name: f"measured: {_words(rows, one)} ({one.name})" for name, one in bests.items() if rows}


def _words(rows: Measured, figures: Figures) -> str:
    what = "wrong of the cast shadow" if rows.probe.error == "wrong_cast" else "of coverage wrong"
    return f"{percent(figures.error)} {what} in {duration(figures.ms)}"


def _said(view: View, rows: Measured) -> str:
    part = part_of(view)
    on_all = sum(trial.on_all for trial in rows.trials)
    said = f"{len(rows.trials)} candidates compared with truth on {rows.probe.pixels} of {part.rows * part.cols} pixels"
    said += "" if rows.probe.thin is None else f", {on_all} of them on all"
    if rows.not_tried:
        said += f"; {len(rows.not_tried)} not run, because smaller maps of the same kind decide"
    return said
