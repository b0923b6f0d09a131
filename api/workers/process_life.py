"""What the service knows of its processes from outside. Where the system has no ``/proc`` (that is, not on Linux), nothing is
known.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path

NICENESS = 2
"""How far render processes stand back behind the service, which answers from its caches while they draw: see nice(2)."""

LOWEST = 19
"""The niceness of what is done while nothing is asked for."""

JOIN_S = 5.0
"""How long a killed process may take to be gone."""

END_CHECK_S = 0.005
"""How often it is looked whether a killed process is gone."""

STOPPED_STATES = "Tt"
"""Of ``/proc/PID/stat``: stopped by a signal or by a tracer."""


def stand_back() -> None:
    """Let the service go before this process where both want the same core."""
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)


def give_way() -> None:
    """Let all others go before this process: for cores, and where memory runs out, which then ends this one."""
    with suppress(OSError, AttributeError):
        os.nice(LOWEST)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


async def process_end(process: BaseProcess) -> None:
    """Wait until a killed process is gone, for ``JOIN_S`` at most. This needs no thread: there may be none left."""
    until_s = asyncio.get_running_loop().time() + JOIN_S
    while process.exitcode is None and asyncio.get_running_loop().time() < until_s:
        await asyncio.sleep(END_CHECK_S)


def is_stopped(pid: int) -> bool:
    """Whether a process was stopped (SIGSTOP, a debugger) and not continued: it will answer nothing."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return state in STOPPED_STATES


def resident_bytes(pid: int | None = None) -> int:
    """Memory that a process takes now, this one by default; 0 where there is no way to know."""
    try:
        pages = Path(f"/proc/{pid or 'self'}/statm").read_text(encoding="ascii").split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def open_descriptors() -> int:
    """File descriptors that this process has open; a usual number where there is no way to count them."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return 32
