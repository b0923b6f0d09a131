"""The policy ``measure``: a short list of candidates, drawn on the view with fewer pixels, held against truth; the winner is taken.

Errors are those of the full view's pixels (``selector.measure.subsampled``), but for chance, and times are drawn out from two
subsampled views. So whoever leads is drawn on all pixels, and leads on only if that confirms it: no candidate wins on few pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selector.choices import Choice, PlanRequest
from selector.formatting import format_duration, format_percent
from selector.measure.trials import Candidate, Trial, TrialView, part_of, trial_view_of
from selector.measure.view_truth import View
from selector.planner.planner import make_plan, planner_of
from selector.portfolio import portfolio
from selector.ranking import CandidateFigures, RankingResult, best, relative_overshoot
from shadows.algorithm import Reasoned
from shadows.plan import Plan, Predicted
from shadows.registry import NO_SHADOWS
from terrain.describe import describe
from terrain.facts.descriptor import Descriptor
from terrain.level.algorithm_names import AlgorithmName
from terrain.level.level import CasterKind, Shadows, override
from terrain.scene import Scene

EXTRAPOLATION_FACTOR = 1.5
"""Times that are drawn out from subsampled views are right to this factor, mostly, and so is the share that is wrong inside."""

RETIME_RATIO = 1.25
"""Who comes as close as this to the winner's time is timed again."""

RETIMED_RUNS = 2
"""So many times."""

MIN_BUDGET_MS = 1e-3
"""What a light is left of the time at least."""


@dataclass(frozen=True)
class LightTrials:
    """What was measured for a light: on what, the trials, and the candidates that were not tried."""

    trial_view: TrialView
    trials: tuple[Trial, ...]
    not_tried: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class TargetBounds:
    """A target; ``max_ms`` is for the lights together."""

    max_error: float
    max_ms: float | None = None

    @classmethod
    def of(cls, shadows: Shadows) -> TargetBounds:
        return cls(shadows.max_error, shadows.max_ms)


