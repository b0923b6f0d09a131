"""Decorators for loops that numba compiles, and helpers that share work out to CPU cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.dispatcher import Dispatcher

from skugga.terrain.compiling.internal import InternalCompiler, forbid_python_calls
from skugga.terrain.compiling.loop_cache import LoopCache
from skugga.terrain.cores import usable_cores

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

CORES = int(os.environ.get("NUMBA_NUM_THREADS", "0")) or usable_cores()
"""Number of threads among which this process divides its loops."""

CHUNKS_PER_CORE = 3
"""Chunks of rows per thread. More than one balances the load, since some rows take longer than others."""


_NUMBA_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, "no_cfunc_wrapper": True}
"""Options of all loops. No fast-math: results must not depend on the machine. The GIL is released: loops run on all cores."""


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` with numba.

    ``skugga.terrain.compiling`` stores the machine code on disk for other processes. It compiles again after any change that the
    code depends on. Pass values that belong together as a ``NamedTuple``. Make a value that may be ``None`` a parameter of its own:
    numba then compiles one variant for ``None`` and one for a value.
    """
    loop = numba.njit(**_NUMBA_OPTIONS)(function)
    if isinstance(loop, Dispatcher):  # else NUMBA_DISABLE_JIT is set and ``loop`` is the plain function
        vars(loop)["_cache"] = LoopCache(loop)
    return loop


def internal(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` as a part of the compiled loops that call it. Python cannot call it.

    Use it for every function that only compiled loops call. Numba optimises and stores its machine code as a part of theirs.
    """
    options = {**_NUMBA_OPTIONS, "no_cpython_wrapper": True, "pipeline_class": InternalCompiler}
    loop = numba.njit(**options)(function)
    if isinstance(loop, Dispatcher):
        vars(loop)["_cache"] = LoopCache(loop, is_stored=False)
        forbid_python_calls(loop)
    return loop


def run_in_chunks(rows: int, loop: Callable[..., Any], *args: Any) -> None:
    """Call ``loop(first, last, *args)`` for chunks [``first``, ``last``) of all rows, on all cores.

    A compiled loop releases the GIL while it runs. The loop itself must not call this function: it would wait for the threads that
    it occupies, and so deadlock.
    """
    if CORES == 1 or rows < 2 * CORES:
        loop(0, rows, *args)
        return
    ends = [rows * n // (CHUNKS_PER_CORE * CORES) for n in range(CHUNKS_PER_CORE * CORES + 1)]
    chunks = [(first, last) for first, last in zip(ends, ends[1:], strict=False) if last > first]
    for future in [_thread_pool().submit(loop, first, last, *args) for first, last in chunks]:
        future.result()


def map_on_cores(work: Callable[[T], R], parts: Iterable[T], cores: int = CORES) -> list[R]:
    """Return ``work(part)`` of all parts, computed on several cores. With one core, or for one part, it runs in this thread.

    Use ``run_in_chunks`` for the rows of a loop. Here the caller divides the work into parts. The call creates its own threads, so
    ``work`` itself may call ``run_in_chunks``.
    """
    parts = list(parts)
    if cores == 1 or len(parts) < 2:  # to start threads takes longer than the loops of a small raster
        return [work(part) for part in parts]
    with ThreadPoolExecutor(cores) as threads:
        return list(threads.map(work, parts))


_pool: list[ThreadPoolExecutor] = []
os.register_at_fork(after_in_child=_pool.clear)  # a forked process has none of its parent's threads


def _thread_pool() -> ThreadPoolExecutor:
    """Return the threads of ``run_in_chunks``, which the first call starts."""
    if not _pool:
        _pool.append(ThreadPoolExecutor(CORES, "skugga-rows"))
    return _pool[0]
