import asyncio
import functools
import os
import signal
import threading
from collections.abc import Awaitable, Callable
from multiprocessing import get_context
from pathlib import Path

import pytest

from skugga.api.errors import WorkerCrashError, WorkerStartError
from skugga.api.settings import Settings
from skugga.api.workers import background_compile
from skugga.api.workers.jobs import BlockJob, BlockTiles, LevelKey, PlanJob, PlanResult, PreparationProgress
from skugga.api.workers.pool import Pool
from skugga.terrain.compiling.ahead_of_time import PRODUCTS
from skugga.terrain.errors import BusyError, GraphicsError, InputError, RenderError, RenderTimeoutError
from tests.api.workers import fake_workers

LEVEL = LevelKey(path=Path("level.yaml"), version="1")
TIMEOUT_S = 30.0
"""Much longer than any test here takes."""


def plan_job(view: str) -> PlanJob:
    """Return the job that plans a view."""
    return PlanJob(level=LEVEL, view=view)


def block(x: int) -> BlockJob:
    """Return the job of a block of tiles in a column of blocks."""
    return BlockJob(level=LEVEL, matrix_set="WebMercatorQuad", zoom=12, block_x=x, block_y=0)


def run_with_pool(scenario: Callable[[Pool], Awaitable[None]], target=fake_workers.scripted, **settings) -> None:
    """Run a scenario with a pool of one process, and check that no process remains."""

    async def run() -> set[int]:
        pool = Pool(Settings(**{"workers": 1, **settings}), target)
        pool.open()
        try:
            await asyncio.wait_for(scenario(pool), TIMEOUT_S)
            return set(pool.ready_pids)
        finally:
            await pool.close()
            assert not pool.ready_pids

    for pid in asyncio.run(run()):
        assert not is_running(pid)


def is_running(pid: int) -> bool:
    """Return whether a process exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


async def wait_until(condition: Callable[[], bool]) -> None:
    """Run the event loop until a condition holds. The time limit of the scenario ends it otherwise."""
    while not condition():
        await asyncio.sleep(0.005)


class Gate:
    """Gate that blocks a worker's jobs: ``job_started`` waits for a job, ``open`` releases it."""

    def __init__(self) -> None:
        spawn = get_context("spawn")
        self._job_started, self._may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
        self.target = functools.partial(fake_workers.scripted, job_started=self._job_started, may_finish=self._may_finish)

    async def job_started(self) -> None:
        """Wait until the render process has started another job."""
        assert await asyncio.to_thread(self._job_started.acquire, True, TIMEOUT_S)

    def open(self, times: int = 1) -> None:
        """Let a number of jobs finish."""
        for _ in range(times):
            self._may_finish.release()


def test_a_pool_answers_a_plan_job():
    async def scenario(pool: Pool) -> None:
        answer = await pool.run(plan_job("map"))
        assert isinstance(answer, PlanResult)
        assert answer.plan_json == '{"view": "map"}'
        assert pool.is_ready
        assert pool.renderer == fake_workers.RENDERER

    run_with_pool(scenario)


def test_compilation_before_readiness_is_reported(caplog: pytest.LogCaptureFixture):
    may_finish = get_context("spawn").Semaphore(0)

    async def run() -> None:
        pool = Pool(Settings(workers=1), functools.partial(fake_workers.compiling, may_finish=may_finish))
        assert pool.preparing == PreparationProgress("starting a render process")
        pool.open()
        await wait_until(lambda: pool.preparing == PreparationProgress("compiling loops for map tiles", 3, 9))
        assert not pool.is_ready
        may_finish.release()
        await asyncio.wait_for(pool.wait_for_first_process(), TIMEOUT_S)
        assert pool.is_ready and pool.preparing is None
        await pool.close()

    with caplog.at_level("INFO", "skugga"):
        asyncio.run(run())
    assert caplog.text.count("compiling loops for map tiles") == 1


def test_the_render_timeout_excludes_compilation():
    async def run() -> None:
        pool = Pool(Settings(workers=1, render_timeout_s=1.0), functools.partial(fake_workers.compiling, steps=4, step_s=0.5))
        pool.open()
        await pool.wait_for_first_process()
        expected_s = pool.expected_s(block(1))
        assert isinstance(await asyncio.wait_for(pool.run(block(1)), TIMEOUT_S), BlockTiles)
        assert pool.counters.jobs_timed_out == 0
        assert pool.expected_s(block(1)) == expected_s, "compilation happens once, so it does not count for the next block"
        await pool.close()

    asyncio.run(run())


