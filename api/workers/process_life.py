"""Priorities of processes, and facts about them from ``/proc``: memory, open files, and whether they are stopped.

On systems without ``/proc`` (other than Linux) these facts are unknown.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path

RENDER_NICENESS = 2
"""Niceness (see nice(2)) of render processes.

The service's own process has a higher priority, since it answers from its caches while they draw."""

IDLE_NICENESS = 19
"""Niceness of processes for idle work: the lowest priority."""

EXIT_TIMEOUT_S = 5.0
"""Maximum seconds to wait for the exit of a killed process."""

EXIT_POLL_INTERVAL_S = 0.005
"""Seconds between two checks whether a killed process has ended."""

STOPPED_STATES = "Tt"
"""Letters in ``/proc/PID/stat`` for the states of a process that a signal or a tracer has stopped."""


def lower_priority() -> None:
    """Set the niceness of this render process, so that the service's process has a higher priority."""
    with suppress(OSError, AttributeError):
        os.nice(RENDER_NICENESS)


def set_idle_priority() -> None:
    """Give this process the lowest CPU priority, and make it the first to be killed when memory runs out."""
    with suppress(OSError, AttributeError):
        os.nice(IDLE_NICENESS)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


async def wait_for_exit(process: BaseProcess) -> None:
    """Wait until a killed process has ended, for at most ``EXIT_TIMEOUT_S``.

    The function polls and needs no thread, since a machine under load may have no thread left.
    """
    until_s = asyncio.get_running_loop().time() + EXIT_TIMEOUT_S
    while process.exitcode is None and asyncio.get_running_loop().time() < until_s:
        await asyncio.sleep(EXIT_POLL_INTERVAL_S)


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped (by SIGSTOP or a debugger), so that it cannot answer; false if unknown."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return state in STOPPED_STATES


def resident_bytes(pid: int | None = None) -> int:
    """Return the resident memory of a process in bytes, by default of this one; 0 if unknown."""
    try:
        pages = Path(f"/proc/{pid or 'self'}/statm").read_text(encoding="ascii").split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def open_descriptors() -> int:
    """Return the number of open file descriptors of this process; 32, a typical number, if they cannot be counted."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return 32
