"""What each policy takes of measured views, from nothing but the body of ``POST /plan``; models are fitted to other views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from selection_fit import Case, asked_of, cases_of, fitted
from selection_judge import Instance, Verdict, instances_of, judged, single_best, stand_in

from selector.candidates import name_of
from selector.cost_model import predicted_ms
from selector.device_profile import DeviceProfile
from selector.error_model import ErrorModel
from selector.predict import predicted_plan
from terrain.descriptor import Descriptor
from terrain.level import Shadows

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
    """All parts judged by models and a single best that the others gave."""
    cases = {view["name"]: cases_of(view) for part in parts for view in part}
    taken: dict[str, Taken] = {"rules": {}, "predict": {}, "measure": {}}
    single: Taken = {}
    for number, part in enumerate(parts):
        others = [view for other, views in enumerate(parts) if other != number for view in views]
        model = fitted([case for view in others for case in cases[view["name"]]])
        best = single_best(instances_of(others))
        for one in instances_of(part):
            key = (one.view["name"], one.goal.name)
            single[key] = stand_in(best, one.view) or max(one.rows, key=one.losses().__getitem__)
            taken["rules"][key] = one.view["picks"][f"rules {one.goal.max_error:g}"]
            taken["predict"][key] = predicted(one, device, model)
            if "measured" in one.view:
                taken["measure"][key] = one.view["measured"][one.goal.name]
    return Split(name, {policy: its for policy, its in taken.items() if its}, single)


def predicted(one: Instance, device: DeviceProfile, model: ErrorModel | None = None) -> str:
    """The row that ``predict`` takes, told nothing but the descriptor (without the view's name) and the target."""
    descriptor = Descriptor.model_validate({**one.view["descriptor"], "view": "view"})
    shadows = Shadows(max_error=one.goal.max_error, max_ms=one.max_ms)
    return name_of(predicted_plan(descriptor, asked_of(descriptor, shadows), None, device, model), one.view["light"])


def verdicts(views: Sequence[Figures], device: DeviceProfile) -> dict[str, dict[str, Verdict]]:
    """By split and policy what its choices are worth."""
    found: dict[str, dict[str, Verdict]] = {}
    for name, parts in (("held-out views", held_out_views(views)), ("leave one terrain out", terrains(views))):
        made = split(name, parts, device)
        found[name] = {policy: judged(_known(views, its), its, made.single) for policy, its in made.taken.items()}
    return found


def _known(views: Sequence[Figures], taken: Taken) -> list[Instance]:
    return [one for one in instances_of(views) if (one.view["name"], one.goal.name) in taken]


def errors_of_time(cases: Iterable[Case], device: DeviceProfile, which: Callable[[Case], bool] = lambda case: True) -> np.ndarray:
    """By how much the expected times of rows are off, as shares of those measured."""
    off = []
    for case in filter(which, cases):
        ms = sum(
            predicted_ms(device, case.descriptor, case.light, step.kinds, step.algorithm, step.settings) for step in case.steps
        )
        off.append(ms / case.row["ms"] - 1.0)
    return np.array(off)
