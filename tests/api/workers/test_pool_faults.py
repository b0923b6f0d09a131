"""Render processes that stop, fail or block others: every wait ends, and the pool continues."""

import asyncio
import errno
import os
import signal
import subprocess
import sys
import time

import pytest

from skugga.api.errors import CircuitOpenError, RetryLaterError, WorkerCrashError
from skugga.api.request import ProductRequest, RequestedSettings
from skugga.api.workers import piped_process, worker_process
from skugga.api.workers import supervisor as supervisor_module
from skugga.api.workers.circuit_breaker import CircuitBreaker
from skugga.api.workers.expected_times import ExpectedTimes
from skugga.api.workers.job_queue import JobQueue, PendingJob
from skugga.api.workers.jobs import BlockJob, LevelKey, PlanResult, SnapshotJob
from skugga.api.workers.pool import Pool
from skugga.api.workers.process_life import is_stopped
from skugga.terrain.errors import RenderTimeoutError
from tests.api.workers import fake_workers
from tests.api.workers.test_pool import LEVEL, Gate, block, plan_job, run_with_pool, wait_until

OTHER_LEVEL = LevelKey(path=LEVEL.path.with_name("other.yaml"), version="1")


def snapshot_job(size: tuple[int, int] = (640, 480), **settings) -> SnapshotJob:
    """Return the job of a snapshot with overrides of the level's ``shadows``."""
    request = ProductRequest(overrides=RequestedSettings.of(settings))
    return SnapshotJob(level=LEVEL, view="map", format="png", size=size, request=request)


def test_a_supervisor_survives_a_lack_of_descriptors(monkeypatch: pytest.MonkeyPatch):
    """Creating the pipe of the next process fails twice, then descriptors are free again."""
    original_context, failures_left = piped_process.get_context, [2]

    class NoPipes:
        def __getattr__(self, name):
            return getattr(original_context("forkserver"), name)

        def Pipe(self):
            raise OSError(errno.EMFILE, "Too many open files")

    def context_without_pipes(method: str):
        if failures_left[0] and started_counts:
            failures_left[0] -= 1
            return NoPipes()
        return original_context(method)

    started_counts: list[int] = []
    monkeypatch.setattr(supervisor_module, "INITIAL_BACKOFF_S", 0.01)
    monkeypatch.setattr(piped_process, "get_context", context_without_pipes)

    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: pool.is_ready)
        started_counts.extend(pool.ready_pids)
        os.kill(*pool.ready_pids, signal.SIGKILL)
        await wait_until(lambda: not failures_left[0] and pool.is_ready and set(started_counts) != pool.ready_pids)
        assert pool.is_healthy
        assert isinstance(await pool.run(plan_job("map")), PlanResult)

    run_with_pool(scenario)


def test_an_ended_supervisor_task_is_unhealthy():
    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: pool.is_ready)
        assert pool.is_healthy
        pool.supervisor.tasks[0].cancel()
        await wait_until(lambda: not pool.is_healthy)

    run_with_pool(scenario)


def test_a_stopped_idle_process_is_replaced(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervisor_module, "HEARTBEAT_INTERVAL_S", 0.2)
    monkeypatch.setattr(supervisor_module, "HEARTBEAT_TIMEOUT_S", 0.2)

    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: pool.is_ready)
        (pid,) = pool.ready_pids
        os.kill(pid, signal.SIGSTOP)
        await wait_until(lambda: is_stopped(pid) or pid not in pool.ready_pids)
        assert not pool.is_ready or pid not in pool.ready_pids
        await wait_until(lambda: pool.is_ready and pid not in pool.ready_pids)
        assert isinstance(await pool.run(plan_job("map")), PlanResult)

    run_with_pool(scenario)


