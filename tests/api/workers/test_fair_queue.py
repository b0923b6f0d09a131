"""Many clients at one queue in simulated time: order of service, refusals, and expected waits."""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from skugga.api.errors import RetryLaterError
from skugga.api.request import ProductRequest
from skugga.api.settings import Settings
from skugga.api.workers.admission import check_admission, is_tile, retry_after_s
from skugga.api.workers.job_queue import JobQueue, PendingJob
from skugga.api.workers.jobs import Job, MapJob, PlanJob, SnapshotJob
from tests.api.workers.test_pool import LEVEL, block

SETTINGS = Settings(workers=1, queue_timeout_s=20.0)
SCREENFUL_TILES = SETTINGS.queue_length
"""Tiles of one screen of a map client. A client may always queue so many."""


def snapshot_job(number: int) -> SnapshotJob:
    """Return the job of a snapshot. Jobs with another number differ in their size."""
    return SnapshotJob(level=LEVEL, view="map", format="png", size=(640 + number, 480))


def make_pending_job(job: Job, client: str, arrived_s: float = 0.0) -> PendingJob:
    """Return a job that a client requested at the time ``arrived_s``."""
    return PendingJob(job, None, arrived_s, clients=Counter([client]))  # type: ignore[arg-type]


@dataclass
class Crowd:
    """Clients that send jobs to one process, some at a time.

    ``job_duration_s`` returns the duration of a job. Like map clients, a client sends its next job after each answer, and does not
    repeat a refused one.
    """

    job_duration_s: Callable[[Job], float]
    queue: JobQueue = field(default_factory=lambda: JobQueue(1))
    answered: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    expired: Counter[str] = field(default_factory=Counter)
    spent_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    waited_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def run(self, clients: dict[str, tuple[int, list[Job]]], end_s: float = 1e9) -> Crowd:
        """Simulate clients up to the time ``end_s``.

        ``clients`` has each client's number of simultaneous requests, and its jobs.
        """
        remaining_jobs = {client: list(jobs) for client, (_, jobs) in clients.items()}
        events: list[tuple[float, int, str, Any]] = []
        running: PendingJob | None = None
        event_number = 0

        def schedule(at_s: float, event_kind: str, event_target: Any) -> None:
            nonlocal event_number
            event_number += 1
            heapq.heappush(events, (at_s, event_number, event_kind, event_target))

        for client, (concurrency, _) in clients.items():
            for _ in range(concurrency):
                schedule(0.0, "ask", client)
        while events and events[0][0] < end_s:
            now_s, _, event_kind, event_target = heapq.heappop(events)
            if event_kind == "ask" and remaining_jobs[event_target]:
                job = remaining_jobs[event_target].pop(0)
                try:
                    check_admission(self.queue, job, event_target, now_s, SETTINGS)
                    pending_job = make_pending_job(job, event_target, now_s)
                    self.queue.put(pending_job)
                    schedule(now_s + SETTINGS.queue_timeout_s, "expire", pending_job)
                except RetryLaterError:
                    self.refused[event_target] += 1
                    schedule(now_s + 1.0, "ask", event_target)
            elif event_kind == "expire" and self.queue.waiting.get(event_target.job) is event_target:
                self.queue.discard(event_target)
                self.expired[event_target.client] += 1
                schedule(now_s, "ask", event_target.client)
            elif event_kind == "done":
                running = None
                self.queue.discard(event_target)
                self.queue.add_duration(event_target.job, self.job_duration_s(event_target.job))
                self.answered[event_target.client] += 1
                self.spent_s[event_target.client] += self.job_duration_s(event_target.job)
                schedule(now_s, "ask", event_target.client)
            if running is None and (running := self.queue.start_next(now_s)) is not None:
                self.waited_s[running.client].append(now_s - running.arrived_s)
                schedule(now_s + self.job_duration_s(running.job), "done", running)
        return self


def blocks_of(client: int, count: int = 115) -> list[Job]:
    """Return blocks of the level of one client, which has a number. 115 are the tiles of two zooms of a map."""
    level = LEVEL.model_copy(update={"path": LEVEL.path.with_name(f"{client}.yaml")})
    return [block(number).model_copy(update={"level": level}) for number in range(count)]


def test_one_client_on_a_cold_level_is_never_refused():
    """The client sends 115 tiles, eight at a time. First tiles are slow on a cold level; all tiles were slow on a wooded
    one.
    """
    for seconds in (lambda job: 1.5 if job.block_x < 8 else 0.2, lambda job: 2.0):
        crowd = Crowd(seconds).run({"one": (8, blocks_of(0))})
        assert crowd.answered["one"] == 115 and not crowd.refused and not crowd.expired


def test_a_screenful_of_tiles_is_admitted():
    crowd = Crowd(lambda job: 0.3).run({"one": (SCREENFUL_TILES, blocks_of(0, SCREENFUL_TILES))})
    assert crowd.answered["one"] == SCREENFUL_TILES and not crowd.refused