def measured_plan(
    scene: Scene,
    view: View,
    name: str = "map",
    overrides: dict[str, Any] | None = None,
    *,
    plan_request: PlanRequest | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> Plan:
    """The plan of a scene's view whose algorithms and settings won on the view itself; ``on_step(done, total)`` is called as the
    work goes on. What the level or the request asks for is kept: only the rest is chosen.

    Where no candidate meets the target the nearest is taken, and the plan says by how much it misses. Raises ``InputError`` and
    ``UnsupportedError`` as ``selector.planner.planner.make_plan`` does, ``RenderError`` where a candidate fails.
    """
    plan_request = plan_request or scene.loaded.level
    bounds = TargetBounds.of(override(plan_request.shadows, overrides or {}))
    descriptor = describe(scene, view, name, "points")
    measured = measured_rows(scene, view, name, overrides, plan_request=plan_request, bounds=bounds, on_step=on_step)
    measured = confirm_winners(measured, bounds)
    verdicts = winners(measured, bounds)
    won = {light: _trial_of(measured[light], verdict.winner.name) for light, verdict in verdicts.items()}
    choices = {light: _reasoned(measured[light], trial, verdicts[light].met, bounds) for light, trial in won.items()}
    plan = make_plan(descriptor, plan_request, overrides, choices, _rejected(measured, bounds))
    missed = [f"{light}: {verdict.missed_by}" for light, verdict in verdicts.items() if verdict.missed_by]
    reasons = [Reasoned(name="target missed", reason="; ".join(missed))] if missed else []
    reasons += [*plan.reasons, *(Reasoned(name=f"{light}: measured", reason=_said(view, rows)) for light, rows in measured.items())]
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
    plan_request: PlanRequest | None = None,
    bounds: TargetBounds | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> dict[str, LightTrials]:
    """The candidates of each light that casts shadows, measured on the view with fewer pixels: all of them, or with a target
    (``bounds``) those that could win. One measurement serves any number of targets (``winners``).
    """
    plan_request = plan_request or scene.loaded.level
    descriptor = describe(scene, view, name, "points")
    candidates = {
        light: light_candidates
        for light, light_candidates in candidates_of(descriptor, plan_request, overrides).items()
        if light_candidates
    }
    total, done = sum(map(len, candidates.values())), 0
    rows = {}
    for light, light_candidates in candidates.items():
        trial_view = trial_view_of(scene, view, light, light_candidates[0].plan, descriptor.pixel_m)
        trials: list[Trial] = []
        for ladder in _ladders(light_candidates):
            for candidate in ladder:
                done += 1
                if bounds is None or not _decided(candidate, trials, bounds):
                    trials.append(trial_view.trial(candidate))
                if on_step is not None:
                    on_step(done, total)
        rows[light] = LightTrials(trial_view, tuple(trials), _without(light_candidates, trials))
    return rows


def _without(candidates: Sequence[Candidate], trials: Sequence[Trial]) -> tuple[Candidate, ...]:
    """The candidates that were not tried."""
    tried = {trial.figures.name for trial in trials}
    return tuple(candidate for candidate in candidates if candidate.choice.name not in tried)


def candidates_of(
    descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None = None
) -> dict[str, list[Candidate]]:
    """By light, what is to be measured: the portfolio as far as it is free, no two that come to the same plan."""
    default_plan = make_plan(descriptor, plan_request, overrides, choices={})
    asked = planner_of(descriptor, plan_request, overrides).asked
    out: dict[str, list[Candidate]] = {}
    for light, per_kind in default_plan.algorithm.items():
        casting: set[CasterKind] = {kind for kind, algorithm in per_kind.items() if algorithm != NO_SHADOWS}
        distinct: dict[str, Candidate] = {}
        for choice in portfolio(descriptor, light, casting, asked) if casting else []:
            plan = make_plan(descriptor, plan_request, overrides, choices={light: choice})
            distinct.setdefault(repr((plan.algorithm[light], plan.settings.get(light))), Candidate(light, choice, plan))
        out[light] = list(distinct.values())
    return out


def winners(measured: Mapping[str, LightTrials], bounds: TargetBounds) -> dict[str, RankingResult]:
    """Who wins for each light. Of the time for all lights each one, the first first, may take what the others can do without."""
    verdicts: dict[str, RankingResult] = {}
    for light, rows in measured.items():
        verdicts[light] = _winner(rows.trials, bounds, _left_ms(measured, bounds, verdicts))
    return verdicts


def confirm_winners(measured: Mapping[str, LightTrials], bounds: TargetBounds) -> dict[str, LightTrials]:
    """The same rows, those that lead drawn on all pixels until one of them leads on; who comes near to it is timed again.

    What a light turns out to need changes what is left for the others, so that they are gone through until nobody new leads.
    """
    out, verdicts, drawn = dict(measured), dict[str, RankingResult](), True
    while drawn:
        verdicts, drawn = {}, False
        for light in measured:
            max_ms = _left_ms(out, bounds, verdicts)
            while not (leader := _leader(out[light], bounds, max_ms)).at_full_resolution:
                at_full_resolution = _with(out[light], out[light].trial_view.full_resolution_trial(leader.candidate))
                out[light], drawn = _tried_further(at_full_resolution, bounds), True
            verdicts[light] = _winner(out[light].trials, bounds, max_ms)
    for light, verdict in verdicts.items():
        for trial in out[light].trials:
            if (
                trial.at_full_resolution
                and verdict.winner.ms / RETIME_RATIO <= trial.figures.ms <= RETIME_RATIO * verdict.winner.ms
            ):
                out[light] = _with(out[light], out[light].trial_view.timed(trial, RETIMED_RUNS))
    return out


def _with(rows: LightTrials, new: Trial) -> LightTrials:
    """Rows with a trial in the place of what was known of its candidate."""
    return replace(rows, trials=tuple(new if old.figures.name == new.figures.name else old for old in rows.trials))


def _tried_further(rows: LightTrials, bounds: TargetBounds) -> LightTrials:
    """Rows with trials of what had been left out because of a smaller map that turned out to be worse than it had seemed."""
    trials = list(rows.trials)
    for candidate in sorted(rows.not_tried, key=_map_size):
        if not _decided(candidate, trials, bounds):
            trials.append(rows.trial_view.trial(candidate))
    return replace(rows, trials=tuple(trials), not_tried=_without(rows.not_tried, trials))


def _winner(trials: Sequence[Trial], bounds: TargetBounds, max_ms: float | None) -> RankingResult:
    """Who wins; of those that were drawn on all pixels, if any were."""
    return best(
        [trial.figures for trial in trials if trial.at_full_resolution] or [trial.figures for trial in trials],
        bounds.max_error,
        max_ms,
    )


def _leader(rows: LightTrials, bounds: TargetBounds, max_ms: float | None) -> Trial:
    """Who would win, if those that were drawn on few pixels turned out as good as they may."""
    name = best(
        [trial.figures if trial.at_full_resolution else _hoped(trial) for trial in rows.trials], bounds.max_error, max_ms
    ).winner.name
    return _trial_of(rows, name)


def _hoped(trial: Trial) -> CandidateFigures:
    figures = trial.figures
    return replace(
        figures,
        ms=figures.ms / EXTRAPOLATION_FACTOR,
        error=max(figures.error - trial.spread, 0.0),
        interior=figures.interior / EXTRAPOLATION_FACTOR,
    )


def _left_ms(measured: Mapping[str, LightTrials], bounds: TargetBounds, verdicts: Mapping[str, RankingResult]) -> float | None:
    """The time that is left for the next light, when those with a verdict have theirs and those after it the least they need."""
    if bounds.max_ms is None:
        return None
    later = list(measured.values())[len(verdicts) + 1 :]
    taken_ms = sum(verdict.winner.ms for verdict in verdicts.values())
    taken_ms += sum(min(trial.figures.ms for trial in rows.trials) for rows in later)
    return max(bounds.max_ms - taken_ms, MIN_BUDGET_MS)


def _ladders(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Candidates that differ in the size of their maps alone, smallest first, by what they have in common."""
    ladders: dict[tuple[object, ...], list[Candidate]] = {}
    for candidate in sorted(candidates, key=_map_size):
        ladders.setdefault(candidate.ladder, []).append(candidate)
    return list(ladders.values())


def _map_size(candidate: Candidate) -> int:
    return candidate.choice.settings.get("map_size", 0)


def _at_most(trial: Trial) -> CandidateFigures:
    return replace(trial.figures, error=trial.figures.error + trial.spread)


def _decided(candidate: Candidate, trials: Sequence[Trial], bounds: TargetBounds) -> bool:
    """Whether smaller maps of the same kind show that a candidate cannot win: errors fall with the size, and times grow."""
    smaller = [trial.figures for trial in trials if trial.candidate.ladder == candidate.ladder]
    accurate = [
        trial_figures.figures for trial_figures in trials if relative_overshoot(_at_most(trial_figures), bounds.max_error) <= 0.0
    ]
    in_time = [trial_figures for trial_figures in accurate if bounds.max_ms is None or trial_figures.ms <= bounds.max_ms]
    least_ms = min((trial_figures.ms for trial_figures in in_time), default=np.inf)
    return any(trial_figures in accurate or trial_figures.ms > EXTRAPOLATION_FACTOR * least_ms for trial_figures in smaller)


def _trial_of(rows: LightTrials, name: str) -> Trial:
    return next(trial for trial in rows.trials if trial.figures.name == name)


def _reasoned(rows: LightTrials, trial: Trial, met: bool, bounds: TargetBounds) -> Choice:
    """The winner's choice, with what was measured of it as the reason."""
    choice, limit = trial.candidate.choice, format_percent(bounds.max_error)
    limit += "" if bounds.max_ms is None else f" within {bounds.max_ms:g} ms"
    verdict = f"the cheapest that keeps to {limit}" if met else f"the nearest to {limit}"
    why = f"measured: {_words(rows, trial.figures)}, {verdict}"
    return replace(choice, why=dict.fromkeys([*choice.algorithm, *choice.settings], why))


def _rejected(measured: Mapping[str, LightTrials], bounds: TargetBounds) -> dict[AlgorithmName, str]:
    """What the best trial of each algorithm under the first light came to."""
    by_algorithm: dict[AlgorithmName, list[Trial]] = {}
    rows = next(iter(measured.values()), None)
    for trial in rows.trials if rows else ():
        for name in {step.algorithm for step in trial.candidate.steps}:
            by_algorithm.setdefault(name, []).append(trial)
    bests = {name: _winner(trials, bounds, bounds.max_ms).winner for name, trials in by_algorithm.items()}
    return {name: f"measured: {_words(rows, figures)} ({figures.name})" for name, figures in bests.items() if rows}


def _words(rows: LightTrials, figures: CandidateFigures) -> str:
    measure_name = "wrong of the cast shadow" if rows.trial_view.error == "wrong_cast" else "of coverage wrong"
    return f"{format_percent(figures.error)} {measure_name} in {format_duration(figures.ms)}"


def _said(view: View, rows: LightTrials) -> str:
    part = part_of(view)
    at_full_resolution = sum(trial.at_full_resolution for trial in rows.trials)
    text = f"{len(rows.trials)} candidates compared with truth on {rows.trial_view.pixels} of {part.rows * part.cols} pixels"
    text += "" if rows.trial_view.subsampled is None else f", {at_full_resolution} of them on all"
    if rows.not_tried:
        text += f"; {len(rows.not_tried)} not run, because smaller maps of the same kind decide"
    return text
