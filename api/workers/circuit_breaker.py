"""A circuit breaker for each kind of job.

After several failures in a row the circuit of a kind opens. Jobs of the kind are then rejected for a while. Otherwise they would
end one render process after another.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

from skugga.api.workers.expected_times import kind_of_job
from skugga.api.workers.jobs import BlockJob, DescriptorJob, DescriptorPlanJob, Job, PlanJob
from skugga.terrain.cache import MIB, Cache, Missing

FAILURE_THRESHOLD = 2
"""Number of failures in a row after which a circuit opens."""

INITIAL_OPEN_S, MAX_OPEN_S = 30.0, 600.0
"""Seconds that a circuit stays open: the first time, and at most. The time doubles with each further failure."""


@dataclass(frozen=True)
class _CircuitRecord:
    """The state of a circuit.

    Attributes
    ----------
    failures : int
        Number of failures in a row.
    open_until_s : float
        Time until which the circuit is open, seconds of the breaker's clock.
    next_open_s : float
        Seconds for which the circuit opens next time.
    """

    failures: int = 0
    open_until_s: float = 0.0
    next_open_s: float = INITIAL_OPEN_S


class CircuitBreaker:
    """Circuit breakers of all kinds of jobs.

    Failures affect jobs of the same kind: of the same type and level, and with the same shadow settings (``kind_of_job``).
    Failures of blocks, plans and descriptors with the level's own shadow settings also open the circuit of the level. All jobs of
    the level are then refused.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._records: Cache[_CircuitRecord] = Cache("skugga.api.workers.circuit_breaker", "process", MIB, lambda _: 512)

    def open_seconds_left(self, job: Job) -> float:
        """Return the seconds until jobs like ``job`` are accepted again; 0 if its circuits are closed."""
        return max(max((self._record(key).open_until_s - self._clock() for key in _circuit_keys(job)), default=0.0), 0.0)

    def record_failure(self, job: Job) -> None:
        """Record that a job timed out or ended its process. Its circuits may open."""
        for key in _affected_circuit_keys(job):
            record = self._record(key)
            record = replace(record, failures=record.failures + 1)
            if record.failures >= FAILURE_THRESHOLD:
                # After the pause a single further failure opens the circuit again.
                record = _CircuitRecord(
                    FAILURE_THRESHOLD - 1, self._clock() + record.next_open_s, min(record.next_open_s * 2.0, MAX_OPEN_S)
                )
            self._records.put(key, value=record)

    def record_success(self, job: Job) -> None:
        """Record that a job succeeded. Its circuits forget earlier failures."""
        for key in _affected_circuit_keys(job):
            self._records.drop(key)

    def _record(self, key: Hashable) -> _CircuitRecord:
        """Return the state of the circuit with a key; a circuit without a record is closed."""
        record = self._records.get(key)
        return _CircuitRecord() if isinstance(record, Missing) else record


def _circuit_keys(job: Job) -> list[Hashable]:
    """Return the keys of the circuits that can reject a job: that of its kind, and that of its level."""
    keys = [kind_of_job(job)]
    return keys if isinstance(job, DescriptorPlanJob) else [*keys, ("level", str(job.level.path), job.level.version)]


def _affected_circuit_keys(job: Job) -> list[Hashable]:
    """Return the keys of the circuits that record the outcome of a job: that of its kind, and for some jobs that of its level.

    These jobs are blocks, plans and descriptors whose request has no shadow settings.
    """
    is_plain = isinstance(job, BlockJob | PlanJob | DescriptorJob) and not job.request.overrides.asked
    return _circuit_keys(job) if is_plain else _circuit_keys(job)[:1]
