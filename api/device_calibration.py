"""Look-up and description of this device's calibration: the profile that predictions of time and error use."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from skugga.api.report.plan_text import LINE_WIDTH, display_name
from skugga.selector.cost.device_profile import DeviceProfile, load_profile
from skugga.selector.formatting import format_duration, format_percent
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.level.level import Shadows


def calibration_for(shadows: Shadows, overrides: dict[str, Any], shows_times: bool = False) -> DeviceProfile | None:
    """Return this device's calibration or an estimate of it, if a plan may need OpenGL.

    ``shadows`` are the level's settings, and ``overrides`` replace some of them. A software rasteriser without a calibration is
    estimated. If times are limited (``max_ms``) or shown (``shows_times``), the estimate runs a benchmark of about two seconds.
    Otherwise only ratios of times count, which a benchmark does not change.

    Returns ``None`` if no requested algorithm needs OpenGL, if there is neither a calibration nor an estimate, or without OpenGL.
    """
    algorithm_override = overrides.get("algorithm")
    algorithms = [algorithm_override] if algorithm_override else [settings.algorithm for settings in shadows.all_settings.values()]
    records = [ALGORITHMS.get(algorithm) if isinstance(algorithm, str) else None for algorithm in algorithms]
    if all(record is not None and not record.needs_opengl for record in records):
        return None
    max_ms = overrides.get("max_ms", shadows.max_ms)
    return calibration(runs_benchmark=shows_times or max_ms is not None)


def calibration(runs_benchmark: bool = True) -> DeviceProfile | None:
    """Return the calibration of this process's OpenGL device; ``None`` if it has none, or without OpenGL.

    A software rasteriser that is not calibrated is estimated (``skugga.selector.cost.device_estimate``), by a benchmark if
    ``runs_benchmark`` is true. A graphics card needs a calibration.
    """
    from skugga.selector.cost.device_estimate import estimated_profile, is_current, is_software_rasteriser, typical_profile
    from skugga.terrain.gl import device as gl

    renderer, version = gl.renderer_and_version()
    profile = load_profile(renderer, version)
    if (profile is not None and is_current(profile)) or not is_software_rasteriser(renderer):
        return profile
    return estimated_profile(renderer, version) if runs_benchmark else typical_profile(renderer, version)


def format_calibration(profile: DeviceProfile, path: Path) -> str:
    """Return a text for a terminal on a calibration: its measurements, the residuals of its fit, and its file."""
    rates = sum(map(len, profile.rates_ns.values()))
    lines = [
        f"Calibrated {profile.renderer} ({profile.version}, {profile.cpus} CPU cores) in "
        f"{format_duration(1000.0 * profile.took_s)}.",
        f"Measured {rates} rates, for {len(profile.rates_ns)} parts of the work.",
    ]
    if profile.residuals:
        fits = [
            f"{display_name(name)} median {format_percent(fit.median)}, 90th percentile {format_percent(fit.p90)}"
            for name, fit in profile.residuals.items()
        ]
        lines.append(f"Residuals of the fit, relative to the measured times: {'; '.join(fits)}.")
    lines += [
        f"Stored in {path}.",
        "The policy predict uses it from now on, for devices of this name and driver only. Equal devices share it. Running "
        "services load it within seconds.",
    ]
    return "\n".join(textwrap.fill(line, LINE_WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in lines)
