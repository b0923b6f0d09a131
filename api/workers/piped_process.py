"""A child process that is connected by a pipe.

This module imports little, because a service starts its first render process before its own slow imports.
"""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from skugga.api.workers.process_life import EXIT_TIMEOUT_S
from skugga.api.workers.worker_config import WorkerConfig

WorkerTarget = Callable[[Connection, WorkerConfig], None]
"""Type of the main function of a render process: of the process's end of the pipe, and its start configuration."""


class PipedProcess:
    """A child process that runs ``target(pipe, *args)`` after ``start``. It ends when this process ends."""

    def __init__(self, target: Callable[..., None], *args: Any, name: str) -> None:
        spawn = get_context("spawn")
        self.pipe, self.child_end = spawn.Pipe()
        self.process = spawn.Process(target=target, args=(self.child_end, *args), name=name, daemon=True)

    def start(self) -> None:
        """Start the process. Raises ``OSError``."""
        self.process.start()
        self.child_end.close()  # otherwise the pipe would stay open when the child ends

    def end(self) -> None:
        """Kill the process if it was started, and close the pipe."""
        if self.process.pid is not None:
            self.process.kill()
            self.process.join(EXIT_TIMEOUT_S)
        self.close()

    def close(self) -> None:
        """Close the pipe of a process that has ended or was never started."""
        self.pipe.close()
        self.child_end.close()


class SpawnedWorker(PipedProcess):
    """A render process, started or not, and the ``config`` that it starts with."""

    def __init__(self, target: WorkerTarget, config: WorkerConfig) -> None:
        super().__init__(target, config, name="skugga-render")
        self.config = config
