"""Supervision of render processes: start them, give them jobs, and replace those that hang, are stopped or die."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from skugga.api.errors import ExhaustedError, WorkerCrashError, WorkerStartError
from skugga.api.resource_exhaustion import exhausted_error, run_in_pool
from skugga.api.settings import Settings
from skugga.api.workers.job_queue import PendingJob
from skugga.api.workers.jobs import BlockJob, Failure, HeartbeatRequest, HeartbeatResponse, PreparationProgress, WorkerReady
from skugga.api.workers.pending_jobs import PendingJobs
from skugga.api.workers.piped_process import SpawnedWorker, WorkerTarget
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.process_life import is_stopped
from skugga.api.workers.worker_config import first_config
from skugga.api.workers.worker_process import WorkerProcess
from skugga.terrain.errors import GraphicsError, RenderTimeoutError, SkuggaError
from skugga.terrain.gl.egl_devices import NO_OPENGL_RENDERER

INITIAL_BACKOFF_S, MAX_BACKOFF_S = 0.5, 30.0
"""Seconds before a process is started again after failed starts: after the second failure in a row, and at most.

The time doubles with each further failure. After the first failure there is no wait."""

PRELOAD_DELAY_S = 1.0
"""Idle seconds after which a process receives the blocks whose levels it should open."""

HEARTBEAT_INTERVAL_S, HEARTBEAT_TIMEOUT_S = 5.0, 30.0
"""Idle seconds before a heartbeat request, and the seconds within which the process must answer it.

