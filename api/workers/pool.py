"""The pool of render processes: a fair queue, single-flight deduplication, a cache of finished pictures, and supervision.

The pool replaces render processes that hang, are stopped or die, so the service survives them.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from skugga.api.errors import CircuitOpenError, ExhaustedError, RetryLaterError, WorkerCrashError, WorkerStartError
from skugga.api.resource_exhaustion import exhausted_error, run_in_pool
from skugga.api.settings import Settings
from skugga.api.workers.admission import check_admission, retry_after_s
from skugga.api.workers.background_compile import BackgroundCompile
from skugga.api.workers.circuit_breaker import CircuitBreaker
from skugga.api.workers.idle_calibration import IdleCalibration, measure_profile
from skugga.api.workers.idle_probes import IdleProbes, Probe, probe_level
from skugga.api.workers.idle_work import IdleWork
from skugga.api.workers.job_queue import JobQueue, PendingJob
from skugga.api.workers.jobs import (
    Answer,
    BlockJob,
    BlockTiles,
    DescriptorPlanJob,
    Failure,
    FrameJob,
    HeartbeatAnswer,
    HeartbeatRequest,
    Job,
    LevelKey,
    PreparationProgress,
    Result,
    Snapshot,
)
from skugga.api.workers.piped_process import SpawnedWorker, WorkerTarget
from skugga.api.workers.plan_basis import PlanMeasurements
from skugga.api.workers.process_life import is_stopped
from skugga.api.workers.worker_config import first_config
from skugga.api.workers.worker_main import worker_main
from skugga.api.workers.worker_process import WorkerProcess
from skugga.terrain.cache import Cache, Missing
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import BusyError, GraphicsError, RenderTimeoutError, SkuggaError
from skugga.terrain.gl.egl_devices import NO_OPENGL

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

INITIAL_BACKOFF_S, MAX_BACKOFF_S = 0.5, 30.0
"""Seconds before a process is started again after failed starts: after the second failure in a row, and at most.

The time doubles with each further failure. After the first failure there is no wait."""

PRELOAD_DELAY_S = 1.0
"""Idle seconds after which a process receives the blocks whose levels it should open."""

HEARTBEAT_INTERVAL_S, HEARTBEAT_TIMEOUT_S = 5.0, 30.0
"""Idle seconds before a heartbeat, and the seconds within which the process must answer it.

