"""``skugga seed``: options, the seeding run, and its progress messages."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast
from urllib.parse import parse_qsl

import typer
from rich import box
from rich.console import Console

from skugga.api.cli.common_options import check_has_style, read_style
from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.product_parameters import split_product_options
from skugga.api.cli.progress import ProgressLines
from skugga.api.cli.tables import table_with_names
from skugga.api.cli.times import TIME_PLACEHOLDER, paths_by_time, sun_from_options, suns_from_options
from skugga.api.matrices import ZoomRange
from skugga.api.products import product_named
from skugga.api.products.product import MapFormat
from skugga.api.request import ProductRequest, RequestedSettings
from skugga.api.seed.drawing import check_tile_format
from skugga.api.seed.local_pool import LocalPool, Runner
from skugga.api.seed.messages import TaskResult
from skugga.api.seed.planning import PlannedRun, SeedRequest, plan_run
from skugga.api.seed.publishing import check_output
from skugga.api.seed.running import TaskCompletion
from skugga.api.seed.seeding import SeedResult, draw_and_publish, requeue_lost_shards
from skugga.api.seed.storage import ShardStore, open_store
from skugga.api.seed.task_table import TaskTable
from skugga.api.workers.block_tiles import BLOCK_SIDE_TILES
from skugga.selector.formatting import format_duration
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import InputError
from skugga.terrain.level.algorithm_names import served_algorithms
from skugga.terrain.level.level import parse_algorithm
from skugga.terrain.level.level_source import LevelSource

if TYPE_CHECKING:
    from skugga.api.seed.dask_cluster import DaskCluster

TASK_TABLE_FILE_NAME = "tasks.sqlite"
LOG_FILE_NAME = "log.jsonl"

ASSUMED_TILE_BYTES = {"color": 84_000, "shadow": 13_000, "mask": 4_000, "terrain-rgb": 70_000, "terrarium": 70_000}
"""Assumed bytes of a PNG tile full of data, by layer, until tiles are measured. ``color`` was measured (docs/reports/scale.md)."""


@dataclass(frozen=True)
class SeedOptions:
    """The command's options, as the user wrote them. ``commands/seed.py`` explains them."""

    output: Path
    zooms: str | None
    layer: str
    format: str
    time: str | None
    times: str | None
    start: str | None
    end: str | None
    step: str | None
    azimuth: float | None
    altitude: float | None
    style: str | None
    slope_exaggeration: float | None
    sky: str | None
    workers: int | None
    scheduler: str | None
    work: Path | None
    shards: str | None
    dry_run: bool
    max_tasks: int | None
    retry_failed: bool
    task_timeout: float
    max_ms: float | None
    as_json: bool


def seed_level(level: LevelSource, options: SeedOptions, declared_options: dict[str, Any]) -> None:
    """Render a level's tiles in advance, or print a forecast (``dry_run``). Raises ``SkuggaError`` and ``OSError``."""
    check_tile_format(options.layer, options.format)
    if declared_options.get("algorithm") is not None:
        parse_algorithm(declared_options["algorithm"], "--algorithm", names=served_algorithms())
    sun = sun_from_options(options.time, options.azimuth, options.altitude)
    suns = tuple(suns_from_options(sun, options.times, options.start, options.end, options.step))
    if len(suns) > 1 and product_named(options.layer).when == "none":
        raise InputError("--layer", options.layer, "with several times, a layer that depends on the sun")
    paths = paths_by_time(options.output, suns)
    for path in paths:
        check_output(path)
    check_output_files(level, [("--output", path) for path in paths])
    level = level.model_copy(update={"path": level.path.resolve()})
    look = read_style(options.style, options.slope_exaggeration, options.sky)
    check_has_style(product_named(options.layer), options.style, options.slope_exaggeration, options.sky)
    layer_options, overrides = split_product_options(product_named(options.layer), declared_options)
    product_request = ProductRequest(
        product=options.layer, options=layer_options, overrides=RequestedSettings.of(overrides), **look
    )
    request = SeedRequest(level, _parse_zooms(options.zooms), suns, product_request, cast(MapFormat, options.format))
    work = options.work or options.output.with_name(options.output.name.replace(TIME_PLACEHOLDER, "times") + ".seed")
    store_address = options.shards or str(work.resolve() / "shards")
    store = open_store(store_address)
    if options.scheduler is not None and options.workers is not None:
        raise InputError.conflict("--workers", "--scheduler", "Leave out --workers: the cluster has its own")
    with TaskTable(work / TASK_TABLE_FILE_NAME) as table, _RunProgress(work / LOG_FILE_NAME, options.as_json) as progress:
        workers = _Workers(options)
        if table.get("spec") is None and not options.dry_run:
            workers.warm_up()  # in parallel with the planning of a new run, which has tasks
        try:
            run = plan_run(table, request, progress.print_status)
            outputs = dict(zip(run.sun_names, paths, strict=True))
            if options.dry_run:
                _print_forecast(table, run, store, options)
                return
            result = draw_and_publish(
                table, run, store, store_address, outputs, lambda: workers.prepare_run(run, store_address),
                progress.report_completion, options.max_tasks, options.retry_failed, options.task_timeout, options.max_ms,
            )  # fmt: skip
        finally:
            workers.close()
        progress.report_end(result, table)


