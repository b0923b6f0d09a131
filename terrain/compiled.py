"""Compiled loops: numba with its cache where one can be written, else without; and rows of a picture shared out to all cores."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core import event

P = ParamSpec("P")
R = TypeVar("R")

NOT_KEPT = "compiled loops cannot be kept, so every process compiles them anew, which takes minutes"
REMEDY = "NUMBA_CACHE_DIR names a folder for them"

CORES = (
    int(os.environ.get("NUMBA_NUM_THREADS", "0"))
    or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count())
    or 1
)
"""Threads of a process that its loops are shared out to."""

ROW_SHARES = 3
"""Shares of the rows for each of them: some rows take longer than others."""

log = logging.getLogger("skugga")

_reasons: list[str] = []


def why_not_kept() -> str | None:
    """Why this process cannot keep compiled loops for others, and what helps, in a sentence; ``None`` while it can."""
    return f"{_reasons[0]}: {REMEDY}" if _reasons else None


@contextmanager
def told_of_compiling(say: Callable[[], None]) -> Iterator[None]:
    """Call ``say`` once, if a loop that is kept nowhere is compiled meanwhile: after an installation that takes a minute or two."""
    with event.install_listener("numba:compile", _First(say)):
        yield


class _First(event.Listener):
    """Calls a function at the first event."""

    def __init__(self, say: Callable[[], None]) -> None:
        self._say: Callable[[], None] | None = say

    def on_start(self, event: Any) -> None:
        """Call it, if it was not yet."""
        say, self._say = self._say, None
        if say is not None:
            say()

    def on_end(self, event: Any) -> None:
        """Nothing."""


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` with numba: no fast-math (results must not depend on the machine), GIL released.

    What belongs together it takes as a ``NamedTuple`` of its module, or of one that changes seldom: numba's cache notices a change
    of the function's own file alone, and goes by the order of the fields. What may be ``None`` is a parameter of its own, so that
    each variant is compiled without the code of the others.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False}
    try:
        loop = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba finds no writable place for its cache, as in a read-only installation
        _reasons.append(f"{NOT_KEPT} (no folder can be written)")
        return numba.njit(cache=False, **options)(function)
    cache = getattr(loop, "_cache", None)
    if cache is not None:  # else a plain function, where numba is told not to compile
        _survive_renames(cache)
        _survive_full_disks(cache)
    return loop


def in_shares(rows: int, loop: Callable[..., Any], *args: Any) -> None:
    """Call ``loop(first, last, *args)`` for shares of some rows, on all cores: a compiled loop holds no lock while it runs.

    The loop itself must not call this: it would wait for the threads that it takes.
    """
    if CORES == 1 or rows < 2 * CORES:
        loop(0, rows, *args)
        return
    ends = [rows * n // (ROW_SHARES * CORES) for n in range(ROW_SHARES * CORES + 1)]
    shares = [(first, last) for first, last in zip(ends, ends[1:], strict=False) if last > first]
    for share in [_threads().submit(loop, first, last, *args) for first, last in shares]:
        share.result()


_pool: list[ThreadPoolExecutor] = []
os.register_at_fork(after_in_child=_pool.clear)  # a forked process has none of its parent's threads


def _threads() -> ThreadPoolExecutor:
    if not _pool:
        _pool.append(ThreadPoolExecutor(CORES, "skugga-rows"))
    return _pool[0]


def _survive_full_disks(cache: Any) -> None:
    """Let a loop that cannot be written be one that is not kept."""
    save = cache.save_overload

    def save_if_possible(signature: Any, made: Any) -> None:
        try:
            save(signature, made)
        except OSError as error:
            if not _reasons:  # numba has a folder for each of ours: one of them stands for all
                _reasons.append(f"{NOT_KEPT} ({cache.cache_path}: {error.strerror})")
                log.warning("%s", why_not_kept())

    cache.save_overload = save_if_possible


def _survive_renames(cache: Any) -> None:
    """Let a cache of an older version count as empty. Numba reads its index before it compares versions, and cannot if the index
    names a tuple or a module that is no longer there.
    """
    index = cache._cache_file
    load = index._load_index

    def load_or_begin_anew() -> dict[Any, Any]:
        try:
            return load()
        except (AttributeError, ImportError):
            return {}

    index._load_index = load_or_begin_anew
