"""The queue of jobs for render processes: it orders jobs, predicts waits, and keeps a process free for short jobs."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from skugga.api.workers.expected_times import ExpectedTimes, kind_of_job
from skugga.api.workers.jobs import Answer, Job

BACKGROUND_PENALTY_S = 20.0
"""Queue penalty in seconds: a background job (a frame of a film) is ordered as if it had arrived this much later.

Requests that arrive within this time go first. Under a continuous load background jobs still make progress.
"""


@dataclass(eq=False)
class PendingJob:
    """A job that waits or runs.

    Attributes
    ----------
    job : Job
        The job.
    answer : asyncio.Future
        Receives the answer.
    arrived_s : float
        Time in seconds when the job arrived, by the event loop's clock.
    expiry_timer : asyncio.TimerHandle or None
        Timer that fails the job if it waits too long in the queue.
    started_s : float or None
        Time in seconds when the job was last started, by the event loop's clock; ``None`` before that.
    cost_s : float
        Expected duration in seconds.
    clients : Counter
        Number of requests that wait for the job, by client. The job counts as a job of the first client.
    start_count : int
        Number of times the job was started.
    plan_version : str
        Version of the plans (``PlanMeasurements.version_of``) at the job's last start.
    is_background : bool
        Whether the job is a part of longer work, such as a frame of a film, so that no request waits for it.
    """

    job: Job
    answer: asyncio.Future[Answer]
    arrived_s: float
    expiry_timer: asyncio.TimerHandle | None = None
    started_s: float | None = None
    cost_s: float = 0.0
    clients: Counter[str] = field(default_factory=Counter)
    start_count: int = 0
    plan_version: str = ""
    is_background: bool = False

    @property
    def client(self) -> str:
        """The client whose share of the processes the job uses: the first one that waits for it."""
        return next(iter(self.clients), "")

    @property
    def sort_key_s(self) -> float:
        """Sort key of the job among its client's jobs, in seconds. The job with the lowest key goes first."""
        return self.arrived_s + self.cost_s + (BACKGROUND_PENALTY_S if self.is_background else 0.0)


