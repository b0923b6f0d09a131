"""Measuring a device: the real fills on made scenes, and the rates that explain their times."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from skugga.selector.cost.calibration_scenes import CalibrationView, calibration_views
from skugga.selector.cost.cost_model import MS_PER_NS, counts_to_ms, work_of
from skugga.selector.cost.device_profile import DeviceProfile, Residual
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS, can_serve
from skugga.shadows.visibility import fill_steps
from skugga.shadows.work import Counts
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.reach import Casters, casters_of
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.antialias import picture_buffer
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene

TIMING_ROUNDS = 3
"""Everything is measured so often, in turns, so that what else the machine does meets all alike. The least time counts: the first
pays for compiling, too.
"""

LIMIT_S = 90.0
"""After so many seconds no further turn is begun."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class CalibrationJob:
    """A step to be measured on a stage's geometry, with its work by part, and the least times of these, milliseconds."""

    scene: Scene
    buffer: GeometryBuffer
    casters: Casters
    step: Step
    work: dict[str, Counts]
    least_ms: dict[str, float] = field(default_factory=dict)


def calibrate(on_step: Progress | None = None) -> DeviceProfile:
    """Measure this process's device; ``on_step(done, total)`` is called as the work goes on, ``done`` rising to ``total``.

    It takes a minute or so. Raises ``GraphicsError`` where there is no OpenGL.
    """
    start, gl = time.perf_counter(), device()
    jobs = _measured(start, on_step or (lambda done, total: None))
    rates = fitted_rates([(job.work[part], part, ms) for job in jobs for part, ms in job.least_ms.items()])
    return DeviceProfile(
        renderer=gl.renderer, version=gl.version, cpus=os.cpu_count() or 1, engine=version("skugga"),
        measured=datetime.now(UTC).replace(microsecond=0), took_s=round(time.perf_counter() - start, 1), rates_ns=rates,
        residuals=fit_residuals(rates, jobs),
    )  # fmt: skip


def _measured(start_s: float, on_step: Progress) -> list[CalibrationJob]:
    with tempfile.TemporaryDirectory(prefix="skugga-") as folder:
        jobs = [job for stage in calibration_views(Path(folder)) for job in calibration_jobs(stage)]
        for turn in range(TIMING_ROUNDS):
            for number, job in enumerate(jobs, start=turn * len(jobs) + 1):
                if turn <= 1 or time.perf_counter() - start_s < LIMIT_S:
                    _run(job)
                on_step(number, TIMING_ROUNDS * len(jobs))
    return jobs


def calibration_jobs(stage: CalibrationView) -> list[CalibrationJob]:
    """What is measured on a stage."""
    descriptor = describe(stage.scene, stage.view, stage.name, "points")
    picture = picture_buffer(stage.scene, stage.view)
    casters = casters_of(stage.scene, picture.own)
    return [
        CalibrationJob(
            stage.scene, picture.buffer, casters, step, work_of(descriptor, step.light, step.kinds, step.algorithm, step.settings)
        )
        for step in _steps(descriptor, stage)
    ]


def _steps(descriptor: Descriptor, stage: CalibrationView) -> Iterator[Step]:
    """What is tried on a stage: the settings of each algorithm that its record names, past the casters that it serves."""
    for algorithm in ALGORITHMS.values():
        kinds = tuple(kind for kind in stage.kinds if can_serve(algorithm.name, descriptor, stage.light, kind))
        if algorithm.passes and kinds:
            for settings in algorithm.calibrated(descriptor, stage.light, stage.grid):
                yield Step(stage.light, kinds, algorithm.name, settings)


def _run(job: CalibrationJob) -> None:
    """Run a job once, and note the times of its parts."""
    clear_caches("light")
    step, log, start = job.step, PassLog(), time.perf_counter()
    fill_steps([step], job.buffer, job.scene, job.casters, (), log)
    left_ms = (time.perf_counter() - start) * 1000.0
    passes_ms = {name.split(": ", 1)[1]: record.ms for name, record in log.records.items()}
    pass_of = ALGORITHMS[step.algorithm].cost.passes
    *others, last = sorted(job.work, key=lambda part: pass_of.get(_plain(part)) is None)
    for part in others:
        its_ms = passes_ms[pass_of[_plain(part)]]
        left_ms -= its_ms
        job.least_ms[part] = min(its_ms, job.least_ms.get(part, np.inf))
    job.least_ms[last] = min(max(left_ms, 1e-3), job.least_ms.get(last, np.inf))


def _plain(part: str) -> str:
    return part.split(",")[0]


def fitted_rates(rows: list[tuple[Counts, str, float]]) -> dict[str, dict[str, float]]:
    """Rates in nanoseconds by part and count, none of them negative, with the least sum of squares of relative errors over ``rows``
    (counts, their part, milliseconds); the algorithm is that of C. Lawson and R. Hanson, Solving Least Squares Problems, 1974.
    """
    from scipy.optimize import nnls

    rates_ns = {}
    for part in dict.fromkeys(part for _, part, _ in rows):
        part_rows = [(counts, ms) for counts, row_part, ms in rows if row_part == part]
        names = sorted({name for counts, _ in part_rows for name, count in counts.items() if count > 0.0})
        shares = np.array([[MS_PER_NS * counts.get(name, 0.0) / ms for name in names] for counts, ms in part_rows])
        scale = shares.max(axis=0)
        rates, _ = nnls(shares / scale, np.ones(len(part_rows)))
        rates_ns[part] = dict(zip(names, (rates / scale).tolist(), strict=True))
    return rates_ns


def fit_residuals(rates_ns: Mapping[str, Mapping[str, float]], jobs: list[CalibrationJob]) -> dict[str, Residual]:
    """How far rates are off the times of whole steps, by algorithm."""
    errors: dict[str, list[float]] = {}
    for job in jobs:
        real_ms = sum(job.least_ms.values())
        expected_ms = sum(counts_to_ms(rates_ns[part], counts) for part, counts in job.work.items())
        errors.setdefault(job.step.algorithm, []).append(abs(expected_ms / real_ms - 1.0))
    return {
        name: Residual(
            rows=len(relative_errors), median=float(np.median(relative_errors)), p90=float(np.quantile(relative_errors, 0.9))
        )
        for name, relative_errors in errors.items()
    }
