"""Calibrations that measure nothing: they are over at once, when they are told, never, or go wrong."""

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
    """A calibration of what fake render processes draw with."""
    fields = {
        "renderer": fake_workers.RENDERER, "version": fake_workers.VERSION, "cpus": 2, "engine": "0",
        "measured": datetime(2026, 1, 1, tzinfo=UTC), "took_s": 1.0, "rates_ns": {"map": {"texels": 1.0 / 3.0}},
    }  # fmt: skip
    return DeviceProfile(**{**fields, **changes})


def when_told(told: Path) -> DeviceProfile:
    """Ready as soon as a file is there."""
    while not told.exists():
        time.sleep(0.01)
    return profile()


def endless(begun: Path) -> DeviceProfile:
    """Leaves a temporary file behind, says where in ``begun``, and never ends."""
    _, left = tempfile.mkstemp()
    _append(begun, left)
    signal.pause()
    raise AssertionError


def failing(begun: Path) -> DeviceProfile:
    """Finds no device."""
    _append(begun, "failing")
    raise GraphicsError("libEGL is broken")


def dying(begun: Path) -> DeviceProfile:
    """Ends its process."""
    _append(begun, "dying")
    os._exit(9)


def buggy(begun: Path) -> DeviceProfile:
    """Divides by nothing."""
    _append(begun, "buggy")
    return profile(took_s=1 / 0)


def elsewhere(begun: Path) -> DeviceProfile:
    """Measures another device."""
    _append(begun, "elsewhere")
    return profile(renderer="another")


def _append(path: Path, text: str) -> None:
    with path.open("a") as file:
        file.write(f"{text}\n")
