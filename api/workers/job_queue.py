"""Jobs that wait for a render process: which is next, which must leave a process to others, and how long all of it may take."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, field

from api.workers.expected_times import ExpectedTimes
from api.workers.jobs import Answer, Job

STANDING_S = 2.0
"""Jobs that come at once are worked off sooner; where some have waited for as long without a break, more come than can be done."""

LOADED_WAIT_S = 0.5
"""How long a job may wait then, or twice as long as it takes itself if that is more: those that are let in are done soon."""


BEHIND_S = 20.0
"""By how much later than it did what stands back is taken to have come: whoever asks for a picture meanwhile goes first. Under a
load that does not end it still has its turn.
"""


@dataclass(eq=False)
class PendingJob:
    """A job on its way: when it came and began (the event loop's clock), how many wait for it, and how often it was begun.

    ``expires`` ends its waiting; ``plan_version`` is that of the plans that it began by. What ``stands_back`` is part of longer
    work, of which nobody waits for this part.
    """

    job: Job
    answer: asyncio.Future[Answer]
    came_s: float
    expires: asyncio.TimerHandle | None = None
    began_s: float | None = None
    waiting: int = 0
    begun: int = 0
    plan_version: str = ""
    stands_back: bool = False


@dataclass
class JobQueue:
    """Jobs that wait, and those that run, under what is known of how long they take.

    The next one is whoever came first, as if each had come later by as long as it will take: light ones pass heavy ones that came
    a little before them, and nothing waits for ever. What stands back has come ``BEHIND_S`` later, and keeps nobody out: pictures
    are refused or let in as if it did not wait. Jobs that are not known to be light, and those that stand back, run on all
    processes but one, where there are several: one is left to the others.
    """

    processes: int
    expected: ExpectedTimes = field(default_factory=ExpectedTimes)
    waiting: dict[Job, PendingJob] = field(default_factory=dict)
    running: set[PendingJob] = field(default_factory=set)
    standing_since_s: float = 0.0

    def __len__(self) -> int:
        return len(self.waiting)

    @property
    def asked_for(self) -> list[PendingJob]:
        """What waits and does not stand back."""
        return [each for each in self.waiting.values() if not each.stands_back]

    def put(self, pending: PendingJob) -> None:
        """Let a job wait."""
        if not pending.stands_back and not self.asked_for:
            self.standing_since_s = pending.came_s
        self.waiting[pending.job] = pending

    def take(self, now_s: float) -> PendingJob | None:
        """The next job, which runs from now on; ``None`` where none may."""
        heavy = sum(not self._is_light(each) for each in self.running)
        may_be_heavy = heavy < max(self.processes - 1, 1)
        candidates = [each for each in self.waiting.values() if may_be_heavy or self._is_light(each)]
        if not candidates:
            return None
        pending = min(candidates, key=self._turn)
        del self.waiting[pending.job]
        pending.began_s, pending.begun = now_s, pending.begun + 1
        self.running.add(pending)
        return pending

    def discard(self, pending: PendingJob) -> None:
        """Forget a job, whether it waits or runs."""
        if self.waiting.get(pending.job) is pending:
            del self.waiting[pending.job]
        self.running.discard(pending)

    def wait_s(self, job: Job, now_s: float) -> float:
        """How long a job that comes now is expected to wait for its turn."""
        turn = now_s + self.expected.of(job)
        before = self._seconds(each for each in self.waiting.values() if self._turn(each) <= turn)
        left = sum(max(self.expected.of(each.job) - (now_s - (each.began_s or now_s)), 0.0) for each in self.running)
        return (before + left) / self.processes

    def longest_wait_s(self, job: Job, now_s: float, otherwise_s: float) -> float:
        """The longest that a job that comes now should have to wait for its turn: ``otherwise_s`` while the load can be borne."""
        if not self.asked_for or now_s - self.standing_since_s < STANDING_S:
            return otherwise_s
        return min(max(LOADED_WAIT_S, 2.0 * self.expected.of(job)), otherwise_s)

    def drained_s(self) -> float:
        """How long all that waits and does not stand back is expected to take."""
        return self._seconds(self.asked_for) / self.processes

    def _seconds(self, pending: Iterable[PendingJob]) -> float:
        return sum(self.expected.of(each.job) for each in pending)

    def _is_light(self, pending: PendingJob) -> bool:
        return not pending.stands_back and self.expected.is_light(pending.job)

    def _turn(self, pending: PendingJob) -> float:
        return pending.came_s + self.expected.of(pending.job) + (BEHIND_S if pending.stands_back else 0.0)
