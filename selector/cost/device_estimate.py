"""Estimate the rates of a device on its first use: those of a typical device, scaled by a benchmark of about two seconds.

The ratios between the times of two candidates are similar on many software rasterisers, so one factor makes the absolute times of
the typical device those of this one. A calibration (``skugga.selector.cost.calibration``) measures every rate, and takes minutes.
"""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from statistics import median

from skugga.selector.cost.device_profile import DeviceProfile, load_profile, profile_path, save_profile
from skugga.selector.cost.typical_device import typical_device
from skugga.shadows.algorithm import Algorithm
from skugga.terrain.cache import MIB, cached

log = logging.getLogger("skugga")

SOFTWARE_RASTERISERS = ("llvmpipe", "softpipe", "swiftshader")
"""Words in OpenGL's renderer string, in lower case, of devices that the rates of the typical device, a CPU, suit."""

BENCHMARK_VIEWS: dict[str, Callable[[Algorithm], bool]] = {
    "few_balls_small": lambda algorithm: algorithm.is_selectable and algorithm.needs_opengl,
    "hills_map": lambda algorithm: algorithm.is_selectable and not algorithm.needs_opengl,
}
"""Calibration views of the benchmark, and which algorithms are timed on them."""

BENCHMARK_RUNS = 2
"""Number of runs of each step. The least time counts, since the first run includes compilation."""


def is_software_rasteriser(renderer: str) -> bool:
    """Return whether OpenGL's renderer string is that of a software rasteriser."""
    return any(word in renderer.lower() for word in SOFTWARE_RASTERISERS)


def typical_profile(renderer: str, driver_version: str) -> DeviceProfile:
    """Return a device's estimated profile with the typical device's rates, for plans that depend on ratios of times alone.

    ``renderer`` and ``driver_version`` are OpenGL's strings of the device.
    """
    return typical_device().model_copy(
        update={"renderer": renderer, "version": driver_version, "cpus": os.cpu_count() or 1, "residuals": {}, "is_estimate": True}
    )


@cached("process", MIB)
def estimated_profile(renderer: str, driver_version: str) -> DeviceProfile:
    """Run the benchmark on this process's device, save the estimated profile in the user's cache folder, and return it.

    ``renderer`` and ``driver_version`` are OpenGL's strings of the device. A profile that another process has stored meanwhile is
    returned instead. Where the folder cannot be written, or has an unusable profile, which stays, the new profile serves this
    process alone. Where the benchmark fails for want of space on disk, it is that of the typical device. Raises ``GraphicsError``
    without OpenGL.
    """
    start_s = time.perf_counter()
    typical = typical_profile(renderer, driver_version)
    try:
        factor = float(f"{_time_ratio():.2g}")
    except OSError as error:
        log.warning("the benchmark of this device failed, so plans use the times of a typical one: %s", error.strerror or error)
        return typical
    rates_ns = {part: {name: factor * rate for name, rate in rates.items()} for part, rates in typical.rates_ns.items()}
    profile = typical.model_copy(
        update={
            "engine": version("skugga"),
            "measured": datetime.now(UTC).replace(microsecond=0),
            "took_s": round(time.perf_counter() - start_s, 1),
            "rates_ns": rates_ns,
        }
    )
    stored = load_profile(renderer, driver_version)
    if stored is not None and is_current(stored):
        return stored
    with suppress(OSError):
        if stored is not None or not profile_path(renderer, driver_version).exists():
            save_profile(profile)
    return profile


def is_current(profile: DeviceProfile) -> bool:
    """Return whether a profile is a calibration, or an estimate by the present rates of the typical device."""
    if not profile.is_estimate:
        return True
    typical_rates_ns = typical_device().rates_ns
    ratios = [
        profile.rates_ns.get(part, {}).get(name, 0.0) / rate
        for part, rates in typical_rates_ns.items()
        for name, rate in rates.items()
        if rate > 0.0
    ]
    return max(ratios) - min(ratios) <= 1e-6 * max(ratios)


def _time_ratio() -> float:
    """Return the median ratio of this device's times to those of the typical device, over the steps of the benchmark."""
    from skugga.selector.cost.calibration import calibration_jobs, run_job
    from skugga.selector.cost.calibration_scenes import calibration_views
    from skugga.selector.cost.cost_model import counts_to_ms

    rates_ns, ratios = typical_device().rates_ns, []
    with tempfile.TemporaryDirectory(prefix="skugga-") as folder:
        for view in calibration_views(Path(folder), BENCHMARK_VIEWS):
            for job in calibration_jobs(view, BENCHMARK_VIEWS[view.name]):
                expected_ms = sum(counts_to_ms(rates_ns.get(part, {}), counts) for part, counts in job.work.items())
                if expected_ms <= 0.0 or not set(job.work) <= set(rates_ns):  # an algorithm that was never calibrated
                    continue
                for _ in range(BENCHMARK_RUNS):
                    run_job(job)
                ratios.append(sum(job.min_ms.values()) / expected_ms)
    return median(ratios) if ratios else 1.0
