"""Times of shadow algorithms, and of other tasks, that take turns.

Times are medians of the shadow alone, without the rest of the frame (``benchmark_views.run_interleaved``). Each is measured once in
a process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import TypeVar

import numpy as np

from benchmarks.algorithms import COMPARED_VARIANTS, COUNTING_VARIANTS
from benchmarks.benchmark_views import BenchmarkView, benchmark_view, make_plans, run_interleaved
from benchmarks.seeds.claims import Figures
from benchmarks.seeds.verdicts import FOUR
from skugga.shadows.plan import Plan

T = TypeVar("T")

LIGHTS = {"": "the spot", "_sun": "the sun"}

SIZE = 1280, 1024
REPEATS = 3

PASS_STAGES = {
    "map": "map", "depth map": "map", "visibility": "look-up", "mask": "look-up", "silhouettes": "volumes", "stencil": "counting",
}  # fmt: skip
"""Stages of the thesis by the engine's passes. The remaining time lies between the passes."""
BETWEEN = "between"
STAGE_NAMES = (*dict.fromkeys(PASS_STAGES.values()), BETWEEN)


@cache
def measure_times(level: str, view: str, algorithms: tuple[str, ...] = FOUR, repeats: int = REPEATS) -> Figures:
    """Return times of algorithms in a view."""
    view_shot = benchmark_view(level, view, SIZE)
    every = {**COMPARED_VARIANTS, **COUNTING_VARIANTS}
    return medians(
        {key: (view_shot, plan) for key, plan in make_plans(view_shot, {key: every[key] for key in algorithms}).items()}, repeats
    )


def medians(runs: dict[str, tuple[BenchmarkView, Plan]], repeats: int) -> Figures:
    """Return median milliseconds of each run (a view with a plan), in total and by stage, with redrawn and with cached shadow maps.

    Also return the share of pixels that a hybrid leaves to its shadow volumes.
    """
    interleaved = run_interleaved(runs, repeats)
    result: Figures = {}
    for (key, mode), milliseconds_of_runs in interleaved.times_ms.items():
        stages: dict[str, list[float]] = {name: [] for name in STAGE_NAMES}
        for all_ms, passes_ms in zip(milliseconds_of_runs, interleaved.passes_ms[key, mode], strict=True):
            for name in STAGE_NAMES[:-1]:
                stages[name].append(sum(ms for pass_name, ms in passes_ms.items() if PASS_STAGES[pass_name] == name))
            stages[BETWEEN].append(all_ms - sum(passes_ms.values()))
        medians_ms = {name: float(np.median(milliseconds)) for name, milliseconds in stages.items()}
        result.setdefault(key, {})[mode] = {"ms": float(np.median(milliseconds_of_runs)), "stages": medians_ms}
    for key, log in interleaved.logs.items():
        result[key]["marked"] = float(sum(record.marked for record in log.records.values()) / runs[key][0].valid.sum())
    return result


def ratio(at: Figures, algorithm: str, other: str, mode: str = "redrawn") -> float:
    """Return the ratio of one algorithm's time to another's. ``mode`` is ``redrawn`` (empty caches) or ``kept`` (cached maps)."""
    return at[algorithm][mode]["ms"] / at[other][mode]["ms"]


def interleaved_times(tasks: dict[str, Callable[[], T]], repeats: int) -> dict[str, list[tuple[float, T]]]:
    """Return milliseconds and results of tasks, task by task.

    Tasks take turns in alternating order. The first turn, which compiles and allocates, does not count.
    """
    results: dict[str, list[tuple[float, T]]] = {name: [] for name in tasks}
    for number in range(repeats + 1):
        for name in [*tasks][:: 1 if number % 2 else -1]:
            start = time.perf_counter()
            result = tasks[name]()
            if number:
                results[name].append((1000.0 * (time.perf_counter() - start), result))
    return results
