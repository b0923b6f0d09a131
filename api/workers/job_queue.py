"""Jobs that wait for a render process: which is next, which must leave a process to others, and how long all of it may take."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from skugga.api.workers.expected_times import ExpectedTimes, kind_of_job
from skugga.api.workers.jobs import Answer, Job

BEHIND_S = 20.0
"""By how much later than it did a background job is taken to have come: whoever asks for a picture meanwhile goes first. Under a
load that does not end it still has its turn.
"""


@dataclass(eq=False)
class PendingJob:
    """A job that waits or runs.

    Attributes
    ----------
    came_s, began_s : float
        When it came and began, by the event loop's clock.
    cost_s : float
        Seconds that it is expected to take.
    expires
        Ends its waiting.
    clients : Counter
        How many requests of each client wait for it. The first client pays for it.
    begun : int
        How often it was begun.
    plan_version : str
        Version of the plans that it began by.
    is_background : bool
        Whether it is part of longer work, and nobody waits for this part.
    """

    job: Job
    answer: asyncio.Future[Answer]
    came_s: float
    expires: asyncio.TimerHandle | None = None
    began_s: float | None = None
    cost_s: float = 0.0
    clients: Counter[str] = field(default_factory=Counter)
    begun: int = 0
    plan_version: str = ""
    is_background: bool = False

    @property
    def client(self) -> str:
        """The client that pays for it."""
        return next(iter(self.clients), "")

    @property
    def turn_s(self) -> float:
        """Where it stands among jobs of its client."""
        return self.came_s + self.cost_s + (BEHIND_S if self.is_background else 0.0)


@dataclass
class JobQueue:
    """Jobs that wait, and those that run, under what is known of how long they take.

    Clients take turns by deficit round robin (Shreedhar, Varghese 1995), in expected seconds, with a quantum that goes to nothing:
    all clients that wait earn the same, and the first one that has earned what its next job costs has the next turn. So a client
    gets its share of the processes, however much others ask for.

    Of one client the job is next that came first, as if each had come later by as long as it will take: light ones pass heavy ones
    that came a little before them, and nothing waits for ever. Background jobs have come ``BEHIND_S`` later, and keep nobody out.
    Jobs that are not known to be light, and background jobs, run on all processes but one, where there are several: one is left to
    the others.
    """

    processes: int
    expected: ExpectedTimes = field(default_factory=ExpectedTimes)
    waiting: dict[Job, PendingJob] = field(default_factory=dict)
    running: set[PendingJob] = field(default_factory=set)
    earned_s: dict[str, float] = field(default_factory=dict)
    """What each client that waits has earned and not spent; the one that had its turn last is the last one."""

    def __len__(self) -> int:
        return len(self.waiting)

    @property
    def pictures(self) -> list[PendingJob]:
        """What waits and is no background job."""
        return [each for each in self.waiting.values() if not each.is_background]

    def of_client(self, client: str) -> list[PendingJob]:
        """The pictures that wait and that a client pays for."""
        return [each for each in self.pictures if each.client == client]

    def put(self, pending: PendingJob) -> None:
        """Let a job wait."""
        pending.cost_s = self.expected.of(pending.job)
        self.waiting[pending.job] = pending

    def take(self, now_s: float) -> PendingJob | None:
        """The next job, which runs from now on; ``None`` where none may."""
        heavy = sum(not self._is_light(each) for each in self.running)
        may_be_heavy = heavy < max(self.processes - 1, 1)
        pending = self._next([each for each in self.waiting.values() if may_be_heavy or self._is_light(each)], now_s)
        if pending is None:
            return None
        del self.waiting[pending.job]
        pending.began_s, pending.begun = now_s, pending.begun + 1
        self.running.add(pending)
        return pending

    def discard(self, pending: PendingJob) -> None:
        """Forget a job, whether it waits or runs."""
        if self.waiting.get(pending.job) is pending:
            del self.waiting[pending.job]
        self.running.discard(pending)

    def learn(self, job: Job, seconds: float) -> None:
        """Note that a job took so long, and expect as much of those of its kind that wait."""
        self.expected.learn(job, seconds)
        kind = kind_of_job(job)
        for each in self.waiting.values():
            if kind_of_job(each.job) == kind:
                each.cost_s = self.expected.of(each.job)

    def wait_s(self, job: Job, client: str, now_s: float) -> float:
        """How long a job of a client that comes now is expected to wait for its turn: until its own jobs before it are done, and
        until each other client has had as much.
        """
        cost_s = self.expected.of(job)
        work_s: dict[str, float] = {client: 0.0}
        for each in self.pictures:
            if each.client != client or each.turn_s <= now_s + cost_s:
                work_s[each.client] = work_s.get(each.client, 0.0) + each.cost_s
        own_s = work_s.pop(client)
        others_s = sum(min(each_s, own_s + cost_s) for each_s in work_s.values())
        left_s = sum(max(each.cost_s - (now_s - (each.began_s or now_s)), 0.0) for each in self.running)
        return (own_s + others_s + left_s) / self.processes

    def _next(self, candidates: Iterable[PendingJob], now_s: float) -> PendingJob | None:
        background: PendingJob | None = None
        firsts: dict[str, PendingJob] = {}
        for each in candidates:
            if each.is_background:
                background = each if background is None or each.turn_s < background.turn_s else background
            elif each.client not in firsts or each.turn_s < firsts[each.client].turn_s:
                firsts[each.client] = each
        if background is not None and (background.turn_s < now_s or not firsts):
            return background
        return self._first_by_deficit(firsts) if firsts else None

    def _first_by_deficit(self, firsts: dict[str, PendingJob]) -> PendingJob:
        """Whose job is next of those of several clients."""
        known = [client for client in self.earned_s if client in firsts]  # in the order of their last turns
        wanting = {client: firsts[client].cost_s - self.earned_s.get(client, 0.0) for client in dict.fromkeys([*known, *firsts])}
        chosen = min(wanting, key=lambda client: wanting[client])
        earning_s = max(wanting[chosen], 0.0)
        waiting = {each.client for each in self.pictures}
        earned_s = {
            client: self.earned_s.get(client, 0.0) for client in dict.fromkeys([*self.earned_s, *wanting]) if client in waiting
        }
        for client in wanting:  # more than the next job costs is not hoarded
            earned_s[client] = min(earned_s[client] + earning_s, firsts[client].cost_s)
        earned_s[chosen] = earned_s.pop(chosen) - firsts[chosen].cost_s
        self.earned_s = earned_s
        return firsts[chosen]

    def _is_light(self, pending: PendingJob) -> bool:
        return not pending.is_background and self.expected.is_light(pending.job)
