"""Calibration of a device: the times of counted operations, stored in a file of the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import re
from datetime import datetime
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from skugga.terrain.atomic_files import disk_error, write_atomically
from skugga.terrain.user_cache import user_cache_folder

SCHEMA_VERSION: Final = 2
"""Version of the profile's format. It changes if the meaning of the rates changes. Profiles of another version are ignored."""

Rate = Annotated[float, Field(ge=0, allow_inf_nan=False)]
"""Nanoseconds per counted operation."""

RelativeError = Annotated[float, Field(ge=0, allow_inf_nan=False)]
"""Absolute difference of a predicted time from the measured one, divided by the measured one."""


class Residual(BaseModel):
    """Relative errors of an algorithm's predicted times, for the times from which the rates were fitted.

    ``rows`` is the number of times. ``median`` and ``p90`` are the median and the 90th percentile of the errors.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rows: Annotated[int, Field(ge=1)]
    median: RelativeError
    p90: RelativeError


class DeviceProfile(BaseModel):
    """The calibration of a device.

    ``rates_ns`` are nanoseconds per counted operation, by part of the work and by name of the count (``skugga.shadows.work``).
    ``renderer`` and ``version`` are OpenGL's strings for the device and its driver. ``cpus`` is the number of CPU cores. ``engine``
    is the version of Skugga that measured the device. ``measured`` is the time of the measurement, and ``took_s`` its duration in
    seconds. ``residuals`` are the relative errors of predicted times by algorithm. ``is_estimate`` tells rates of a typical device
    from measured ones (``skugga.selector.cost.device_estimate``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[2] = SCHEMA_VERSION
    renderer: Annotated[str, Field(min_length=1)]
    version: Annotated[str, Field(min_length=1)]
    cpus: Annotated[int, Field(ge=1)]
    engine: str
    measured: datetime
    took_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    rates_ns: Annotated[dict[str, Annotated[dict[str, Rate], Field(min_length=1)]], Field(min_length=1)]
    residuals: dict[str, Residual] = {}
    is_estimate: bool = False


def profile_path(renderer: str, version: str) -> Path:
    """Return the path of the profile of a device and its driver version. The file name has readable words and a unique digest.

    ``renderer`` and ``version`` are OpenGL's strings.
    """
    words = re.sub(r"[^a-z0-9]+", "-", renderer.lower()).strip("-")[:40] or "device"
    digest = hashlib.sha256(f"{renderer}\n{version}".encode()).hexdigest()[:12]
    return user_cache_folder("devices") / f"{words}-{digest}.json"


def check_profile_file(renderer: str, version: str) -> None:
    """Raise the ``OSError`` with which ``save_profile`` would fail, before a calibration that takes minutes."""
    path = profile_path(renderer, version)
    path.parent.mkdir(parents=True, exist_ok=True)
    if (error := disk_error(path)) is not None:
        raise error


def save_profile(profile: DeviceProfile) -> Path:
    """Write a profile to its file by an atomic write. Raises ``OSError`` if the folder cannot be written."""
    path = profile_path(profile.renderer, profile.version)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, profile.model_dump_json(indent=1))
    return path


def load_profile(renderer: str, version: str) -> DeviceProfile | None:
    """Return the profile of a device, or ``None`` without a usable one (``missing_profile_reason`` gives the reason)."""
    profile = _read(renderer, version)
    return profile if isinstance(profile, DeviceProfile) else None


def missing_profile_reason(renderer: str, version: str) -> str | None:
    """Return why a device has no usable profile, as a sentence; ``None`` if it has one."""
    profile = _read(renderer, version)
    return profile if isinstance(profile, str) else None


def _read(renderer: str, version: str) -> DeviceProfile | str:
    """Return the profile of a device and its driver version, or as a sentence the reason why there is no usable one."""
    path = profile_path(renderer, version)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return f"{renderer} is not calibrated; skugga calibrate measures the times that predictions use"
    except (OSError, ValueError) as error:  # ValueError: not JSON, or not UTF-8
        return f"{path} cannot be read ({' '.join(str(error).split())}): run skugga calibrate again"
    if isinstance(data, dict) and data.get("schema_version") != SCHEMA_VERSION:
        return f"{path} was written by another version of Skugga: run skugga calibrate again"
    try:
        profile = DeviceProfile.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        field_path = ".".join(map(str, first["loc"])) or "the whole file"
        return f"{path}: {field_path}: {first['msg'].lower()}: run skugga calibrate again"
    if (profile.renderer, profile.version) != (renderer, version):
        return f"{path} is for another device, {profile.renderer}: run skugga calibrate again"
    return profile


def profile_digest(device: DeviceProfile | None) -> str:
    """Return a digest that changes with the calibration of a device; empty without a calibration.

    That of an estimate depends on its rates alone, so equal estimates of two machines or two starts have one digest.
    """
    if device is None:
        return ""
    text = device.model_dump_json(include={"rates_ns"} if device.is_estimate else None)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
