"""Stopped render processes: they are ended after a time limit, and other processes draw their tasks."""

from __future__ import annotations

import os
import signal
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from skugga.api.seed.local_pool import MAX_FAILED_STARTS, LocalPool
from skugga.api.seed.messages import MIN_TASK_TIMEOUT_S, Task, TaskFailure, TaskResult
from skugga.api.seed.planning import plan_run
from skugga.api.seed.run_spec import RunSpec
from skugga.api.seed.running import TIMEOUT_PER_EXPECTED_TIME, TaskCompletion, task_of
from skugga.api.seed.seeding import draw_and_publish
from skugga.api.seed.task_table import TaskTable
from skugga.terrain.errors import GraphicsError, RenderError
from tests.api.seed.runs import Run, rough_ground, write_ground

TASK_TIME_LIMIT_S = 15.0
"""Limit for tasks that take half a second: long enough on a busy machine."""


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run over rough ground that has not started."""
    return Run(write_ground(tmp_path / "dem.tif", rough_ground(120)), tmp_path / "out.pmtiles", (11, 14))


class StoppingPool(LocalPool):
    """Pool of one process, which is stopped ``times`` times when it receives the task of zoom 11."""

    def __init__(self, times: int, timeout_s: float | None = None) -> None:
        super().__init__(1)
        self.left, self._limit_s = times, timeout_s

    def submit(self, task: Task, worker_queue: int) -> None:
        if not self.left or task.zoom != 11:
            super().submit(task, worker_queue)
            return
        self.left -= 1
        super().submit(task if self._limit_s is None else task._replace(timeout_s=self._limit_s), worker_queue)
        os.kill(self.pids[0], signal.SIGSTOP)


def seed_with_pool(run: Run, pool: LocalPool, **options: float) -> list[TaskCompletion]:
    """Seed by a pool, and return the ends of tasks."""
    ends: list[TaskCompletion] = []
    shards = str(run.work / "shards")
    with TaskTable(run.work / "tasks.sqlite") as table:
        planned = plan_run(table, run.request, lambda text: None)
        draw_and_publish(
            table, planned, run.store, shards, {planned.sun_names[0]: run.output}, lambda: pool.prepare_run(planned.spec, shards),
            ends.append, **options,
        )  # fmt: skip
    return ends


def attempt_counts(run: Run) -> list[int]:
    """Return the number of attempts in which a worker died, for each task with any."""
    with closing(sqlite3.connect(run.work / "tasks.sqlite")) as table:
        return [row[0] for row in table.execute("SELECT tries FROM tasks WHERE tries > 0")]


@pytest.mark.long
def test_a_stopped_process_is_replaced_and_its_task_drawn(run: Run, tmp_path: Path):
    pool = StoppingPool(times=1)
    first = pool.pids
    seed_with_pool(run, pool, min_timeout_s=TASK_TIME_LIMIT_S)
    assert pool.left == 0 and attempt_counts(run) == [1]
    assert pool.pids != first and not Path(f"/proc/{first[0]}").exists()
    undisturbed_run = Run(run.level, tmp_path / "whole.pmtiles", run.zooms)
    undisturbed_run()
    assert run.output.read_bytes() == undisturbed_run.output.read_bytes()


@pytest.mark.long
def test_a_task_that_always_hangs_is_listed_as_failed(run: Run):
    pool = StoppingPool(times=100, timeout_s=1.0)
    with pytest.raises(RenderError, match=r"1 of \d+ tasks failed.*zoom 11 .*did not answer within 1 s"):
        seed_with_pool(run, pool)
    assert pool.left == 97 and attempt_counts(run) == [3]


@pytest.mark.long
def test_a_hung_process_of_a_cluster_worker_is_replaced(run: Run):
    from skugga.api.seed.dask_worker import PersistentProcess

    render_process, shards = PersistentProcess(), str(run.work / "shards")
    with TaskTable(run.work / "tasks.sqlite") as table:
        planned = plan_run(table, run.request, lambda text: None)
        task = task_of(table, planned, table.waiting_tasks()[0], MIN_TASK_TIMEOUT_S)
    run.store.write("run.json", planned.spec.model_dump_json().encode())
    assert isinstance(render_process.draw(shards, "run.json", task), TaskResult)
    assert render_process._process is not None
    os.kill(render_process._process.pid, signal.SIGSTOP)
    failure = render_process.draw(shards, "run.json", task._replace(timeout_s=1.0))
    assert isinstance(failure, TaskFailure) and (failure.kind, failure.error) == (
        "died",
        "its render process did not answer within 1 s",
    )
    assert isinstance(render_process.draw(shards, "run.json", task), TaskResult)
    render_process.end()


def test_processes_that_hang_at_the_start_end_the_run(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(RunSpec, "model_dump_json", lambda self: "")
    pool = LocalPool(1, start_timeout_s=0.2)
    stopped_pids: list[int] = []
    try:
        pool.prepare_run(RunSpec.model_construct(), "nowhere")
        with pytest.raises(GraphicsError, match=f"{MAX_FAILED_STARTS} render processes in a row ended or did not answer"):
            for _ in range(2 * MAX_FAILED_STARTS):
                os.kill(pool.pids[0], signal.SIGSTOP)
                stopped_pids += pool.pids
                assert pool.wait(1.0) == []
    finally:
        pool.close()
    assert len(set(stopped_pids)) == MAX_FAILED_STARTS and not any(Path(f"/proc/{pid}").exists() for pid in stopped_pids)


def test_the_limit_of_a_task_has_a_minimum_and_a_ratio(run: Run):
    with TaskTable(run.work / "tasks.sqlite") as table:
        planned = plan_run(table, run.request, lambda text: None)
        number = table.waiting_tasks()[0]
        expected_s = table.task_row(number)[-1]
        assert task_of(table, planned, number, MIN_TASK_TIMEOUT_S).timeout_s == MIN_TASK_TIMEOUT_S > 100.0 * expected_s > 0.0
        assert task_of(table, planned, number, 0.01).timeout_s == TIMEOUT_PER_EXPECTED_TIME * expected_s