def test_eight_clients_get_equal_shares():
    crowd = Crowd(lambda job: 0.2).run({f"client {n}": (8, blocks_of(n)) for n in range(8)}, end_s=60.0)
    assert not crowd.refused and not crowd.expired
    assert max(crowd.spent_s.values()) - min(crowd.spent_s.values()) < 1.0, crowd.spent_s


def test_a_client_with_many_jobs_does_not_slow_others():
    """It requests 300 pictures at a time. Each takes ten times as long as a tile."""
    jobs = {f"normal {n}": (6, blocks_of(n, 1000)) for n in range(7)}
    greedy_jobs: list[Job] = [greedy_job for n in range(10_000) for greedy_job in (snapshot_job(n), block(n))]
    job_duration_s = lambda job: 0.1 if job.level != LEVEL else 1.0  # noqa: E731
    crowd = Crowd(job_duration_s).run({**jobs, "greedy": (300, greedy_jobs)}, end_s=40.0)
    assert not [name for name in jobs if crowd.refused[name] or crowd.expired[name]]
    assert crowd.refused["greedy"] > 0, "requests beyond the client's share are refused"
    normal_s = [crowd.spent_s[name] for name in jobs]
    assert min(normal_s) > 0.9 * 40.0 / 8, crowd.spent_s
    assert crowd.spent_s["greedy"] <= 40.0 / 8 + 1.0, "a client is ahead of its share by one picture at most"
    waited_s = sorted(wait for name in jobs for wait in crowd.waited_s[name])
    assert waited_s[-1] < 7.0, "six tiles of 0.1 s at an eighth of the time take 4.8 s, and a greedy picture 1 s"


def test_the_queued_work_of_a_client_is_bounded_in_seconds():
    queue = JobQueue(1)
    for n in range(100):
        queue.add_duration(snapshot_job(n), 0.01)
    for n in range(100):
        check_admission(queue, snapshot_job(n), "one", 0.0, SETTINGS)
        queue.put(make_pending_job(snapshot_job(n), "one"))
    heavy_job = PlanJob(level=LEVEL, view="map")
    queue.add_duration(heavy_job, 30.0)
    with pytest.raises(RetryLaterError, match="this one would add 30.0 s") as error_info:
        check_admission(queue, heavy_job, "one", 0.0, SETTINGS)
    assert error_info.value.retry_after_s == 1
    check_admission(queue, heavy_job, "other", 0.0, SETTINGS)


def test_a_screenful_is_admitted_however_long_it_takes():
    queue = JobQueue(1)
    queue.add_duration(block(0), 5.0)
    for n in range(SCREENFUL_TILES):
        check_admission(queue, block(n), "one", 0.0, SETTINGS)
        queue.put(make_pending_job(block(n), "one"))
    with pytest.raises(RetryLaterError) as error_info:
        check_admission(queue, block(SCREENFUL_TILES), "one", 0.0, SETTINGS)
    assert error_info.value.retry_after_s == 120
    check_admission(queue, block(SCREENFUL_TILES), "other", 0.0, SETTINGS)


@pytest.mark.parametrize(("side", "is_small"), [(256, True), (1024, True), (1025, False)])
def test_small_maps_count_as_tiles(side: int, is_small: bool):
    job = MapJob(level=LEVEL, bounds=(0.0, 0.0, 1.0, 1.0), crs="EPSG:4326", size=(side, 256), format="png")
    assert is_tile(job) == is_small
    assert is_tile(block(0)) and not is_tile(snapshot_job(0))


def test_the_expected_wait_depends_on_the_client_s_own_queue():
    queue = JobQueue(1)
    queue.add_duration(block(0), 1.0)
    for n in range(10):
        queue.put(make_pending_job(block(n), "greedy"))
    assert queue.wait_s(block(99), "greedy", 0.0) == pytest.approx(10.0)
    assert queue.wait_s(block(99), "new", 0.0) == pytest.approx(1.0), (
        "the new client waits for one equal share of the greedy client's work"
    )


def test_the_expected_wait_uses_the_times_of_the_job_s_kind():
    queue = JobQueue(1)
    for n in range(2):
        queue.put(make_pending_job(block(n), "one"))
    assert queue.wait_s(block(9), "one", 0.0) == pytest.approx(1.0), "two jobs of the initial estimate of 0.5 s"
    queue.add_duration(block(0), 4.0)
    assert queue.wait_s(block(9), "one", 0.0) == pytest.approx(8.0)


def test_layers_have_separate_expected_times():
    queue = JobQueue(1)
    mask = block(0).model_copy(update={"request": ProductRequest(product="mask"), "format": "tif", "tiles": 2})
    queue.add_duration(block(0), 0.1)
    assert queue.expected_times.expected_s(mask) == pytest.approx(0.1), (
        "without own measurements the time is that of the job's kind"
    )
    queue.add_duration(mask, 3.0)
    assert (queue.expected_times.expected_s(mask), queue.expected_times.expected_s(block(0))) == pytest.approx((3.0, 0.1))


def test_retry_after_is_whole_and_at_most_two_minutes():
    assert [retry_after_s(wait_s) for wait_s in (0.0, 0.2, 7.1, 1e9)] == [1, 1, 8, 120]
