"""The service's side of a render process: send jobs, wait for answers, and detect a process that hangs or dies."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, TypeVar

from skugga.api.errors import ExhaustedError, WorkerCrashError, WorkerStartError
from skugga.api.resource_exhaustion import exhausted_error
from skugga.api.workers.child_process import ChildProcess
from skugga.api.workers.jobs import Answer, BlockJob, Failure, HeartbeatRequest, Job, PreparationProgress, WorkerReady
from skugga.api.workers.piped_process import SpawnedWorker
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.process_life import is_stopped
from skugga.terrain.errors import RenderTimeoutError

MAX_LOGGED_CHARACTERS = 300
"""Maximum characters of a job in the log, since descriptors are long."""

STOP_POLL_INTERVAL_S = 1.0
"""Seconds between two checks whether a process that works on a job was stopped (SIGSTOP)."""

T = TypeVar("T")

log = logging.getLogger("skugga")


class WorkerProcess:
    """A render process. Call ``start``, then ``send_and_receive`` with one job at a time, then ``end``.

    Parameters
    ----------
    spawned_worker
        The process, started or not.
    threads
        Threads that wait for the pipe.
    on_death
        Called in the event loop when the process ends by itself.
    on_preparation_progress
        Called in the event loop with the progress of preparations, before the process is ready or before it starts a job.

    Attributes
    ----------
    measurements : PlanMeasurements or None
        The measurements that its plans use, as last sent to it.
    preload_blocks : tuple
        Blocks that the next heartbeat request names. The process opens their levels while it is idle. Empty after that request.
    has_ended : bool
        Whether the process ended by itself.
    has_prepared : bool
        Whether it made preparations (for example compiled loops) during its last job.
    is_preparing : bool
        Whether it makes preparations now.
    """

    def __init__(
        self,
        spawned_worker: SpawnedWorker,
        threads: Executor,
        on_death: Callable[[], None],
        on_preparation_progress: Callable[[PreparationProgress], None] = lambda preparing: None,
    ) -> None:
        self._child, self._pipe = ChildProcess(spawned_worker, threads), spawned_worker.pipe
        self._on_death, self._on_preparing = on_death, on_preparation_progress
        self._task = ""
        self._watched_sentinel: int | None = None
        self.measurements = spawned_worker.config.measurements
        self.preload_blocks: tuple[BlockJob, ...] = ()
        self.has_ended = False
        self.has_prepared = False
        self.is_preparing = False

    @property
    def pid(self) -> int | None:
        """Process id; ``None`` before the start."""
        return self._child.pid

    async def start(self, timeout_s: float) -> WorkerReady:
        """Start the process if necessary, and wait until it has warmed up.

        Raises
        ------
        WorkerStartError
            The process cannot be started, ends before it is ready, or sends no message for ``timeout_s`` seconds.
        ExhaustedError
            The machine has no thread, memory or file descriptor left for it.
        SkuggaError
            The process's own error, for example if it cannot draw.
        """
        if self.pid is None:
            try:
                await self._child.start()
            except OSError as error:
                raise exhausted_error(error) or WorkerStartError(f"a render process cannot be started: {error.strerror}") from None
        self._watched_sentinel = self._child.sentinel
        asyncio.get_running_loop().add_reader(self._watched_sentinel, self._note_death)
        try:
            answer = await self._answer(self._pipe.recv, timeout_s)
        except TimeoutError:
            raise WorkerStartError(f"a render process did not warm up within {timeout_s:g} s") from None
        except (EOFError, OSError):
            raise WorkerStartError(f"render process {self.pid} ended while it warmed up") from None
        if isinstance(answer, Failure):
            raise answer.to_error()
        self.measurements = self.measurements or PlanMeasurements(answer.device)
        return answer

    async def send_and_receive(
        self, job: Job | HeartbeatRequest, timeout_s: float, measurements: PlanMeasurements | None = None
    ) -> Answer:
        """Send a job or a heartbeat and return the answer.

        Parameters
        ----------
        job
            The job or heartbeat.
        timeout_s
            Maximum seconds until the next message of the process.
        measurements
            The measurements that plans use, which are sent before the job if they changed; ``None`` leaves them unchanged.

        Raises
        ------
        WorkerCrashError
            The process ended or was stopped. The caller must end it.
        RenderTimeoutError
            The process sent no message in time. The caller must end it.
        ExhaustedError
            No thread is available. Nothing was sent.
        """
        previous_measurements, self.measurements = self.measurements, measurements or self.measurements
        self.has_prepared = False

        def send_and_receive() -> Answer:
            if self.measurements is not previous_measurements:
                self._pipe.send(self.measurements)
            self._pipe.send(job)  # in a thread: sending a long job blocks while the process does not read
            return self._pipe.recv()

        try:
            return await self._answer(send_and_receive, timeout_s)
        except ExhaustedError:  # nothing was sent
            raise
        except TimeoutError:
            raise RenderTimeoutError(f"The picture took longer than the limit of {timeout_s:g} s.") from None
        except Exception as error:  # the pipe broke, or delivered unreadable data
            raise WorkerCrashError(
                f"render process {self.pid} ended during {repr(job)[:MAX_LOGGED_CHARACTERS]}: {error!r}"
            ) from None

    async def end(self) -> None:
        """Kill the process and close its pipe."""
        self._unwatch()
        await self._child.end()

    async def _answer(self, receive: Callable[[], Any], timeout_s: float) -> Any:
        """Return the first message that is no ``PreparationProgress``. Each message may take ``timeout_s`` seconds.

        ``receive`` waits for the first message of all and returns it. Raises the errors of ``_receive``.
        """
        message = await self._receive(receive, timeout_s)
        try:
            while isinstance(message, PreparationProgress):
                self.has_prepared = self.is_preparing = True
                if message.task != self._task:
                    log.info("render process %s: %s", self.pid, message.task)
                    self._task = message.task
                self._on_preparing(message)
                message = await self._receive(self._pipe.recv, timeout_s)
        finally:
            self.is_preparing = False
        return message

    async def _receive(self, function: Callable[[], T], timeout_s: float) -> T:
        """Run ``function``, which waits for the next message of the process, in a thread, and return its result.

        Raises ``TimeoutError`` after ``timeout_s`` seconds, ``EOFError`` if the process was stopped, and the function's errors.
        """
        loop = asyncio.get_running_loop()
        deadline, answer = loop.time() + timeout_s, self._child.run_in_thread(function)
        while True:
            completed, _ = await asyncio.wait({answer}, timeout=max(min(STOP_POLL_INTERVAL_S, deadline - loop.time()), 0.0))
            if completed:
                return answer.result()
            if self.pid is not None and is_stopped(self.pid):
                raise EOFError("the process was stopped")
            if loop.time() >= deadline:
                raise TimeoutError

    def _note_death(self) -> None:
        """Record that the process has ended by itself, and report it."""
        self._unwatch()
        self.has_ended = True
        self._on_death()

    def _unwatch(self) -> None:
        """Stop watching for the end of the process."""
        if self._watched_sentinel is not None:
            asyncio.get_running_loop().remove_reader(self._watched_sentinel)
            self._watched_sentinel = None
