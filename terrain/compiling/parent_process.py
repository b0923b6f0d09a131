"""How a process ends with the one that started it. Where the system has no ``prctl`` (not on Linux), its pipe alone ends it."""

from __future__ import annotations

import ctypes
import signal
import sys
from contextlib import suppress

PR_SET_PDEATHSIG = 1
"""See prctl(2): the signal that a process gets when the one that started it ends."""


def end_with_parent() -> None:
    """Let the system kill this process as soon as its parent ends, however that ends, and whatever this one is doing then."""
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
