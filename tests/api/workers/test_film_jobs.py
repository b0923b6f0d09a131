"""Frames of films as jobs: lower priority than pictures, retries of lost frames, and plans handed from frame to frame
across workers.
"""

from __future__ import annotations

import asyncio
import functools
import os
import pickle
import signal
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skugga.api.errors import RetryLaterError, WorkerCrashError
from skugga.api.request import PictureRequest
from skugga.api.workers import film_jobs
from skugga.api.workers.expected_times import ExpectedTimes
from skugga.api.workers.job_queue import BACKGROUND_PENALTY_S, JobQueue, PendingJob
from skugga.api.workers.jobs import FilmPicture, FilmPlanState, FrameJob
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.pool import Pool
from skugga.selector.film import film_frames, frame_moments
from skugga.selector.film_request import FilmRequest, FilmSpan
from skugga.selector.replanning import Replanner
from skugga.selector.select import select
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
from tests.api.conftest import write_level
from tests.api.workers import fake_workers
from tests.api.workers.test_pool import LEVEL, TIMEOUT_S, block, plan_job, run_with_pool, wait_until

SPAN = FilmSpan(10, 60.0)


def frame_job(number: int = 0, previous_plans: FilmPlanState | None = None) -> FrameJob:
    """Return the job of a frame of a film."""
    return FrameJob(level=LEVEL, span=SPAN, size=(96, 64), frame_number=number, previous_plan_state=previous_plans)


def make_pending_job(job: Any, arrived_s: float) -> PendingJob:
    """Return a job that arrived at the time ``arrived_s``; frames of films run in the background."""
    return PendingJob(job, None, arrived_s, is_background=isinstance(job, FrameJob))  # type: ignore[arg-type]


def test_pictures_go_before_earlier_frames():
    queue = JobQueue(1, ExpectedTimes())
    first, tile, plan = (
        make_pending_job(frame_job(), 0.0),
        make_pending_job(block(1), 1.0),
        make_pending_job(plan_job("map"), BACKGROUND_PENALTY_S - 1.0),
    )
    for job in (first, tile, plan):
        queue.put(job)
    taken_jobs = []
    for _ in range(3):
        taken_jobs.append(queue.start_next(20.0))
        queue.discard(taken_jobs[-1])  # type: ignore[arg-type]
    assert taken_jobs == [tile, plan, first]


def test_a_frame_is_not_starved_by_a_steady_load():
    queue = JobQueue(1, ExpectedTimes())
    first, late_job = make_pending_job(frame_job(), 0.0), make_pending_job(block(1), BACKGROUND_PENALTY_S + 30.0)
    queue.put(first)
    queue.put(late_job)
    assert queue.start_next(BACKGROUND_PENALTY_S + 30.0) is first


def test_frames_leave_one_process_for_pictures():
    queue = JobQueue(3, ExpectedTimes())
    queue.expected_times.add_duration(frame_job(), 0.001)
    for number in range(3):
        queue.put(make_pending_job(frame_job(number), 0.0))
    assert [queue.start_next(0.0) is not None for _ in range(3)] == [True, True, False]
    queue.expected_times.add_duration(block(0), 0.1)
    tile = make_pending_job(block(1), 1.0)
    queue.put(tile)
    assert queue.start_next(1.0) is tile


def test_waiting_frames_do_not_count_as_queued_pictures():
    queue = JobQueue(1, ExpectedTimes())
    queue.put(make_pending_job(frame_job(), 0.0))
    assert (len(queue), len(queue.foreground_jobs)) == (1, 0)
    assert queue.wait_s(block(1), "", 5.0) == 0.0


class FilmGate:
    """Gate that holds the jobs of a process. ``orders`` are pairs of frame number and order."""

    def __init__(self, *commands: tuple[int, str]) -> None:
        spawn = get_context("spawn")
        self._job_started, self._may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
        self.target = functools.partial(
            fake_workers.filming, job_started=self._job_started, may_finish=self._may_finish, commands=commands
        )

    async def job_started(self) -> None:
        """Wait until the render process has started another job."""
        assert await asyncio.to_thread(self._job_started.acquire, True, TIMEOUT_S)

    def open(self, times: int = 1) -> None:
        """Let a number of jobs finish."""
        for _ in range(times):
            self._may_finish.release()


def test_pictures_overtake_frames_and_full_queue_takes_frames():
    gate = FilmGate()

    async def scenario(pool: Pool) -> None:
        finished: list[str] = []

        async def run_and_record(name: str, job: Any) -> None:
            await pool.run(job)
            finished.append(name)

        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(run_and_record("running", block(0)))
            await gate.job_started()
            tasks.create_task(run_and_record("frame", frame_job(0)))
            tasks.create_task(run_and_record("frame", frame_job(1)))
            await wait_until(lambda: pool.queued_count == 2)
            tasks.create_task(run_and_record("tile", block(1)))
            await wait_until(lambda: pool.queued_count == 3)
            with pytest.raises(RetryLaterError, match="1 pictures of this client are queued"):
                await pool.run(block(2))
            gate.open(4)
        assert finished == ["running", "tile", "frame", "frame"]
        assert pool.counters.jobs_refused == 1

    run_with_pool(scenario, gate.target, queue_length=1, queue_work_s=0.1)