@dataclass
class JobQueue:
    """Waiting and running jobs, scheduled by their expected durations.

    Clients take turns by deficit round robin (Shreedhar, Varghese 1995) with an infinitesimal quantum. All waiting clients earn
    credit in seconds at the same rate. The first client whose credit reaches the expected duration of its next job goes next. Each
    client thus gets an equal share of the processes, however many jobs the other clients add.

    A client's jobs are ordered by arrival time plus expected duration. So short jobs overtake long ones that arrived a little
    earlier, and every job gets its turn. Background jobs have a penalty of ``BACKGROUND_PENALTY_S`` and do not count in admission
    control.

    If there are several processes, one of them is kept free for short jobs (``ExpectedTimes.is_short``). Other jobs, and all
    background jobs, share the remaining processes.

    Attributes
    ----------
    process_count : int
        Number of render processes.
    expected_times : ExpectedTimes
        Expected durations.
    waiting : dict
        Waiting jobs, by job.
    running : set
        Running jobs.
    credit_s : dict
        Unspent credit of each waiting client, in seconds. The client that had the last turn comes last.
    """

    process_count: int
    expected_times: ExpectedTimes = field(default_factory=ExpectedTimes)
    waiting: dict[Job, PendingJob] = field(default_factory=dict)
    running: set[PendingJob] = field(default_factory=set)
    credit_s: dict[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.waiting)

    @property
    def foreground_jobs(self) -> list[PendingJob]:
        """Waiting jobs, except background jobs."""
        return [pending_job for pending_job in self.waiting.values() if not pending_job.is_background]

    def jobs_of_client(self, client: str) -> list[PendingJob]:
        """Return the waiting jobs of a client (``PendingJob.client``), except background jobs."""
        return [pending_job for pending_job in self.foreground_jobs if pending_job.client == client]

    def put(self, pending: PendingJob) -> None:
        """Add a job to the waiting ones, and set its expected duration."""
        pending.cost_s = self.expected_times.expected_s(pending.job)
        self.waiting[pending.job] = pending

    def start_next(self, now_s: float) -> PendingJob | None:
        """Move the job whose turn it is from the waiting to the running ones, and return it; ``None`` if no job may start.

        ``now_s`` is the time in seconds, by the event loop's clock.
        """
        long_count = sum(not self._is_short(pending_job) for pending_job in self.running)
        may_be_long = long_count < max(self.process_count - 1, 1)
        pending = self._choose_next(
            [pending_job for pending_job in self.waiting.values() if may_be_long or self._is_short(pending_job)], now_s
        )
        if pending is None:
            return None
        del self.waiting[pending.job]
        pending.started_s, pending.start_count = now_s, pending.start_count + 1
        self.running.add(pending)
        return pending

    def discard(self, pending: PendingJob) -> None:
        """Remove a job from the waiting or the running ones."""
        if self.waiting.get(pending.job) is pending:
            del self.waiting[pending.job]
        self.running.discard(pending)

    def add_duration(self, job: Job, seconds: float) -> None:
        """Learn the measured duration of a job in seconds, and update the expected durations of waiting jobs of its kind."""
        self.expected_times.add_duration(job, seconds)
        kind = kind_of_job(job)
        for pending_job in self.waiting.values():
            if kind_of_job(pending_job.job) == kind:
                pending_job.cost_s = self.expected_times.expected_s(pending_job.job)

    def wait_s(self, job: Job, client: str, now_s: float) -> float:
        """Return the expected wait in seconds of a job that a client requests now.

        The job waits for the running jobs and for its client's jobs with a lower sort key. Meanwhile each other client uses up to
        as much time as this client.
        """
        cost_s = self.expected_times.expected_s(job)
        work_s: dict[str, float] = {client: 0.0}
        for pending_job in self.foreground_jobs:
            if pending_job.client != client or pending_job.sort_key_s <= now_s + cost_s:
                work_s[pending_job.client] = work_s.get(pending_job.client, 0.0) + pending_job.cost_s
        client_work_s = work_s.pop(client)
        other_clients_s = sum(min(other_work_s, client_work_s + cost_s) for other_work_s in work_s.values())
        running_left_s = sum(
            max(pending_job.cost_s - (now_s - (pending_job.started_s or now_s)), 0.0) for pending_job in self.running
        )
        return (client_work_s + other_clients_s + running_left_s) / self.process_count

    def _choose_next(self, candidates: Iterable[PendingJob], now_s: float) -> PendingJob | None:
        """Return the job of ``candidates`` whose turn it is; ``None`` without candidates. ``now_s`` is the event loop's time."""
        background: PendingJob | None = None
        first_jobs: dict[str, PendingJob] = {}
        for pending_job in candidates:
            if pending_job.is_background:
                background = pending_job if background is None or pending_job.sort_key_s < background.sort_key_s else background
            elif pending_job.client not in first_jobs or pending_job.sort_key_s < first_jobs[pending_job.client].sort_key_s:
                first_jobs[pending_job.client] = pending_job
        if background is not None and (background.sort_key_s < now_s or not first_jobs):
            return background
        return self._first_by_deficit(first_jobs) if first_jobs else None

    def _first_by_deficit(self, first_jobs: dict[str, PendingJob]) -> PendingJob:
        """Choose one of the clients' first jobs by deficit round robin, and update the credit of all clients.

        ``first_jobs`` has the job with the lowest sort key of each client.
        """
        ordered_clients = [client for client in self.credit_s if client in first_jobs]  # ordered by last turn
        deficits_s = {
            client: first_jobs[client].cost_s - self.credit_s.get(client, 0.0)
            for client in dict.fromkeys([*ordered_clients, *first_jobs])
        }
        chosen = min(deficits_s, key=lambda client: deficits_s[client])
        earned_now_s = max(deficits_s[chosen], 0.0)
        waiting_clients = {pending_job.client for pending_job in self.foreground_jobs}
        credit_s = {
            client: self.credit_s.get(client, 0.0)
            for client in dict.fromkeys([*self.credit_s, *deficits_s])
            if client in waiting_clients
        }
        for client in deficits_s:  # credit is capped at the cost of the next job
            credit_s[client] = min(credit_s[client] + earned_now_s, first_jobs[client].cost_s)
        credit_s[chosen] = credit_s.pop(chosen) - first_jobs[chosen].cost_s
        self.credit_s = credit_s
        return first_jobs[chosen]

    def _is_short(self, pending: PendingJob) -> bool:
        """Return whether a job may use the process that is kept free for short jobs."""
        return not pending.is_background and self.expected_times.is_short(pending.job)
