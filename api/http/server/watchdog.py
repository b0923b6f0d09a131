"""Watchdog of the event loop: a service that is stuck ends itself, so that its supervisor starts it again.

Python waits for a new thread to run when it starts one. A thread that ends before that, for want of memory, leaves the event loop
waiting for ever (``threading.Thread.start``). Nothing in the loop can notice.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Callable

CHECK_INTERVAL_S = 5.0
"""Seconds between two checks whether the event loop runs."""

MAX_MISSED_CHECKS = 24
"""Consecutive checks in which the event loop did not run, after which the service ends: two minutes.

Checks are counted, not seconds, so that a process that was stopped for hours goes on where it was.
"""

STUCK_EXIT_STATUS = 70
"""Exit status of a stuck service: an internal software error (sysexits.h)."""

STUCK_MESSAGE = b"ERROR skugga: the event loop has been stuck for two minutes. The service ends, so that it can be started again.\n"


def end_stuck_process() -> None:
    """Write a message to standard error and end the process at once. Both need no memory."""
    os.write(2, STUCK_MESSAGE)
    os._exit(STUCK_EXIT_STATUS)


def watch_event_loop(
    loop: asyncio.AbstractEventLoop, on_stuck: Callable[[], None] = end_stuck_process, check_interval_s: float = CHECK_INTERVAL_S
) -> None:
    """Start a daemon thread that calls ``on_stuck`` once if the event loop does not run for ``MAX_MISSED_CHECKS`` checks.

    ``check_interval_s`` is the time in seconds between two checks. The thread ends with the loop.
    """
    has_run = threading.Event()

    def watch() -> None:
        missed_checks = 0
        while missed_checks < MAX_MISSED_CHECKS:
            try:
                loop.call_soon_threadsafe(has_run.set)
            except RuntimeError:  # the loop is closed
                return
            except MemoryError:
                pass
            time.sleep(check_interval_s)
            missed_checks = 0 if has_run.is_set() else missed_checks + 1
            has_run.clear()
        on_stuck()

    threading.Thread(target=watch, name="watchdog", daemon=True).start()
