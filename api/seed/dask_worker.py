"""Code that runs on a Dask cluster's workers. Each keeps one render process, since an OpenGL context must not change threads."""

from __future__ import annotations

from dataclasses import replace
from threading import Lock
from typing import Any

from distributed import WorkerPlugin, get_worker

from skugga.api.seed.messages import Begun, Drawn, NotDrawn, Task
from skugga.api.seed.render_process import RenderProcess, threads_of_one
from skugga.api.seed.storage import store_at
from skugga.terrain.errors import GraphicsError


class KeptProcess:
    """The render process of a Dask worker: either of the current run, or warm for the next one."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._run: tuple[str, str] | None = None
        self._process: RenderProcess | None = None

    def warm_up(self) -> None:
        """Start a process if none exists, without waiting for it."""
        if self._lock.acquire(blocking=False):  # otherwise a task is being drawn
            try:
                if self._process is None:
                    self._process = RenderProcess(threads_of_one(1))
            finally:
                self._lock.release()

    def draw(self, shards: str, spec: str, task: Task) -> Drawn | NotDrawn:
        """Draw a task of a run."""
        with self._lock:
            try:
                process = self._of((shards, spec))
                process.draw(task)
                said = process.hear()
                assert not isinstance(said, Begun)
                return said
            except GraphicsError as error:
                self._end()
                return NotDrawn(task.id, str(error), "refused")
            except EOFError as ended:
                self._end()
                return NotDrawn(task.id, str(ended), "died")

    def end(self) -> None:
        """End the process unless it draws. A drawing process belongs to another run, or ends when the next run begins."""
        if self._lock.acquire(blocking=False):
            try:
                self._end()
            finally:
                self._lock.release()

    def _of(self, run: tuple[str, str]) -> RenderProcess:
        if self._run not in (None, run):
            self._end()
        if self._process is None:
            self._process = RenderProcess(threads_of_one(1))
        if self._run is None:
            self._process.begin(store_at(run[0]).read(run[1]).decode(), run[0])
            self._process.hear()
            self._run = run
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.end()
        self._process = self._run = None


kept = KeptProcess()
"""The render process of this Dask worker."""


class WarmProcess(WorkerPlugin):
    """Dask plugin that gives a worker a warm render process from the time it joins until it or the run ends."""

    def setup(self, worker: Any) -> None:
        """Implement Dask's hook: the worker has joined, or the run begins."""
        kept.warm_up()

    def teardown(self, worker: Any) -> None:
        """Implement Dask's hook: the worker leaves, or the run has ended."""
        kept.end()


def draw_on_worker(shards: str, spec: str, task: tuple[Any, ...]) -> Drawn | NotDrawn:
    """Draw a task on a Dask worker. ``spec`` names the file in the shard store that holds the ``RunSpec``."""
    return replace(kept.draw(shards, spec, Task(*task)), worker=get_worker().address)
