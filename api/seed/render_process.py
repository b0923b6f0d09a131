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
import time as clock
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from skugga.api.seed.messages import Begin, Begun, Drawn, NotBegun, NotDrawn, Task
from skugga.api.seed.storage import store_at
from skugga.terrain.compiling.ahead import compile_ahead
from skugga.terrain.compiling.hooks import compiled_by
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import GraphicsError, NoOpenGLError, RenderError, SkuggaError
from skugga.terrain.gl.egl_devices import take_turn
from skugga.terrain.level.gdal_guard import forbid_code

if TYPE_CHECKING:
    from skugga.api.seed.drawing import Drawer
    from skugga.api.seed.run_spec import RunSpec

START_LIMIT_S = 600.0
"""After so long a process counts as hung that has been told which run to draw for, and is not ready: where nobody has compiled its
loops yet that takes minutes.
"""

DRAW_TASKS = "import sys; from skugga.api.seed.render_process import draw_tasks; draw_tasks(*map(int, sys.argv[1:]))"

DIED = "its render process ended in the middle of it"

GONE_S = 10.0
"""How long it is waited for a killed process. One that waits for a disk that does not answer ends when that does."""

log = logging.getLogger("skugga.worker")


class RenderProcess:
    """A child that draws tasks, one at a time. It warms up, and waits to ``begin`` a run. One thread asks it, and ends it.

    What it is told it has to answer within a time, ``start_limit_s`` or that of a task: then it counts as hung. ``number`` is its
    own among those beside it.
    """

    def __init__(self, environment: Mapping[str, str], start_limit_s: float = START_LIMIT_S, number: int = 0) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", DRAW_TASKS, str(theirs.fileno()), str(number)],
                pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env={**os.environ, **environment},
            )  # fmt: skip
        self.connection = Connection(ours.detach())
        self.begun = False
        self.task: Task | None = None
        self._start_limit_s = start_limit_s
        self._wait_for(None)

    def begin(self, spec: str, shards: str) -> None:
        """Let it draw for a run (``RunSpec`` as JSON); ``hear`` tells when it is ready."""
        self._wait_for(self._start_limit_s)
        try:
            self.connection.send(Begin(spec, shards))
        except OSError:
            pass  # it has ended: that is heard of

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def left_s(self) -> float | None:
        """For how many seconds more it may be waited for: 0 where it counts as hung; ``None`` where it has nothing to answer."""
        return None if self._until is None else max(self._until - clock.monotonic(), 0.0)

    def hear(self) -> Drawn | NotDrawn | Begun:
        """What it has to say; waits for it. Raises ``GraphicsError`` where it cannot draw the run's tasks, and ``EOFError`` where
        it has ended or hangs, with what is told of its task.
        """
        try:
            hangs = not self.connection.poll(self.left_s)
            said: Any = None if hangs else self.connection.recv()
        except (EOFError, OSError):
            raise EOFError(DIED) from None
        if hangs:
            raise EOFError(f"its render process gave no answer within {self._limit_s:g} s")
        if isinstance(said, NotBegun):
            raise GraphicsError(said.error)
        if isinstance(said, Begun):
            self.begun = True
        else:
            self.task = None
        self._wait_for(None)
        return said

    def draw(self, task: Task) -> None:
        """Begin a task; ``hear`` tells of it. A process that has ended is heard of there, too."""
        self.task = task
        self._wait_for(task.limit_s)
        try:
            self.connection.send(task)
        except OSError:
            pass

    def end(self) -> None:
        """End it at once: it holds nothing that would be lost."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GONE_S)
        self.connection.close()

    def _wait_for(self, limit_s: float | None) -> None:
        self._limit_s, self._until = limit_s, None if limit_s is None else clock.monotonic() + limit_s


def threads_of_one(threads: int) -> dict[str, str]:
    """The environment of a process that has so many threads: of a software rasteriser, and of compiled loops."""
    return {"LP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}


def draw_tasks(descriptor: int, number: int = 0) -> None:
    """What a child runs; of several OpenGL devices it takes that whose turn its number is."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the one that started it
    forbid_code()
    take_turn(number)
    with compiled_by(lambda products: compile_ahead(products, usable_cores())):
        _draw_until_closed(Connection(descriptor))


def _draw_until_closed(connection: Connection) -> None:
    from skugga.api.seed.drawing import Drawer  # what draws: here alone, and while nobody waits yet
    from skugga.api.seed.run_spec import RunSpec
    from skugga.api.workers.warm_up import warm_up

    try:
        try:
            renderer = warm_up()
            begin = connection.recv()
            spec = RunSpec.model_validate_json(begin.spec)
            check_renderer(renderer, spec)
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


def check_renderer(renderer: str, spec: RunSpec) -> None:
    """Raise ``GraphicsError`` where what draws is not what a run was planned for."""
    if renderer != spec.renderer:
        raise GraphicsError(f"the run was planned for the renderer '{spec.renderer}'; this worker draws with '{renderer}'")


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
