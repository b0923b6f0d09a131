"""Admission control: which job is let into the queue, and when a client that is refused is told to come back.

Each client has a share of its own. A screenful of its tiles is let in whatever is before it: a tile that is refused is a hole in a
map, since map clients do not ask again. What it asks for beyond that is bounded in seconds of expected work.
"""

from __future__ import annotations

import math

from skugga.api.errors import LaterError
from skugga.api.settings import Settings
from skugga.api.workers.job_queue import JobQueue
from skugga.api.workers.jobs import BlockJob, Job, MapJob

TILE_SIDE_PX = 1024
"""A map that is no larger is a tile of clients that tile maps of any extent (WMS)."""

LONGEST_RETRY_S = 120
"""The latest that a refused client is told to come back."""


def is_tile(job: Job) -> bool:
    """Whether a map of many pictures has a hole where this one is refused."""
    if isinstance(job, MapJob):
        return max(job.size) <= TILE_SIDE_PX
    return isinstance(job, BlockJob)


def check_admission(queue: JobQueue, job: Job, client: str, now_s: float, settings: Settings, is_ready: bool = True) -> None:
    """Raise ``LaterError`` where a job of a client is one too many. Before a service ``is_ready`` no wait can be expected."""
    own = queue.of_client(client)
    if not own or (is_tile(job) and sum(is_tile(each.job) for each in own) < settings.queue_length):
        return
    cost_s, work_s = queue.expected.of(job), sum(each.cost_s for each in own)
    if work_s + cost_s > settings.queue_work_s:
        message = (
            f"The service is busy: {len(own)} of this client's pictures wait, which are expected to take {work_s:.1f} s, "
            f"and this one would take {cost_s:.1f} s."
        )
        raise LaterError(message, retry_after_s(queue.wait_s(job, client, now_s)))
    wait_s = queue.wait_s(job, client, now_s)
    if is_ready and wait_s > settings.queue_timeout_s:
        raise LaterError(f"The service is busy: the wait is expected to be {wait_s:.1f} s.", retry_after_s(wait_s))


def retry_after_s(seconds: float) -> int:
    """When to come back, in whole seconds."""
    return min(max(math.ceil(seconds), 1), LONGEST_RETRY_S)
