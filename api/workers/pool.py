"""The render processes of a service: a bounded queue before them, one render for all who want the same, finished pictures
kept, and a service that goes on when a process hangs or dies."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from api.device_calibration import digest_of
from api.errors import WorkerCrashError
from api.settings import Settings, cores
from api.workers.jobs import Answer, BlockTiles, Failure, Job, Result, ServedPictures, Snapshot
from api.workers.render_worker import WorkerConfig, worker_main
from api.workers.worker_process import WorkerProcess, WorkerTarget
from terrain.cache import Cache, Missing
from terrain.errors import BusyError, GraphicsError, RenderTimeoutError, SkuggaError

if TYPE_CHECKING:
    from selector.cost.device_profile import DeviceProfile

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
"""Pause before a second start in a row that follows a failure; it doubles from there."""

log = logging.getLogger("skugga")


@dataclass(eq=False)
class _PendingJob:
    """A job on its way, and how many wait for it."""

    job: Job
    answer: asyncio.Future[Answer]
    waiting: int = 0


@dataclass
class PoolCounters:
    """What the pool has done since it was started."""

    answered: int = 0
    failed: int = 0
    abandoned: int = 0
    started: int = 0


class Pool:
    """Runs jobs in render processes. To be used from one event loop.

    Equal jobs at the same time are one job. Finished blocks and snapshots are kept within ``block_cache_bytes``. A process that
    is started prepares for what is ``served``.
    """

    def __init__(
        self,
        settings: Settings,
        target: WorkerTarget = worker_main,
        served: Callable[[], tuple[ServedPictures, ...]] = tuple,
    ) -> None:
        self._settings = settings
        self._target, self._served = target, served
        self._config = WorkerConfig(gl_threads=max(cores() // settings.workers, 1), expect_renderer=settings.expect_renderer)
        self._threads = ThreadPoolExecutor(settings.workers, "skugga-pipe")
        self._finished: Cache[BlockTiles | Snapshot] = Cache(
            "api.workers.finished", "process", settings.block_cache_bytes, lambda drawn: drawn.nbytes
        )
        self._flights: dict[Job, _PendingJob] = {}
        self._queue: OrderedDict[Job, _PendingJob] = OrderedDict()
        self._news = asyncio.Event()
        self._slots: list[asyncio.Task[None]] = []
        self._start_error: SkuggaError | None = None
        self._closed = False
        self._settled = asyncio.Event()
        self.renderer: str | None = None
        self.device: DeviceProfile | None = None
        self.pids: set[int] = set()
        self.tally = PoolCounters()

    @property
    def ready(self) -> bool:
        """Whether a render process has warmed up."""
        return bool(self.pids)

    @property
    def calibration(self) -> str:
        """The digest of the calibration that new plans go by."""
        return digest_of(self.device)

    async def settled(self) -> None:
        """Wait until it is known what the first process draws with, or that it cannot be started."""
        await self._settled.wait()

    @property
    def queued(self) -> int:
        """Jobs that wait for a process."""
        return len(self._queue)

    def finished(self, job: Job) -> BlockTiles | Snapshot | None:
        """A block or a snapshot that is kept."""
        drawn = self._finished.get(job)
        return None if isinstance(drawn, Missing) else drawn

    def open(self) -> None:
        """Start the processes; returns at once."""
        self._slots = [asyncio.create_task(self._slot(first=number == 0)) for number in range(self._settings.workers)]

    async def close(self) -> None:
        """End the processes and fail what is on its way."""
        self._closed = True
        self._settled.set()
        for slot in self._slots:
            slot.cancel()
        await asyncio.gather(*self._slots, return_exceptions=True)
        self._fail_all(BusyError("The service is shutting down."), list(self._flights.values()))
        self._threads.shutdown(wait=True)

    async def run(self, job: Job) -> Result:
        """The answer to a job, from memory where it is kept.

        Raises ``BusyError`` where the queue is full, ``GraphicsError`` where no process can be started,
        ``RenderTimeoutError``, ``WorkerCrashError``, and what the work itself raises. A job that nobody waits for any
        more is dropped unless it has begun.
        """
        kept = self.finished(job)
        if kept is not None:
            return kept
        flight = self._flights.get(job) or self._enqueue(job)
        flight.waiting += 1
        try:
            answer = await asyncio.shield(flight.answer)
        finally:
            flight.waiting -= 1
            if not flight.waiting and self._queue.get(job) is flight:
                del self._queue[job], self._flights[job]
                flight.answer.cancel()
                self.tally.abandoned += 1
        if isinstance(answer, Failure):
            raise answer.error()
        return answer

    def _enqueue(self, job: Job) -> _PendingJob:
        if self._closed:
            raise BusyError("The service is shutting down.")
        if self._start_error is not None and not self.ready:
            raise GraphicsError(str(self._start_error))
        if len(self._queue) >= self._settings.queue_length:
            raise BusyError(f"The service is busy: {len(self._queue)} pictures are waiting to be drawn.")
        flight = _PendingJob(job, asyncio.get_running_loop().create_future())
        # An error that nobody waits for any more is no news.
        flight.answer.add_done_callback(lambda answer: answer.cancelled() or answer.exception())
        self._flights[job] = self._queue[job] = flight
        self._news.set()
        return flight

    async def _slot(self, first: bool) -> None:
        """Keep one process running, whatever happens to it. The first to start compiles what the others then find compiled."""
        if not first:
            await self._settled.wait()
        failures = 0
        while True:
            if failures > 1:
                await asyncio.sleep(min(FIRST_PAUSE_S * 2 ** (failures - 2), LONGEST_PAUSE_S))
            config = replace(self._config, served=self._served())
            worker = WorkerProcess(self._target, config, self._threads, self._news.set)
            try:
                healthy = await self._start_and_serve(worker)
            finally:
                self.pids.discard(worker.pid or 0)
                await worker.end()
            failures = 0 if healthy else failures + 1

    async def _start_and_serve(self, worker: WorkerProcess) -> bool:
        """Whether the process ended in good order or at least after good work."""
        try:
            began = asyncio.get_running_loop().time()
            ready = await worker.start(self._settings.start_timeout_s)
            self.renderer, self.device = ready.renderer, ready.device
        except SkuggaError as error:
            log.error("a render process could not be started: %s", error)
            self._start_error = error
            if not self.ready:
                self._fail_all(GraphicsError(str(error)), list(self._queue.values()))
            return False
        finally:
            self._settled.set()
        took = asyncio.get_running_loop().time() - began
        self._start_error = None
        self.tally.started += 1
        self.pids.add(worker.pid or 0)
        log.info("render process %s ready after %.1f s: %s", worker.pid, took, self.renderer)
        return await self._serve(worker)

    async def _serve(self, worker: WorkerProcess) -> bool:
        for count in range(self._settings.recycle_blocks):
            flight = await self._next(worker)
            if flight is None:
                log.error("render process %s died while it was idle", worker.pid)
                return count > 0
            try:
                answer = await worker.ask(flight.job, self._settings.render_timeout_s)
            except (RenderTimeoutError, WorkerCrashError) as error:
                log.error("render process %s is replaced: %s", worker.pid, error)
                self._land(flight, error)
                return count > 0
            self._land(flight, answer)
            if isinstance(answer, Failure) and answer.fatal:
                log.error("render process %s is replaced: %s", worker.pid, answer.message)
                return count > 0
        log.info("render process %s is replaced after %d jobs", worker.pid, self._settings.recycle_blocks)
        return True

    async def _next(self, worker: WorkerProcess) -> _PendingJob | None:
        """The next job of the queue; ``None`` where the process dies while it waits for one."""
        while not worker.dead:
            if self._queue:
                return self._queue.popitem(last=False)[1]
            self._news.clear()
            await self._news.wait()
        return None

    def _land(self, flight: _PendingJob, answer: Answer | SkuggaError) -> None:
        self._flights.pop(flight.job, None)
        if isinstance(answer, SkuggaError):
            self.tally.failed += 1
            flight.answer.set_exception(answer)
        else:
            self.tally.answered += 1
            if isinstance(answer, BlockTiles | Snapshot):
                self._finished.put(flight.job, value=answer)
            flight.answer.set_result(answer)

    def _fail_all(self, error: SkuggaError, flights: list[_PendingJob]) -> None:
        for flight in flights:
            self._queue.pop(flight.job, None)
            self._land(flight, error)
