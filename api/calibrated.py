"""What this machine was calibrated for: the profile that predictions go by, found for the device that a process draws with."""

from __future__ import annotations

import hashlib
import textwrap
from pathlib import Path
from typing import Any

from api.report.plan_words import WIDTH, spoken
from selector.cost.device_profile import DeviceProfile, load_profile
from selector.words import duration, percent
from terrain.errors import GraphicsError
from terrain.gl import device as gl
from terrain.level.level import Shadows

WITHOUT_OPENGL = ("sweep", "truth", "none")
"""Algorithms that leave nothing to predict, and that draw maps without a device."""


def calibration_for(shadows: Shadows, overrides: dict[str, Any]) -> DeviceProfile | None:
    """This device's calibration where there is something to choose; ``None`` where it has none, or there is no OpenGL."""
    asked = overrides.get("algorithm") or shadows.algorithm
    return None if asked in WITHOUT_OPENGL else calibration()


def calibration() -> DeviceProfile | None:
    """The calibration of the device that this process draws with; ``None`` where there is none, or no OpenGL."""
    try:
        device = gl.device()
    except GraphicsError:
        return None
    return load_profile(device.renderer, device.version)


def digest_of(device: DeviceProfile | None) -> str:
    """What changes with a calibration; empty where there is none."""
    return "" if device is None else hashlib.sha256(device.model_dump_json().encode()).hexdigest()[:16]


def in_words(profile: DeviceProfile, path: Path) -> str:
    """What a calibration measured, how well it fits and where it is kept, as text for a terminal."""
    rates = sum(map(len, profile.rates_ns.values()))
    said = [
        f"Calibrated {profile.renderer} ({profile.version}, {profile.cpus} CPU cores) in {duration(1000.0 * profile.took_s)}.",
        f"{rates} rates measured, for {len(profile.rates_ns)} parts of the work.",
    ]
    if profile.residuals:
        fits = [
            f"{spoken(name)} median {percent(fit.median)}, 90th percentile {percent(fit.p90)}"
            for name, fit in profile.residuals.items()
        ]
        said.append(f"Residuals of the fit, relative to the measured times: {'; '.join(fits)}.")
    said += [
        f"Kept in {path}.",
        "The policy predict uses it from now on, on this device and driver only. A running service uses it from the next "
        "render process that it starts.",
    ]
    return "\n".join(textwrap.fill(line, WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in said)
