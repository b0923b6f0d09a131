"""A child process as an event loop sees it: started, waited for, and ended for good. All waiting is done in threads."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, TypeVar

from skugga.api.exhaustion import in_thread
from skugga.api.workers.process_life import JOIN_S, process_end
from skugga.api.workers.spawned import PipedProcess

T = TypeVar("T")

log = logging.getLogger("skugga")


class ChildProcess:
    """A piped process and the thread that waits for it. ``start`` it, wait for it by ``in_new_thread``, then ``end`` it.

    Threads go on where the waiting for them is given up: they end with the process. To be used from one event loop.
    """

    def __init__(self, piped: PipedProcess, threads: Executor) -> None:
        self.pipe = piped.pipe
        self._piped, self._threads = piped, threads
        self._in_thread: asyncio.Future[Any] | None = None

    @property
    def pid(self) -> int | None:
        """Process id, once started."""
        return self._piped.process.pid

    @property
    def exitcode(self) -> int | None:
        """The status that the process ended with; ``None`` while it runs."""
        return self._piped.process.exitcode

    @property
    def sentinel(self) -> int:
        """A descriptor that can be read as soon as the process ends."""
        return self._piped.process.sentinel

    async def start(self) -> None:
        """Start the process. Raises ``ExhaustedError`` or ``OSError``."""
        await asyncio.shield(self.in_new_thread(self._piped.start))

    def in_new_thread(self, function: Callable[[], T]) -> asyncio.Future[T]:
        """Run a function in a thread, one at a time. Raises ``ExhaustedError`` where there is no thread."""
        running = in_thread(self._threads, function)
        running.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._in_thread = running
        return running

    async def gone(self) -> None:
        """Wait until the process has ended, for ``JOIN_S`` at most."""
        await process_end(self._piped.process)

    async def end(self) -> None:
        """End the process at once, and close its pipe. It holds nothing that would be lost."""
        if self._in_thread is not None and self.pid is None:
            await asyncio.wait({self._in_thread})  # it is just being started
        if self.pid is not None:
            self._piped.process.kill()
            await self.gone()
        if self._in_thread is not None:
            done, _ = await asyncio.wait({self._in_thread}, timeout=JOIN_S)
            if not done:  # a closed pipe's number could be another file's before it is read
                log.error("process %s cannot be killed; its pipe stays open", self.pid)
                return
        self._piped.close()
