"""The choices of each policy for measured views, from the body of ``POST /plan`` only; models are fitted to other views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.selection.fit import FitCase, asked_of, cases_of, fit_model
from benchmarks.selection.judge import GOALS, GoalInstance, instances_of, single_best, stand_in
from benchmarks.selection.probes import RecordedProver, recorded_options
from skugga.selector.candidates import name_of
from skugga.selector.choices import StandaloneRequest
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel
from skugga.selector.measure.probing import LightProbe, leader_of, probe_options
from skugga.selector.planner.planner import planner_of
from skugga.selector.predict import plan_options, predicted_plan
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import Shadows

POLICIES = ("rules", "predict", "probe", "measure")

Figures = dict[str, Any]
Taken = dict[tuple[str, str], str]

FOLDS = 3
"""Folds of the views of each terrain: each is judged by models that were fitted to the others."""


BUDGET_S = 3.0
"""The time of a probe, seconds ..."""

BUDGETS_S = (1.0, 3.0, 10.0, 30.0)
"""... and other times to compare, beside that of ``measure``, which has no limit."""


@dataclass(frozen=True, eq=False)
class Split:
    """The choices of each policy for all instances, with models fitted to a fold without the instance."""

    name: str
    instances: Sequence[GoalInstance]
    taken: Mapping[str, Taken]
    single: Taken
    best: Mapping[str, int]
    """The single best choices by goal, and the number of folds where each was it."""
    probe_s: Mapping[tuple[str, str], float]
    """The duration of an instance's probe."""
    drawn: Mapping[tuple[str, str], int]
    """The number of options that it draws."""
    by_budget: Mapping[str, Taken]
    """The choices with probes of other durations."""


def held_out_views(views: Sequence[Figures]) -> list[list[Figures]]:
    """Return folds with views of each terrain in turn."""
    counts: dict[str, int] = {}
    parts: list[list[Figures]] = [[] for _ in range(FOLDS)]
    for view in views:
        number = counts[view["terrain"]] = counts.get(view["terrain"], -1) + 1
        parts[number % FOLDS].append(view)
    return parts


def terrains(views: Sequence[Figures]) -> list[list[Figures]]:
    """Return folds of one terrain each."""
    return [[view for view in views if view["terrain"] == name] for name in dict.fromkeys(view["terrain"] for view in views)]


def split(name: str, parts: Sequence[tuple[Sequence[Figures], Sequence[Figures]]], device: DeviceProfile) -> Split:
    """Judge all folds (views to judge, views to fit to) by models and a single best for each goal from the training views."""
    cases: dict[str, list[FitCase]] = {}
    taken: dict[str, Taken] = {policy: {} for policy in POLICIES}
    single: Taken = {}
    bests: dict[str, int] = {}
    instances: list[GoalInstance] = []
    probe_s: dict[tuple[str, str], float] = {}
    drawn: dict[tuple[str, str], int] = {}
    by_budget: dict[str, Taken] = {}
    for part, others in parts:
        for view in others:
            cases.setdefault(view["name"], cases_of(view))
        model = fit_model([case for view in others for case in cases[view["name"]]], device)
        best = {goal.name: single_best(instances_of(others, [goal])) for goal in GOALS}
        for goal, choice in best.items():
            bests[f"{goal}: {choice}"] = bests.get(f"{goal}: {choice}", 0) + 1
        for view in part:
            for one in instances_of([view]):
                key = (view["name"], one.goal.name)
                instances.append(one)
                single[key] = stand_in(best[one.goal.name], view) or max(one.rows, key=one.losses().__getitem__)
                taken["rules"][key] = view["picks"][_rules_pick(one)]
                taken["predict"][key] = predicted(one, device, model)
                found, names = replayed(one, device, model, BUDGET_S)
                taken["probe"][key] = taken["predict"][key] if found is None else names[_leader(found, one)]
                probe_s[key], drawn[key] = (0.0, 0) if found is None else (found.seconds, len(found.drawn))
                for policy, budget_s in [("measure", None), *((f"{each:g} s", each) for each in BUDGETS_S)]:
                    found, names = replayed(one, device, model, budget_s)
                    chosen = taken["predict"][key] if found is None else names[_leader(found, one)]
                    (taken if policy == "measure" else by_budget).setdefault(policy, {})[key] = chosen
    return Split(name, instances, taken, single, bests, probe_s, drawn, by_budget)


def _rules_pick(one: GoalInstance) -> str:
    """Return the name of the rules' plan for a goal."""
    within = f"rules {one.goal.max_error:g} within"
    return within if one.max_ms is not None and within in one.view["picks"] else f"rules {one.goal.max_error:g}"


def _leader(probe: LightProbe, one: GoalInstance) -> int:
    return leader_of(probe.options, one.goal.max_error, one.max_ms)


def _described(one: GoalInstance) -> tuple[Descriptor, StandaloneRequest]:
    """Return the input of a policy: the descriptor without the view's name, and the target."""
    descriptor = Descriptor.model_validate({**one.view["descriptor"], "view": "view"})
    return descriptor, asked_of(descriptor, Shadows(max_error=one.goal.max_error, max_ms=one.max_ms))


def predicted(one: GoalInstance, device: DeviceProfile, model: ErrorModel | None = None) -> str:
    """Return the row that ``predict`` chooses."""
    descriptor, asked = _described(one)
    return name_of(predicted_plan(descriptor, asked, None, device, model), one.view["light"])


def replayed(
    one: GoalInstance, device: DeviceProfile, model: ErrorModel | None, budget_s: float | None
) -> tuple[LightProbe | None, list[str]]:
    """Replay a probe of an instance from its view's record; also return the names of its options' rows.

    The result is ``None`` without a record.
    """
    record, light = one.view.get("probe") or {}, one.view["light"]
    options = plan_options(planner_of(*_described(one)), device, model)
    if light not in options.lights or not record:
        return None, []
    its = options.lights[light]
    names = [name_of(options.planner.plan({light: each.choice}, {}), light) for each in its.options]
    known = recorded_options(its, [name if name in one.rows else "" for name in names], record)
    if not known.numbers:
        return None, names
    prober = RecordedProver(record, names)
    return probe_options(known, prober, one.goal.max_error, one.max_ms, budget_s), names


def splits(views: Sequence[Figures], device: DeviceProfile) -> list[Split]:
    """Return views held out of known terrains, all of a terrain held out, and terrains that no model was ever fitted to."""
    known, unseen = ([view for view in views if bool(view.get("unseen")) is which] for which in (False, True))

    def without(parts: Sequence[Sequence[Figures]]) -> list[tuple[Sequence[Figures], Sequence[Figures]]]:
        return [
            (part, [view for other, its in enumerate(parts) if other != number for view in its])
            for number, part in enumerate(parts)
        ]

    made = [split("held-out views", without(held_out_views(known)), device)]
    made.append(split("leave one terrain out", without(terrains(known)), device))
    if unseen:
        made.append(split("unseen terrains", [(unseen, known)], device))
    return made


def errors_of_time(
    cases: Iterable[FitCase], device: DeviceProfile, which: Callable[[FitCase], bool] = lambda case: True
) -> np.ndarray:
    """Return the errors of rows' expected times, as shares of the measured ones."""
    off = []
    for case in filter(which, cases):
        off.append(case.expected_ms(device) / case.row["ms"] - 1.0)
    return np.array(off)
