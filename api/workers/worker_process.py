"""One render process as the service sees it: it is asked for answers, and watched while it makes them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, TypeVar

from skugga.api.errors import ExhaustedError, WorkerCrashError, WorkerStartError
from skugga.api.exhaustion import exhausted_error
from skugga.api.workers.child_process import ChildProcess
from skugga.api.workers.jobs import Answer, BlockJob, Failure, Job, Ping, Preparing, Ready
from skugga.api.workers.plan_basis import PlanBasis
from skugga.api.workers.process_life import is_stopped
from skugga.api.workers.spawned import Spawned
from skugga.terrain.errors import RenderTimeoutError

MOST_SAID = 300
"""Characters of a job in the log: descriptors are long."""

LOOK_EVERY_S = 1.0
"""How often it is looked whether a process that works was stopped."""

T = TypeVar("T")

log = logging.getLogger("skugga")


class WorkerProcess:
    """A process that was spawned, or is to be. ``start`` it, ``ask`` it one job at a time, then ``end`` it.

    In the event loop ``on_death`` is called when it ends by itself, and ``on_preparing`` with what it does before it is ready or
    begins a job. ``basis`` is what its plans go by. ``prepared`` says whether it had to prepare for the job that it did last,
    ``is_preparing`` whether it does now. For ``first_blocks`` it prepares while it is idle, once it was told of them.
    """

    def __init__(
        self,
        spawned: Spawned,
        threads: Executor,
        on_death: Callable[[], None],
        on_preparing: Callable[[Preparing], None] = lambda preparing: None,
    ) -> None:
        self._child, self._pipe = ChildProcess(spawned, threads), spawned.pipe
        self._on_death, self._on_preparing = on_death, on_preparing
        self._task = ""
        self._watched: int | None = None
        self.basis = spawned.config.basis
        self.first_blocks: tuple[BlockJob, ...] = ()
        self.dead = False
        self.prepared = False
        self.is_preparing = False

    @property
    def pid(self) -> int | None:
        """Process id, once started."""
        return self._child.pid

    async def start(self, timeout_s: float) -> Ready:
        """Start the process if it was not, and wait until it has warmed up.

        Raises ``WorkerStartError`` if it ends before that or nothing is heard of it for so long, ``ExhaustedError`` if the machine
        has no room for it, and the process's own error if it says why it cannot draw.
        """
        if self.pid is None:
            try:
                await self._child.start()
            except OSError as error:
                raise exhausted_error(error) or WorkerStartError(f"a render process cannot be started: {error.strerror}") from None
        self._watched = self._child.sentinel
        asyncio.get_running_loop().add_reader(self._watched, self._note_death)
        try:
            answer = await self._answer(self._pipe.recv, timeout_s)
        except TimeoutError:
            raise WorkerStartError(f"a render process did not warm up within {timeout_s:g} s") from None
        except (EOFError, OSError):
            raise WorkerStartError(f"render process {self.pid} ended while it warmed up") from None
        if isinstance(answer, Failure):
            raise answer.error()
        self.basis = self.basis or PlanBasis(answer.device)
        return answer

    async def ask(self, job: Job | Ping, timeout_s: float, basis: PlanBasis | None = None) -> Answer:
        """The answer to a job, by plans of a ``basis`` (``None``: as before). After a ``WorkerCrashError`` or
        ``RenderTimeoutError`` the process is of no more use. Raises ``ExhaustedError`` where there is no thread to ask it in.
        """
        told, self.basis = self.basis, basis or self.basis
        self.prepared = False

        def send_and_receive() -> Answer:
            if self.basis is not told:
                self._pipe.send(self.basis)
            self._pipe.send(job)  # not in the event loop: a process that does not read lets it wait where the job is long
            return self._pipe.recv()

        try:
            return await self._answer(send_and_receive, timeout_s)
        except ExhaustedError:  # nothing was sent
            raise
        except TimeoutError:
            raise RenderTimeoutError(f"The picture took longer than the {timeout_s:g} s it may take.") from None
        except Exception as error:  # the pipe broke, or brought what cannot be read
            raise WorkerCrashError(f"render process {self.pid} ended in the middle of {repr(job)[:MOST_SAID]}: {error!r}") from None

    async def end(self) -> None:
        """End the process at once. It holds nothing that would be lost."""
        self._unwatch()
        await self._child.end()

    async def _answer(self, function: Callable[[], Any], timeout_s: float) -> Any:
        """Return what follows all that is prepared first; each step of that may take ``timeout_s``. Raises as ``_heard``."""
        heard = await self._heard(function, timeout_s)
        try:
            while isinstance(heard, Preparing):
                self.prepared = self.is_preparing = True
                if heard.task != self._task:
                    log.info("render process %s: %s", self.pid, heard.task)
                    self._task = heard.task
                self._on_preparing(heard)
                heard = await self._heard(self._pipe.recv, timeout_s)
        finally:
            self.is_preparing = False
        return heard

    async def _heard(self, function: Callable[[], T], timeout_s: float) -> T:
        """What a function brings from the pipe. Raises ``TimeoutError``, and ``EOFError`` for a process that was stopped."""
        loop = asyncio.get_running_loop()
        until, answer = loop.time() + timeout_s, self._child.in_new_thread(function)
        while True:
            done, _ = await asyncio.wait({answer}, timeout=max(min(LOOK_EVERY_S, until - loop.time()), 0.0))
            if done:
                return answer.result()
            if self.pid is not None and is_stopped(self.pid):
                raise EOFError("it was stopped")
            if loop.time() >= until:
                raise TimeoutError

    def _note_death(self) -> None:
        self._unwatch()
        self.dead = True
        self._on_death()

    def _unwatch(self) -> None:
        if self._watched is not None:
            asyncio.get_running_loop().remove_reader(self._watched)
            self._watched = None
