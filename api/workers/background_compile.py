"""Background compilation of loops, once a service can draw, at the lowest priority.

A loop is a function that numba compiles to machine code and stores in a cache on disk. Missing loops are those that the cache
lacks.
"""

from __future__ import annotations

import asyncio
import logging
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from skugga.api.resource_exhaustion import run_in_pool
from skugga.api.workers.jobs import PreparationProgress
from skugga.terrain.compiling.ahead_of_time import PRODUCTS, Progress, compile_ahead

RETRY_DELAY_S = 60.0
"""Minimum seconds between a failed compilation and the next one."""

log = logging.getLogger("skugga")


class BackgroundCompile:
    """Compiles all missing loops once, in a separate process. After a failure the next ``start_if_needed`` retries.

    Use it from one event loop.

    Parameters
    ----------
    core_count
        Number of cores to use.
    on_progress
        Called in the event loop with the progress, and with ``None`` when the compilation has ended.
    """

    def __init__(self, core_count: int, on_progress: Callable[[PreparationProgress | None], None]) -> None:
        self._core_count, self._on_progress = core_count, on_progress
        self._executor = ThreadPoolExecutor(1, "skugga-compile")
        self._compile_process: subprocess.Popen[str] | None = None
        self._task: asyncio.Task[None] | None = None
        self._is_done = self._closed = False
        self._retry_at_s = float("-inf")

    @property
    def is_running(self) -> bool:
        """Whether loops are being compiled."""
        return self._task is not None and not self._task.done()

    def start_if_needed(self, missing_loop_count: int) -> None:
        """Start the compilation of the missing loops, whose number is ``missing_loop_count``. Return at once.

        It does not start if no loops are missing, it runs or is done already, or it failed less than ``RETRY_DELAY_S`` ago.
        """
        if self._closed or self.is_running or self._is_done or asyncio.get_running_loop().time() < self._retry_at_s:
            return
        if missing_loop_count:
            self._on_progress(PreparationProgress("compiling loops for other products", 0, missing_loop_count))
            self._task = asyncio.create_task(self._run(asyncio.get_running_loop()))

    async def close(self) -> None:
        """Kill the compiling process and wait for its end. Loops that it has compiled stay stored."""
        self._closed = True
        if self._compile_process is not None:
            self._compile_process.kill()
        if self._task is not None:
            await asyncio.gather(self._task, return_exceptions=True)
        self._executor.shutdown(wait=True)

    async def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        """Compile the missing loops in a thread, and record whether that succeeded. ``loop`` is the event loop."""

        def report(task: str, done: int, total: int) -> None:
            loop.call_soon_threadsafe(self._on_progress, PreparationProgress(task, done, total))

        try:
            await run_in_pool(self._executor, self._compile, report)
            self._is_done = True
        except Exception as error:
            self._retry_at_s = loop.time() + RETRY_DELAY_S
            log.warning("background compilation of numba functions failed: %s. They are compiled on first use.", error)
        finally:
            self._on_progress(None)

    def _compile(self, report: Progress) -> None:
        """Compile the missing loops in a separate process, and wait for its end. ``report`` is called in this thread."""
        compile_ahead(PRODUCTS, self._core_count, report, background=True, on_start=self._note_start)

    def _note_start(self, process: subprocess.Popen[str]) -> None:
        """Remember the compiling process, so that ``close`` can kill it; kill it at once if that has happened already."""
        self._compile_process = process
        if self._closed:
            process.kill()