def test_a_job_of_a_stopped_process_is_retried(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(worker_process, "STOP_POLL_INTERVAL_S", 0.1)
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        running_job = asyncio.create_task(pool.run(plan_job("map")))
        await gate.job_started()
        os.kill(*pool.ready_pids, signal.SIGSTOP)
        await gate.job_started()
        gate.open(2)
        assert isinstance(await running_job, PlanResult)
        assert pool.counters.jobs_retried == 1

    run_with_pool(scenario, gate.target)


def test_a_queued_job_times_out():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        pool.jobs.queue.expected_times.add_duration(plan_job("first"), 0.01)
        running_job = asyncio.create_task(pool.run(plan_job("first")))
        await gate.job_started()
        with pytest.raises(RetryLaterError, match=r"limit of 0.3 s") as caught:
            await pool.run(plan_job("waits"))
        assert caught.value.retry_after_s >= 1
        assert pool.queued_count == 0 and pool.counters.jobs_expired == 1
        gate.open()
        await running_job

    run_with_pool(scenario, gate.target, queue_timeout_s=0.3)


def test_a_job_with_too_long_an_expected_wait_is_refused():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        pool.jobs.queue.expected_times.add_duration(block(0), 30.0)
        await wait_until(lambda: pool.is_ready)
        running_job = asyncio.create_task(pool.run(block(0)))
        await gate.job_started()
        waiting = asyncio.create_task(pool.run(plan_job("waits"), "other"))
        await wait_until(lambda: pool.queued_count == 1)
        with pytest.raises(RetryLaterError, match="the expected wait is") as caught:
            await pool.run(plan_job("map"), "other")
        assert 20 <= caught.value.retry_after_s <= 31
        waiting.cancel()
        gate.open()
        await running_job

    run_with_pool(scenario, gate.target, queue_timeout_s=20.0)


def test_repeated_timeouts_open_the_breaker_of_one_level():
    async def scenario(pool: Pool) -> None:
        hanging_job = plan_job("hang")
        for _ in range(2):
            with pytest.raises(RenderTimeoutError):
                await pool.run(hanging_job)
        with pytest.raises(CircuitOpenError, match="level level") as caught:
            await pool.run(hanging_job)
        assert 1 <= caught.value.retry_after_s <= 30
        started_count = pool.counters.processes_started
        other_job = plan_job("map").model_copy(update={"level": OTHER_LEVEL})
        assert isinstance(await pool.run(other_job), PlanResult)
        assert pool.counters.processes_started <= started_count + 1

    run_with_pool(scenario, render_timeout_s=0.3)


def test_a_timeout_does_not_count_as_a_failed_start(monkeypatch: pytest.MonkeyPatch):
    """Otherwise the next process would start only after backoffs that double."""
    monkeypatch.setattr(supervisor_module, "INITIAL_BACKOFF_S", 1000.0)

    async def scenario(pool: Pool) -> None:
        for number in range(3):
            hanging_job = plan_job("hang").model_copy(update={"level": LevelKey(path=LEVEL.path, version=str(number))})
            with pytest.raises(RenderTimeoutError):
                await pool.run(hanging_job)
        assert isinstance(await pool.run(plan_job("map")), PlanResult)

    run_with_pool(scenario, render_timeout_s=0.2)


def test_a_job_that_crashes_its_process_is_tried_twice():
    async def scenario(pool: Pool) -> None:
        with pytest.raises(WorkerCrashError):
            await pool.run(plan_job("crash"))
        assert pool.counters.jobs_retried == 1

    run_with_pool(scenario)


def make_pending_job(job, arrived_s: float) -> PendingJob:
    """Return a job that arrived at the time ``arrived_s``."""
    return PendingJob(job, None, arrived_s)  # type: ignore[arg-type]


def test_light_jobs_overtake_heavy_ones_for_a_limited_time():
    queue = JobQueue(1, ExpectedTimes())
    queue.expected_times.add_duration(snapshot_job(), 30.0)
    queue.expected_times.add_duration(block(0), 0.1)
    heavy_job, light_job, later_job = (
        make_pending_job(snapshot_job(), 0.0),
        make_pending_job(block(1), 10.0),
        make_pending_job(block(2), 31.0),
    )
    for job in (heavy_job, light_job, later_job):
        queue.put(job)
    assert [queue.start_next(40.0) for _ in range(1)] == [light_job]
    queue.discard(light_job)
    assert queue.start_next(40.0) is heavy_job


def test_one_process_is_reserved_for_light_jobs():
    queue = JobQueue(3, ExpectedTimes())
    queue.expected_times.add_duration(block(0), 0.1)
    slow_jobs = [snapshot_job((640 + n, 480)) for n in range(4)]
    for job in slow_jobs:
        queue.put(make_pending_job(job, 0.0))
    taken_jobs = [queue.start_next(0.0) for _ in range(3)]
    assert [taken_job is not None for taken_job in taken_jobs] == [True, True, False]
    queue.put(make_pending_job(block(1), 5.0))
    light_job = queue.start_next(5.0)
    assert light_job is not None and isinstance(light_job.job, BlockJob)
    assert queue.start_next(5.0) is None
    queue.discard(taken_jobs[0])  # type: ignore[arg-type]
    assert queue.start_next(5.0) is not None


def test_a_single_process_does_heavy_jobs_too():
    queue = JobQueue(1, ExpectedTimes())
    queue.put(make_pending_job(snapshot_job(), 0.0))
    assert queue.start_next(0.0) is not None


def test_expected_times_follow_measurements():
    expected = ExpectedTimes()
    assert not expected.is_short(block(0))
    expected.add_duration(block(0), 1.0)
    assert expected.is_short(block(1)) and expected.expected_s(block(1)) == 1.0
    expected.add_duration(block(1), 2.0)
    assert expected.expected_s(block(2)) == pytest.approx(1.3)
    assert expected.expected_s(block(2).model_copy(update={"level": OTHER_LEVEL})) == 0.5, (
        "another level keeps the initial estimate"
    )
    expected.add_duration(snapshot_job((1280, 1024)), 4.0)
    assert expected.expected_s(snapshot_job((2560, 2048))) == pytest.approx(16.0), (
        "the time of a snapshot is proportional to its pixels: four times as many take 16 s"
    )


def test_the_breaker_closes_after_pauses_that_double():
    now_s = [0.0]
    breaker = CircuitBreaker(lambda: now_s[0])
    breaker.record_failure(block(0))
    assert breaker.open_seconds_left(block(0)) == 0.0
    breaker.record_failure(block(1))
    assert breaker.open_seconds_left(block(2)) == 30.0
    assert breaker.open_seconds_left(plan_job("map")) == 30.0, (
        "failures with the level's own settings open the circuit of the whole level"
    )
    now_s[0] = 31.0
    assert breaker.open_seconds_left(block(0)) == 0.0
    breaker.record_failure(block(0))
    assert breaker.open_seconds_left(block(0)) == 60.0
    now_s[0] = 100.0
    breaker.record_success(block(0))
    breaker.record_failure(block(0))
    assert breaker.open_seconds_left(block(0)) == 0.0


def test_the_breaker_opens_only_for_jobs_with_equal_options():
    breaker = CircuitBreaker(lambda: 0.0)
    for _ in range(2):
        breaker.record_failure(snapshot_job(algorithm="shadow_volume"))
    assert breaker.open_seconds_left(snapshot_job((100, 100), algorithm="shadow_volume")) > 0.0
    assert breaker.open_seconds_left(snapshot_job()) == 0.0
    assert breaker.open_seconds_left(block(0)) == 0.0


PARENT = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], stdout=subprocess.PIPE, text=True)
print(child.pid, child.stdout.readline().strip(), flush=True)
sys.stdin.read()
"""
CHILD = """
from skugga.terrain.compiling.parent_process import end_with_parent
end_with_parent()
print('busy', flush=True)
while True: pass
"""


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's own")
@pytest.mark.parametrize("stops_child", [False, True])
def test_a_process_ends_with_its_killed_parent(stops_child: bool):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline().split()[0])
    if stops_child:
        os.kill(pid, signal.SIGSTOP)
    parent.kill()
    parent.communicate()
    deadline_s = time.monotonic() + 10.0
    while _is_alive(pid):
        assert time.monotonic() < deadline_s, "the child outlived its parent"
        time.sleep(0.01)


def _is_alive(pid: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_fake_process_answers_heartbeats():
    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: pool.is_ready)
        (pid,) = pool.ready_pids
        await asyncio.sleep(0.3)
        assert pool.ready_pids == {pid}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(supervisor_module, "HEARTBEAT_INTERVAL_S", 0.05)
        run_with_pool(scenario, fake_workers.scripted)
