"""What each policy takes of measured views, from nothing but the body of ``POST /plan``; models are fitted to other views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.selection.fit import FitCase, asked_of, cases_of, fit_model
from benchmarks.selection.judge import GoalInstance, PolicyScore, instances_of, judged, single_best, stand_in
from selector.candidates import name_of
from selector.cost.cost_model import predicted_ms
from selector.cost.device_profile import DeviceProfile
from selector.cost.error_model import ErrorModel
from selector.predict import predicted_plan
from terrain.facts.descriptor import Descriptor
from terrain.level.level import Shadows

Figures = dict[str, Any]
Taken = dict[tuple[str, str], str]

FOLDS = 3
"""Parts into which the views of each terrain are dealt: each is judged by models that were fitted to the others."""


@dataclass(frozen=True, eq=False)
class Split:
    """What each policy takes of all instances, where the models of each instance were fitted to a part that has not got it."""

    name: str
    taken: Mapping[str, Taken]
    single: Taken
    best: Mapping[str, int]
    """The single best choices, and in how many parts each was it."""


def held_out_views(views: Sequence[Figures]) -> list[list[Figures]]:
    """Parts with views of each terrain in turn."""
    counts: dict[str, int] = {}
    parts: list[list[Figures]] = [[] for _ in range(FOLDS)]
    for view in views:
        number = counts[view["terrain"]] = counts.get(view["terrain"], -1) + 1
        parts[number % FOLDS].append(view)
    return parts


def terrains(views: Sequence[Figures]) -> list[list[Figures]]:
    """Parts of one terrain each."""
    return [[view for view in views if view["terrain"] == name] for name in dict.fromkeys(view["terrain"] for view in views)]


def split(name: str, parts: Sequence[Sequence[Figures]], device: DeviceProfile) -> Split:
    """All parts judged by models and a single best that the others gave. ``measure`` goes without the limits of time: it chose in
    another hour than that in which the rows were timed (``lateness``).
    """
    cases = {view["name"]: cases_of(view) for part in parts for view in part}
    choices_by_policy: dict[str, Taken] = {"rules": {}, "predict": {}, "measure": {}}
    single: Taken = {}
    bests: dict[str, int] = {}
    for number, part in enumerate(parts):
        others = [view for other, views in enumerate(parts) if other != number for view in views]
        model = fit_model([case for view in others for case in cases[view["name"]]])
        best = single_best(instances_of(others))
        bests[best] = bests.get(best, 0) + 1
        for one in instances_of(part):
            key = (one.view["name"], one.goal.name)
            single[key] = stand_in(best, one.view) or max(one.rows, key=one.losses().__getitem__)
            choices_by_policy["rules"][key] = one.view["picks"][f"rules {one.goal.max_error:g}"]
            choices_by_policy["predict"][key] = predicted(one, device, model)
            if one.max_ms is None and one.goal.name in one.view.get("measured", {}):
                choices_by_policy["measure"][key] = one.view["measured"][one.goal.name]
    return Split(name, {policy: choices for policy, choices in choices_by_policy.items() if choices}, single, bests)


def lateness(views: Sequence[Figures]) -> np.ndarray:
    """What ``measure`` took within a limit of time, by the times of the rows: as multiples of the limit."""
    limited = [one for one in instances_of(views) if one.max_ms is not None and one.goal.name in one.view.get("measured", {})]
    return np.array([one.rows[one.view["measured"][one.goal.name]]["ms"] / (one.max_ms or np.inf) for one in limited])


def predicted(one: GoalInstance, device: DeviceProfile, model: ErrorModel | None = None) -> str:
    """The row that ``predict`` takes, told nothing but the descriptor (without the view's name) and the target."""
    descriptor = Descriptor.model_validate({**one.view["descriptor"], "view": "view"})
    shadows = Shadows(max_error=one.goal.max_error, max_ms=one.max_ms)
    return name_of(predicted_plan(descriptor, asked_of(descriptor, shadows), None, device, model), one.view["light"])


def splits(views: Sequence[Figures], device: DeviceProfile) -> list[Split]:
    """Views held out of known terrains, and all of a terrain left out."""
    parts = {"held-out views": held_out_views(views), "leave one terrain out": terrains(views)}
    return [split(name, split_parts, device) for name, split_parts in parts.items()]


def policy_score(views: Sequence[Figures], made: Split, policy: str, with_plans: bool = False) -> PolicyScore:
    """What a policy's choices are worth; ``with_plans`` counts what it takes to plan a frame of a perspective view, too.

    Tiles share a plan, and one that was measured is made beforehand.
    """

    def own_ms(view: Figures) -> float:
        return view["plan_ms"] if with_plans and view["descriptor"]["view_kind"] == "perspective" else 0.0

    choices = made.taken[policy]
    return judged(
        [one for one in instances_of(views) if (one.view["name"], one.goal.name) in choices], choices, made.single, own_ms
    )


def errors_of_time(
    cases: Iterable[FitCase], device: DeviceProfile, which: Callable[[FitCase], bool] = lambda case: True
) -> np.ndarray:
    """By how much the expected times of rows are off, as shares of those measured."""
    off = []
    for case in filter(which, cases):
        ms = sum(
            predicted_ms(device, case.descriptor, case.light, step.kinds, step.algorithm, step.settings) for step in case.steps
        )
        off.append(ms / case.row["ms"] - 1.0)
    return np.array(off)
