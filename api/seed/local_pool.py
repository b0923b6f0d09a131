"""Tasks drawn by render processes of this machine."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from multiprocessing.connection import wait
from typing import Protocol

from api.seed.messages import Begun, Drawn, NotDrawn, Task
from api.seed.render_process import RenderProcess, threads_of_one
from api.seed.run_spec import RunSpec
from api.settings import cores
from terrain.errors import GraphicsError

MOST_FRUITLESS = 5
"""Starts in a row of processes that end before they drew anything: then something is wrong with all of them."""

DIED = "its render process ended in the middle of it"


class Runner(Protocol):
    """What draws tasks. To be used from one thread."""

    def free(self) -> int:
        """How many tasks may be submitted now."""

    def submit(self, task: Task) -> None:
        """Begin a task."""

    def wait(self, timeout_s: float) -> Sequence[Drawn | NotDrawn]:
        """What has become of tasks, waited for so long. Raises ``GraphicsError`` where nothing can be drawn at all."""

    def close(self) -> None:
        """End all; what is being drawn is lost."""


class LocalPool:
    """So many processes of this machine, that warm up until a run is begun. One that dies is replaced; its task is told of as
    ``died``.
    """

    def __init__(self, workers: int) -> None:
        self._environment = threads_of_one(max(cores() // workers, 1))
        self._fruitless = 0
        self._run: tuple[str, str] | None = None
        self._processes = [RenderProcess(self._environment) for _ in range(workers)]

    def begin(self, spec: RunSpec, shards: str) -> LocalPool:
        """Let them draw for a run; this pool."""
        self._run = spec.model_dump_json(), shards
        for process in self._processes:
            process.begin(*self._run)
        return self

    def free(self) -> int:
        """As the protocol says."""
        return sum(process.begun and process.task is None for process in self._processes)

    def submit(self, task: Task) -> None:
        """As the protocol says."""
        next(process for process in self._processes if process.begun and process.task is None).draw(task)

    def wait(self, timeout_s: float) -> Sequence[Drawn | NotDrawn]:
        """As the protocol says."""
        outcomes: list[Drawn | NotDrawn] = []
        by_connection = {
            process.connection: process for process in self._processes if process.task is not None or not process.begun
        }
        if not by_connection:
            clock.sleep(min(timeout_s, 0.1))
        for connection in wait(list(by_connection), timeout_s):
            process = by_connection[connection]  # type: ignore[index]
            try:
                said = process.hear()
            except EOFError:
                outcomes += self._replaced(process)
                continue
            if isinstance(said, Begun):
                continue
            self._fruitless = 0
            outcomes.append(said)
        return outcomes

    def close(self) -> None:
        """As the protocol says."""
        for process in self._processes:
            process.end()

    @property
    def pids(self) -> list[int]:
        """Its processes' ids."""
        return [process.pid for process in self._processes]

    def _replaced(self, process: RenderProcess) -> list[NotDrawn]:
        lost = process.task
        process.end()
        self._fruitless += 1
        if self._fruitless >= MOST_FRUITLESS * len(self._processes):
            raise GraphicsError(f"{self._fruitless} render processes in a row ended before they had drawn anything")
        another = self._processes[self._processes.index(process)] = RenderProcess(self._environment)
        assert self._run is not None
        another.begin(*self._run)
        return [] if lost is None else [NotDrawn(lost.id, DIED, "died")]