The timeout is long since the process may be opening a level for later requests."""

MAX_STARTS = 2
"""Maximum number of times that a job is started, if its process dies while the job runs."""

log = logging.getLogger("skugga")


@dataclass
class PoolCounters:
    """Counters of the pool since its start.

    Attributes
    ----------
    answered, failed : int
        Jobs that ended with an answer, and jobs that ended with an error.
    abandoned : int
        Jobs dropped because no request waited for them any more.
    started : int
        Render processes that became ready.
    refused : int
        Jobs refused by admission control or by the circuit breaker.
    expired : int
        Jobs that waited too long in the queue.
    timed_out : int
        Jobs that ran too long in a process.
    retried : int
        Jobs started again after their process died.
    """

    answered: int = 0
    failed: int = 0
    abandoned: int = 0
    started: int = 0
    refused: int = 0
    expired: int = 0
    timed_out: int = 0
    retried: int = 0


class Pool:
    """Runs jobs in render processes. Use it from one event loop.

    Requests for equal jobs share one job. Finished blocks and snapshots are cached, up to ``Settings.block_cache_bytes``. Once a
    process is ready, loops (functions that numba compiles) that the cache on disk lacks are compiled in the background.

    Parameters
    ----------
    settings
        The service's settings.
    target
        Main function of a render process.
    preload_blocks
        Returns a block of each level. Idle processes open these levels for later requests.
    measure
        Calibrates the device (measures the costs of algorithms) in idle time, if it has no calibration.
    probe
        Probes a level (observes errors and times of algorithms on its maps) in idle time, once its maps are requested.
    spawned_worker
        The first render process, if it has been started already, with ``first_config``.

    Attributes
    ----------
    renderer : str or None
        OpenGL's name of the renderer; ``None`` until a process is ready.
    measurements : PlanMeasurements or None
        The calibration and the probes that plans use. If it is replaced, jobs that start later use the new one in all processes,
        and cached pictures of other plan versions are no longer used.
    preparing : PreparationProgress or None
        Progress of the first process until it is ready, then of the background compilation; ``None`` without either.
    preparing_since : float
        Start of the preparation, in seconds of ``time.monotonic``.
    background_compile, idle_work, idle_calibration, idle_probes
        The background compilation, the queue of idle work, and what calibrates and probes in idle time.
    ready_pids : set of int
        Process ids of the render processes that are ready.
    counters : PoolCounters
        Counters for metrics.
    on_picture_finished : callable
        Called with each block or snapshot that a process has finished.
    """

    def __init__(
        self,
        settings: Settings,
        target: WorkerTarget = worker_main,
        preload_blocks: Callable[[], tuple[BlockJob, ...]] = tuple,
        measure: Callable[[], DeviceProfile] = measure_profile,
        probe: Probe = probe_level,
        spawned_worker: SpawnedWorker | None = None,
    ) -> None:
        self._settings = settings
        self._target, self._preload_blocks, self._spawned = target, preload_blocks, spawned_worker
        self._config = first_config(settings)
        # Twice as many threads: a process that cannot be killed keeps its thread while a new one replaces it.
        self._threads = ThreadPoolExecutor(2 * settings.workers, "skugga-pipe")
        self._picture_cache: Cache[BlockTiles | Snapshot] = Cache(
            "skugga.api.workers.finished", "process", settings.block_cache_bytes, lambda picture: picture.nbytes
        )
        self._pending: dict[Job, PendingJob] = {}
        self._queue = JobQueue(settings.workers)
        self._circuit_breaker = CircuitBreaker()
        self._queue_changed = asyncio.Event()
        self._supervisor_tasks: list[asyncio.Task[None]] = []
        self._workers: set[WorkerProcess] = set()
        self._start_error: SkuggaError | None = None
        self._closed = False
        self._first_process_event = asyncio.Event()
        self._starting = 0
        self.renderer: str | None = None
        self.measurements: PlanMeasurements | None = None
        self.preparing: PreparationProgress | None = PreparationProgress("starting a render process")
        self.preparing_since = time.monotonic()
        self.background_compile = BackgroundCompile(usable_cores(), self._note_preparation_progress)
        self.idle_work = IdleWork(self._is_busy, self._config.gl_threads)
        self.idle_calibration = IdleCalibration(
            settings.calibrate_when_idle, self.idle_work, self._device, self._set_device, measure
        )
        self.idle_probes = IdleProbes(
            settings.probe_when_idle, self.idle_work, self._device, self._known_probes, self._add_probes, probe
        )
        self.ready_pids: set[int] = set()
        self.counters = PoolCounters()
        self.on_picture_finished: Callable[[BlockTiles | Snapshot], None] = lambda picture: None

    @property
    def is_ready(self) -> bool:
        """Whether a render process has warmed up and is not stopped (SIGSTOP) now."""
        return any(not is_stopped(pid) for pid in self.ready_pids)

    @property
    def is_healthy(self) -> bool:
        """Whether all tasks that supervise render processes still run, or the pool was closed."""
        return self._closed or not any(task.done() for task in self._supervisor_tasks)

    def plan_version(self, level: LevelKey | None) -> str:
        """Return the present version of a level's plans; ``None`` stands for plans of clients' descriptors."""
        return "" if self.measurements is None else self.measurements.version_of(level)

    def _plan_version_of(self, job: Job) -> str:
        return self.plan_version(None if isinstance(job, DescriptorPlanJob) else job.level)

    def _device(self) -> DeviceProfile | None:
        return None if self.measurements is None else self.measurements.device

    def _set_device(self, device: DeviceProfile) -> None:
        self.measurements = replace(self.measurements or PlanMeasurements(), device=device)

    def _known_probes(self) -> Mapping[str, str]:
        return {} if self.measurements is None else self.measurements.probes_json_by_version

    def _add_probes(self, probes: Mapping[str, str]) -> None:
        self.measurements = (self.measurements or PlanMeasurements()).with_probes(probes)

    def _is_busy(self) -> bool:
        """Return whether jobs wait or run, a process starts, or loops are compiled: idle work must not run then."""
        return bool(self.queued or self.running or self._starting or self.background_compile.is_running)

    def _note_preparation_progress(self, preparing: PreparationProgress | None) -> None:
        if self.preparing is None:
            self.preparing_since = time.monotonic()
        self.preparing = preparing

    async def wait_for_first_process(self) -> None:
        """Wait until the first process has warmed up, so that ``renderer`` is known, or until it has failed to start."""
        await self._first_process_event.wait()

    @property
    def queued(self) -> int:
        """Number of jobs that wait for a process."""
        return len(self._queue)

    @property
    def running(self) -> int:
        """Number of jobs that processes work on."""
        return len(self._queue.running)

    @property
    def cached_bytes(self) -> int:
        """Bytes of the cached blocks and snapshots."""
        return self._picture_cache.nbytes

    def cached_picture(self, job: Job) -> BlockTiles | Snapshot | None:
        """Return the cached block or snapshot of a job, drawn with the present version of plans; ``None`` without one."""
        cached = self._picture_cache.get(job, self._plan_version_of(job))
        return None if isinstance(cached, Missing) else cached

    def expected_s(self, job: Job) -> float:
        """Return the expected duration of a job in seconds, without its wait."""
        return self._queue.expected_times.expected_s(job)

    def open(self) -> None:
        """Start tasks that start and supervise the render processes. Return at once."""
        self.idle_work.start()
        self._supervisor_tasks = [asyncio.create_task(self._supervise(number)) for number in range(self._settings.workers)]

    async def close(self) -> None:
        """End the render processes and all background work, and fail all pending jobs."""
        self._closed = True
        self._first_process_event.set()
        for task in self._supervisor_tasks:
            task.cancel()
        await asyncio.gather(
            self.idle_calibration.close(), self.idle_probes.close(), self.idle_work.close(), self.background_compile.close(),
            *self._supervisor_tasks, return_exceptions=True,
        )  # fmt: skip
        self._fail_all(BusyError("The service is shutting down."), list(self._pending.values()))
        self._threads.shutdown(wait=True)

    def expected_wait_s(self, job: Job, client: str) -> float:
        """Return the expected wait in the queue, in seconds, of a job that a client requests now."""
        return self._queue.wait_s(job, client, asyncio.get_running_loop().time())

    async def run(self, job: Job, client: str = "") -> Result:
        """Return the answer to a client's job, from the cache if possible.

        The answer uses plans of the version at the time of the call, or of a newer version. If the call is cancelled and no other
        request waits for the job, the job is dropped unless it has started.

        Raises
        ------
        RetryLaterError
            The client has too many jobs in the queue, or the job waited too long.
        CircuitOpenError
            Jobs of this kind fail repeatedly.
        WorkerStartError
            No render process can be started.
        GraphicsError
            No render process can draw with OpenGL.
        RenderTimeoutError
            The job ran too long.
        WorkerCrashError
            The process ended while the job ran, also at its second start.
        SkuggaError
            The error that the job itself raised.
        """
        cached = self.cached_picture(job)
        if cached is not None:
            return cached
        version = self._plan_version_of(job)
        pending = self._pending.get(job) or self._enqueue(job, client)
        answer = await self._finished_answer(pending, client)
        if pending.plan_version not in (version, self._plan_version_of(job)):  # the job had started earlier, with older plans
            answer = await self._finished_answer(self._pending.get(job) or self._enqueue(job, client), client)
        if isinstance(answer, Failure):
            raise answer.to_error()
        return answer

    async def _finished_answer(self, pending: PendingJob, client: str) -> Answer:
        """Wait for the answer to a pending job on behalf of a client."""
        job = pending.job
        pending.clients[client] += 1
        try:
            return await asyncio.shield(pending.answer)
        finally:
            pending.clients[client] -= 1
            pending.clients += Counter()  # drops clients without waiting requests
            if not pending.clients and self._queue.waiting.get(job) is pending:
                self._remove(pending)
                pending.answer.cancel()
                self.counters.abandoned += 1

    def _enqueue(self, job: Job, client: str) -> PendingJob:
        if self._closed:
            raise BusyError("The service is shutting down.")
        if self._start_error is not None and not self.ready_pids:
            raise _start_error_of(self._start_error)
        self.idle_work.pause_for_requests()
        loop = asyncio.get_running_loop()
        left_s = self._circuit_breaker.seconds_left(job)
        if left_s > 0.0:
            self.counters.refused += 1
            raise _circuit_open_error(job, left_s)
        pending = PendingJob(job, loop.create_future(), loop.time(), is_background=isinstance(job, FrameJob))
        # Mark errors as retrieved, since no request may wait for them any more.
        pending.answer.add_done_callback(lambda answer: answer.cancelled() or answer.exception())
        if not pending.is_background:
            try:
                check_admission(self._queue, job, client, loop.time(), self._settings, bool(self.ready_pids))
            except RetryLaterError:
                self.counters.refused += 1
                raise
            self._start_expiry_timer(pending)
        self._pending[job] = pending
        self._queue.put(pending)
        self._queue_changed.set()
        return pending

    def _start_expiry_timer(self, pending: PendingJob) -> None:
        pending.expiry_timer = asyncio.get_running_loop().call_later(self._settings.queue_timeout_s, self._expire, pending)

    def _expire(self, pending: PendingJob) -> None:
        """Fail a job that has waited too long in the queue.

        The job waits for another ``queue_timeout_s`` if no process has been ready or has failed yet, or if a process prepares (for
        example compiles loops) now.
        """
        if self._queue.waiting.get(pending.job) is not pending:
            return
        if not self._first_process_event.is_set() or any(worker.is_preparing for worker in self._workers):
            self._start_expiry_timer(pending)
            return
        self.counters.expired += 1
        message = f"The service is busy: this picture waited longer than the limit of {self._settings.queue_timeout_s:g} s."
        wait_s = self._queue.wait_s(pending.job, pending.client, asyncio.get_running_loop().time())
        self._finish(pending, RetryLaterError(message, retry_after_s(wait_s)))

    async def _supervise(self, number: int) -> None:
        """Run a render process, and replace it whenever it ends, for ever. Failed starts are repeated after growing pauses.

        ``number`` counts the supervised processes from 0. All others wait for the start of process 0, which compiles loops for all
        of them.
        """
        if number:
            await self._first_process_event.wait()
        failures = 0
        while True:
            if failures > 1:
                await asyncio.sleep(min(INITIAL_BACKOFF_S * 2 ** (failures - 2), MAX_BACKOFF_S))
            try:
                healthy = await self._run_process(number)
            except Exception as error:  # out of descriptors, threads or memory, or a bug: the task survives all of them
                log.error("a supervisor of render processes failed and starts another process: %s: %s", type(error).__name__, error)
                self._note_start_failure(exhausted_error(error) or WorkerStartError(f"a render process cannot be started: {error}"))
                healthy = False
            failures = 0 if healthy else failures + 1

    async def _run_process(self, number: int) -> bool:
        """Start a render process and serve jobs with it until it ends.

        Return whether it worked: it became ready, and ran at least one job.
        """
        spawned_worker, self._spawned = self._spawned, None
        if spawned_worker is None:
            # Require OpenGL if an earlier process had it: a service must not lose features at a restart.
            needs_opengl = self.renderer not in (None, NO_OPENGL)
            config = replace(self._config, needs_opengl=needs_opengl, measurements=self.measurements, number=number)
            spawned_worker = SpawnedWorker(self._target, config)
        worker = WorkerProcess(spawned_worker, self._threads, self._queue_changed.set, self._note_preparation_progress)
        self._workers.add(worker)
        try:
            worker.preload_blocks = await run_in_pool(self._threads, self._preload_blocks)
            return await self._start_and_serve(worker)
        finally:
            self._workers.discard(worker)
            self.ready_pids.discard(worker.pid or 0)
            await worker.end()

    async def _start_and_serve(self, worker: WorkerProcess) -> bool:
        try:
            began_s = asyncio.get_running_loop().time()
            self._starting += 1
            ready = await worker.start(self._settings.start_timeout_s)
            self.renderer, self.measurements = ready.renderer, self.measurements or worker.measurements
        except SkuggaError as error:
            log.error("a render process could not be started: %s", error)
            self._note_start_failure(error)
            return False
        finally:
            self._starting -= 1
            self._first_process_event.set()
        duration_s = asyncio.get_running_loop().time() - began_s
        self._start_error = None
        self.counters.started += 1
        self.ready_pids.add(worker.pid or 0)
        renderer_text = f"{self.renderer}, {ready.egl_device}" if ready.egl_device else self.renderer
        log.info("render process %s ready after %.1f s: %s", worker.pid, duration_s, renderer_text)
        self.preparing = self.preparing if self.background_compile.is_running else None
        self.background_compile.start_if_needed(ready.missing_loops)
        self.idle_calibration.start_watching(ready.renderer, ready.version)
        self.idle_probes.start_watching(ready.renderer, ready.version)
        return await self._serve(worker)

    def _note_start_failure(self, error: SkuggaError) -> None:
        self._start_error = error
        self._first_process_event.set()
        if not self.ready_pids:
            self._fail_all(_start_error_of(error), list(self._queue.waiting.values()))

    async def _serve(self, worker: WorkerProcess) -> bool:
        """Run jobs in a process until it ends or must be replaced.

        Return whether it took any job. Otherwise its end counts as a failed start.
        """
        for count in range(self._settings.recycle_blocks):
            pending = await self._next(worker)
            if pending is None:
                return count > 0
            pending.plan_version = self._plan_version_of(pending.job)
            try:
                answer = await worker.send_and_receive(pending.job, self._settings.render_timeout_s, self.measurements)
            except ExhaustedError as error:  # the process did not receive the job
                self._finish(pending, error)
                continue
            except WorkerCrashError as error:
                log.error("render process %s is replaced: %s", worker.pid, error)
                self._retry_or_finish(pending, error)
                return True
            except RenderTimeoutError as error:
                log.error("render process %s is replaced: %s", worker.pid, error)
                self.counters.timed_out += 1
                self._queue.add_duration(pending.job, self._settings.render_timeout_s)
                self._finish(pending, error)
                self._record_crash(pending.job)
                return True
            except Exception as error:  # a bug of this task: clients must not wait for ever
                self._finish(pending, WorkerCrashError(f"the supervisor of the render process failed: {error!r}"))
                raise
            if isinstance(answer, Failure) and answer.is_fatal:
                log.error("render process %s is replaced: %s", worker.pid, answer.message)
                self._retry_or_finish(pending, answer)
                return True
            self._finish(pending, answer, add_duration=not worker.has_prepared)
        log.info("render process %s is replaced after %d jobs", worker.pid, self._settings.recycle_blocks)
        return True

    async def _next(self, worker: WorkerProcess) -> PendingJob | None:
        """Wait for the next job of the queue and return it; return ``None`` if the process dies or does not answer a heartbeat."""
        loop = asyncio.get_running_loop()
        while not worker.has_ended:
            pending = self._queue.start_next(loop.time())
            if pending is not None:
                if pending.expiry_timer is not None:
                    pending.expiry_timer.cancel()
                return pending
            self._queue_changed.clear()
            try:
                await asyncio.wait_for(
                    self._queue_changed.wait(), PRELOAD_DELAY_S if worker.preload_blocks else HEARTBEAT_INTERVAL_S
                )
            except TimeoutError:
                try:
                    pong = await worker.send_and_receive(HeartbeatRequest(worker.preload_blocks), HEARTBEAT_TIMEOUT_S)
                    worker.preload_blocks = ()
                    if isinstance(pong, HeartbeatAnswer):
                        self.background_compile.start_if_needed(pong.missing_loops)
                except ExhaustedError:  # try again later
                    continue
                except (RenderTimeoutError, WorkerCrashError):
                    log.error("render process %s is replaced: it does not answer any more", worker.pid)
                    return None
        log.error("render process %s died while it was idle", worker.pid)
        return None

    def _retry_or_finish(self, pending: PendingJob, outcome: Failure | SkuggaError) -> None:
        """Queue a job again whose process ended, if it was started fewer than ``MAX_STARTS`` times and a request waits.

        Otherwise answer its requests with ``outcome``.
        """
        if pending.start_count < MAX_STARTS and pending.clients and not self._closed:
            self._queue.discard(pending)
            self._queue.put(pending)
            self._queue_changed.set()
            self.counters.retried += 1
            if not pending.is_background:
                self._start_expiry_timer(pending)
            return
        self._finish(pending, outcome)
        self._record_crash(pending.job)

    def _record_crash(self, job: Job) -> None:
        """Record that a job ended its process.

        If that opens a circuit of the circuit breaker, fail the waiting jobs that the circuit breaker refuses now.
        """
        self._circuit_breaker.record_failure(job)
        left_s = self._circuit_breaker.seconds_left(job)
        if left_s <= 0.0:
            return
        log.error("%s keeps failing: its circuit breaker is open for %.0f s", _job_title(job), left_s)
        for pending in list(self._queue.waiting.values()):
            if self._circuit_breaker.seconds_left(pending.job) > 0.0:
                self._finish(pending, _circuit_open_error(pending.job, left_s))

    def _finish(self, pending: PendingJob, answer: Answer | SkuggaError, add_duration: bool = True) -> None:
        """Answer all requests that wait for a job, with a result or an error, and remove the job.

        ``add_duration`` says whether its duration is learnt. It is not if the process made one-time preparations before the job.
        """
        if pending.started_s is not None and not isinstance(answer, SkuggaError | Failure):
            if add_duration:
                self._queue.add_duration(pending.job, asyncio.get_running_loop().time() - pending.started_s)
            self._circuit_breaker.record_success(pending.job)
        self._remove(pending)
        if pending.answer.done():
            return
        if isinstance(answer, SkuggaError):
            self.counters.failed += 1
            pending.answer.set_exception(answer)
        else:
            self.counters.answered += 1
            if isinstance(answer, BlockTiles | Snapshot):
                self._picture_cache.put(pending.job, answer.plan_version, value=answer)
                self.on_picture_finished(answer)
            if isinstance(answer, BlockTiles) and isinstance(pending.job, BlockJob) and answer.unprobed_class is not None:
                self.idle_probes.request_probe(pending.job.level, answer.unprobed_class)
            pending.answer.set_result(answer)

    def _remove(self, pending: PendingJob) -> None:
        if pending.expiry_timer is not None:
            pending.expiry_timer.cancel()
        if self._pending.get(pending.job) is pending:
            del self._pending[pending.job]
        self._queue.discard(pending)
        self._queue_changed.set()  # a waiting job may start now

    def _fail_all(self, error: SkuggaError, pending_jobs: list[PendingJob]) -> None:
        for pending in pending_jobs:
            self._finish(pending, error)


def _start_error_of(error: SkuggaError) -> SkuggaError:
    """Return the error for requests if ``error`` prevents the start of render processes."""
    return error if isinstance(error, ExhaustedError | WorkerStartError) else GraphicsError(str(error))


def _job_title(job: Job) -> str:
    if isinstance(job, DescriptorPlanJob):
        return "A plan of such a descriptor"
    settings_clause = " with these settings" if job.request.overrides.asked else ""
    return f"A {type(job).__name__.removesuffix('Job').lower()} of level {job.level.path.stem}{settings_clause}"


def _circuit_open_error(job: Job, open_s: float) -> CircuitOpenError:
    message = f"{_job_title(job)} took too long, or ended its render process, several times. Try again later."
    return CircuitOpenError(message, retry_after_s(open_s))