def test_missing_loops_are_compiled_in_the_background(monkeypatch: pytest.MonkeyPatch):
    finished = threading.Event()

    def compile_ahead(products, processes, progress, background, on_start) -> None:
        assert tuple(products) == PRODUCTS and background
        progress("compiling loops for points", 5, 7)
        assert finished.wait(TIMEOUT_S)

    monkeypatch.setattr(background_compile, "compile_ahead", compile_ahead)

    async def run() -> None:
        pool = Pool(Settings(workers=2), functools.partial(fake_workers.compiling, missing=7))
        pool.open()
        await wait_until(lambda: pool.preparing == PreparationProgress("compiling loops for points", 5, 7))
        assert pool.is_ready and pool.background_compile.is_running
        assert isinstance(await pool.run(block(1)), BlockTiles), "jobs do not wait for the compilation"
        assert not pool.idle_work._is_idle(), "idle work, such as a calibration, waits for the compilation"
        finished.set()
        await wait_until(lambda: pool.preparing is None and not pool.background_compile.is_running)
        await pool.close()

    asyncio.run(run())


def test_a_stopping_service_ends_background_compilation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "store"))

    async def run() -> int:
        pool = Pool(Settings(workers=1), functools.partial(fake_workers.compiling, missing=7))
        pool.open()
        await wait_until(lambda: pool.background_compile._compile_process is not None)
        compile_process = pool.background_compile._compile_process
        assert compile_process is not None
        await asyncio.wait_for(pool.close(), TIMEOUT_S)
        return compile_process.returncode

    assert asyncio.run(run()) == -signal.SIGKILL


def test_other_workers_start_when_the_first_is_ready():
    async def scenario(pool: Pool) -> None:
        assert not pool.ready_pids
        await pool.wait_for_first_process()
        assert len(pool.ready_pids) == 1
        await wait_until(lambda: len(pool.ready_pids) == 3)

    run_with_pool(scenario, workers=3)


def test_equal_jobs_are_deduplicated():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        waiting_jobs = [asyncio.create_task(pool.run(block(1))) for _ in range(5)]
        await gate.job_started()
        gate.open()
        answers = await asyncio.gather(*waiting_jobs)
        assert all(answer is answers[0] for answer in answers)
        assert pool.counters.jobs_answered == 1

    run_with_pool(scenario, gate.target)


def test_finished_blocks_are_cached_within_a_byte_limit():
    async def scenario(pool: Pool) -> None:
        first = await pool.run(block(1))
        assert pool.cached_picture(block(1)) is first
        assert await pool.run(block(1)) is first
        await pool.run(block(2))
        assert pool.cached_picture(block(1)) is None
        assert pool.cached_picture(block(2)) is not None
        assert pool.counters.jobs_answered == 2

    run_with_pool(scenario, block_cache_bytes=100)  # the tiles of a block take 64


def test_only_a_client_with_a_full_queue_is_refused():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        running_job = asyncio.create_task(pool.run(plan_job("first")))
        await gate.job_started()
        queued = [asyncio.create_task(pool.run(plan_job(f"queued {n}"), "one")) for n in range(2)]
        await wait_until(lambda: pool.queued_count == 2)
        with pytest.raises(BusyError, match="2 pictures of this client are queued"):
            await pool.run(plan_job("too many"), "one")
        repeated_job = asyncio.create_task(pool.run(plan_job("queued 1"), "one"))  # no new job, so it is admitted
        other_job = asyncio.create_task(pool.run(plan_job("too many"), "other"))
        gate.open(4)
        await asyncio.gather(running_job, repeated_job, other_job, *queued)

    run_with_pool(scenario, gate.target, queue_work_s=1.2)  # a plan is expected to take 0.5 s


def test_a_job_counts_for_the_clients_that_wait_for_it():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        running_job = asyncio.create_task(pool.run(plan_job("first")))
        await gate.job_started()
        leaving_job = asyncio.create_task(pool.run(plan_job("second"), "one"))
        await wait_until(lambda: pool.queued_count == 1)
        staying_job = asyncio.create_task(pool.run(plan_job("second"), "other"))
        await wait_until(lambda: len(pool.jobs.queue.waiting[plan_job("second")].clients) == 2)
        assert len(pool.jobs.queue.jobs_of_client("one")) == 1
        leaving_job.cancel()
        await wait_until(lambda: not pool.jobs.queue.jobs_of_client("one"))
        assert len(pool.jobs.queue.jobs_of_client("other")) == 1 and pool.counters.jobs_abandoned == 0
        gate.open(2)
        await asyncio.gather(running_job, staying_job)

    run_with_pool(scenario, gate.target)


def test_a_cancelled_client_does_not_cancel_others():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        leaving_job, staying_job = (asyncio.create_task(pool.run(block(1))) for _ in range(2))
        await gate.job_started()
        leaving_job.cancel()
        gate.open()
        assert (await staying_job).tiles
        with pytest.raises(asyncio.CancelledError):
            await leaving_job

    run_with_pool(scenario, gate.target)


def test_a_job_that_nobody_waits_for_is_dropped():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        first = asyncio.create_task(pool.run(plan_job("first")))
        await gate.job_started()
        dropped_job = asyncio.create_task(pool.run(plan_job("dropped")))
        await wait_until(lambda: pool.queued_count == 1)
        dropped_job.cancel()
        await wait_until(lambda: pool.queued_count == 0)
        last = asyncio.create_task(pool.run(plan_job("last")))
        gate.open(2)
        await asyncio.gather(first, last)
        assert (pool.counters.jobs_answered, pool.counters.jobs_abandoned) == (2, 1)

    run_with_pool(scenario, gate.target)


