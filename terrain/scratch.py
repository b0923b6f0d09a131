"""Reuse the memory of large temporary arrays.

The operating system clears each page of new memory. For an array of tens of megabytes that is written once and read once, this
takes as long as the work on it.
"""

from __future__ import annotations

import weakref
from threading import Lock

import numpy as np

from skugga.terrain.cache import MIB

MAX_IDLE_BYTES = 128 * MIB
"""Upper bound of the address space that is kept while no array uses it. Pages that no array wrote take no memory."""

_buffers: list[tuple[memoryview, weakref.ref[np.ndarray] | None]] = []  # with the array that uses the memory, if any
_lock = Lock()


def scratch_array(shape: tuple[int, int], dtype: type[np.generic]) -> np.ndarray:
    """Return an uninitialised array, in the memory of an earlier one if nobody refers to that any more.

    The array and its views can be kept for any time: each of them holds the memory.
    """
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    with _lock:
        kept = [entry for entry in _buffers if _is_in_use(entry[1])]
        idle = sorted((buffer for buffer, user in _buffers if not _is_in_use(user)), key=len)
        buffer = next((buffer for buffer in idle if len(buffer) >= size), None) or np.empty(max(size, 1), np.uint8).data
        memory = np.frombuffer(buffer, dtype, shape[0] * shape[1])  # the base of all views, which therefore hold it
        nbytes = 0
        for candidate in [buffer, *(other for other in reversed(idle) if other is not buffer)]:
            nbytes += len(candidate)
            if nbytes <= MAX_IDLE_BYTES:
                kept.append((candidate, weakref.ref(memory) if candidate is buffer else None))
        _buffers[:] = kept
    return memory.reshape(shape)


def _is_in_use(user: weakref.ref[np.ndarray] | None) -> bool:
    """Return whether an array still uses memory. ``user`` is a reference to it, or ``None``."""
    return user is not None and user() is not None
