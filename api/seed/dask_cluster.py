"""Tasks drawn by a Dask cluster: https://distributed.dask.org.

Dask distributes tasks, each a few numbers, and returns the indexes of their tiles. The tiles themselves go straight to the shard
store and never through the task graph. ``dask_worker`` holds the code that runs on Dask's workers.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import hashlib
import logging
import secrets
import time as clock
from collections.abc import Sequence
from contextlib import suppress
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any

from skugga.api.seed.messages import Task, TaskFailure, TaskResult
from skugga.api.seed.storage import open_store
from skugga.terrain.errors import GraphicsError, InputError, Problem, RenderError

if TYPE_CHECKING:
    from skugga.api.seed.run_spec import RunSpec

CLUSTER_TIMEOUT_S = 120.0
"""Maximum seconds to wait for a lost scheduler, or for the first worker: either may be restarting."""

WORKER_POLL_INTERVAL_S = 1.0
"""Seconds between two queries for the list of workers."""

TASKS_PER_WORKER = 2
"""Tasks queued per worker: the one being drawn, and the next one."""

SCHEDULER_LOST_ERRORS = (OSError, ValueError, RuntimeError, TimeoutError, asyncio.CancelledError, concurrent.futures.CancelledError)
"""Errors that Dask's client raises when its scheduler is gone."""

log = logging.getLogger("skugga")