The timeout is long since the process may be opening a level for later requests."""

log = logging.getLogger("skugga")


class WorkerSupervisor:
    """Runs the jobs of ``jobs`` in render processes, and replaces processes that end. Use it from one event loop.

    Parameters
    ----------
    settings
        The service's settings.
    jobs
        The pending jobs.
    worker_target
        Main function of a render process.
    preload_blocks
        Returns a block of each level. Idle processes open these levels for later requests.
    spawned_worker
        The first render process, if it has been started already, with ``first_config``.
    current_measurements
        Returns the measurements that plans use; ``None`` before a process is ready.
    on_ready
        Called with each process that has become ready, and its message.
    on_preparation_progress
        Called with the progress of a process's preparations.
    on_missing_loops
        Called with the number of loops (functions that numba compiles) without machine code, as an idle process reports it.

    Attributes
    ----------
    renderer : str or None
        OpenGL's name of the renderer; ``None`` until a process is ready.
    ready_pids : set of int
        Process ids of the render processes that are ready.
    workers : set of WorkerProcess
        The render processes.
    starting_count : int
        Number of processes that are starting.
    first_process_event : asyncio.Event
        Set once the first process has become ready or has failed to start.
    tasks : list of asyncio.Task
        A task for each render process, which starts and supervises it.
    """

    def __init__(
        self,
        settings: Settings,
        jobs: PendingJobs,
        worker_target: WorkerTarget,
        preload_blocks: Callable[[], tuple[BlockJob, ...]],
        spawned_worker: SpawnedWorker | None,
        current_measurements: Callable[[], PlanMeasurements | None],
        on_ready: Callable[[WorkerProcess, WorkerReady], None],
        on_preparation_progress: Callable[[PreparationProgress], None],
        on_missing_loops: Callable[[int], None],
    ) -> None:
        self._settings, self._jobs, self._measurements = settings, jobs, current_measurements
        self._target, self._preload_blocks, self._spawned = worker_target, preload_blocks, spawned_worker
        self._on_ready, self._on_preparation_progress = on_ready, on_preparation_progress
        self._on_missing_loops = on_missing_loops
        self._config = first_config(settings)
        # Twice as many threads: a process that cannot be killed keeps its thread while a new one replaces it.
        self._threads = ThreadPoolExecutor(2 * settings.workers, "skugga-pipe")
        self._start_error: SkuggaError | None = None
        self.renderer: str | None = None
        self.ready_pids: set[int] = set()
        self.workers: set[WorkerProcess] = set()
        self.starting_count = 0
        self.first_process_event = asyncio.Event()
        self.tasks: list[asyncio.Task[None]] = []

    @property
    def is_ready(self) -> bool:
        """Whether a render process has warmed up and is not stopped (SIGSTOP) now."""
        return any(not is_stopped(pid) for pid in self.ready_pids)

    def start(self) -> None:
        """Start the supervising tasks. Return at once."""
        self.tasks = [asyncio.create_task(self._supervise(number)) for number in range(self._settings.workers)]

    def cancel(self) -> None:
        """Cancel the supervising tasks. The caller must then wait for ``tasks``, which end their processes."""
        self.first_process_event.set()
        for task in self.tasks:
            task.cancel()

    def shut_down_threads(self) -> None:
        """Wait for the threads that read from processes. Call it after ``tasks`` have ended."""
        self._threads.shutdown(wait=True)

    def check_startable(self) -> None:
        """Raise the error of the last start if no process is ready and the last start has failed."""
        if self._start_error is not None and not self.ready_pids:
            raise _start_error_of(self._start_error)

    async def _supervise(self, process_number: int) -> None:
        """Run a render process, and replace it whenever it ends, for ever. Failed starts are repeated after growing pauses.

        ``process_number`` counts the supervised processes from 0. All others wait for the start of process 0, which compiles loops
        for all of them.
        """
        if process_number:
            await self.first_process_event.wait()
        failures = 0
        while True:
            if failures > 1:
                await asyncio.sleep(min(INITIAL_BACKOFF_S * 2 ** (failures - 2), MAX_BACKOFF_S))
            try:
                healthy = await self._run_process(process_number)
            except Exception as error:  # out of descriptors, threads or memory, or a bug: the task survives all of them
                log.error(
                    "the supervisor of a render process failed and starts another process: %s: %s", type(error).__name__, error
                )
                self._note_start_failure(exhausted_error(error) or WorkerStartError(f"a render process cannot be started: {error}"))
                healthy = False
            failures = 0 if healthy else failures + 1

    async def _run_process(self, process_number: int) -> bool:
        """Start a render process and serve jobs with it until it ends.

        Return whether it worked: it became ready, and ran at least one job.
        """
        spawned_worker, self._spawned = self._spawned, None
        if spawned_worker is None:
            # Require OpenGL if an earlier process had it: a service must not lose features at a restart.
            needs_opengl = self.renderer not in (None, NO_OPENGL_RENDERER)
            config = replace(self._config, needs_opengl=needs_opengl, measurements=self._measurements(), number=process_number)
            spawned_worker = SpawnedWorker(self._target, config)
        worker = WorkerProcess(spawned_worker, self._threads, self._jobs.may_start_event.set, self._on_preparation_progress)
        self.workers.add(worker)
        try:
            worker.preload_blocks = await run_in_pool(self._threads, self._preload_blocks)
            return await self._start_and_serve(worker)
        finally:
            self.workers.discard(worker)
            self.ready_pids.discard(worker.pid or 0)
            await worker.end()

    async def _start_and_serve(self, worker: WorkerProcess) -> bool:
        """Start a render process and run jobs in it until it ends. Return whether it became ready and ran at least one job."""
        try:
            began_s = asyncio.get_running_loop().time()
            self.starting_count += 1
            ready = await worker.start(self._settings.start_timeout_s)
            self.renderer = ready.renderer
        except SkuggaError as error:
            log.error("a render process could not be started: %s", error)
            self._note_start_failure(error)
            return False
        finally:
            self.starting_count -= 1
            self.first_process_event.set()
        duration_s = asyncio.get_running_loop().time() - began_s
        self._start_error = None
        self._jobs.counters.processes_started += 1
        self.ready_pids.add(worker.pid or 0)
        renderer_text = f"{self.renderer}, {ready.egl_device}" if ready.egl_device else self.renderer
        log.info("render process %s ready after %.1f s: %s", worker.pid, duration_s, renderer_text)
        self._on_ready(worker, ready)
        return await self._run_jobs(worker)

    def _note_start_failure(self, error: SkuggaError) -> None:
        """Record that a render process cannot be started. If no process is ready, fail the waiting jobs with its error."""
        self._start_error = error
        self.first_process_event.set()
        if not self.ready_pids:
            self._jobs.fail_waiting(_start_error_of(error))

    async def _run_jobs(self, worker: WorkerProcess) -> bool:
        """Run jobs in a process until it ends or must be replaced.

        Return whether it ran any job. Otherwise its end counts as a failed start.
        """
        for count in range(self._settings.recycle_blocks):
            pending = await self._next_job(worker)
            if pending is None:
                return count > 0
            try:
                answer = await worker.send_and_receive(pending.job, self._settings.render_timeout_s, self._measurements())
            except ExhaustedError as error:  # the process did not receive the job
                self._jobs.finish(pending, error)
                continue
            except WorkerCrashError as error:
                log.error("render process %s is replaced: %s", worker.pid, error)
                self._jobs.retry_or_finish(pending, error)
                return True
            except RenderTimeoutError as error:
                log.error("render process %s is replaced: %s", worker.pid, error)
                self._jobs.counters.jobs_timed_out += 1
                self._jobs.queue.add_duration(pending.job, self._settings.render_timeout_s)
                self._jobs.finish(pending, error)
                self._jobs.record_crash(pending.job)
                return True
            except Exception as error:  # a bug of this task: clients must not wait for ever
                self._jobs.finish(pending, WorkerCrashError(f"the supervisor of the render process failed: {error!r}"))
                raise
            if isinstance(answer, Failure) and answer.is_fatal:
                log.error("render process %s is replaced: %s", worker.pid, answer.message)
                self._jobs.retry_or_finish(pending, answer)
                return True
            self._jobs.finish(pending, answer, add_duration=not worker.has_prepared)
        log.info("render process %s is replaced after %d jobs", worker.pid, self._settings.recycle_blocks)
        return True

    async def _next_job(self, worker: WorkerProcess) -> PendingJob | None:
        """Wait for the next job and return it; return ``None`` if the process dies or does not answer a heartbeat request."""
        loop = asyncio.get_running_loop()
        while not worker.has_ended:
            pending = self._jobs.start_next(loop.time())
            if pending is not None:
                return pending
            self._jobs.may_start_event.clear()
            try:
                delay_s = PRELOAD_DELAY_S if worker.preload_blocks else HEARTBEAT_INTERVAL_S
                await asyncio.wait_for(self._jobs.may_start_event.wait(), delay_s)
            except TimeoutError:
                try:
                    answer = await worker.send_and_receive(HeartbeatRequest(worker.preload_blocks), HEARTBEAT_TIMEOUT_S)
                    worker.preload_blocks = ()
                    if isinstance(answer, HeartbeatResponse):
                        self._on_missing_loops(answer.missing_loop_count)
                except ExhaustedError:  # try again later
                    continue
                except (RenderTimeoutError, WorkerCrashError):
                    log.error("render process %s is replaced: it did not answer a heartbeat request", worker.pid)
                    return None
        log.error("render process %s died while it was idle", worker.pid)
        return None


def _start_error_of(error: SkuggaError) -> SkuggaError:
    """Return the error for requests if ``error`` prevents the start of render processes."""
    return error if isinstance(error, ExhaustedError | WorkerStartError) else GraphicsError(str(error))
