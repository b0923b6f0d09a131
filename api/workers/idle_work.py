"""Idle work: jobs that no request waits for. They run one at a time, in separate processes, while the render processes are idle.

A job's process has the lowest priority. It is stopped (SIGSTOP) while requests wait or run. So requests do not wait for it, and
the times that it measures are those of an idle machine. The process ends with the service. A failed job is not retried.
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
from skugga.api.workers.piped_process import PipedProcess
from skugga.api.workers.process_life import set_idle_priority
from skugga.terrain.compiling.parent_process import end_with_parent
from skugga.terrain.errors import SkuggaError

IDLE_DELAY_S = 5.0
"""Seconds without requests after which idle work starts or resumes."""

IDLE_CHECK_INTERVAL_S = 0.25
"""Seconds between two checks whether the service is idle."""

JOB_TIMEOUT_S = 900.0
"""Timeout of a job in seconds, without its pauses."""


@dataclass(frozen=True, eq=False)
class IdleJob:
    """A call ``function(*args)`` that runs in a separate process.

    The function must be importable from a module, and its arguments and result must be picklable.

    Attributes
    ----------
    function, args
        The function to call, and its arguments.
    on_result
        Called in the event loop with the result.
    on_failure
        Called in the event loop with the reason if the job fails.
    is_wanted
        Returns whether the result is still needed. If not, a queued job is dropped, and the process of a running job is killed.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...]
    on_result: Callable[[Any], Awaitable[None]]
    on_failure: Callable[[str], None]
    is_wanted: Callable[[], bool] = lambda: True


class _JobFailedError(Exception):
    """The job has failed. The message is the reason."""


class _ObsoleteJobError(Exception):
    """The result of the running job is no longer needed."""


class IdleWork:
    """A queue of jobs for idle time, first in, first out. Use it from one event loop.

    Parameters
    ----------
    is_busy
        Returns whether any request waits or runs.
    gl_threads
        Number of threads of a software rasteriser.
    """

    def __init__(self, is_busy: Callable[[], bool], gl_threads: int = 1) -> None:
        self._is_busy, self._gl_threads = is_busy, gl_threads
        self._jobs: asyncio.Queue[IdleJob] = asyncio.Queue()
        # One thread for the whole lifetime: a process ends with the thread that started it.
        self._threads = ThreadPoolExecutor(1, "skugga-idle")
        self._task: asyncio.Task[None] | None = None
        self._last_activity_s = float("-inf")
        self._child: ChildProcess | None = None
        self.is_paused = False

    @property
    def pid(self) -> int | None:
        """Process id of the running job; ``None`` without one."""
        return None if self._child is None else self._child.pid

    def add(self, job: IdleJob) -> None:
        """Queue a job. It starts after ``IDLE_DELAY_S`` seconds without requests, counted from now at the earliest."""
        self._last_activity_s = asyncio.get_running_loop().time()
        self._jobs.put_nowait(job)

    def pause_for_requests(self) -> None:
        """Stop the process of the running job, because a request has arrived.

        The process resumes after ``IDLE_DELAY_S`` seconds without requests.
        """
        self._last_activity_s = asyncio.get_running_loop().time()
        self._set_paused(True)

    def start(self) -> None:
        """Start a task that runs the queued jobs. Return at once."""
        self._task = asyncio.create_task(self._process_jobs())

    async def close(self) -> None:
        """Kill the process of the running job, and start no other jobs."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self._threads.shutdown(wait=True)

    async def _process_jobs(self) -> None:
        """Run the queued jobs one after another, each when the service is idle, for ever."""
        while True:
            job = await self._jobs.get()
            while job.is_wanted() and not self._is_idle():
                await asyncio.sleep(IDLE_CHECK_INTERVAL_S)
            if not job.is_wanted():
                continue
            try:
                await job.on_result(await self._run_job(job))
            except _ObsoleteJobError:
                continue
            except Exception as error:  # out of memory, descriptors or disk, or a bug: requests must not notice
                job.on_failure(_failure_reason(error))

    def _is_idle(self) -> bool:
        """Return whether no request has waited or run for ``IDLE_DELAY_S`` seconds. Stop the running job if one does now."""
        if self._is_busy():
            self.pause_for_requests()
        return asyncio.get_running_loop().time() - self._last_activity_s >= IDLE_DELAY_S

    async def _run_job(self, job: IdleJob) -> Any:
        """Run a job and return its result. The process never outlives this call.

        Raises ``_JobFailedError``, ``_ObsoleteJobError`` or ``OSError``.
        """
        # Files that a killed process leaves behind are deleted with its temporary folder.
        with tempfile.TemporaryDirectory(prefix="skugga-", ignore_cleanup_errors=True) as folder:
            piped = PipedProcess(idle_main, folder, self._gl_threads, job.function, job.args, name="skugga-idle")
            child = ChildProcess(piped, self._threads)
            try:
                await child.start()
                self._child, self.is_paused = child, False
                answer = child.run_in_thread(child.pipe.recv)
                await self._watch(job, answer)
                try:
                    is_success, result = answer.result()
                except (EOFError, OSError):
                    await child.wait_for_end()
                    raise _JobFailedError(f"its process ended with exit status {child.exitcode}") from None
                if not is_success:
                    raise _JobFailedError(result)
                return result
            finally:
                self._child, self.is_paused = None, False
                await child.end()

    async def _watch(self, job: IdleJob, answer: asyncio.Future[Any]) -> None:
        """Wait for the answer of a job's process. Stop the process while requests wait or run, and resume it when they are done.

        Raises ``_JobFailedError`` after ``JOB_TIMEOUT_S``, and ``_ObsoleteJobError`` if the result is no longer needed.
        """
        left_s = JOB_TIMEOUT_S
        while not answer.done():
            await asyncio.wait({answer}, timeout=IDLE_CHECK_INTERVAL_S)
            if not job.is_wanted():
                raise _ObsoleteJobError
            if self._is_idle():
                self._set_paused(False)
            if not self.is_paused:
                left_s -= IDLE_CHECK_INTERVAL_S
                if left_s <= 0.0:
                    raise _JobFailedError(f"it took longer than {JOB_TIMEOUT_S:g} s")

    def _set_paused(self, is_paused: bool) -> None:
        """Stop or resume the process of the running job, if there is one."""
        if self.pid is not None and is_paused != self.is_paused:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGSTOP if is_paused else signal.SIGCONT)
            self.is_paused = is_paused


def idle_main(pipe: Connection, folder: str, gl_threads: int, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    """Run ``function(*args)`` in a process for idle work, and send the outcome through the pipe.

    The outcome is ``(True, result)`` or ``(False, reason)``. Temporary files go to ``folder``. ``gl_threads`` is the number
    of threads of a software rasteriser.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the service, which ends this process
    end_with_parent()
    # The service sends nothing, so a readable pipe has been closed: the service ended before ``end_with_parent`` was called.
    if pipe.poll(0):
        return
    set_idle_priority()
    os.environ.setdefault("LP_NUM_THREADS", str(gl_threads))
    tempfile.tempdir = folder
    try:
        answer = True, function(*args)
    except Exception as error:  # the service logs it once, whatever it is
        answer = False, _failure_reason(error)
    with suppress(BrokenPipeError):
        pipe.send(answer)


def _failure_reason(error: Exception) -> str:
    """Return the message of an error; errors of unexpected types include the type."""
    has_message = isinstance(error, SkuggaError | OSError | _JobFailedError)
    return str(error) if has_message else f"{type(error).__name__}: {error}"
