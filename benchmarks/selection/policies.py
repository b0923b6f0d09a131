"""The choices of each policy for measured views. Policies see only the body of ``POST /plan``. Models are fitted to other views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.selection.fit import FitCase, cases_of, fit_model, request_of
from benchmarks.selection.judge import GOALS, GoalInstance, equivalent_row, instances_of, single_best
from benchmarks.selection.probes import RecordedProber, recorded_options
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
"""Policies that are judged. ``rules`` are the fixed rules, ``predict`` uses models alone, ``probe`` and ``measure`` add probes."""

Figures = dict[str, Any]
"""A measured view's record by key."""
RowChoices = dict[tuple[str, str], str]
"""Name of the chosen row (measured plan) by names of view and goal."""

FOLDS = 3
"""Number of folds of the views of each terrain: each fold is judged by models that were fitted to the others."""


BUDGET_S = 3.0
"""Time limit of the policy ``probe``, seconds."""

BUDGETS_S = (1.0, 3.0, 10.0, 30.0)
"""Other time limits of a probe to compare, seconds. The policy ``measure`` has no limit."""


@dataclass(frozen=True, eq=False)
class Split:
    """The choices of each policy for all instances. Models are fitted to views of folds that do not contain the instance."""

    name: str
    instances: Sequence[GoalInstance]
    choices: Mapping[str, RowChoices]
    """Chosen rows by policy."""
    single: RowChoices
    """Rows of the single best choice for each goal."""
    best: Mapping[str, int]
    """Number of folds in which a choice was the single best for a goal. Keys are texts of the form "goal: choice"."""
    probe_s: Mapping[tuple[str, str], float]
    """Seconds of the probe of each instance, by names of view and goal."""
    drawn: Mapping[tuple[str, str], int]
    """Number of options that the probe of each instance draws, by names of view and goal."""
    by_budget: Mapping[str, RowChoices]
    """Chosen rows by the probe's time limit, a text such as "3 s"."""


def held_out_views(views: Sequence[Figures]) -> list[list[Figures]]:
    """Split views into folds, so that each fold has views of every terrain in turn."""
    counts: dict[str, int] = {}
    parts: list[list[Figures]] = [[] for _ in range(FOLDS)]
    for view in views:
        number = counts[view["terrain"]] = counts.get(view["terrain"], -1) + 1
        parts[number % FOLDS].append(view)
    return parts


def terrains(views: Sequence[Figures]) -> list[list[Figures]]:
    """Split views into folds, so that each fold has all views of one terrain."""
    return [[view for view in views if view["terrain"] == name] for name in dict.fromkeys(view["terrain"] for view in views)]


def split(name: str, parts: Sequence[tuple[Sequence[Figures], Sequence[Figures]]], device: DeviceProfile) -> Split:
    """Return the choices of each policy for the views of all folds.

    ``parts`` are pairs of views to judge and views to train with. The training views give the error model, and the single best
    choice for each goal.
    """
    cases: dict[str, list[FitCase]] = {}
    choices: dict[str, RowChoices] = {policy: {} for policy in POLICIES}
    single: RowChoices = {}
    bests: dict[str, int] = {}
    instances: list[GoalInstance] = []
    probe_s: dict[tuple[str, str], float] = {}
    draw_counts: dict[tuple[str, str], int] = {}
    by_budget: dict[str, RowChoices] = {}
    for part, training_views in parts:
        for view in training_views:
            cases.setdefault(view["name"], cases_of(view))
        model = fit_model([case for view in training_views for case in cases[view["name"]]], device)
        best = {goal.name: single_best(instances_of(training_views, [goal])) for goal in GOALS}
        for goal, choice in best.items():
            bests[f"{goal}: {choice}"] = bests.get(f"{goal}: {choice}", 0) + 1
        for view in part:
            for instance in instances_of([view]):
                key = (view["name"], instance.goal.name)
                instances.append(instance)
                single[key] = equivalent_row(best[instance.goal.name], view) or max(
                    instance.rows, key=instance.losses().__getitem__
                )
                choices["rules"][key] = view["picks"][_rules_pick(instance)]
                choices["predict"][key] = predicted_row(instance, device, model)
                probe, names = replay_probe(instance, device, model, BUDGET_S)
                choices["probe"][key] = choices["predict"][key] if probe is None else names[_leader(probe, instance)]
                probe_s[key], draw_counts[key] = (0.0, 0) if probe is None else (probe.seconds, len(probe.drawn))
                for policy, budget_s in [("measure", None), *((f"{limit_s:g} s", limit_s) for limit_s in BUDGETS_S)]:
                    probe, names = replay_probe(instance, device, model, budget_s)
                    chosen = choices["predict"][key] if probe is None else names[_leader(probe, instance)]
                    (choices if policy == "measure" else by_budget).setdefault(policy, {})[key] = chosen
    return Split(name, instances, choices, single, bests, probe_s, draw_counts, by_budget)


