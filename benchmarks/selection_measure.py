"""Measuring an instance: every pick of the portfolio drawn on the real view, timed, and held against ray-traced truth."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from selection_judge import GOALS
from selection_views import Instance

from selector.candidates import name_of
from selector.compare import compare
from selector.portfolio import portfolio
from selector.rules import choose, planner_of
from shadows.plan import Plan
from terrain.camera import PerspectiveView
from terrain.descriptor import Descriptor, describe
from terrain.errors import UnsupportedError
from terrain.gl import device
from terrain.grid import MapView
from terrain.scene import Scene

TIME_LIMIT_S = 25.0
"""What a view may take in all; beyond it there are fewer repeats."""

Figures = dict[str, Any]


def plans_of(descriptor: Descriptor, scene: Scene, light: str) -> dict[str, Plan]:
    """By name the plans of all picks of a light, and those that the rules lead to at each error that is asked for."""
    level = scene.loaded.level
    planner = planner_of(descriptor, level)
    picks = portfolio(descriptor, light, planner.casting(light))
    plans = {pick.name: planner.plan({light: pick}, {}) for pick in picks}
    return plans | {f"rules {goal.max_error:g}": choose(descriptor, level, {"max_error": goal.max_error}) for goal in GOALS}


def measured(instance: Instance, data: Path) -> Figures:
    """An instance's record: its descriptor as ``POST /plan`` takes it, milliseconds and errors of its rows, and by pick the row."""
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.opened(data, Path(folder))
        light = scene.light_names[0]
        descriptor = describe(scene, view, instance.view)
        plans = plans_of(descriptor, scene, light)
        found = _compared(scene, view, instance.view, light, plans)
    return {
        "name": instance.name, "family": instance.family, "terrain": instance.terrain, "light": light,
        "renderer": device().renderer, "error": found.error, "boundary": _rounded(found.boundary),
        "noise_floor": _rounded(found.noise_floor), "remarks": found.remarks,
        "rows": {row.figures["name"]: _row(row.figures, light) for row in found.rows},
        "picks": {pick: name_of(plan, light) for pick, plan in plans.items()},
        "descriptor": descriptor.model_dump(mode="json"),
    }  # fmt: skip


def _row(figures: Figures, light: str) -> Figures:
    shares = {key: _rounded(figures[key]) for key in ("wrong", "wrong_cast", "interior", "coverage")}
    algorithms = sorted(set(figures["algorithm"].get(light, {}).values()) - {"none"})
    ms, runs = _rounded(figures["ms_median"]), figures["runs"]
    return {"algorithms": algorithms, "ms": ms, "runs": runs, **shares, "bytes": figures["bytes"]}


def described(instance: Instance, data: Path) -> Figures:
    """The descriptor of an instance as JSON."""
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.opened(data, Path(folder))
        return describe(scene, view, instance.view).model_dump(mode="json")


def _compared(scene: Scene, view: MapView | PerspectiveView, name: str, light: str, plans: dict[Any, Plan]) -> Any:
    """The comparison of those plans that the view is served with; what a fill refuses is taken out of ``plans``."""
    while True:
        try:
            return compare(scene, view, name, light=light, time_limit_s=TIME_LIMIT_S, plans=list(plans.values()))
        except UnsupportedError:
            swept = [pick for pick, plan in plans.items() if any(step.algorithm == "sweep" for step in plan.steps)]
            if not swept:
                raise
            for pick in swept:
                del plans[pick]


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")
