"""Run ``skugga seed`` as a whole: plan, draw and publish, without any output to the terminal."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from skugga.api.errors import BrokenShardError
from skugga.api.picture_cost import MAX_MS_OPTION, check_cost, limit_or_service_limit_ms
from skugga.api.seed.local_pool import Runner
from skugga.api.seed.messages import MIN_TASK_TIMEOUT_S
from skugga.api.seed.planning import PlannedRun
from skugga.api.seed.publishing import publish
from skugga.api.seed.running import TaskCompletion, run_tasks, shard_name
from skugga.api.seed.storage import ShardStore, check_writable
from skugga.api.seed.task_table import SHARD_LOST_REASON, TaskTable
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.errors import InputError, RenderError

MAX_PUBLISH_ATTEMPTS = 5
"""Maximum number of attempts to publish, with broken shards drawn again in between."""

FAILED_TASKS_FILE_NAME = "failed.txt"


@dataclass(frozen=True)
class SeedResult:
    """The result of a run.

    Attributes
    ----------
    drawn_count : int
        Number of tasks drawn by this run.
    written_paths : list of Path
        Written outputs.
    drawing_s, publishing_s : float
        Duration of drawing, including the start of workers, and of writing, in seconds.
    """

    drawn_count: int
    written_paths: list[Path]
    drawing_s: float
    publishing_s: float


def requeue_lost_shards(table: TaskTable, store: ShardStore) -> None:
    """Queue tasks again that are done but whose shards are missing in the store."""
    existing = store.names()
    table.retry([number for number, key in table.tasks_with_shards() if shard_name(key) not in existing], SHARD_LOST_REASON)


def draw_and_publish(
    table: TaskTable,
    run: PlannedRun,
    store: ShardStore,
    store_address: str,
    outputs: Mapping[str, Path],
    start_runner: Callable[[], Runner],
    on_progress: Callable[[TaskCompletion], None],
    max_tasks: int | None = None,
    retry_failed: bool = False,
    min_timeout_s: float = MIN_TASK_TIMEOUT_S,
    max_ms: float | None = None,
) -> SeedResult:
    """Draw all waiting tasks, and write the outputs if none failed.

    ``store_address`` is the folder or address of ``store``. ``outputs`` has the paths of outputs by names of suns.
    ``start_runner`` starts the workers, and ``on_progress`` is called after each task. ``retry_failed`` queues failed tasks
    again. ``min_timeout_s`` is that of ``run_tasks``.

    Raises ``InputError`` if more than ``max_tasks`` would run, ``TooCostlyError`` if a block is expected to take longer than
    ``max_ms`` (default: the time limit of a service), ``RenderError`` if tasks failed, and the errors of ``run_tasks``.
    """
    requeue_lost_shards(table, store)
    if retry_failed:
        table.retry(table.failed_tasks())
    waiting_count = len(table.waiting_tasks())
    if max_tasks is not None and waiting_count > max_tasks:
        raise InputError.over_limit(
            "--max-tasks", f"{waiting_count} tasks", str(max_tasks), "Raise the limit, or use --dry-run to list the tasks"
        )
    _check_costs(table, run, max_ms)
    if waiting_count:
        check_writable(store, store_address)
    drawn_count, drawing_s = 0, 0.0
    for _ in range(MAX_PUBLISH_ATTEMPTS):
        begin = clock.perf_counter()
        drawn_count += _draw(table, run, start_runner, on_progress, min_timeout_s)
        _report_failed_tasks(table)
        drawn_at = clock.perf_counter()
        drawing_s += drawn_at - begin
        try:
            written_outputs = publish(table, run, store, outputs)
        except BrokenShardError:
            continue
        delete_unused_shards(table, store)
        return SeedResult(drawn_count, written_outputs, drawing_s, clock.perf_counter() - drawn_at)
    raise RenderError(f"{store_address}: shards are missing or corrupt right after they are written. Check the store.")


def _check_costs(table: TaskTable, run: PlannedRun, max_ms: float | None) -> None:
    """Raise ``TooCostlyError`` if a block of a zoom with waiting tasks is expected to take longer than ``max_ms``, milliseconds.

    Without ``max_ms`` the time limit of a service applies.
    """
    zooms_with_tasks = {(sun, zoom) for sun, zoom, *_ in table.waiting_totals()}
    for planned in run.spec.plans:
        if (run.sun_names[planned.sun], planned.zoom) in zooms_with_tasks:
            subject = f"a block of zoom {planned.zoom}"
            check_cost(planned.parsed_plan, subject, limit_or_service_limit_ms(max_ms), MAX_MS_OPTION, has_free_size=False)


def delete_unused_shards(table: TaskTable, store: ShardStore) -> None:
    """Delete shards that belong to no task of the table."""
    store.delete(store.names() - {shard_name(key) for key in table.keys()})


def _draw(
    table: TaskTable,
    run: PlannedRun,
    start_runner: Callable[[], Runner],
    on_progress: Callable[[TaskCompletion], None],
    min_timeout_s: float,
) -> int:
    """Draw all waiting tasks with the workers that ``start_runner`` returns, and return their number.

    No workers start without tasks.
    """
    waiting_count = len(table.waiting_tasks())
    if waiting_count:
        runner = start_runner()
        try:
            run_tasks(table, run, runner, on_progress, min_timeout_s)
        finally:
            runner.close()
    return waiting_count


def _report_failed_tasks(table: TaskTable) -> None:
    """Write the list of failed tasks. Raises ``RenderError`` if any failed."""
    failed_tasks, path = table.failed_tasks(), table.folder / FAILED_TASKS_FILE_NAME
    if not failed_tasks:
        path.unlink(missing_ok=True)
        return
    lines = [
        f"zoom {failed_task.zoom} block {failed_task.x},{failed_task.y} {failed_task.sun}: {failed_task.error}".replace("\n", " ")
        for failed_task in failed_tasks.values()
    ]
    write_atomically(path, "\n".join(lines) + "\n")
    count = table.counts()
    raise RenderError(
        f"{len(failed_tasks)} of {sum(count.values())} tasks failed, so nothing was published. See {path}, or use --retry-failed "
        f"to run them again. First failure: {lines[0]}"
    )
