"""A child process that an event loop starts, waits for and ends. All blocking calls run in threads."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, TypeVar

from skugga.api.resource_exhaustion import run_in_pool
from skugga.api.workers.piped_process import PipedProcess
from skugga.api.workers.process_life import EXIT_TIMEOUT_S, wait_for_exit

T = TypeVar("T")

log = logging.getLogger("skugga")


class ChildProcess:
    """A child process with a pipe, and the thread that reads from the pipe.

    Call ``start``, then ``run_in_thread`` with functions that use ``pipe``, then ``end``. Cancelling a wait does not stop its
    thread. The thread ends when the process ends. Use it from one event loop.
    """

    def __init__(self, piped_process: PipedProcess, threads: Executor) -> None:
        self.pipe = piped_process.pipe
        self._piped, self._threads = piped_process, threads
        self._thread_future: asyncio.Future[Any] | None = None

    @property
    def pid(self) -> int | None:
        """Process id; ``None`` before the start."""
        return self._piped.process.pid

    @property
    def exitcode(self) -> int | None:
        """Exit status of the process; ``None`` while it runs."""
        return self._piped.process.exitcode

    @property
    def sentinel(self) -> int:
        """A file descriptor that becomes readable when the process ends."""
        return self._piped.process.sentinel

    async def start(self) -> None:
        """Start the process. Raises ``ExhaustedError`` or ``OSError``."""
        await asyncio.shield(self.run_in_thread(self._piped.start))

    def run_in_thread(self, function: Callable[[], T]) -> asyncio.Future[T]:
        """Run a function in a thread. Call it for one function at a time. Raises ``ExhaustedError`` if no thread is available."""
        running = run_in_pool(self._threads, function)
        running.add_done_callback(lambda future: future.cancelled() or future.exception())
        self._thread_future = running
        return running

    async def wait_for_end(self) -> None:
        """Wait until the process has ended, for at most ``EXIT_TIMEOUT_S``."""
        await wait_for_exit(self._piped.process)

    async def end(self) -> None:
        """Kill the process and close its pipe."""
        if self._thread_future is not None and self.pid is None:
            await asyncio.wait({self._thread_future})  # the process is still starting
        if self.pid is not None:
            self._piped.process.kill()
            await self.wait_for_end()
        if self._thread_future is not None:
            completed, _ = await asyncio.wait({self._thread_future}, timeout=EXIT_TIMEOUT_S)
            if not completed:  # the thread still reads: the number of a closed pipe could be reused for another file
                log.error("process %s cannot be killed, so its pipe stays open", self.pid)
                return
        self._piped.close()