class _Workers:
    """The local or cluster workers of a seeding run. They start and warm up before the run begins."""

    def __init__(self, options: SeedOptions) -> None:
        self._count, self._scheduler = options.workers or usable_cores(), options.scheduler
        self._idle_workers: LocalPool | DaskCluster | None = None

    def warm_up(self) -> None:
        """Start local or cluster workers. Raises ``InputError`` if the cluster cannot be reached."""
        if self._scheduler is None:
            self._idle_workers = LocalPool(self._count)
        else:
            from skugga.api.seed.dask_cluster import DaskCluster

            self._idle_workers = DaskCluster(self._scheduler)

    def prepare_run(self, run: PlannedRun, store_address: str) -> Runner:
        """Prepare the workers for a planned run, starting them if necessary, and return the ``Runner`` that draws its tasks."""
        if self._idle_workers is None:
            self.warm_up()
        assert self._idle_workers is not None
        runner = self._idle_workers.prepare_run(run.spec, store_address)
        self._idle_workers = None
        return runner

    def close(self) -> None:
        """Stop workers that were started but not handed to a run. A run stops its own workers."""
        if self._idle_workers is not None:
            self._idle_workers.close()


def _parse_zooms(text: str | None) -> ZoomRange | None:
    """Return the first and last zoom of ``--zooms``, such as ``8-13`` or ``8``; ``None`` without a text. Raises ``InputError``."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,2})(?:-(\d{1,2}))?", text.strip())
    if not match or int(match[1]) > int(match[2] or match[1]):
        raise InputError("--zooms", text, "one zoom or a range of two, the lower one first, such as 8-13")
    return ZoomRange(int(match[1]), int(match[2] or match[1]))


def _print_forecast(table: TaskTable, run: PlannedRun, store: ShardStore, options: SeedOptions) -> None:
    """Print the tasks that a run would draw: why they are drawn, and their expected time and size."""
    requeue_lost_shards(table, store)
    measured_costs = table.measured_costs()
    rows: list[dict[str, Any]] = []
    for sun, zoom, reason, count, full_tasks, seconds in table.waiting_totals():
        assumed_bytes = ASSUMED_TILE_BYTES.get(run.spec.layer, ASSUMED_TILE_BYTES["color"]) * min(4**zoom, BLOCK_SIDE_TILES**2)
        full_bytes = measured_costs[zoom][1] if zoom in measured_costs else assumed_bytes
        rows.append({
            "sun": sun, "zoom": zoom, "why": reason, "tasks": count, "seconds": round(seconds, 3),
            "bytes": int(full_tasks * full_bytes), "measured": zoom in measured_costs,
        })  # fmt: skip
    workers = options.workers or usable_cores()
    total = {name: sum(float(row[name]) for row in rows) for name in ("tasks", "seconds", "bytes")}
    counts = table.counts()
    if options.as_json:
        typer.echo(json.dumps({"rows": rows, "total": total, "workers": workers, "states": counts}, indent=2))
        return
    text_table = table_with_names("sun", "zoom", "why", box=box.SIMPLE_HEAD)
    for name in ("tasks", "worker time", "bytes"):
        text_table.add_column(name, justify="right")
    for row in rows:
        text_table.add_row(
            _format_sun_name(row["sun"]), str(row["zoom"]), row["why"], str(row["tasks"]),
            ("" if row["measured"] else "about ") + format_duration(1000.0 * row["seconds"]), _format_bytes(row["bytes"]),
        )  # fmt: skip
    console = Console(width=None if sys.stdout.isatty() else 160)
    if rows:
        console.print(text_table)
    wall_time_text = "" if options.scheduler else f", {format_duration(1000.0 * total['seconds'] / workers)} with {workers} workers"
    typer.echo(
        f"{total['tasks']:.0f} tasks would run: {format_duration(1000.0 * total['seconds'])} of worker time{wall_time_text}, "
        f"about {_format_bytes(total['bytes'])}. Done: {counts.get('done', 0)}, failed: {counts.get('failed', 0)}."
    )


def _format_sun_name(name: str) -> str:
    """Return the name of a sun in the task table, a query string, as a person reads it: ``azimuth 225, altitude 12``."""
    fields = parse_qsl(name)
    return ", ".join(value if key == "time" else f"{key} {float(value):g}" for key, value in fields) or "the level's"


def _format_bytes(byte_count: float) -> str:
    """Return a number of bytes as text with three significant digits and a decimal unit."""
    for unit in ("B", "kB", "MB", "GB"):
        if byte_count < 1000.0:
            return f"{byte_count:.3g} {unit}"
        byte_count /= 1000.0
    return f"{byte_count:.3g} TB"


class _RunProgress:
    """Progress of a seeding run: a line for each task, with a bar on a terminal. A log file gets the same as JSON lines."""

    def __init__(self, log_path: Path, is_quiet: bool) -> None:
        self._log_path, self._is_quiet = log_path, is_quiet
        self._lines = ProgressLines("Drawing")
        self._file: IO[str] | None = None

    def __enter__(self) -> _RunProgress:
        self._lines.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._lines.__exit__(*error)
        if self._file is not None:
            self._file.close()

    def print_status(self, text: str) -> None:
        """Print a step before the first task, on a terminal only."""
        self._lines.print_status(text)

    def report_completion(self, completion: TaskCompletion) -> None:
        """Report the end of a task."""
        task, outcome = completion.task, completion.outcome
        block_label = f"zoom {task.zoom} block {task.x},{task.y}"
        record: dict[str, Any] = {"task": task.id, "zoom": task.zoom, "x": task.x, "y": task.y, "sun": task.sun}
        if isinstance(outcome, TaskResult):
            record |= {
                "seconds": round(outcome.duration_s, 4), "encode_s": round(outcome.encode_s, 4), "bytes": outcome.nbytes,
                "peak_bytes": outcome.peak_bytes, "worker": outcome.worker,
            }  # fmt: skip
            text = f"{outcome.duration_s:.2f} s, {_format_bytes(outcome.nbytes)}, worker's peak {_format_bytes(outcome.peak_bytes)}"
        else:
            record |= {"error": outcome.error}
            text = f"failed: {outcome.error}"
        record |= {"done": completion.done_count, "total": completion.total_count}
        self._write_record(record)
        self._print_line(f"[{completion.done_count}/{completion.total_count}] {block_label}: {text}", completion)

    def report_end(self, seed_result: SeedResult, table: TaskTable) -> None:
        """Report the end of the run."""
        counts = table.counts()
        record = {
            "drawn": seed_result.drawn_count, "tasks": sum(counts.values()),
            "written": [str(path) for path in seed_result.written_paths],
            "drawing_s": round(seed_result.drawing_s, 3), "publishing_s": round(seed_result.publishing_s, 3),
        }  # fmt: skip
        self._write_record(record)
        if self._is_quiet:
            typer.echo(json.dumps(record, indent=2))
            return
        for path in seed_result.written_paths:
            typer.echo(f"Wrote {path}.")
        if not seed_result.written_paths:
            typer.echo(f"Nothing to do: all {record['tasks']} tasks are done, and the output is up to date.")

    def _write_record(self, record: dict[str, Any]) -> None:
        """Append a record to the log file as one line of JSON. The first record opens the file."""
        if self._file is None:
            self._file = self._log_path.open("a", encoding="utf-8")
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()

    def _print_line(self, text: str, completion: TaskCompletion) -> None:
        """Print a line about a finished task and advance the bar, unless the output is quiet."""
        if not self._is_quiet:
            self._lines.print_line(text)
            self._lines.advance(completion.done_count, completion.total_count)
