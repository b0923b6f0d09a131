"""A process that draws tasks: its main loop, and the parent's side. An OpenGL context stays in the thread that created it.

It is a plain child process, because the workers of a cluster may not have children of ``multiprocessing``. It ends when its
connection is closed, for whatever reason.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import time as clock
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from skugga.api.seed.messages import RunReady, RunRefused, StartRun, Task, TaskFailure, TaskResult
from skugga.api.seed.storage import open_store
from skugga.terrain.compiling.ahead_of_time import compile_ahead
from skugga.terrain.compiling.hooks import missing_loop_compiler
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import GraphicsError, NoOpenGLError, RenderError, SkuggaError
from skugga.terrain.gl.egl_devices import set_process_number
from skugga.terrain.level.gdal_guard import forbid_python_code

if TYPE_CHECKING:
    from skugga.api.seed.drawing import TaskDrawer
    from skugga.api.seed.run_spec import RunSpec

START_TIMEOUT_S = 600.0
"""Seconds within which a process must be ready for a run. First it compiles the loops (functions that numba compiles to machine
code) that the cache on disk lacks, which takes minutes."""

DRAW_TASKS_CODE = "import sys; from skugga.api.seed.render_process import draw_tasks; draw_tasks(*map(int, sys.argv[1:]))"

# Reason of a failed task, in words.
DIED_REASON = "its render process ended while drawing it"

EXIT_TIMEOUT_S = 10.0
"""Maximum seconds to wait for the exit of a killed process. A process that waits for an unresponsive disk ends when
the disk responds."""

log = logging.getLogger("skugga.worker")


class RenderProcess:
    """A child process that draws one task at a time. It warms up, then waits for ``prepare_run``. Use it from one thread.

    Every request has a timeout: ``start_timeout_s``, or the limit of a task. After it the process counts as hung. ``number``
    distinguishes the processes of a machine.
    """

    def __init__(self, environment: Mapping[str, str], start_timeout_s: float = START_TIMEOUT_S, process_number: int = 0) -> None:
        parent_end, child_end = socket.socketpair()
        with child_end:
            self._process = subprocess.Popen(
                [sys.executable, "-c", DRAW_TASKS_CODE, str(child_end.fileno()), str(process_number)],
                pass_fds=[child_end.fileno()], stdin=subprocess.DEVNULL, env={**os.environ, **environment},
            )  # fmt: skip
        self.connection = Connection(parent_end.detach())
        self.is_ready = False
        self.task: Task | None = None
        self._start_timeout_s = start_timeout_s
        self._set_deadline(None)

    def prepare_run(self, spec_json: str, store_address: str) -> None:
        """Prepare the process for a run (``RunSpec`` as JSON). ``receive`` reports readiness.

        ``store_address`` is the folder or address of the shard store.
        """
        self._set_deadline(self._start_timeout_s)
        try:
            self.connection.send(StartRun(spec_json, store_address))
        except OSError:
            pass  # it has ended: ``receive`` reports that

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def remaining_s(self) -> float | None:
        """Seconds until the timeout, 0 if the process hangs; ``None`` without a pending request."""
        return None if self._deadline is None else max(self._deadline - clock.monotonic(), 0.0)

    def receive(self) -> TaskResult | TaskFailure | RunReady:
        """Wait for the next message and return it.

        Raises ``GraphicsError`` if the process cannot draw the run's tasks, and ``EOFError`` with the reason if it has ended or
        hangs.
        """
        try:
            timed_out = not self.connection.poll(self.remaining_s)
            message: Any = None if timed_out else self.connection.recv()
        except (EOFError, OSError):
            raise EOFError(DIED_REASON) from None
        if timed_out:
            raise EOFError(f"its render process did not answer within {self._timeout_s:g} s")
        if isinstance(message, RunRefused):
            raise GraphicsError(message.error)
        if isinstance(message, RunReady):
            self.is_ready = True
        else:
            self.task = None
        self._set_deadline(None)
        return message

    def draw(self, task: Task) -> None:
        """Start to draw a task. ``receive`` returns its result, and also reports if the process has ended."""
        self.task = task
        self._set_deadline(task.timeout_s)
        try:
            self.connection.send(task)
        except OSError:
            pass

    def end(self) -> None:
        """Kill the process. It holds no state that must be saved."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(EXIT_TIMEOUT_S)
        self.connection.close()

    def _set_deadline(self, timeout_s: float | None) -> None:
        """Start the timeout of a request, ``timeout_s`` seconds from now; ``None`` if no request is pending."""
        self._timeout_s, self._deadline = timeout_s, None if timeout_s is None else clock.monotonic() + timeout_s


def thread_environment(threads: int) -> dict[str, str]:
    """Return environment variables that limit a process's threads, both of a software rasteriser and of compiled loops."""
    return {"LP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}


def draw_tasks(file_descriptor: int, process_number: int = 0) -> None:
    """Run the main loop of a child process, which is connected by ``file_descriptor``.

    ``process_number`` distributes processes among several OpenGL devices in turn.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the parent
    forbid_python_code()
    set_process_number(process_number)
    with missing_loop_compiler(lambda products: compile_ahead(products, usable_cores())):
        _draw_until_closed(Connection(file_descriptor))


def _draw_until_closed(connection: Connection) -> None:
    """Warm up, prepare for the run that ``connection`` names, and draw its tasks until the connection is closed."""
    from skugga.api.seed.drawing import TaskDrawer  # imports of drawing code: only in this process, before a run begins
    from skugga.api.seed.run_spec import RunSpec
    from skugga.api.workers.warm_up import warm_up

    try:
        try:
            renderer = warm_up()
            start = connection.recv()
            spec = RunSpec.model_validate_json(start.spec_json)
            check_renderer(renderer, spec)
            drawer = TaskDrawer(spec, open_store(start.store_address))
        except SkuggaError as error:
            connection.send(RunRefused(str(error)))
            return
        connection.send(RunReady(renderer))
        while True:
            answer = draw(drawer, connection.recv())
            connection.send(answer)
    except (EOFError, OSError):
        return


def check_renderer(renderer: str, spec: RunSpec) -> None:
    """Raise ``GraphicsError`` if ``renderer``, OpenGL's name of it in this process, differs from the one of the run's plans."""
    if renderer != spec.renderer:
        raise GraphicsError(f"the run was planned for the renderer '{spec.renderer}', but this worker draws with '{renderer}'")


def draw(drawer: TaskDrawer, task: Task) -> TaskResult | TaskFailure:
    """Draw a task, and return its result or the reason of its failure."""
    try:
        return drawer.draw(task)
    except NoOpenGLError as error:
        return TaskFailure(task.id, str(error), "stopped")
    except GraphicsError:
        raise EOFError from None  # the context is unreliable: this process ends, and another one retries
    except SkuggaError as error:
        return TaskFailure(task.id, str(error), "failed")
    except OSError as error:  # writing the shard failed: the disk is full, or the folder is gone
        return TaskFailure(task.id, f"{error.filename or 'shards'}: {error.strerror or error}", "stopped")
    except Exception as error:
        log.exception("a task failed unexpectedly")
        return TaskFailure(task.id, str(RenderError(f"{type(error).__name__}: {error}")), "failed")
