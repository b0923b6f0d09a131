"""Pending jobs of a pool: a fair queue, single-flight deduplication, expiry, retries, and a cache of finished pictures."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable

from skugga.api.errors import CircuitOpenError, RetryLaterError
from skugga.api.settings import Settings
from skugga.api.workers.admission import check_admission, retry_after_s
from skugga.api.workers.circuit_breaker import CircuitBreaker
from skugga.api.workers.job_queue import JobQueue, PendingJob
from skugga.api.workers.jobs import Answer, BlockTiles, DescriptorPlanJob, Failure, FrameJob, Job, Result, Snapshot
from skugga.api.workers.pool_counters import PoolCounters
from skugga.terrain.cache import Cache, Missing
from skugga.terrain.errors import BusyError, SkuggaError

MAX_JOB_STARTS = 2
"""Maximum number of times that a job is started, if its process dies while the job runs."""

log = logging.getLogger("skugga")


class PendingJobs:
    """Jobs that wait or run, and the requests that wait for them. Use it from one event loop.

    Requests for equal jobs share one job. Finished blocks and snapshots are cached, up to ``Settings.block_cache_bytes``.

    Parameters
    ----------
    settings
        The service's settings.
    plan_version_of
        Returns the present version of the plans that a job uses.
    has_ready_process
        Returns whether a render process is ready.
    can_expire
        Returns whether waiting jobs may expire now. They may not while processes start or prepare.
    before_enqueue
        Called before a job is queued. It raises ``SkuggaError`` if no process can run jobs.
    on_result
        Called with each job that a process has finished and its result.

    Attributes
    ----------
    queue : JobQueue
        The waiting and running jobs.
    may_start_event : asyncio.Event
        Set whenever a waiting job may start.
    counters : PoolCounters
        Counters for metrics.
    """

    def __init__(
        self,
        settings: Settings,
        plan_version_of: Callable[[Job], str],
        has_ready_process: Callable[[], bool],
        can_expire: Callable[[], bool],
        before_enqueue: Callable[[], None],
        on_result: Callable[[Job, Result], None],
    ) -> None:
        self._settings, self._plan_version_of = settings, plan_version_of
        self._has_ready_process, self._can_expire = has_ready_process, can_expire
        self._before_enqueue, self._on_result = before_enqueue, on_result
        self._picture_cache: Cache[BlockTiles | Snapshot] = Cache(
            "skugga.api.workers.finished", "process", settings.block_cache_bytes, lambda picture: picture.nbytes
        )
        self._pending: dict[Job, PendingJob] = {}
        self._circuit_breaker = CircuitBreaker()
        self._closed = False
        self.queue = JobQueue(settings.workers)
        self.may_start_event = asyncio.Event()
        self.counters = PoolCounters()

    @property
    def cached_bytes(self) -> int:
        """Bytes of the cached blocks and snapshots."""
        return self._picture_cache.nbytes

    def cached_picture(self, job: Job) -> BlockTiles | Snapshot | None:
        """Return the cached block or snapshot of a job, drawn with the present version of plans; ``None`` without one."""
        cached = self._picture_cache.get(job, self._plan_version_of(job))
        return None if isinstance(cached, Missing) else cached

    def stop_accepting(self) -> None:
        """Reject new jobs from now on, and do not retry jobs."""
        self._closed = True

    async def run(self, job: Job, client: str) -> Result:
        """Return the answer to a client's job, from the cache if possible. ``Pool.run`` describes it."""
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

    def start_next(self, now_s: float) -> PendingJob | None:
        """Start the job whose turn it is, and return it; ``None`` if no job may start."""
        pending = self.queue.start_next(now_s)
        if pending is not None:
            if pending.expiry_timer is not None:
                pending.expiry_timer.cancel()
            pending.plan_version = self._plan_version_of(pending.job)
        return pending

    def retry_or_finish(self, pending: PendingJob, outcome: Failure | SkuggaError) -> None:
        """Queue a job again whose process ended, if it was started fewer than ``MAX_JOB_STARTS`` times and a request waits.

        Otherwise answer its requests with ``outcome``.
        """
        if pending.start_count < MAX_JOB_STARTS and pending.clients and not self._closed:
            self.queue.discard(pending)
            self.queue.put(pending)
            self.may_start_event.set()
            self.counters.jobs_retried += 1
            if not pending.is_background:
                self._start_expiry_timer(pending)
            return
        self.finish(pending, outcome)
        self.record_crash(pending.job)

    def record_crash(self, job: Job) -> None:
        """Record that a job ended its process.

        If that opens a circuit of the circuit breaker, fail the waiting jobs that the circuit breaker rejects now.
        """
        self._circuit_breaker.record_failure(job)
        left_s = self._circuit_breaker.open_seconds_left(job)
        if left_s <= 0.0:
            return
        log.error("%s keeps failing: its circuit breaker is open for %.0f s", _job_title(job), left_s)
        for pending in list(self.queue.waiting.values()):
            if self._circuit_breaker.open_seconds_left(pending.job) > 0.0:
                self.finish(pending, _circuit_open_error(pending.job, left_s))

    def finish(self, pending: PendingJob, answer: Answer | SkuggaError, add_duration: bool = True) -> None:
        """Answer all requests that wait for a job, with a result or an error, and remove the job.

        ``add_duration`` says whether the queue learns the job's duration. It does not if the process made one-time preparations
        before the job.
        """
        if pending.started_s is not None and not isinstance(answer, SkuggaError | Failure):
            if add_duration:
                self.queue.add_duration(pending.job, asyncio.get_running_loop().time() - pending.started_s)
            self._circuit_breaker.record_success(pending.job)
        self._remove(pending)
        if pending.answer.done():
            return
        if isinstance(answer, SkuggaError):
            self.counters.jobs_failed += 1
            pending.answer.set_exception(answer)
        else:
            self.counters.jobs_answered += 1
            if isinstance(answer, BlockTiles | Snapshot):
                self._picture_cache.put(pending.job, answer.plan_version, value=answer)
            if not isinstance(answer, Failure):
                self._on_result(pending.job, answer)
            pending.answer.set_result(answer)

    def fail_waiting(self, error: SkuggaError) -> None:
        """Fail all waiting jobs."""
        self._fail_all(error, list(self.queue.waiting.values()))

    def fail_pending(self, error: SkuggaError) -> None:
        """Fail all waiting and running jobs."""
        self._fail_all(error, list(self._pending.values()))

    def _fail_all(self, error: SkuggaError, pending_jobs: list[PendingJob]) -> None:
        """Answer all requests for some jobs with an error."""
        for pending in pending_jobs:
            self.finish(pending, error)

    async def _finished_answer(self, pending: PendingJob, client: str) -> Answer:
        """Wait for the answer to a pending job on behalf of a client."""
        job = pending.job
        pending.clients[client] += 1
        try:
            return await asyncio.shield(pending.answer)
        finally:
            pending.clients[client] -= 1
            pending.clients += Counter()  # drops clients without waiting requests
            if not pending.clients and self.queue.waiting.get(job) is pending:
                self._remove(pending)
                pending.answer.cancel()
                self.counters.jobs_abandoned += 1

    def _enqueue(self, job: Job, client: str) -> PendingJob:
        """Queue a job of a client and return it. Raises ``SkuggaError`` if it is rejected."""
        if self._closed:
            raise BusyError("The service is shutting down.")
        self._before_enqueue()
        loop = asyncio.get_running_loop()
        left_s = self._circuit_breaker.open_seconds_left(job)
        if left_s > 0.0:
            self.counters.jobs_refused += 1
            raise _circuit_open_error(job, left_s)
        pending = PendingJob(job, loop.create_future(), loop.time(), is_background=isinstance(job, FrameJob))
        # Mark errors as retrieved, since no request may wait for them any more.
        pending.answer.add_done_callback(lambda answer: answer.cancelled() or answer.exception())
        if not pending.is_background:
            try:
                check_admission(self.queue, job, client, loop.time(), self._settings, self._has_ready_process())
            except RetryLaterError:
                self.counters.jobs_refused += 1
                raise
            self._start_expiry_timer(pending)
        self._pending[job] = pending
        self.queue.put(pending)
        self.may_start_event.set()
        return pending

    def _start_expiry_timer(self, pending: PendingJob) -> None:
        """Start the timer that fails a job after ``queue_timeout_s`` seconds in the queue."""
        pending.expiry_timer = asyncio.get_running_loop().call_later(self._settings.queue_timeout_s, self._expire, pending)

    def _expire(self, pending: PendingJob) -> None:
        """Fail a job that has waited too long in the queue. While jobs may not expire, it waits for another ``queue_timeout_s``."""
        if self.queue.waiting.get(pending.job) is not pending:
            return
        if not self._can_expire():
            self._start_expiry_timer(pending)
            return
        self.counters.jobs_expired += 1
        message = f"The service is busy: this picture waited longer than the limit of {self._settings.queue_timeout_s:g} s."
        wait_s = self.queue.wait_s(pending.job, pending.client, asyncio.get_running_loop().time())
        self.finish(pending, RetryLaterError(message, retry_after_s(wait_s)))

    def _remove(self, pending: PendingJob) -> None:
        """Remove a job that is answered or dropped, and let another waiting job start."""
        if pending.expiry_timer is not None:
            pending.expiry_timer.cancel()
        if self._pending.get(pending.job) is pending:
            del self._pending[pending.job]
        self.queue.discard(pending)
        self.may_start_event.set()  # a waiting job may start now


def _job_title(job: Job) -> str:
    """Return words for a job in a message, such as ``A block of level jacksboro``."""
    if isinstance(job, DescriptorPlanJob):
        return "The plan of this descriptor"
    settings_clause = " with these settings" if job.request.overrides.asked else ""
    return f"A {type(job).__name__.removesuffix('Job').lower()} of level {job.level.path.stem}{settings_clause}"


def _circuit_open_error(job: Job, open_s: float) -> CircuitOpenError:
    """Return the error for a job that a circuit breaker rejects.

    ``open_s`` is the time in seconds until jobs like it are accepted.
    """
    message = f"{_job_title(job)} took too long, or ended its render process, several times. Try again later."
    return CircuitOpenError(message, retry_after_s(open_s))
