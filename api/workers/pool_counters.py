"""Counters of a pool of render processes, for metrics."""

from __future__ import annotations

from dataclasses import dataclass


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
        Jobs rejected by admission control or by the circuit breaker.
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
