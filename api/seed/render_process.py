"""A process that draws tasks: what runs in it, and how it is started and asked. An OpenGL context stays in the thread that made it.

It is a plain child, not one of ``multiprocessing``: a cluster's workers may not have such children of their own. It ends when its
connection is closed, however the other side ends.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Literal

from api.seed.drawing import Drawer, Drawn
from api.seed.run_spec import RunSpec, Task
from api.seed.storage import store_at
from terrain.errors import GraphicsError, NoOpenGLError, RenderError, SkuggaError
from terrain.level.gdal_guard import forbid_code

log = logging.getLogger("skugga.worker")


@dataclass(frozen=True)
class Begin:
    """Tells a process which run's tasks it will draw (``RunSpec`` as JSON), and where their shards go."""

    spec: str
    shards: str


@dataclass(frozen=True)
class Begun:
    """It is ready to draw."""

    renderer: str


@dataclass(frozen=True)
class NotDrawn:
    """A task that was not drawn, and why: it ``failed``, its worker ``died``, the run is ``stopped``, whatever the task, or a
    ``worker`` of a cluster is ``refused``.
    """

    id: int
    error: str
    how: Literal["failed", "died", "stopped", "refused"]
    worker: str = ""


@dataclass(frozen=True)
class NotBegun:
    """A process that cannot draw tasks of a run."""

    error: str


class RenderProcess:
    """A child that draws tasks, one at a time. To be started, asked from one thread, and ended."""

    def __init__(self, spec: RunSpec, shards: str, environment: Mapping[str, str]) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", f"from api.seed.render_process import draw_tasks; draw_tasks({theirs.fileno()})"],
                pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env={**os.environ, **environment},
            )  # fmt: skip
        self.connection = Connection(ours.detach())
        self.begun = False
        self.task: Task | None = None
        self.connection.send(Begin(spec.model_dump_json(), shards))

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def hear(self) -> Drawn | NotDrawn | Begun:
        """What it has to say; waits for it. Raises ``GraphicsError`` where it cannot draw the run's tasks, and ``EOFError`` where
        it has ended.
        """
        try:
            said = self.connection.recv()
        except OSError:
            raise EOFError from None
        if isinstance(said, NotBegun):
            raise GraphicsError(said.error)
        if isinstance(said, Begun):
            self.begun = True
        else:
            self.task = None
        return said

    def draw(self, task: Task) -> None:
        """Begin a task; ``hear`` tells of it. A process that has ended is heard of there, too."""
        self.task = task
        try:
            self.connection.send(task)
        except OSError:
            pass

    def end(self) -> None:
        """End it at once: it holds nothing that would be lost."""
        self._process.kill()
        self._process.wait()
        self.connection.close()


def threads_of_one(threads: int) -> dict[str, str]:
    """The environment of a process that has so many threads: of a software rasteriser, and of compiled loops."""
    return {"LP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}


def draw_tasks(descriptor: int) -> None:
    """What a child runs."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the one that started it
    forbid_code()
    connection = Connection(descriptor)
    try:
        begin = connection.recv()
        spec = RunSpec.model_validate_json(begin.spec)
        try:
            renderer = check_renderer(spec)
            drawer = Drawer(spec, store_at(begin.shards))
        except SkuggaError as error:
            connection.send(NotBegun(str(error)))
            return
        connection.send(Begun(renderer))
        while True:
            answer = draw(drawer, connection.recv())
            connection.send(answer)
    except (EOFError, OSError):
        return


def check_renderer(spec: RunSpec) -> str:
    """Warm up and say what draws here. Raises ``GraphicsError`` where that is not what a run was planned for."""
    from api.workers.warm_up import warm_up

    renderer = warm_up()
    if renderer != spec.renderer:
        raise GraphicsError(f"the run was planned for the renderer '{spec.renderer}'; this worker draws with '{renderer}'")
    return renderer


def draw(drawer: Drawer, task: Task) -> Drawn | NotDrawn:
    """A task drawn, or why not."""
    try:
        return drawer.draw(task)
    except NoOpenGLError as error:
        return NotDrawn(task.id, str(error), "stopped")
    except GraphicsError:
        raise EOFError from None  # the context is in doubt: this process ends, and another one tries
    except SkuggaError as error:
        return NotDrawn(task.id, str(error), "failed")
    except OSError as error:  # of the shard: the disk is full, or the folder is gone
        return NotDrawn(task.id, f"{error.filename or 'shards'}: {error.strerror or error}", "stopped")
    except Exception as error:
        log.exception("a task failed unexpectedly")
        return NotDrawn(task.id, str(RenderError(f"{type(error).__name__}: {error}")), "failed")
