"""Admission control: decide which jobs enter the queue, and when a client with a refused job may try again.

The limits apply to each client separately. A screenful of tiles (``queue_length``) always enters the queue: map clients do not
retry, so a refused tile leaves a hole in a map. Other jobs of a client enter while its jobs in the queue need less than
``queue_work_s`` seconds of expected work.
"""

from __future__ import annotations

import math

from skugga.api.errors import RetryLaterError
from skugga.api.settings import Settings
from skugga.api.workers.job_queue import JobQueue
from skugga.api.workers.jobs import BlockJob, Job, MapJob

MAX_TILE_SIDE_PX = 1024
"""Longest side in pixels of a map that counts as a tile.

Clients of WMS request maps of this size side by side, like tiles."""

MAX_RETRY_AFTER_S = 120
"""Upper bound of ``Retry-After`` in seconds."""


def is_tile(job: Job) -> bool:
    """Return whether a job draws a part of a client's map: a block or a small map. Its refusal would leave a hole there."""
    if isinstance(job, MapJob):
        return max(job.size) <= MAX_TILE_SIDE_PX
    return isinstance(job, BlockJob)


def check_admission(queue: JobQueue, job: Job, client: str, now_s: float, settings: Settings, is_ready: bool = True) -> None:
    """Raise ``RetryLaterError`` if a job must not enter the queue.

    It may enter if its client has no other job there, or if it is one of a screenful of tiles (``is_tile``). Otherwise the client's
    jobs in the queue must not need more than ``queue_work_s`` seconds, and the expected wait must not exceed ``queue_timeout_s``.

    Parameters
    ----------
    queue, job, client
        The queue, the new job, and the client that requests it.
    now_s
        The time in seconds, by the event loop's clock.
    settings
        The service's settings, with the limits.
    is_ready
        Whether a render process is ready. Before that the expected wait is unknown and not limited.
    """
    client_jobs = queue.jobs_of_client(client)
    if not client_jobs or (is_tile(job) and sum(is_tile(pending_job.job) for pending_job in client_jobs) < settings.queue_length):
        return
    cost_s, work_s = queue.expected_times.expected_s(job), sum(pending_job.cost_s for pending_job in client_jobs)
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
    """Return a time as whole seconds for ``Retry-After``: rounded up, from 1 to ``MAX_RETRY_AFTER_S``."""
    return min(max(math.ceil(seconds), 1), MAX_RETRY_AFTER_S)
