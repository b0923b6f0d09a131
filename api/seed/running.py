"""A run's tasks drawn, by whatever draws them: the heaviest first, each noted as soon as it is done."""

from __future__ import annotations

import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skugga.api.seed.local_pool import Runner
from skugga.api.seed.messages import LEAST_LIMIT_S, Drawn, NotDrawn, Task
from skugga.api.seed.planning import PlannedRun
from skugga.api.seed.task_table import TaskTable
from skugga.terrain.errors import RenderError

MOST_DEATHS = 3
"""How often a task is begun of which workers die."""

LIMIT_TIMES = 100.0
"""After so many times as long as a task is expected to take, or ``LEAST_LIMIT_S`` if that is more, its process counts as hung."""

FILES_EVERY_S = 0.5
"""How often it is looked whether the level's files have changed, where there are many of them; ..."""

FEW_FILES = 100
"""... where there are no more, after every task."""

HEARD_EVERY_S = 1.0

LONGEST_STRETCH, STRETCHES_LEFT = 16, 4
"""Tasks that a lane is given at once, at most; and how many such stretches for each lane there are in what is left, at least."""


@dataclass(frozen=True)
class TaskEnd:
    """A task that is done, or has failed (``outcome``), and how many of those of the run are."""

    task: Task
    outcome: Drawn | NotDrawn
    done: int
    total: int


def shard_name(key: str) -> str:
    """The name of a key's shard."""
    return f"{key[:2]}/{key}.tiles"


def task_of(table: TaskTable, run: PlannedRun, number: int, least_limit_s: float) -> Task:
    """A task as workers are told it."""
    sun, zoom, x, y, key, expected_s = table.place(number)
    return Task(number, run.sun_names.index(sun), zoom, x, y, shard_name(key), max(least_limit_s, LIMIT_TIMES * expected_s))


class WaitingTasks:
    """Tasks in the order in which they are to be begun, handed out to lanes: a lane gets stretches of neighbours, for a worker that
    draws a block beside the one before has most of the ground there already. Where there is nothing else, it gets what another
    lane would have drawn last.
    """

    def __init__(self, tasks: Sequence[int]) -> None:
        self._left = deque(tasks)
        self._lanes: dict[int, deque[int]] = {}

    def __len__(self) -> int:
        return len(self._left) + sum(map(len, self._lanes.values()))

    def take(self, lane: int) -> int:
        """The next task of a lane. Raises ``IndexError`` where none waits."""
        own = self._lanes.setdefault(lane, deque())
        if not own and self._left:
            # Shorter ones towards the end: the heaviest are to be begun first, whoever is free.
            count = min(max(len(self._left) // (STRETCHES_LEFT * len(self._lanes)), 1), LONGEST_STRETCH)
            own.extend(self._left.popleft() for _ in range(count))
        return own.popleft() if own else max(self._lanes.values(), key=len).pop()

    def put_back(self, task: int) -> None:
        """Let a task wait again, after all others."""
        self._left.append(task)


def run_tasks(
    table: TaskTable,
    run: PlannedRun,
    runner: Runner,
    on_progress: Callable[[TaskEnd], None],
    least_limit_s: float = LEAST_LIMIT_S,
) -> None:
    """Draw what waits. Tasks that fail are noted, and the others go on. A process that has drawn a task for ``least_limit_s``, or
    for ``LIMIT_TIMES`` as long as expected if that is more, counts as dead.

    Raises ``RenderError`` where the level changes meanwhile, where no shard can be written, and where nothing can be drawn: what is
    done by then stays done.
    """
    waiting = WaitingTasks(table.waiting())
    running: dict[int, Task] = {}
    unchecked: list[Drawn] = []
    total, done, looked = len(waiting), 0, clock.monotonic()
    while waiting or running:
        for lane in runner.free():
            if waiting:
                task = task_of(table, run, waiting.take(lane), least_limit_s)
                running[task.id] = task
                runner.submit(task, lane)
        for outcome in runner.wait(HEARD_EVERY_S):
            ended = running.pop(outcome.id, None)
            if ended is None:
                continue  # it was begun twice, and is done
            if isinstance(outcome, NotDrawn):
                if outcome.how == "stopped":
                    _note(table, run, unchecked)
                    raise RenderError(outcome.error)
                if outcome.how == "died" and table.tried(outcome.id) < MOST_DEATHS:
                    waiting.put_back(outcome.id)
                    continue
                table.fail(outcome.id, outcome.error)
            else:
                unchecked.append(outcome)
            done += 1
            on_progress(TaskEnd(ended, outcome, done, total))
        if unchecked and (len(run.files) <= FEW_FILES or clock.monotonic() - looked > FILES_EVERY_S or not running):
            _note(table, run, unchecked)
            unchecked, looked = [], clock.monotonic()


def _note(table: TaskTable, run: PlannedRun, drawn: list[Drawn]) -> None:
    """Note what was drawn of a level that is still what it was."""
    if not run.unchanged:
        raise RenderError(
            f"{run.loaded.path}: the level, or a file that it is made of, has changed during the run; "
            f"what was drawn before that is kept, the same command goes on"
        )
    table.finish(drawn)