def _rules_pick(instance: GoalInstance) -> str:
    """Return the name of the fixed rules' plan for a goal."""
    within = f"rules {instance.goal.max_error:g} within"
    return within if instance.max_ms is not None and within in instance.view["picks"] else f"rules {instance.goal.max_error:g}"


def _leader(probe: LightProbe, instance: GoalInstance) -> int:
    """Return the index of the option that a probe prefers for the instance's target."""
    return leader_of(probe.options, instance.goal.max_error, instance.max_ms)


def _policy_input(instance: GoalInstance) -> tuple[Descriptor, StandaloneRequest]:
    """Return the input of a policy: the descriptor without the view's name, and a request with the target."""
    descriptor = Descriptor.model_validate({**instance.view["descriptor"], "view": "view"})
    return descriptor, request_of(descriptor, Shadows(max_error=instance.goal.max_error, max_ms=instance.max_ms))


def predicted_row(instance: GoalInstance, device: DeviceProfile, model: ErrorModel | None = None) -> str:
    """Return the name of the row that the policy ``predict`` chooses. ``model`` ``None`` stands for the bundled error model."""
    descriptor, request = _policy_input(instance)
    return name_of(predicted_plan(descriptor, request, None, device, model), instance.view["light"])


def replay_probe(
    instance: GoalInstance, device: DeviceProfile, model: ErrorModel | None, budget_s: float | None
) -> tuple[LightProbe | None, list[str]]:
    """Replay a probe of an instance from the record of its view. Return its result, and the names of its options' rows.

    The result is ``None`` if the view has no record of probes. ``model`` ``None`` stands for the bundled error model. ``budget_s``
    limits the simulated seconds; ``None`` is no limit.
    """
    record, light = instance.view.get("probe") or {}, instance.view["light"]
    options = plan_options(planner_of(*_policy_input(instance)), device, model)
    if light not in options.lights or not record:
        return None, []
    light_options = options.lights[light]
    names = [name_of(options.planner.plan({light: option.choice}, {}), light) for option in light_options.options]
    known_options = recorded_options(light_options, [name if name in instance.rows else "" for name in names], record)
    if not known_options.numbers:
        return None, names
    prober = RecordedProber(record, names, known_options)
    return probe_options(known_options, prober, instance.goal.max_error, instance.max_ms, budget_s), names


def splits(views: Sequence[Figures], device: DeviceProfile) -> list[Split]:
    """Return three ways of splitting views into folds for testing.

    They hold out single views, all views of a terrain, and terrains that no model was ever fitted to.
    """
    known_views, unseen_views = ([view for view in views if bool(view.get("unseen")) is which] for which in (False, True))

    def held_out_folds(parts: Sequence[Sequence[Figures]]) -> list[tuple[Sequence[Figures], Sequence[Figures]]]:
        return [
            (part, [view for other, other_part in enumerate(parts) if other != number for view in other_part])
            for number, part in enumerate(parts)
        ]

    result = [split("held-out views", held_out_folds(held_out_views(known_views)), device)]
    result.append(split("leave one terrain out", held_out_folds(terrains(known_views)), device))
    if unseen_views:
        result.append(split("unseen terrains", [(unseen_views, known_views)], device))
    return result


def errors_of_time(
    cases: Iterable[FitCase], device: DeviceProfile, which: Callable[[FitCase], bool] = lambda case: True
) -> np.ndarray:
    """Return (expected - measured) / measured time (n,) of the cases that ``which`` selects."""
    deviations = []
    for case in filter(which, cases):
        deviations.append(case.expected_ms(device) / case.row["ms"] - 1.0)
    return np.array(deviations)