def test_waiting_frames_do_not_time_out():
    gate = FilmGate()

    async def scenario(pool: Pool) -> None:
        running = asyncio.create_task(pool.run(block(0)))
        await gate.job_started()
        waiting = asyncio.create_task(pool.run(frame_job()))
        await wait_until(lambda: pool.queued_count == 1)
        with pytest.raises(RetryLaterError, match="waited longer than the limit of"):
            await pool.run(block(1))  # came later, and times out
        assert not waiting.done()
        gate.open(2)
        await running
        assert isinstance(await waiting, FilmPicture)

    run_with_pool(scenario, gate.target, queue_timeout_s=1.0)


def test_a_frame_of_a_killed_process_is_retried_with_its_plans():
    gate = FilmGate()

    async def scenario(pool: Pool) -> None:
        gate.open()
        first = await pool.run(frame_job(0))
        await gate.job_started()
        drawing = asyncio.create_task(pool.run(frame_job(1, first.next_plan_state)))  # type: ignore[union-attr]
        await gate.job_started()
        os.kill(*pool.ready_pids, signal.SIGKILL)
        await gate.job_started()
        gate.open()
        second = await drawing
        assert isinstance(second, FilmPicture) and np.array_equal(second.color, np.full((4, 6, 3), 2))
        assert pool.counters.jobs_retried == 1

    run_with_pool(scenario, gate.target)


def test_a_frame_that_crashes_two_processes_is_an_error():
    async def scenario(pool: Pool) -> None:
        with pytest.raises(WorkerCrashError):
            await pool.run(frame_job(3))
        assert pool.counters.jobs_retried == 1

    run_with_pool(scenario, functools.partial(fake_workers.filming, commands=((3, "crash"),)))


def test_a_cancelled_frame_is_dropped():
    gate = FilmGate()

    async def scenario(pool: Pool) -> None:
        running = asyncio.create_task(pool.run(block(0)))
        await gate.job_started()
        waiting = asyncio.create_task(pool.run(frame_job()))
        await wait_until(lambda: pool.queued_count == 1)
        waiting.cancel()
        await wait_until(lambda: pool.queued_count == 0)
        assert pool.counters.jobs_abandoned == 1
        gate.open()
        await running

    run_with_pool(scenario, gate.target)


ALGORITHMS = ["sweep"] * 3 + ["shadow_map"] * 9
"""Preferred algorithm of each frame. The switch happens after five frames that prefer the new one, over several frames."""


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Callable[..., Any]]:
    """Return ``plans(number)``, which makes plans by ``ALGORITHMS`` for a frame."""

    def plan_maker_of(number: int) -> Callable[..., Any]:
        def make_plan(descriptor: Any, plan_request: Any, overrides: Any) -> Any:
            return select(descriptor, plan_request, {"algorithm": ALGORITHMS[number], **(overrides or {})}, "rules")

        return make_plan

    return plan_maker_of


def test_single_frames_equal_those_of_the_film(
    tmp_path: Path, plans: Callable[[int], Callable[..., Any]], monkeypatch: pytest.MonkeyPatch
):
    """Frames are equal to the bit, also through a switch: jobs hand plans on as a film does from frame to frame, and
    through a pipe.
    """
    view = {"kind": "perspective", "eye": [8.43, 47.5, 300], "target": [8.45, 47.51, 0], "size": [96, 64]}
    path = write_level(tmp_path, "hills", views={"eye": view})
    scene = build_scene(load_level(path))
    request = FilmRequest(FilmSpan(len(ALGORITHMS), 60.0), "eye")
    level = LEVEL.model_copy(update={"path": path})
    replanner = Replanner(plans=lambda *args: plans(frame_number[0])(*args))
    expected_frames, frame_number = [], [0]
    for moment in frame_moments(scene, request):
        frame_number[0] = moment.number
        (rendered,) = film_frames(scene, request, [moment], replanner)
        expected_frames.append(rendered)
    assert (
        any(film_frame.transition is not None for film_frame in expected_frames)
        and expected_frames[0].plan.algorithms_text != expected_frames[-1].plan.algorithms_text
    )

    before: FilmPlanState | None = None
    for number, expected in enumerate(expected_frames):
        monkeypatch.setattr(film_jobs, "view_plan_selector", lambda *_, number=number: plans(number))
        job = FrameJob(level=level, span=request.span, view="eye", frame_number=number, previous_plan_state=before)
        picture = pickle.loads(pickle.dumps(film_jobs.draw_film_frame(pickle.loads(pickle.dumps(job)), scene, PlanMeasurements())))
        assert np.array_equal(picture.color, expected.color), number
        before = picture.next_plan_state
    scene.close()


def test_equal_frames_differ_by_their_plan_handover():
    assert frame_job(0) == frame_job(0) and hash(frame_job(0)) == hash(frame_job(0))
    handover, other_handover = FilmPlanState(1), FilmPlanState(1)  # type: ignore[arg-type]
    assert frame_job(1, handover) == frame_job(1, handover) != frame_job(1, other_handover), "plan states are compared by identity"
    request = PictureRequest(sun=SunSpec(azimuth=100, altitude=30))
    assert frame_job(0).model_copy(update={"request": request}) != frame_job(0)
