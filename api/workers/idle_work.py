"""Work for which no request waits: done in processes of its own, one at a time, while the render processes are idle.

A job's process stands back behind all others, and is stopped while requests wait or are worked on: they do not wait for it, and
times that it takes are of an idle machine. It ends with the service. A job that fails is not tried again.
"""

from __future__ import annotations

import asyncio
import os
import signal
import tempfile
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from skugga.api.workers.child_process import ChildProcess
from skugga.api.workers.process_life import give_way
from skugga.api.workers.spawned import PipedProcess
from skugga.terrain.compiling.parent_process import end_with_parent
from skugga.terrain.errors import SkuggaError

QUIET_S = 5.0
"""How long nothing has to have waited or run before idle work begins, or goes on."""

QUIET_CHECK_S = 0.25
"""How often it is looked whether that is so."""

LONGEST_S = 900.0
"""How long a job may run, without its pauses, before it is given up."""


@dataclass(frozen=True, eq=False)
class IdleJob:
    """``function(*args)`` in a process of its own: a function of a module, and values that can be pickled.

    In the event loop ``done`` is called with what it returns, or ``failed`` with the reason why it returns nothing. It is dropped
    where it is not ``wanted`` any more.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...]
    done: Callable[[Any], Awaitable[None]]
    failed: Callable[[str], None]
    wanted: Callable[[], bool] = lambda: True


class _FailedError(Exception):
    """A job has brought nothing; the reason is its text."""


class _NotWantedError(Exception):
    """Nobody wants the result any more."""


class IdleWork:
    """Jobs that wait for idleness, first come first served. ``busy`` says whether anything waits or runs; ``gl_threads`` are
    those of a software rasteriser. To be used from one event loop.
    """

    def __init__(self, busy: Callable[[], bool], gl_threads: int = 1) -> None:
        self._busy, self._gl_threads = busy, gl_threads
        self._jobs: asyncio.Queue[IdleJob] = asyncio.Queue()
        # One thread that lives as long as this: a process ends with the thread that has started it.
        self._threads = ThreadPoolExecutor(1, "skugga-idle")
        self._task: asyncio.Task[None] | None = None
        self._disturbed_s = float("-inf")
        self._child: ChildProcess | None = None
        self.paused = False

    @property
    def pid(self) -> int | None:
        """The process of the job that is being done."""
        return None if self._child is None else self._child.pid

    def add(self, job: IdleJob) -> None:
        """Let a job wait for idleness, which counts from now on at the earliest."""
        self._disturbed_s = asyncio.get_running_loop().time()
        self._jobs.put_nowait(job)

    def disturb(self) -> None:
        """Something has come that is to be done at once: idle work stops."""
        self._disturbed_s = asyncio.get_running_loop().time()
        self._pause(True)

    def open(self) -> None:
        """Begin to wait for jobs and idleness."""
        self._task = asyncio.create_task(self._work())

    async def close(self) -> None:
        """End what is being done, and begin nothing more."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self._threads.shutdown(wait=True)

    async def _work(self) -> None:
        while True:
            job = await self._jobs.get()
            while job.wanted() and not self._idle():
                await asyncio.sleep(QUIET_CHECK_S)
            if not job.wanted():
                continue
            try:
                await job.done(await self._result(job))
            except _NotWantedError:
                continue
            except Exception as error:  # out of memory, descriptors or disk, or a bug: requests must not notice
                job.failed(_reason(error))

    def _idle(self) -> bool:
        if self._busy():
            self.disturb()
        return asyncio.get_running_loop().time() - self._disturbed_s >= QUIET_S

    async def _result(self, job: IdleJob) -> Any:
        """What a job returns; its process is gone after it, whatever happens. Raises ``_FailedError``, ``_NotWantedError`` or
        ``OSError``.
        """
        # What a killed process leaves in its temporary folder goes with it.
        with tempfile.TemporaryDirectory(prefix="skugga-", ignore_cleanup_errors=True) as folder:
            piped = PipedProcess(idle_main, folder, self._gl_threads, job.function, job.args, name="skugga-idle")
            child = ChildProcess(piped, self._threads)
            try:
                await child.start()
                self._child, self.paused = child, False
                answer = child.in_new_thread(child.pipe.recv)
                await self._watch(job, answer)
                try:
                    done, result = answer.result()
                except (EOFError, OSError):
                    await child.gone()
                    raise _FailedError(f"its process ended with status {child.exitcode}") from None
                if not done:
                    raise _FailedError(result)
                return result
            finally:
                self._child, self.paused = None, False
                await child.end()

    async def _watch(self, job: IdleJob, answer: asyncio.Future[Any]) -> None:
        """Wait for an answer, and stop and continue its process by what else is to be done."""
        left_s = LONGEST_S
        while not answer.done():
            await asyncio.wait({answer}, timeout=QUIET_CHECK_S)
            if not job.wanted():
                raise _NotWantedError
            if self._idle():
                self._pause(False)
            if not self.paused:
                left_s -= QUIET_CHECK_S
                if left_s <= 0.0:
                    raise _FailedError(f"it took longer than {LONGEST_S:g} s")

    def _pause(self, pause: bool) -> None:
        if self.pid is not None and pause != self.paused:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGSTOP if pause else signal.SIGCONT)
            self.paused = pause


def idle_main(pipe: Connection, folder: str, gl_threads: int, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    """An idle job's process: what the function returns, or why it does not, is sent; temporary files lie in ``folder``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the service, which ends this process
    end_with_parent()
    if pipe.poll(0):  # nothing is ever sent: the service has ended before that could be noted
        return
    give_way()
    os.environ.setdefault("LP_NUM_THREADS", str(gl_threads))
    tempfile.tempdir = folder
    try:
        answer = True, function(*args)
    except Exception as error:  # whatever it is, it is told once, by the service
        answer = False, _reason(error)
    with suppress(BrokenPipeError):
        pipe.send(answer)


def _reason(error: Exception) -> str:
    known = isinstance(error, SkuggaError | OSError | _FailedError)
    return str(error) if known else f"{type(error).__name__}: {error}"
