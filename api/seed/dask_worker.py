"""Code that runs on a Dask cluster's workers.

Each worker keeps one render process, because an OpenGL context must not change threads.
"""

from __future__ import annotations

from dataclasses import replace
from threading import Lock
from typing import Any

from distributed import WorkerPlugin, get_worker

from skugga.api.seed.messages import RunReady, Task, TaskFailure, TaskResult
from skugga.api.seed.render_process import RenderProcess, thread_environment
from skugga.api.seed.storage import open_store
from skugga.terrain.errors import GraphicsError


class PersistentProcess:
    """The render process of a Dask worker. It draws tasks of the current run, or is warm and waits for the next run."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._run: tuple[str, str] | None = None
        self._process: RenderProcess | None = None

    def warm_up(self) -> None:
        """Start a process if none exists, without waiting for it."""
        if self._lock.acquire(blocking=False):  # otherwise a task is being drawn
            try:
                if self._process is None:
                    self._process = RenderProcess(thread_environment(1))
            finally:
                self._lock.release()

    def draw(self, store_address: str, spec: str, task: Task) -> TaskResult | TaskFailure:
        """Draw a task of a run. ``spec`` names the file in the shard store at ``store_address`` that holds the ``RunSpec``."""
        with self._lock:
            try:
                process = self._process_for((store_address, spec))
                process.draw(task)
                message = process.receive()
                assert not isinstance(message, RunReady)
                return message
            except GraphicsError as error:
                self._end()
                return TaskFailure(task.id, str(error), "refused")
            except EOFError as ended:
                self._end()
                return TaskFailure(task.id, str(ended), "died")

    def end(self) -> None:
        """End the process unless it draws. A process that draws belongs to another run, or ends when the next run begins."""
        if self._lock.acquire(blocking=False):
            try:
                self._end()
            finally:
                self._lock.release()

    def _process_for(self, run: tuple[str, str]) -> RenderProcess:
        """Return the process, ready for a run. A process that was prepared for another run is replaced.

        ``run`` has the address of the shard store and the name of the file in it that holds the ``RunSpec``.
        """
        if self._run not in (None, run):
            self._end()
        if self._process is None:
            self._process = RenderProcess(thread_environment(1))
        if self._run is None:
            self._process.prepare_run(open_store(run[0]).read(run[1]).decode(), run[0])
            self._process.receive()
            self._run = run
        return self._process

    def _end(self) -> None:
        """Kill the process, if there is one."""
        if self._process is not None:
            self._process.end()
        self._process = self._run = None


persistent_process = PersistentProcess()
"""The render process of this Dask worker."""


class WarmUpPlugin(WorkerPlugin):
    """Dask plugin that starts a render process when a worker joins. The process ends with the worker or with the run."""

    def setup(self, worker: Any) -> None:
        """Implement Dask's hook: the worker has joined, or the run begins."""
        persistent_process.warm_up()

    def teardown(self, worker: Any) -> None:
        """Implement Dask's hook: the worker leaves, or the run has ended."""
        persistent_process.end()


def draw_on_worker(store_address: str, spec: str, task: tuple[Any, ...]) -> TaskResult | TaskFailure:
    """Draw a task on a Dask worker. ``spec`` names the file in the shard store that holds the ``RunSpec``.

    ``task`` has the fields of a ``Task``.
    """
    return replace(persistent_process.draw(store_address, spec, Task(*task)), worker=get_worker().address)
