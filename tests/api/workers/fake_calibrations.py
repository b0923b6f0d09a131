"""Fake calibrations that measure nothing: they end at once, on request or never, or they fail."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from skugga.selector.cost.device_profile import DeviceProfile
from skugga.terrain.errors import GraphicsError
from tests.api.workers import fake_workers


def profile(**changes) -> DeviceProfile:
    """Return a profile of the device that fake render processes draw with."""
    fields = {
        "renderer": fake_workers.RENDERER, "version": fake_workers.VERSION, "cpus": 2, "engine": "0",
        "measured": datetime(2026, 1, 1, tzinfo=UTC), "took_s": 1.0, "rates_ns": {"map": {"texels": 1.0 / 3.0}},
    }  # fmt: skip
    return DeviceProfile(**{**fields, **changes})


def return_when_file_exists(path: Path) -> DeviceProfile:
    """Return a profile as soon as a file exists."""
    while not path.exists():
        time.sleep(0.01)
    return profile()


def run_endlessly(start_log: Path) -> DeviceProfile:
    """Leave a temporary file behind, append its path to ``start_log``, and never end."""
    _, temporary_file = tempfile.mkstemp()
    _append(start_log, temporary_file)
    signal.pause()
    raise AssertionError


def raise_graphics_error(start_log: Path) -> DeviceProfile:
    """Fail to find a device."""
    _append(start_log, "failing")
    raise GraphicsError("libEGL is broken")


def exit_process(start_log: Path) -> DeviceProfile:
    """End the process."""
    _append(start_log, "dying")
    os._exit(9)


def divide_by_zero(start_log: Path) -> DeviceProfile:
    """Divide by zero."""
    _append(start_log, "buggy")
    return profile(took_s=1 / 0)


def return_other_device(start_log: Path) -> DeviceProfile:
    """Return the profile of another device."""
    _append(start_log, "elsewhere")
    return profile(renderer="another")


def _append(path: Path, text: str) -> None:
    """Append a line of text to a file."""
    with path.open("a") as file:
        file.write(f"{text}\n")
