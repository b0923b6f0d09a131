"""Tasks drawn by render processes of this machine."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from multiprocessing.connection import wait
from typing import Protocol

from skugga.api.seed.messages import RunReady, Task, TaskFailure, TaskResult
from skugga.api.seed.render_process import START_TIMEOUT_S, RenderProcess, thread_environment
from skugga.api.seed.run_spec import RunSpec
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import GraphicsError

MAX_FAILED_STARTS = 5
"""Maximum number of starts in a row, per process, that draw nothing. More failures indicate a common cause."""


class Runner(Protocol):
    """Protocol of the workers that draw the tasks of a run. Use it from one thread."""

    def free_worker_queues(self) -> Sequence[int]:
        """Return the worker queues that accept a task now. A worker queue is listed once for each task that it accepts.

        Consecutive tasks of a queue are best neighbours on the map, because its worker then has most of the ground in memory.
        """

    def submit(self, task: Task, worker_queue: int) -> None:
        """Start to draw a task on a worker queue, without waiting for its result."""

    def wait(self, timeout_s: float) -> Sequence[TaskResult | TaskFailure]:
        """Return results of tasks, after at most ``timeout_s`` seconds. Raises ``GraphicsError`` if the workers cannot draw."""

    def close(self) -> None:
        """End all workers. Tasks that are being drawn are lost."""


class LocalPool:
    """A fixed number of render processes of this machine. They warm up before a run begins.

    A process that dies or hangs is replaced. Its task then ends with a ``TaskFailure`` of the kind ``died``.
    """

    def __init__(self, workers: int, start_timeout_s: float = START_TIMEOUT_S) -> None:
        self._environment, self._start_timeout_s = thread_environment(max(usable_cores() // workers, 1)), start_timeout_s
        self._failed_starts = 0
        self._run: tuple[str, str] | None = None
        self._processes = [self._start_process(number) for number in range(workers)]

    def prepare_run(self, spec: RunSpec, store_address: str) -> LocalPool:
        """Prepare the processes for a run, and return this pool. ``store_address`` is the folder or address of the shard store."""
        self._run = spec.model_dump_json(), store_address
        for process in self._processes:
            process.prepare_run(*self._run)
        return self

    def free_worker_queues(self) -> Sequence[int]:
        """Implement ``Runner.free_worker_queues``. Each process is a worker queue."""
        return [worker_queue for worker_queue, process in enumerate(self._processes) if process.is_ready and process.task is None]

    def submit(self, task: Task, worker_queue: int) -> None:
        """Implement ``Runner.submit``."""
        self._processes[worker_queue].draw(task)

    def wait(self, timeout_s: float) -> Sequence[TaskResult | TaskFailure]:
        """Implement ``Runner.wait``."""
        outcomes: list[TaskResult | TaskFailure] = []
        by_connection = {
            process.connection: process for process in self._processes if process.task is not None or not process.is_ready
        }
        if not by_connection:
            clock.sleep(min(timeout_s, 0.1))
        readable = wait(list(by_connection), timeout_s)
        for connection, process in by_connection.items():
            if connection not in readable and process.remaining_s != 0.0:
                continue
            try:
                message = process.receive()
            except EOFError as ended:
                outcomes += self._replace(process, str(ended))
                continue
            if isinstance(message, RunReady):
                continue
            self._failed_starts = 0
            outcomes.append(message)
        return outcomes

    def close(self) -> None:
        """Implement ``Runner.close``."""
        for process in self._processes:
            process.end()

    @property
    def pids(self) -> list[int]:
        """Ids of the processes."""
        return [process.pid for process in self._processes]

    def _start_process(self, number: int) -> RenderProcess:
        """Start a render process without waiting for it. ``number`` counts the processes of the pool from 0."""
        return RenderProcess(self._environment, self._start_timeout_s, number)

    def _replace(self, process: RenderProcess, reason: str) -> list[TaskFailure]:
        """Replace a process that has died or hangs. Return the failure of the task that it was drawing, or an empty list.

        ``reason`` is the text of the failure. Raises ``GraphicsError`` after too many starts in a row that draw nothing.
        """
        lost_task = process.task
        process.end()
        self._failed_starts += 1
        if self._failed_starts >= MAX_FAILED_STARTS * len(self._processes):
            raise GraphicsError(
                f"{self._failed_starts} render processes in a row ended or did not answer before they drew anything"
            )
        number = self._processes.index(process)
        replacement = self._processes[number] = self._start_process(number)
        assert self._run is not None
        replacement.prepare_run(*self._run)
        return [] if lost_task is None else [TaskFailure(lost_task.id, reason, "died")]
