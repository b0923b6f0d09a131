"""Measuring an instance: every pick of the portfolio drawn on the real view, timed, and held against ray-traced truth."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from selection_views import Instance

from selector.candidates import name_of
from selector.compare import compare
from selector.picks import Pick
from selector.portfolio import portfolio
from selector.rules import choose
from shadows.plan import Plan
from terrain.camera import PerspectiveView
from terrain.descriptor import Descriptor, describe
from terrain.errors import UnsupportedError
from terrain.gl import device
from terrain.grid import MapView
from terrain.scene import Scene

TIME_LIMIT_S = 45.0
"""What the picks of a view may take in all; beyond it there are fewer repeats."""

Figures = dict[str, Any]


def picks_of(descriptor: Descriptor, scene: Scene, light: str) -> dict[Pick, Plan]:
    """The picks of a light and their plans, of the kinds of casters that cast at all."""
    level = scene.loaded.level
    usual = choose(descriptor, level, picks={})
    kinds = [kind for kind, name in usual.algorithm.get(light, {}).items() if name != "none"]
    return {pick.name: choose(descriptor, level, picks={light: pick}) for pick in portfolio(descriptor, light, kinds)}  # type: ignore[misc]


def measured(instance: Instance, data: Path) -> Figures:
    """An instance's figures: its descriptor as ``POST /plan`` takes it, and by pick milliseconds and errors."""
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.opened(data, Path(folder))
        light = scene.light_names[0]
        descriptor = describe(scene, view, instance.view)
        plans = picks_of(descriptor, scene, light)
        found = _compared(scene, view, instance.view, light, plans)
    rows = {row.figures["name"]: row.figures for row in found.rows}
    keys = {"ms": "ms_median", "wrong_cast": "wrong_cast", "interior": "interior", "coverage": "coverage", "runs": "runs"}
    kept = {}
    for pick, plan in plans.items():
        row = rows.get(name_of(plan, light))
        if row is not None:
            kept[pick] = {key: _rounded(row[source]) for key, source in keys.items()}
            kept[pick] |= {"stages": row["stages"], "counters": row["counters"], "bytes": row["bytes"]}
    return {
        "name": instance.name, "family": instance.family, "terrain": instance.terrain, "light": light,
        "renderer": device().renderer, "error": found.error, "boundary": _rounded(found.boundary),
        "noise_floor": _rounded(found.noise_floor), "remarks": found.remarks, "picks": kept,
    }  # fmt: skip


def described(instance: Instance, data: Path) -> dict[str, Any]:
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
