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

TIMEOUT_PER_EXPECTED_TIME = 100.0
"""Timeout of a task relative to its expected duration; ``MIN_TASK_TIMEOUT_S`` is the minimum timeout."""

FILE_CHECK_INTERVAL_S = 0.5
"""Interval between checks for changes of the level's files, if the level has more than ``MAX_FILES_PER_TASK_CHECK``."""

MAX_FILES_PER_TASK_CHECK = 100
"""Up to this number, files are checked after every task."""

POLL_INTERVAL_S = 1.0
"""Maximum seconds to wait for results before the run looks for free workers again."""

MAX_BATCH_TASKS, MIN_BATCHES_PER_WORKER_QUEUE = 16, 4
"""Maximum number of tasks in a batch for a worker queue, and minimum number of batches per worker queue in the remaining tasks."""


@dataclass(frozen=True)
class TaskCompletion:
    """The result or failure of a task, and the run's progress: the number of tasks done and in total.

    Attributes
    ----------
    task : Task
        The task.
    outcome : TaskResult or TaskFailure
        Its result, or the reason why it was not drawn.
    done_count, total_count : int
        Number of tasks that have ended, and number of all tasks of this run.
    """

    task: Task
    outcome: TaskResult | TaskFailure
    done_count: int
    total_count: int


def shard_name(key: str) -> str:
    """Return the name of the shard for a task's key, which is a digest of the task's inputs."""
    return f"{key[:2]}/{key}.tiles"


def task_of(table: TaskTable, run: PlannedRun, task_number: int, min_timeout_s: float) -> Task:
    """Return a task of the table in the form that is sent to workers. ``min_timeout_s`` is that of ``run_tasks``."""
    sun, zoom, x, y, key, expected_s = table.task_row(task_number)
    return Task(
        task_number,
        run.sun_names.index(sun),
        zoom,
        x,
        y,
        shard_name(key),
        max(min_timeout_s, TIMEOUT_PER_EXPECTED_TIME * expected_s),
    )


class WaitingTasks:
    """The queue of tasks, assigned to worker queues in batches of tasks that are neighbours on the map.

    ``tasks`` are numbers of tasks in the table. A worker that draws neighbouring blocks already has most of their ground in
    memory. A worker queue for which no task is left steals the last task of the longest worker queue.
    """

    def __init__(self, tasks: Sequence[int]) -> None:
        self._unassigned_tasks = deque(tasks)
        self._worker_queues: dict[int, deque[int]] = {}

    def __len__(self) -> int:
        return len(self._unassigned_tasks) + sum(map(len, self._worker_queues.values()))

    def take(self, worker_queue: int) -> int:
        """Return the number of the next task of a worker queue. Raises ``IndexError`` if none waits."""
        queued_tasks = self._worker_queues.setdefault(worker_queue, deque())
        if not queued_tasks and self._unassigned_tasks:
            # Smaller batches towards the end, so that all worker queues share the remaining heavy tasks.
            count = min(
                max(len(self._unassigned_tasks) // (MIN_BATCHES_PER_WORKER_QUEUE * len(self._worker_queues)), 1), MAX_BATCH_TASKS
            )
            queued_tasks.extend(self._unassigned_tasks.popleft() for _ in range(count))
        return queued_tasks.popleft() if queued_tasks else max(self._worker_queues.values(), key=len).pop()

    def requeue(self, task: int) -> None:
        """Queue a task again by its number, behind all tasks that are not assigned to a worker queue."""
        self._unassigned_tasks.append(task)


def run_tasks(
    table: TaskTable,
    run: PlannedRun,
    runner: Runner,
    on_progress: Callable[[TaskCompletion], None],
    min_timeout_s: float = MIN_TASK_TIMEOUT_S,
) -> None:
    """Draw all waiting tasks. A failed task is recorded and does not stop the others.

    A process counts as dead if it takes too long for a task: longer than ``min_timeout_s``, and longer than
    ``TIMEOUT_PER_EXPECTED_TIME`` times the expected duration.

    Raises ``RenderError`` if the level changes meanwhile, if no shard can be written, or if nothing can be drawn. Finished tasks
    stay done.
    """
    waiting_tasks = WaitingTasks(table.waiting_tasks())
    running: dict[int, Task] = {}
    unchecked: list[TaskResult] = []
    total, done, checked_at_s = len(waiting_tasks), 0, clock.monotonic()
    while waiting_tasks or running:
        for worker_queue in runner.free_worker_queues():
            if waiting_tasks:
                task = task_of(table, run, waiting_tasks.take(worker_queue), min_timeout_s)
                running[task.id] = task
                runner.submit(task, worker_queue)
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
                table.record_failure(outcome.id, outcome.error)
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
    table.record_results(results)
