"""Measure an instance (a view under a light): draw every choice of algorithms, time it, and compare it with ray-traced truth."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.selection.code_versions import algorithms_of, origin_now, stale_algorithms
from benchmarks.selection.judge import GOALS
from benchmarks.selection.probes import record_probes
from benchmarks.selection.views import ViewInstance
from skugga.selector.candidates import name_of
from skugga.selector.cost.device_profile import DeviceProfile, load_profile
from skugga.selector.measure.compare import NO_CAST_SHADOW_REMARK, compare, picture_blocks, run_light
from skugga.selector.planner.planner import make_plan, planner_of
from skugga.selector.portfolio import portfolio
from skugga.selector.select import select
from skugga.shadows.plan import Plan, Step
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene

RUNS = 3
"""The number of timed runs of a row, all rows in turns, after a first run that compiles."""

Figures = dict[str, Any]
"""A measured view's record, or a row (measured plan) of it, by key."""


def plans_of(descriptor: Descriptor, scene: Scene, light: str) -> dict[str, Plan]:
    """Return by name the plans of all choices for a light, and the plans of the fixed rules for the largest error of each goal."""
    level = scene.loaded.level
    planner = planner_of(descriptor, level)
    choices = portfolio(descriptor, light, planner.casting_kinds(light), planner.requested_shadows)
    plans = {choice.name: planner.plan({light: choice}, {}) for choice in choices}
    return plans | {f"rules {goal.max_error:g}": make_plan(descriptor, level, {"max_error": goal.max_error}) for goal in GOALS}


def rows_of(plans: Mapping[str, Plan], light: str) -> dict[str, str]:
    """Return by choice the name of its row (measured plan). Choices share a row exactly if their plans have the same steps.

    The fixed rules may split cascades differently from a choice of the same name. The name of the second row then has the choice in
    parentheses.
    """
    names: dict[str, str] = {}
    rows_by_name: dict[str, list[tuple[list[Step], str]]] = {}
    for choice, plan in plans.items():
        name, light_steps = name_of(plan, light), plan.steps_of_light(light)
        same_name = rows_by_name.setdefault(name, [])
        row = next((row for steps, row in same_name if steps == light_steps), f"{name} ({choice})" if same_name else name)
        same_name.append((light_steps, row))
        names[choice] = row
    return names


def measure_instance(instance: ViewInstance, data: Path) -> Figures:
    """Measure an instance, and return its record. ``data`` is the folder of sample rasters.

    The record has the descriptor as ``POST /plan`` takes it, times and errors of all rows, and by choice the name of the row
    (``picks``). ``compared`` and ``timed`` are the origins of errors and times. ``error`` names the error of targets. It is
    ``wrong`` in a view without cast shadow, since ``wrong_cast`` is a share of cast shadow.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.open(data, Path(folder))
        light = scene.light_names[0]
        descriptor = describe(scene, view, instance.view)
        plans = plans_of(descriptor, scene, light)
        comparison = _compare_supported(scene, view, instance.view, light, plans)
        error, names = "wrong" if NO_CAST_SHADOW_REMARK in comparison.remarks else comparison.error, rows_of(plans, light)
        record = {
            "name": instance.name, "family": instance.family, "terrain": instance.terrain, "unseen": instance.unseen,
            "light": light,
            "renderer": device().renderer, "error": error, "boundary": _rounded(comparison.undecided_share),
            "noise_floor": _rounded(comparison.noise_floor), "remarks": comparison.remarks,
            "rows": {
                row: _row(compared_row.figures, light)
                for row, compared_row in zip(names.values(), comparison.rows, strict=True)
            },
            "picks": names,
            "descriptor": descriptor.model_dump(mode="json"),
        }  # fmt: skip
        record["compared"] = origin_now(algorithms_of(record["rows"]))
        return record | _time_rows(scene, view, light, plans, record["rows"])


def time_again(instance: ViewInstance, data: Path, record: Figures) -> Figures:
    """Return a record whose rows are timed again. Rows that no choice leads to any more are removed.

    If a choice leads to a row that was never measured, or to an algorithm whose code has changed (``code_versions``), the whole
    instance is measured again, except for its probes.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.open(data, Path(folder))
        light = record["light"]
        plans = plans_of(describe(scene, view, instance.view), scene, light)
        names = {choice: row for choice, row in rows_of(plans, light).items() if not _is_refused(choice, record)}
        if set(names.values()) <= set(record["rows"]) and not stale_algorithms(record, "compared"):
            rows = {row: record["rows"][row] for row in dict.fromkeys(names.values())}
            plans = {choice: plans[choice] for choice in names}
            return record | {"picks": names} | _time_rows(scene, view, light, plans, rows)
    return measure_instance(instance, data) | {key: record[key] for key in ("probe", "probed", "plan_ms") if key in record}


