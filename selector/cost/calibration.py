"""Calibrate a device: time the real shadow work on generated scenes, and fit the rates that explain the times."""

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
from skugga.selector.cost.cost_model import MS_PER_NS, counts_to_ms, step_work
from skugga.selector.cost.device_profile import DeviceProfile, Residual
from skugga.shadows.algorithm import Algorithm
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS, can_serve
from skugga.shadows.visibility import fill_steps
from skugga.shadows.work import Counts
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.antialias import picture_buffer
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene

TIMING_ROUNDS = 3
"""Rounds of timing. Each round times every job, so that other load on the machine affects all jobs alike.

The least time of a job counts, because the first run includes compilation.
"""

TIME_LIMIT_S = 90.0
"""Seconds after which the third round of timing stops. The first two rounds always complete."""

ProgressCallback = Callable[[int, int], None]
"""A function that is called with the number of steps done and the total number of steps."""


@dataclass(frozen=True, eq=False)
class CalibrationJob:
    """A step of a plan (one call of an algorithm) that is timed on the geometry of a calibration view.

    Attributes
    ----------
    scene
        The scene.
    buffer
        Geometry of the view.
    casters
        Casters that reach the view.
    step
        The step.
    work
        Counts of operations by part of the work (``skugga.shadows.work``).
    min_ms
        Least time so far by part of the work, milliseconds.
    """

    scene: Scene
    buffer: GeometryBuffer
    casters: Casters
    step: Step
    work: dict[str, Counts]
    min_ms: dict[str, float] = field(default_factory=dict)


def calibrate(on_step: ProgressCallback | None = None) -> DeviceProfile:
    """Calibrate this process's device and return its profile.

    It takes about a minute. ``on_step(done, total)`` reports progress. Raises ``GraphicsError`` without OpenGL.
    """
    start, gl = time.perf_counter(), device()
    jobs = _timed_jobs(start, on_step or (lambda done, total: None))
    rates = fitted_rates([(job.work[part], part, ms) for job in jobs for part, ms in job.min_ms.items()])
    return DeviceProfile(
        renderer=gl.renderer, version=gl.version, cpus=os.cpu_count() or 1, engine=version("skugga"),
        measured=datetime.now(UTC).replace(microsecond=0), took_s=round(time.perf_counter() - start, 1), rates_ns=rates,
        residuals=fit_residuals(rates, jobs),
    )  # fmt: skip


def _timed_jobs(start_s: float, on_step: ProgressCallback) -> list[CalibrationJob]:
    """Run the jobs of all calibration views for ``TIMING_ROUNDS`` rounds, and return them with their least times.

    ``start_s`` is the start of the calibration by ``time.perf_counter``, for ``TIME_LIMIT_S``.
    """
    with tempfile.TemporaryDirectory(prefix="skugga-") as folder:
        jobs = [job for calibration_view in calibration_views(Path(folder)) for job in calibration_jobs(calibration_view)]
        for round_number in range(TIMING_ROUNDS):
            for number, job in enumerate(jobs, start=round_number * len(jobs) + 1):
                if round_number <= 1 or time.perf_counter() - start_s < TIME_LIMIT_S:
                    run_job(job)
                on_step(number, TIMING_ROUNDS * len(jobs))
    return jobs


def calibration_jobs(
    calibration_view: CalibrationView, is_timed: Callable[[Algorithm], bool] = lambda algorithm: True
) -> list[CalibrationJob]:
    """Return the jobs to time on a calibration view: one for each algorithm and its settings to calibrate.

    Algorithms for which ``is_timed`` returns ``False`` are left out.
    """
    descriptor = describe(calibration_view.scene, calibration_view.view, calibration_view.name, "points")
    picture = picture_buffer(calibration_view.scene, calibration_view.view)
    casters = find_casters(calibration_view.scene, picture.pixel_buffer)
    return [
        CalibrationJob(
            calibration_view.scene,
            picture.buffer,
            casters,
            step,
            step_work(descriptor, step.light, step.kinds, step.algorithm, step.settings),
        )
        for step in _steps(descriptor, calibration_view)
        if is_timed(ALGORITHMS[step.algorithm])
    ]


def _steps(descriptor: Descriptor, calibration_view: CalibrationView) -> Iterator[Step]:
    """Yield the steps to time on a calibration view.

    Each algorithm is timed with several settings, for the kinds of casters whose shadows it can draw.
    """
    for algorithm in ALGORITHMS.values():
        kinds = tuple(
            kind for kind in calibration_view.kinds if can_serve(algorithm.name, descriptor, calibration_view.light, kind)
        )
        if algorithm.passes and kinds:
            for settings in algorithm.calibration_settings(descriptor, calibration_view.light, calibration_view.calibration_extent):
                yield Step(calibration_view.light, kinds, algorithm.name, settings)


def run_job(job: CalibrationJob) -> None:
    """Run a job once, and update the least time of each part of its work."""
    clear_caches("light")
    step, log, start = job.step, PassLog(), time.perf_counter()
    fill_steps([step], job.buffer, job.scene, job.casters, (), log)
    left_ms = (time.perf_counter() - start) * 1000.0
    passes_ms = {name.split(": ", 1)[1]: record.ms for name, record in log.records.items()}
    pass_of = ALGORITHMS[step.algorithm].cost.pass_of_part
    *earlier_parts, last = sorted(job.work, key=lambda part: pass_of.get(_base_part(part)) is None)
    for part in earlier_parts:
        part_ms = passes_ms[pass_of[_base_part(part)]]
        left_ms -= part_ms
        job.min_ms[part] = min(part_ms, job.min_ms.get(part, np.inf))
    job.min_ms[last] = min(max(left_ms, 1e-3), job.min_ms.get(last, np.inf))


def _base_part(part: str) -> str:
    """Return the name of a part of the work without its kind of view or light, which follows a comma."""
    return part.split(",")[0]


def fitted_rates(rows: list[tuple[Counts, str, float]]) -> dict[str, dict[str, float]]:
    """Fit the rates (nanoseconds per counted operation) that explain measured times. Rates are not negative.

    Each of ``rows`` holds counts of operations by name, the part of the work, and its milliseconds. The result is the rate by part
    and by name of the count. The fit minimizes the sum of squares of the relative errors. The algorithm is that of C. Lawson and R.
    Hanson, Solving Least Squares Problems, 1974.
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
    """Return the relative errors of the times that the rates predict for whole steps, by algorithm.

    ``rates_ns`` are the rates by part of the work and name of the count, and ``jobs`` the measured steps.
    """
    errors: dict[str, list[float]] = {}
    for job in jobs:
        real_ms = sum(job.min_ms.values())
        expected_ms = sum(counts_to_ms(rates_ns[part], counts) for part, counts in job.work.items())
        errors.setdefault(job.step.algorithm, []).append(abs(expected_ms / real_ms - 1.0))
    return {
        name: Residual(
            rows=len(relative_errors), median=float(np.median(relative_errors)), p90=float(np.quantile(relative_errors, 0.9))
        )
        for name, relative_errors in errors.items()
    }
