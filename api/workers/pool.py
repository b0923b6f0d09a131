"""The pool of render processes, with the measurements that plans use and the background work of a service.

``pending_jobs`` queues the jobs, and ``supervisor`` runs them. The service survives render processes that hang, are stopped or die.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from skugga.api.settings import Settings
from skugga.api.workers.background_compile import BackgroundCompile
from skugga.api.workers.idle_calibration import IdleCalibration, measure_profile
from skugga.api.workers.idle_probes import IdleProbes, Probe, probe_level
from skugga.api.workers.idle_work import IdleWork
from skugga.api.workers.jobs import (
    BlockJob,
    BlockTiles,
    DescriptorPlanJob,
    Job,
    LevelKey,
    PreparationProgress,
    Result,
    Snapshot,
    WorkerReady,
)
from skugga.api.workers.pending_jobs import PendingJobs
from skugga.api.workers.piped_process import SpawnedWorker, WorkerTarget
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.pool_counters import PoolCounters
from skugga.api.workers.supervisor import WorkerSupervisor
from skugga.api.workers.worker_config import first_config
from skugga.api.workers.worker_main import worker_main
from skugga.api.workers.worker_process import WorkerProcess
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import BusyError

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile


class Pool:
    """Runs jobs in render processes. Use it from one event loop.

    Requests for equal jobs share one job. Finished blocks and snapshots are cached, up to ``Settings.block_cache_bytes``. Once a
    process is ready, loops (functions that numba compiles) that the cache on disk lacks are compiled in the background.

    Parameters
    ----------
    settings
        The service's settings.
    worker_target
        Main function of a render process.
    preload_blocks
        Returns a block of each level. Idle processes open these levels for later requests.
    measure_device
        Calibrates the device (measures the costs of algorithms) in idle time, if it has no calibration.
    probe
        Probes a level (observes errors and times of algorithms on its maps) in idle time, once its maps are requested.
    spawned_worker
        The first render process, if it has been started already, with ``first_config``.

    Attributes
    ----------
    jobs : PendingJobs
        The waiting and running jobs.
    supervisor : WorkerSupervisor
        Starts, supervises and replaces the render processes.
    measurements : PlanMeasurements or None
        The calibration and the probes that plans use. If it is replaced, jobs that start later use the new one in all processes,
        and cached pictures of other plan versions are no longer used.
    preparing : PreparationProgress or None
        Progress of the first process until it is ready, then of the background compilation; ``None`` without either.
    preparing_since_s : float
        Start of the preparation, in seconds of ``time.monotonic``.
    background_compile, idle_work, idle_calibration, idle_probes
        The background compilation, the queue of idle work, and what calibrates and probes in idle time.
    on_picture_finished : callable
        Called with each block or snapshot that a process has finished.
    """

    def __init__(
        self,
        settings: Settings,
        worker_target: WorkerTarget = worker_main,
        preload_blocks: Callable[[], tuple[BlockJob, ...]] = tuple,
        measure_device: Callable[[], DeviceProfile] = measure_profile,
        probe: Probe = probe_level,
        spawned_worker: SpawnedWorker | None = None,
    ) -> None:
        self._closed = False
        self.jobs = PendingJobs(
            settings,
            self._plan_version_of,
            lambda: bool(self.ready_pids),
            self._can_expire,
            self._prepare_for_job,
            self._note_result,
        )
        self.supervisor = WorkerSupervisor(
            settings, self.jobs, worker_target, preload_blocks, spawned_worker, lambda: self.measurements, self._note_ready,
            self._note_preparation_progress, lambda missing_loop_count: self.background_compile.start_if_needed(missing_loop_count),
        )  # fmt: skip
        self.measurements: PlanMeasurements | None = None
        self.preparing: PreparationProgress | None = PreparationProgress("starting a render process")
        self.preparing_since_s = time.monotonic()
        self.background_compile = BackgroundCompile(usable_cores(), self._note_preparation_progress)
        self.idle_work = IdleWork(self._is_busy, first_config(settings).gl_threads)
        self.idle_calibration = IdleCalibration(
            settings.calibrate_when_idle, self.idle_work, self._device, self._set_device, measure_device
        )
        self.idle_probes = IdleProbes(
            settings.probe_when_idle, self.idle_work, self._device, self._known_probes, self._add_probes, probe
        )
        self.on_picture_finished: Callable[[BlockTiles | Snapshot], None] = lambda picture: None

    @property
    def renderer(self) -> str | None:
        """OpenGL's name of the renderer; ``None`` until a process is ready."""
        return self.supervisor.renderer

    @property
    def ready_pids(self) -> set[int]:
        """Process ids of the render processes that are ready."""
        return self.supervisor.ready_pids

    @property
    def counters(self) -> PoolCounters:
        """Counters for metrics."""
        return self.jobs.counters

    @property
    def is_ready(self) -> bool:
        """Whether a render process has warmed up and is not stopped (SIGSTOP) now."""
        return self.supervisor.is_ready

    @property
    def is_healthy(self) -> bool:
        """Whether all tasks that supervise render processes still run, or the pool was closed."""
        return self._closed or not any(task.done() for task in self.supervisor.tasks)

    @property
    def queued_count(self) -> int:
        """Number of jobs that wait for a process."""
        return len(self.jobs.queue)

    @property
    def running_count(self) -> int:
        """Number of jobs that processes work on."""
        return len(self.jobs.queue.running)

    @property
    def cached_bytes(self) -> int:
        """Bytes of the cached blocks and snapshots."""
        return self.jobs.cached_bytes

    def plan_version(self, level: LevelKey | None) -> str:
        """Return the present version of a level's plans; ``None`` stands for plans of clients' descriptors."""
        return "" if self.measurements is None else self.measurements.version_of(level)

    def cached_picture(self, job: Job) -> BlockTiles | Snapshot | None:
        """Return the cached block or snapshot of a job, drawn with the present version of plans; ``None`` without one."""
        return self.jobs.cached_picture(job)

    def expected_s(self, job: Job) -> float:
        """Return the expected duration of a job in seconds, without its wait."""
        return self.jobs.queue.expected_times.expected_s(job)

    def expected_wait_s(self, job: Job, client: str) -> float:
        """Return the expected wait in the queue, in seconds, of a job that a client requests now."""
        return self.jobs.queue.wait_s(job, client, asyncio.get_running_loop().time())

    def open(self) -> None:
        """Start tasks that start and supervise the render processes. Return at once."""
        self.idle_work.start()
        self.supervisor.start()

    async def wait_for_first_process(self) -> None:
        """Wait until the first process has warmed up, so that ``renderer`` is known, or until it has failed to start."""
        await self.supervisor.first_process_event.wait()

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
        return await self.jobs.run(job, client)

    async def close(self) -> None:
        """End the render processes and all background work, and fail all pending jobs."""
        self._closed = True
        self.jobs.stop_accepting()
        self.supervisor.cancel()
        await asyncio.gather(
            self.idle_calibration.close(), self.idle_probes.close(), self.idle_work.close(), self.background_compile.close(),
            *self.supervisor.tasks, return_exceptions=True,
        )  # fmt: skip
        self.jobs.fail_pending(BusyError("The service is shutting down."))
        self.supervisor.shut_down_threads()

    def _plan_version_of(self, job: Job) -> str:
        """Return the present version of the plans that a job uses."""
        return self.plan_version(None if isinstance(job, DescriptorPlanJob) else job.level)

    def _device(self) -> DeviceProfile | None:
        """Return the calibration that plans use; ``None`` without one."""
        return None if self.measurements is None else self.measurements.device

    def _set_device(self, device: DeviceProfile) -> None:
        """Set the calibration that plans use."""
        self.measurements = replace(self.measurements or PlanMeasurements(), device=device)

    def _known_probes(self) -> Mapping[str, str]:
        """Return the probes that plans use, as JSON by the version of their level."""
        return {} if self.measurements is None else self.measurements.probes_json_by_version

    def _add_probes(self, probes: Mapping[str, str]) -> None:
        """Add probes to those that plans use, as JSON by the version of their level."""
        self.measurements = (self.measurements or PlanMeasurements()).with_probes(probes)

    def _is_busy(self) -> bool:
        """Return whether jobs wait or run, a process starts, or loops are compiled: idle work must not run then."""
        return bool(self.queued_count or self.running_count or self.supervisor.starting_count or self.background_compile.is_running)

    def _can_expire(self) -> bool:
        """Return whether waiting jobs may expire: a process has started or failed, and none prepares (for example compiles) now."""
        has_started = self.supervisor.first_process_event.is_set()
        return has_started and not any(worker.is_preparing for worker in self.supervisor.workers)

    def _prepare_for_job(self) -> None:
        """Pause idle work for a job. Raise ``SkuggaError`` if no process can be started for it."""
        self.supervisor.check_startable()
        self.idle_work.pause_for_requests()

    def _note_preparation_progress(self, preparing: PreparationProgress | None) -> None:
        """Record the progress of a preparation; ``None`` records its end."""
        if self.preparing is None:
            self.preparing_since_s = time.monotonic()
        self.preparing = preparing

    def _note_ready(self, worker: WorkerProcess, ready: WorkerReady) -> None:
        """Start the background work that a ready process allows."""
        self.measurements = self.measurements or worker.measurements
        self.preparing = self.preparing if self.background_compile.is_running else None
        self.background_compile.start_if_needed(ready.missing_loop_count)
        self.idle_calibration.start_watching(ready.renderer, ready.version)
        self.idle_probes.start_watching(ready.renderer, ready.version)

    def _note_result(self, job: Job, result: Result) -> None:
        """Report a finished block or snapshot, and request a probe if it would improve the map's plan."""
        if isinstance(result, BlockTiles | Snapshot):
            self.on_picture_finished(result)
        if isinstance(result, BlockTiles) and isinstance(job, BlockJob) and result.unprobed_class is not None:
            self.idle_probes.request_probe(job.level, result.unprobed_class)
