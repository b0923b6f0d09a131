"""Draw a run's tasks by any ``Runner``, the heaviest first. Each task is recorded when it is done."""

from __future__ import annotations

import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skugga.api.seed.local_pool import Runner
from skugga.api.seed.messages import MIN_TASK_TIMEOUT_S, Task, TaskFailure, TaskResult
from skugga.api.seed.planning import PlannedRun
from skugga.api.seed.task_table import TaskTable
from skugga.terrain.errors import RenderError

MAX_WORKER_DEATHS = 3
"""Number of workers that may die while they draw the same task. The task then fails."""

TIMEOUT_RATIO = 100.0
"""Timeout of a task relative to its expected duration; ``MIN_TASK_TIMEOUT_S`` is the minimum timeout."""

FILE_CHECK_INTERVAL_S = 0.5
"""Interval between checks for changes of the level's files, if the level has more than ``MAX_FILES_PER_TASK_CHECK``."""

MAX_FILES_PER_TASK_CHECK = 100
"""Up to this number, files are checked after every task."""

POLL_INTERVAL_S = 1.0

MAX_BATCH_TASKS, MIN_BATCHES_PER_LANE = 16, 4
"""Maximum number of tasks in a batch for a lane, and minimum number of such batches per lane in the remaining tasks."""


@dataclass(frozen=True)
class TaskCompletion:
    """The result or failure of a task, and the run's progress: the number of tasks done and in total."""

    task: Task
    outcome: TaskResult | TaskFailure
    done: int
    total: int


def shard_name(key: str) -> str:
    """Return the name of the shard for a task's key, which is a digest of the task's inputs."""
    return f"{key[:2]}/{key}.tiles"


def task_of(table: TaskTable, run: PlannedRun, number: int, min_timeout_s: float) -> Task:
    """Return a task of the table in the form that is sent to workers."""
    sun, zoom, x, y, key, expected_s = table.task_row(number)
    return Task(number, run.sun_names.index(sun), zoom, x, y, shard_name(key), max(min_timeout_s, TIMEOUT_RATIO * expected_s))


class WaitingTasks:
    """The queue of tasks, assigned to lanes (queues of workers) in batches of tasks that are neighbours on the map.

    A worker that draws neighbouring blocks already has most of their ground in memory. If no task is left for a lane, it steals the
    last task of the longest lane.
    """

    def __init__(self, tasks: Sequence[int]) -> None:
        self._left = deque(tasks)
        self._lanes: dict[int, deque[int]] = {}

    def __len__(self) -> int:
        return len(self._left) + sum(map(len, self._lanes.values()))

    def take(self, lane: int) -> int:
        """Return the next task of a lane. Raises ``IndexError`` if none waits."""
        lane_tasks = self._lanes.setdefault(lane, deque())
        if not lane_tasks and self._left:
            # Smaller batches towards the end, so that all lanes share the remaining heavy tasks.
            count = min(max(len(self._left) // (MIN_BATCHES_PER_LANE * len(self._lanes)), 1), MAX_BATCH_TASKS)
            lane_tasks.extend(self._left.popleft() for _ in range(count))
        return lane_tasks.popleft() if lane_tasks else max(self._lanes.values(), key=len).pop()

    def requeue(self, task: int) -> None:
        """Queue a task again, behind all tasks that are not assigned to a lane."""
        self._left.append(task)


def run_tasks(
    table: TaskTable,
    run: PlannedRun,
    runner: Runner,
    on_progress: Callable[[TaskCompletion], None],
    min_timeout_s: float = MIN_TASK_TIMEOUT_S,
) -> None:
    """Draw all waiting tasks. A failed task is recorded and does not stop the others.

    A process counts as dead if it takes too long for a task: longer than ``min_timeout_s``, and longer than ``TIMEOUT_RATIO`` times
    the expected duration.

    Raises ``RenderError`` if the level changes meanwhile, if no shard can be written, or if nothing can be drawn. Finished tasks
    stay done.
    """
    waiting_tasks = WaitingTasks(table.waiting_tasks())
    running: dict[int, Task] = {}
    unchecked: list[TaskResult] = []
    total, done, checked_at_s = len(waiting_tasks), 0, clock.monotonic()
    while waiting_tasks or running:
        for lane in runner.free_lanes():
            if waiting_tasks:
                task = task_of(table, run, waiting_tasks.take(lane), min_timeout_s)
                running[task.id] = task
                runner.submit(task, lane)
        for outcome in runner.wait(POLL_INTERVAL_S):
            ended = running.pop(outcome.id, None)
            if ended is None:
                continue  # started twice, and done already
            if isinstance(outcome, TaskFailure):
                if outcome.kind == "stopped":
                    _record_results(table, run, unchecked)
                    raise RenderError(outcome.error)
                if outcome.kind == "died" and table.record_worker_death(outcome.id) < MAX_WORKER_DEATHS:
                    waiting_tasks.requeue(outcome.id)
                    continue
                table.fail(outcome.id, outcome.error)
            else:
                unchecked.append(outcome)
            done += 1
            on_progress(TaskCompletion(ended, outcome, done, total))
        if unchecked and (
            len(run.files) <= MAX_FILES_PER_TASK_CHECK or clock.monotonic() - checked_at_s > FILE_CHECK_INTERVAL_S or not running
        ):
            _record_results(table, run, unchecked)
            unchecked, checked_at_s = [], clock.monotonic()


def _record_results(table: TaskTable, run: PlannedRun, results: list[TaskResult]) -> None:
    """Record drawn tasks, provided that the level's files are unchanged. Raises ``RenderError`` if they have changed."""
    if not run.is_unchanged:
        raise RenderError(
            f"{run.loaded.path}: the level, or one of its files, has changed during the run. Run the same command again to resume."
        )
    table.finish(results)