class DaskCluster:
    """The workers of a cluster, found by the address of its scheduler.

    Each worker has a render process. These warm up before a run begins, or when a worker joins later. Raises ``InputError`` if no
    scheduler answers.
    """

    def __init__(self, address: str, cluster_timeout_s: float = CLUSTER_TIMEOUT_S) -> None:
        try:
            import distributed

            from skugga.api.seed import dask_worker
        except ImportError:
            raise InputError(
                "--scheduler", Problem("the package distributed is not installed"), "Run pip install 'skugga[cluster]'"
            ) from None
        self._distributed: Any = distributed
        self._worker_module: Any = dask_worker
        self._plugin = f"skugga-{secrets.token_hex(8)}"
        self._address, self._cluster_timeout_s = address, cluster_timeout_s
        self._run: tuple[str, str] | None = None
        self._running: dict[int, tuple[Task, Any]] = {}
        self._finished_futures: Queue[tuple[int, Any]] = Queue()
        self._refusal_reasons: dict[str, str] = {}
        self._workers: list[str] = []
        self._polled_at_s, self._present_at_s = -WORKER_POLL_INTERVAL_S, clock.monotonic()
        try:
            self._client: Any = self._distributed.Client(address, timeout=10.0, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                "--scheduler", Problem(f"no Dask scheduler answers at {address} ({_one_line(error)})"), "Check the address"
            ) from None
        self._warm_up()

    def prepare_run(self, spec: RunSpec, store_address: str) -> DaskCluster:
        """Prepare the workers for a run, and return this cluster. ``store_address`` is the folder or address of the shard store.

        Raises ``OSError`` if the shard store is not writable.
        """
        content = spec.model_dump_json().encode()
        name = f"run-{hashlib.blake2b(content, digest_size=8).hexdigest()}.json"
        open_store(store_address).write(name, content)
        self._run, self._present_at_s = (store_address, name), clock.monotonic()
        return self

    def free_worker_queues(self) -> Sequence[int]:
        """Implement ``Runner.free_worker_queues`` with a single worker queue, since Dask chooses the worker of a task."""
        return [0] * max(TASKS_PER_WORKER * len(self._eligible_workers()) - len(self._running), 0)

    def submit(self, task: Task, worker_queue: int = 0) -> None:
        """Implement ``Runner.submit``."""
        assert self._run is not None
        eligible = self._eligible_workers()
        self._running[task.id] = task, None
        try:
            future = self._client.submit(
                self._worker_module.draw_on_worker,
                *self._run,
                tuple(task),
                pure=False,
                retries=0,
                workers=eligible if self._refusal_reasons else None,
            )
        except SCHEDULER_LOST_ERRORS:
            self._polled_at_s = -WORKER_POLL_INTERVAL_S  # it is resubmitted once the scheduler returns
            return
        self._running[task.id] = task, future
        future.add_done_callback(lambda completed, number=task.id: self._finished_futures.put((number, completed)))

    def wait(self, timeout_s: float) -> Sequence[TaskResult | TaskFailure]:
        """Implement ``Runner.wait``."""
        self._update_workers()
        outcomes: list[TaskResult | TaskFailure] = []
        until = clock.monotonic() + timeout_s
        while not outcomes and (left := until - clock.monotonic()) > 0.0:
            try:
                number, future = self._finished_futures.get(timeout=min(left, WORKER_POLL_INTERVAL_S))
            except Empty:
                self._update_workers()
                continue
            if number not in self._running or self._running[number][1] is not future:
                continue
            task = self._running[number][0]
            if future.cancelled() or future.status == "lost":
                self._reconnect()
                continue
            outcomes += self._outcome(task, future)
        return outcomes

    def close(self) -> None:
        """Implement ``Runner.close``. The cluster itself keeps running."""
        with suppress(Exception):  # the scheduler may be gone
            self._client.cancel([future for _, future in self._running.values()])
            self._client.unregister_worker_plugin(self._plugin)
        with suppress(Exception):
            self._client.close(timeout=5.0)
        if self._run is not None:
            store_address, name = self._run
            with suppress(OSError):
                open_store(store_address).delete([name])

    def _warm_up(self) -> None:
        """Start a render process on every worker that is present, and on each one that joins later."""
        try:
            self._client.register_plugin(self._worker_module.WarmUpPlugin(), name=self._plugin)
        except Exception as error:  # an error of a worker, or a lost scheduler: the first task reports it
            log.warning("%s: render processes cannot warm up before their first tasks: %s", self._address, _one_line(error))

    def _outcome(self, task: Task, future: Any) -> list[TaskResult | TaskFailure]:
        """Return the result or failure of a task from its finished Dask future. The list is empty if the task is submitted again.

        That happens after the scheduler was lost, or if a worker cannot draw this run. Raises ``GraphicsError`` if no worker can.
        """
        try:
            if future.status != "finished":
                reason = _one_line(future.exception(timeout=5.0))
                del self._running[task.id]
                return [TaskFailure(task.id, f"its Dask worker ended while drawing it: {reason}", "died")]
            message: TaskResult | TaskFailure = future.result(timeout=30.0)
        except SCHEDULER_LOST_ERRORS:  # the result is lost with the scheduler
            self._reconnect()
            return []
        del self._running[task.id]
        if isinstance(message, TaskFailure) and message.kind == "refused":
            log.warning("worker %s is refused: %s", message.worker, message.error)
            self._refusal_reasons[message.worker] = message.error
            if not self._eligible_workers():
                raise GraphicsError(f"no worker of the cluster can draw this run: {message.error}")
            self.submit(task)
            return []
        return [message]

    def _eligible_workers(self) -> list[str]:
        """Return the addresses of the present workers that have not been refused for this run."""
        return [worker for worker in self._workers if worker not in self._refusal_reasons]

    def _update_workers(self) -> None:
        """Update the list of workers. Raises ``RenderError`` if no worker has been present for long."""
        now_s = clock.monotonic()
        if now_s - self._polled_at_s < WORKER_POLL_INTERVAL_S:
            return
        self._polled_at_s = now_s
        if self._client.status != "running":
            self._reconnect()
            return
        try:
            self._workers = sorted(self._client.nthreads())
        except SCHEDULER_LOST_ERRORS:
            self._reconnect()
            return
        for task in [task for task, future in self._running.values() if future is None]:
            self.submit(task)
        if self._workers:
            self._present_at_s = now_s
        elif now_s - self._present_at_s > self._cluster_timeout_s:
            raise RenderError(
                f"{self._address}: no worker joined within {self._cluster_timeout_s:g} s. Run the same command again to resume."
            )

    def _reconnect(self) -> None:
        """Reconnect to a lost scheduler, and resubmit its tasks. Raises ``RenderError``."""
        lost_tasks = [task for task, _ in self._running.values()]
        self._running = {}
        log.warning("the scheduler %s does not answer; %d tasks are resubmitted when it does", self._address, len(lost_tasks))
        with suppress(Exception):  # the scheduler is gone
            self._client.close(timeout=1.0)
        until = clock.monotonic() + self._cluster_timeout_s
        while True:
            try:
                self._client = self._distributed.Client(self._address, timeout=5.0, set_as_default=False)
                break
            except SCHEDULER_LOST_ERRORS as error:
                if clock.monotonic() > until:
                    raise RenderError(
                        f"{self._address}: the scheduler did not return within {self._cluster_timeout_s:g} s ({_one_line(error)}). "
                        f"Run the same command again to resume."
                    ) from None
                clock.sleep(1.0)
        self._warm_up()
        self._workers, self._present_at_s, self._refusal_reasons = [], clock.monotonic(), {}
        for task in lost_tasks:
            self.submit(task)


def _one_line(error: object) -> str:
    """Return the text of an error in one line of up to 200 characters, or the name of its type if it has no text."""
    return " ".join(str(error).split())[:200] or type(error).__name__
