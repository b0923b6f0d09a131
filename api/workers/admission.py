"""Admission control: which jobs enter the queue, and when a refused client may try again.

Each client has a share of its own. A screenful of its tiles always enters the queue: map clients do not retry, so a refused
tile leaves a hole in a map. Further jobs of a client are bounded in seconds of expected work.
"""

from __future__ import annotations

import math

from skugga.api.errors import RetryLaterError
from skugga.api.settings import Settings
from skugga.api.workers.job_queue import JobQueue
from skugga.api.workers.jobs import BlockJob, Job, MapJob

MAX_TILE_SIDE_PX = 1024
"""A map of at most this size counts as a tile: clients of WMS tile maps of any extent."""

MAX_RETRY_AFTER_S = 120
"""Upper bound of ``Retry-After``."""


def is_tile(job: Job) -> bool:
    """Return whether refusing the job would leave a hole in a map of many pictures."""
    if isinstance(job, MapJob):
        return max(job.size) <= MAX_TILE_SIDE_PX
    return isinstance(job, BlockJob)


def check_admission(queue: JobQueue, job: Job, client: str, now_s: float, settings: Settings, is_ready: bool = True) -> None:
    """Raise ``RetryLaterError`` if the job exceeds its client's share of the queue.

    The expected wait counts only once the service ``is_ready``; before that it cannot be estimated.
    """
    client_jobs = queue.jobs_of_client(client)
    if not client_jobs or (is_tile(job) and sum(is_tile(pending_job.job) for pending_job in client_jobs) < settings.queue_length):
        return
    cost_s, work_s = queue.expected.of(job), sum(pending_job.cost_s for pending_job in client_jobs)
    if work_s + cost_s > settings.queue_work_s:
        message = (
            f"The service is busy: {len(client_jobs)} pictures of this client are queued, expected to take {work_s:.1f} s, "
            f"and this one would add {cost_s:.1f} s."
        )
        raise RetryLaterError(message, retry_after_s(queue.wait_s(job, client, now_s)))
    wait_s = queue.wait_s(job, client, now_s)
    if is_ready and wait_s > settings.queue_timeout_s:
        raise RetryLaterError(f"The service is busy: the expected wait is {wait_s:.1f} s.", retry_after_s(wait_s))


def retry_after_s(seconds: float) -> int:
    """Return ``Retry-After`` in whole seconds."""
    return min(max(math.ceil(seconds), 1), MAX_RETRY_AFTER_S)