def compare_again(instance: ViewInstance, data: Path, record: Figures) -> Figures:
    """Return a record whose errors are measured again, those of rows and of probes, while all times are kept.

    It serves after a change of the code that alters pictures but takes the same time. Errors do not depend on other load of the
    machine. Raises ``ValueError`` if a choice leads to a row that was never measured.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.open(data, Path(folder))
        light = record["light"]
        plans = plans_of(describe(scene, view, instance.view), scene, light)
        comparison = _compare_supported(scene, view, instance.view, light, plans)
        names = rows_of(plans, light)
        if missing := set(names.values()) - set(record["rows"]):
            raise ValueError(f"{instance.name}: rows without times: {', '.join(sorted(missing))}")
        errors = {row: _row(compared_row.figures, light) for row, compared_row in zip(names.values(), comparison.rows, strict=True)}
        probe_record = record_probes(scene, view, instance.view, light, _calibration())
    rows = {row: record["rows"][row] | figures for row, figures in errors.items()}
    probe = record["probe"]
    probed_rows = {row: old | {"proofs": probe_record["rows"][row]["proofs"]} for row, old in probe["rows"].items()}
    return record | {
        "picks": names, "rows": rows, "boundary": _rounded(comparison.undecided_share),
        "noise_floor": _rounded(comparison.noise_floor), "remarks": comparison.remarks,
        "compared": origin_now(algorithms_of(rows)), "probe": _all_rounded(probe | {"rows": probed_rows}),
    }  # fmt: skip


def _is_refused(choice: str, record: Figures) -> bool:
    """Return whether a choice was left out of a record because its algorithm refused the view."""
    return "sweep" in choice and choice not in record["picks"]


def _time_rows(
    scene: Scene, view: MapView | PerspectiveView, light: str, plans: Mapping[str, Plan], rows: Mapping[str, Figures]
) -> Figures:
    """Return ``rows`` with their median milliseconds, and the origin of the times.

    Times are those of a perspective view, or of one block of a map on average. ``plans`` has the plans by choice, and ``rows`` the
    measured rows by name.
    """
    pictures = picture_blocks(scene, view)
    plan_by_row = {name: plans[choice] for choice, name in rows_of(plans, light).items()}
    times: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(1 + RUNS):
        for name, row_times in times.items():
            row_times.append(run_light(scene, pictures, plan_by_row[name], light).times[0])
    count = len(pictures) if isinstance(view, MapView) else 1
    timed = {name: row | {"ms": _rounded(float(np.median(times[name][1:])) / count), "runs": RUNS} for name, row in rows.items()}
    return {"rows": timed, "timed": origin_now(algorithms_of(timed))}


def _row(figures: Figures, light: str) -> Figures:
    """Return a row of the record (algorithms, rounded errors in [0, 1], bytes of the passes) from the figures of a comparison."""
    shares = {key: _rounded(figures[key]) for key in ("wrong", "wrong_cast", "interior", "coverage")}
    algorithms = sorted(set(figures["algorithm"].get(light, {}).values()) - {"none"})
    return {"algorithms": algorithms, **shares, "bytes": figures["bytes"]}


def describe_again(instance: ViewInstance, data: Path, record: Figures) -> Figures:
    """Return a record with a new descriptor, and with the milliseconds of describing the loaded scene and of choosing."""
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.open(data, Path(folder))
        profile = load_profile(device().renderer, device().version)
        times_ms = []
        for _ in range(1 + RUNS):
            start = time.perf_counter()
            descriptor = describe(scene, view, instance.view)
            select(descriptor, scene.loaded.level, None, "predict", profile)
            times_ms.append(1000.0 * (time.perf_counter() - start))
        return record | {"descriptor": descriptor.model_dump(mode="json"), "plan_ms": _rounded(float(np.median(times_ms[1:])))}


def measure_probes(instance: ViewInstance, data: Path, record: Figures) -> Figures:
    """Return a record with the measurements of probes."""
    with tempfile.TemporaryDirectory() as folder:
        scene, view = instance.open(data, Path(folder))
        probe_record = record_probes(scene, view, instance.view, record["light"], _calibration())
        return record | {"probe": _all_rounded(probe_record), "probed": origin_now(algorithms_of(record["rows"]))}


def _calibration() -> DeviceProfile:
    """Return the calibration of this machine's device."""
    profile = load_profile(device().renderer, device().version)
    assert profile is not None and not profile.is_estimate, "run skugga calibrate first"
    return profile


def _all_rounded(value: Any) -> Any:
    """Round every number in nested dictionaries and lists to five significant digits."""
    match value:
        case float():
            return _rounded(value)
        case dict():
            return {key: _all_rounded(entry) for key, entry in value.items()}
        case list():
            return [_all_rounded(entry) for entry in value]
    return value


def _compare_supported(scene: Scene, view: MapView | PerspectiveView, name: str, light: str, plans: dict[Any, Plan]) -> Any:
    """Compare the plans that support a view with ray-traced truth, and return the comparison.

    Refused plans are removed from ``plans``. ``name`` is the name of the view.
    """
    while True:
        try:
            return compare(scene, view, name, light=light, time_limit_s=0.0, plans=list(plans.values()))
        except UnsupportedError:
            swept = [choice for choice, plan in plans.items() if any(step.algorithm == "sweep" for step in plan.steps)]
            if not swept:
                raise
            for choice in swept:
                del plans[choice]


def _rounded(value: float) -> float:
    """Round a number to five significant digits."""
    return float(f"{value:.5g}")
