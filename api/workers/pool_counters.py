"""Counters of a pool of render processes, for metrics."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class PoolCounters:
    """Counters of the pool since its start.

    Attributes
    ----------
    jobs_answered, jobs_failed : int
        Jobs that ended with an answer, and jobs that ended with an error.
    jobs_abandoned : int
        Jobs dropped because no request waited for them any more.
    processes_started : int
        Render processes that became ready.
    jobs_refused : int
        Jobs rejected by admission control or by the circuit breaker.
    jobs_expired : int
        Jobs that waited too long in the queue.
    jobs_timed_out : int
        Jobs that ran too long in a process.
    jobs_retried : int
        Jobs started again after their process died.
    """

    jobs_answered: int = 0
    jobs_failed: int = 0
    jobs_abandoned: int = 0
    processes_started: int = 0
    jobs_refused: int = 0
    jobs_expired: int = 0
    jobs_timed_out: int = 0
    jobs_retried: int = 0
