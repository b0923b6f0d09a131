"""Times of shadow algorithms and of other tasks, which take turns.

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
from benchmarks.seeds.verdicts import THESIS_ALGORITHMS
from skugga.shadows.plan import Plan

T = TypeVar("T")

LIGHT_BY_SUFFIX = {"": "the spot", "_sun": "the sun"}
"""Names of the lights for readers, by the suffix of the thesis's levels."""

SIZE_PX = 1280, 1024
"""Width and height of the timed views."""
REPEATS = 3
"""Number of timed turns."""

STAGE_BY_PASS = {
    "map": "map", "depth map": "map", "visibility": "look-up", "mask": "look-up", "silhouettes": "volumes", "stencil": "counting",
}  # fmt: skip
"""Stage of the thesis by pass of the engine. The remaining time, between passes, is the stage ``BETWEEN_PASSES``."""
BETWEEN_PASSES = "between"
"""Name of the stage that is the time outside of all passes."""
STAGE_NAMES = (*dict.fromkeys(STAGE_BY_PASS.values()), BETWEEN_PASSES)


@cache
def measure_times(level: str, view: str, algorithms: tuple[str, ...] = THESIS_ALGORITHMS, repeats: int = REPEATS) -> Figures:
    """Return median times of algorithms in the view ``view`` of a bundled level (``median_times``).

    ``algorithms`` are keys of ``COMPARED_VARIANTS`` or ``COUNTING_VARIANTS``.
    """
    timed_view = benchmark_view(level, view, SIZE_PX)
    all_variants = {**COMPARED_VARIANTS, **COUNTING_VARIANTS}
    return median_times(
        {key: (timed_view, plan) for key, plan in make_plans(timed_view, {key: all_variants[key] for key in algorithms}).items()},
        repeats,
    )


def median_times(runs: dict[str, tuple[BenchmarkView, Plan]], repeats: int) -> Figures:
    """Return median milliseconds of each run (a view with a plan), in total and by stage, with redrawn and with cached shadow maps.

    Also return the share of pixels that a hybrid leaves to its shadow volumes.
    """
    interleaved = run_interleaved(runs, repeats)
    result: Figures = {}
    for (key, mode), milliseconds_of_runs in interleaved.times_ms.items():
        stages: dict[str, list[float]] = {name: [] for name in STAGE_NAMES}
        for total_ms, passes_ms in zip(milliseconds_of_runs, interleaved.passes_ms[key, mode], strict=True):
            for name in STAGE_NAMES[:-1]:
                stages[name].append(sum(ms for pass_name, ms in passes_ms.items() if STAGE_BY_PASS[pass_name] == name))
            stages[BETWEEN_PASSES].append(total_ms - sum(passes_ms.values()))
        medians_ms = {name: float(np.median(milliseconds)) for name, milliseconds in stages.items()}
        result.setdefault(key, {})[mode] = {"ms": float(np.median(milliseconds_of_runs)), "stages": medians_ms}
    for key, log in interleaved.logs.items():
        result[key]["marked"] = float(sum(record.marked for record in log.records.values()) / runs[key][0].valid.sum())
    return result


def time_ratio(times: Figures, algorithm: str, other: str, mode: str = "redrawn") -> float:
    """Return the ratio of one algorithm's time to another's. ``mode`` is ``redrawn`` (empty caches) or ``kept`` (cached maps)."""
    return times[algorithm][mode]["ms"] / times[other][mode]["ms"]


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
