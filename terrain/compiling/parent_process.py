"""End a process together with its parent, by ``prctl`` on Linux.

On other systems a process ends when it finds that the pipe from its parent is closed.
"""

from __future__ import annotations

import ctypes
import signal
import sys
from contextlib import suppress

PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal that a process receives when its parent ends."""


def end_with_parent() -> None:
    """Make the kernel kill this process as soon as its parent ends, for whatever reason. Do nothing except on Linux."""
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
