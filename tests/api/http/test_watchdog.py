"""The watchdog ends a process whose event loop is stuck, and no other."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from skugga.api.http.server import watchdog
from skugga.api.http.server.watchdog import STUCK_EXIT_STATUS, STUCK_MESSAGE, watch_event_loop

ROOT = Path(__file__).resolve().parents[3]

STUCK_SCRIPT = """
import asyncio, threading
from skugga.api.http.server import watchdog

async def hang():
    watchdog.watch_event_loop(asyncio.get_running_loop(), check_interval_s=0.01)
    threading.Event().wait()  # as Thread.start waits for a thread that has ended already

asyncio.run(hang())
"""


def test_a_stuck_process_ends_with_a_message():
    run = subprocess.run([sys.executable, "-c", STUCK_SCRIPT], cwd=ROOT, capture_output=True, timeout=60, check=False)
    assert (run.returncode, run.stderr) == (STUCK_EXIT_STATUS, STUCK_MESSAGE)


def test_a_loop_that_runs_or_stops_briefly_is_left_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(watchdog, "MAX_MISSED_CHECKS", 40)
    stuck = threading.Event()

    async def scenario() -> None:
        watch_event_loop(asyncio.get_running_loop(), stuck.set, check_interval_s=0.01)
        for _ in range(3):
            time.sleep(0.1)  # the loop stands still for ten ticks
            await asyncio.sleep(0.1)

    asyncio.run(scenario())
    time.sleep(0.6)  # longer than the ticks that would be missed: the thread has ended with the loop
    assert not stuck.is_set()
    assert not [thread for thread in threading.enumerate() if thread.name == "watchdog"]


def test_a_loop_that_stays_stuck_is_reported_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(watchdog, "MAX_MISSED_CHECKS", 5)
    reports: list[float] = []

    async def scenario() -> None:
        watch_event_loop(asyncio.get_running_loop(), lambda: reports.append(time.monotonic()), check_interval_s=0.01)
        time.sleep(1.0)

    asyncio.run(scenario())
    assert len(reports) == 1