def test_a_running_job_finishes_and_is_cached_after_cancelling():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        cancelled_job = asyncio.create_task(pool.run(block(1)))
        await gate.job_started()
        cancelled_job.cancel()
        gate.open()
        await wait_until(lambda: pool.cached_picture(block(1)) is not None)

    run_with_pool(scenario, gate.target)


@pytest.mark.parametrize(
    ("view", "error"),
    [("refuse", InputError), ("fail", RenderError), ("break_opengl", GraphicsError), ("crash", WorkerCrashError)],
)
def test_an_error_affects_only_its_own_job(view: str, error: type[Exception]):
    async def scenario(pool: Pool) -> None:
        for _ in range(2):
            with pytest.raises(error):
                await pool.run(plan_job(view))
            assert isinstance(await pool.run(plan_job("map")), PlanResult)
        replacement_count = 4 if view in ("break_opengl", "crash") else 0  # each job is tried twice
        assert pool.counters.processes_started == 1 + replacement_count

    run_with_pool(scenario)


def test_a_job_over_its_time_limit_ends_its_process():
    async def scenario(pool: Pool) -> None:
        await pool.run(plan_job("map"))
        (pid,) = pool.ready_pids
        with pytest.raises(RenderTimeoutError):
            await pool.run(plan_job("hang"))
        assert isinstance(await pool.run(plan_job("map")), PlanResult)
        assert pid not in pool.ready_pids
        assert not is_running(pid)

    run_with_pool(scenario, render_timeout_s=0.5)


def test_a_job_of_a_killed_process_is_retried():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        running_job = asyncio.create_task(pool.run(plan_job("first")))
        await gate.job_started()
        queued = asyncio.create_task(pool.run(plan_job("second")))
        os.kill(*pool.ready_pids, signal.SIGKILL)
        gate.open(2)
        assert isinstance(await running_job, PlanResult), "another process draws the job again"
        assert isinstance(await queued, PlanResult)
        assert pool.counters.jobs_retried == 1

    run_with_pool(scenario, gate.target)


def test_a_process_killed_while_idle_is_replaced():
    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: pool.is_ready)
        (pid,) = pool.ready_pids
        os.kill(pid, signal.SIGKILL)
        await wait_until(lambda: pool.is_ready and pid not in pool.ready_pids)
        assert isinstance(await pool.run(plan_job("map")), PlanResult)

    run_with_pool(scenario)


def test_processes_are_recycled():
    async def scenario(pool: Pool) -> None:
        for number in range(5):
            await pool.run(plan_job(f"map {number}"))
        assert pool.counters.processes_started == 3

    run_with_pool(scenario, recycle_blocks=2)


@pytest.mark.parametrize(
    ("target", "error"), [(fake_workers.failing_at_start, GraphicsError), (fake_workers.exiting_at_start, WorkerStartError)]
)
def test_a_pool_that_cannot_start_raises_for_all_jobs(target, error):
    async def scenario(pool: Pool) -> None:
        with pytest.raises(error):
            await pool.run(plan_job("waits for the first start"))
        with pytest.raises(error):
            await pool.run(plan_job("comes later"))
        assert not pool.is_ready

    run_with_pool(scenario, target)


def test_a_start_that_never_ends_times_out():
    async def scenario(pool: Pool) -> None:
        with pytest.raises(WorkerStartError, match="warm up"):
            await pool.run(plan_job("map"))

    run_with_pool(scenario, fake_workers.never_ready, start_timeout_s=0.5)


def test_closing_fails_running_and_queued_jobs():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        running_job = asyncio.create_task(pool.run(plan_job("first")))
        await gate.job_started()
        queued = asyncio.create_task(pool.run(plan_job("second")))
        await wait_until(lambda: pool.queued_count == 1)
        (pid,) = pool.ready_pids
        await pool.close()
        for task in (running_job, queued):
            with pytest.raises(BusyError):
                await task
        with pytest.raises(BusyError):
            await pool.run(plan_job("third"))
        assert not is_running(pid)

    run_with_pool(scenario, gate.target)


def test_closing_at_once_leaves_no_process():
    async def scenario(pool: Pool) -> None:
        await asyncio.sleep(0)  # the processes are starting

    before = set(get_context("spawn").active_children())
    run_with_pool(scenario, workers=2)
    assert set(get_context("spawn").active_children()) <= before


def test_several_processes_work_at_once():
    gate = Gate()

    async def scenario(pool: Pool) -> None:
        gate.open()
        await pool.run(block(0))  # lets the pool learn how fast such blocks are
        await gate.job_started()
        jobs = [asyncio.create_task(pool.run(block(n))) for n in (1, 2)]
        await gate.job_started()
        await gate.job_started()
        gate.open(2)
        await asyncio.gather(*jobs)

    run_with_pool(scenario, gate.target, workers=2)
