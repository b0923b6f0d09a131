"""Cost of large pyramids from measured figures, and a simulation of many workers.

    python -m benchmarks.scale measure DATA [--json FILE]    # rates of coordinator, Dask, packing; times of tasks
    python -m benchmarks.scale tell FILE [--workers 1000] [--money 0.04]

``measure`` draws a mosaic of a real raster with one worker (``benchmarks.seed``). It then measures the rates of the serial parts:
the coordinator and its table of tasks with empty tasks, Dask with empty tasks on a local cluster, and the packing of tiles into an
archive.

``tell`` prints the tables of docs/reports/scale.md from these figures: hours and bytes for a country and for the planet, and costs
by the price of a core hour (``--money``). It also simulates a run of many workers task by task from the measured times. Some
workers are slow, and some die.
"""

from __future__ import annotations

import argparse
import heapq
import json
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.seed import SUN_OPTIONS, dask_cluster, write_mosaic
from skugga.api.matrices import ZoomRange
from skugga.api.seed.archive import ArchiveMetadata, ShardIndex, write_archive
from skugga.api.seed.messages import Task, TaskResult
from skugga.api.seed.planning import PlannedRun, SeedRequest, plan_run
from skugga.api.seed.running import run_tasks
from skugga.api.seed.storage import FolderStore
from skugga.api.seed.task_table import TaskTable
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec

TILES_PER_BLOCK = 16
"""Number of tiles of a whole block, which is one task."""

EARTH_EQUATOR_M = 40_075_016.7
"""Length of the equator."""


@dataclass(frozen=True)
class ScaleFigures:
    """Figures of one machine.

    Attributes
    ----------
    tasks
        Zoom, seconds, tiles and bytes of each task.
    peak_bytes
        Peak memory of a worker, bytes.
    coordinator_per_s
        Tasks per second that the coordinator dispatches and records.
    dask_per_s
        Tasks per second that Dask dispatches and records.
    packing_bytes_per_s, packing_tiles_per_s
        Bytes and tiles per second that are packed into an archive.
    """

    tasks: list[tuple[int, float, int, int]]
    peak_bytes: int
    coordinator_per_s: float
    dask_per_s: float
    packing_bytes_per_s: float
    packing_tiles_per_s: float


@dataclass(frozen=True)
class PyramidArea:
    """A pyramid to draw.

    Attributes
    ----------
    name
        Name of the area and size of its cells.
    area_km2
        Its area in square kilometres.
    latitude_deg
        Its mean latitude.
    cell_m
        Side of the raster's cells, metres.
    """

    name: str
    area_km2: float
    latitude_deg: float
    cell_m: float

    @property
    def last_zoom(self) -> int:
        """The last zoom, whose pixels are nearest in size to the raster's cells."""
        return int(np.rint(np.log2(EARTH_EQUATOR_M * np.cos(np.radians(self.latitude_deg)) / 256.0 / self.cell_m)))

    @property
    def tile_count(self) -> float:
        """Number of tiles of the last zoom and of all lower zooms, which add a third."""
        side_m = EARTH_EQUATOR_M * np.cos(np.radians(self.latitude_deg)) / 2**self.last_zoom
        return float(4.0 / 3.0 * self.area_km2 * 1e6 / side_m**2)


PYRAMID_AREAS = (
    PyramidArea("Switzerland at 10 m", 41_285.0, 46.8, 10.0),
    PyramidArea("Norway at 10 m", 323_800.0, 65.0, 10.0),
    PyramidArea("all land but Antarctica at 30 m", 134_600_000.0, 30.0, 30.0),
)
"""Areas of the tables, from small to large."""

TIMES_PER_DAY = 24
"""Number of times of a day for which the tables count the tiles of an area."""


class NoOpRunner:
    """A ``Runner`` whose tasks do nothing, so that only the coordinator takes time."""

    def __init__(self) -> None:
        self._submitted: deque[Task] = deque()

    def free_worker_queues(self) -> Sequence[int]:
        """Implement ``Runner.free_worker_queues``."""
        return [0] * (2000 - len(self._submitted))

    def submit(self, task: Task, lane: int) -> None:
        """Implement ``Runner.submit``."""
        self._submitted.append(task)

    def wait(self, timeout_s: float) -> Sequence[TaskResult]:
        """Implement ``Runner.wait``. It returns one task at a time, as workers finish one by one."""
        task = self._submitted.popleft()
        index, _ = ShardIndex.from_tiles({4**12 + 16 * task.id + i: b"tile" for i in range(16)})
        return [TaskResult(task.id, index.to_bytes(), 64, 1.0, 0.1, 0)]

    def close(self) -> None:
        """Implement ``Runner.close``."""


def pending_tasks(folder: Path, raster: Path, zooms: tuple[int, int]) -> tuple[TaskTable, PlannedRun]:
    """Plan a run over a raster. Return the table of its waiting tasks, and the run.

    ``zooms`` are the first and the last zoom. The table's file is written into ``folder``.
    """
    table = TaskTable(folder / "idle" / "tasks.sqlite")
    request = SeedRequest(LevelSource(path=raster), ZoomRange(*zooms), (SunSpec(azimuth=225.0, altitude=20.0),), "color", "png")
    return table, plan_run(table, request, lambda text: None)


def measure_coordinator_per_s(folder: Path, raster: Path) -> float:
    """Return the number of tasks per second that the coordinator dispatches and records."""
    table, run = pending_tasks(folder, raster, (8, 15))
    with table:
        count = len(table.waiting_tasks())
        start = time.perf_counter()
        run_tasks(table, run, NoOpRunner(), lambda end: None)
        return count / (time.perf_counter() - start)


def measure_dask_per_s(folder: Path, tasks: int = 2000) -> float:
    """Return the number of tasks without work per second on a Dask cluster with one worker.

    ``tasks`` is their number. Two tasks are pending at a time, as in ``DaskCluster``.
    """
    import distributed

    index = bytes(448)
    with dask_cluster(folder, 1) as address, distributed.Client(address) as client:
        client.submit(_no_op, -1, index, pure=False).result()
        start = time.perf_counter()
        waiting_tasks = deque(range(tasks))
        running = [client.submit(_no_op, waiting_tasks.popleft(), index, pure=False) for _ in range(20)]
        completed = distributed.as_completed(running)
        for future in completed:
            future.result()
            if waiting_tasks:
                completed.add(client.submit(_no_op, waiting_tasks.popleft(), index, pure=False))
        return tasks / (time.perf_counter() - start)


def _no_op(number: int, index: bytes) -> TaskResult:
    """Return the result of a task that draws nothing. ``number`` is the task's, ``index`` the encoded index of its tiles."""
    return TaskResult(number, index, 0, 0.0, 0.0, 0)


def measure_packing(folder: Path, tiles: int = 200_000, tile_bytes: int = 20_000) -> tuple[float, float]:
    """Return the bytes per second and the tiles per second of packing ``tiles`` tiles of ``tile_bytes`` bytes into an archive."""
    body = np.random.default_rng(1).bytes(tile_bytes - 8)
    store, indexes, first = FolderStore(folder / "pack"), [], (4**12 - 1) // 3
    for number in range(tiles // TILES_PER_BLOCK):
        ids = range(first + number * 16, first + number * 16 + 16)
        index, content = ShardIndex.from_tiles({tile_id: body + tile_id.to_bytes(8, "big") for tile_id in ids})
        store.write(f"{number % 256:02x}/{number}", content)
        indexes.append(index)
    start = time.perf_counter()
    facts = ArchiveMetadata("png", (0.0, 0.0, 1.0, 1.0), 12, 12, {})
    write_archive(folder / "packed.pmtiles", indexes, lambda i: store.read(f"{i % 256:02x}/{i}"), facts)
    elapsed_s = time.perf_counter() - start
    return tiles * tile_bytes / elapsed_s, tiles / elapsed_s


def measure(data: Path) -> ScaleFigures:
    """Draw a mosaic with one worker, and measure the rates of the serial parts. ``data`` is the folder of sample rasters."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raster, output = folder / "mosaic.tif", folder / "out.pmtiles"
        write_mosaic(data / "mountain" / "bigtujunga_30m_utm11.tif", 6, raster)
        command = [
            sys.executable,
            "-c",
            "from skugga.api.cli.main import main; main()",
            "seed",
            str(raster),
            "--zooms",
            "8-13",
            *SUN_OPTIONS,
        ]
        subprocess.run([*command, "-o", str(output), "--workers", "1", "--json"], check=True, stdout=subprocess.DEVNULL)
        log = [json.loads(line) for line in (Path(f"{output}.seed") / "log.jsonl").read_text(encoding="utf-8").splitlines()]
        finished = [entry for entry in log if "seconds" in entry]
        with TaskTable(Path(f"{output}.seed") / "tasks.sqlite") as table:
            counts = {
                number: len(ShardIndex.from_bytes(index).ids)
                for number, _, index in table.finished_tasks("azimuth=225.0&altitude=20.0")
            }
        tasks = [(entry["zoom"], entry["seconds"], counts[entry["task"]], entry["bytes"]) for entry in finished]
        bytes_per_s, tiles_per_s = measure_packing(folder)
        return ScaleFigures(
            tasks, max(entry["peak_bytes"] for entry in finished), measure_coordinator_per_s(folder, raster),
            measure_dask_per_s(folder),
            bytes_per_s, tiles_per_s,
        )  # fmt: skip


@dataclass(frozen=True)
class SimulatedRun:
    """Result of a simulated run of many workers.

    Attributes
    ----------
    hours
        Duration of the run, hours.
    busy_share
        Share of the workers' time that they draw.
    lost_tasks
        Number of tasks that were lost because their worker died.
    """

    hours: float
    busy_share: float
    lost_tasks: int


def simulate(
    task_s: np.ndarray, task_count: int, workers: int, dispatches_per_s: float, slow_share: float, slow_factor: float,
    deaths_per_hour: float,
    longest_first: bool = True, seed: int = 1,
) -> SimulatedRun:  # fmt: skip
    """Simulate ``workers`` workers that run ``task_count`` tasks, whose times are drawn from the measured seconds ``task_s`` (n,).

    ``slow_share`` of the workers are slower by ``slow_factor``. A worker dies ``deaths_per_hour`` times an hour on average, loses
    its task, and restarts after a minute. The coordinator dispatches at most ``dispatches_per_s`` tasks per second. With
    ``longest_first`` it dispatches long tasks first.
    """
    rng = np.random.default_rng(seed)
    times = rng.choice(task_s, task_count)
    if longest_first:
        times = np.sort(times)[::-1]
    waiting_times = deque(times.tolist())
    slower = np.where(rng.random(workers) < slow_share, slow_factor, 1.0)
    free = [(0.0, worker) for worker in range(workers)]
    heapq.heapify(free)
    coordinator, end, busy, lost_count = 0.0, 0.0, 0.0, 0
    while waiting_times:
        at, worker = heapq.heappop(free)
        coordinator = max(coordinator, at) + 1.0 / dispatches_per_s
        duration_s = waiting_times.popleft() * slower[worker]
        dies = rng.exponential(3600.0 / deaths_per_hour) if deaths_per_hour else np.inf
        if dies < duration_s:
            lost_count += 1
            waiting_times.append(duration_s / slower[worker])
            heapq.heappush(free, (coordinator + dies + 60.0, worker))
            continue
        busy += duration_s
        end = max(end, coordinator + duration_s)
        heapq.heappush(free, (coordinator + duration_s, worker))
    return SimulatedRun(end / 3600.0, busy / (end * workers), lost_count)


def print_tables(figures: ScaleFigures, workers: int, core_hour_price: float) -> None:
    """Print the tables of docs/reports/scale.md. ``workers`` is the number of simulated workers."""
    seconds = np.array([task[1] for task in figures.tasks])
    tiles = sum(task[2] for task in figures.tasks)
    rate, tile_bytes = tiles / seconds.sum(), sum(task[3] for task in figures.tasks) / tiles
    full = np.array([task[1] for task in figures.tasks if task[2] == TILES_PER_BLOCK])
    print(f"tiles per second and core: {rate:.0f}; bytes per tile: {tile_bytes:.0f}; ", end="")
    print(f"peak memory of a worker: {figures.peak_bytes / 2**20:.0f} MiB")
    print(
        f"seconds of a task of {TILES_PER_BLOCK} tiles: median {np.median(full):.3f}, "
        f"95th percentile {np.quantile(full, 0.95):.3f}, maximum {full.max():.3f}"
    )
    print(f"tasks per second: coordinator {figures.coordinator_per_s:.0f}, Dask {figures.dask_per_s:.0f}; ", end="")
    print(f"packing: {figures.packing_bytes_per_s / 1e6:.0f} MB and {figures.packing_tiles_per_s:.0f} tiles per second\n")
    print(f"| place | last zoom | tiles, {TIMES_PER_DAY} times | core hours | bytes | money | packing, one disk |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for place in PYRAMID_AREAS:
        count = place.tile_count * TIMES_PER_DAY
        hours = count / rate / 3600.0
        packing_h = max(count * tile_bytes / figures.packing_bytes_per_s, count / figures.packing_tiles_per_s) / 3600.0
        size = count * tile_bytes / 1e9
        print(
            f"| {place.name} | {place.last_zoom} | {count / 1e6:,.1f} million | {_format_number(hours)} | "
            f"{_format_number(size)} GB | {_format_number(hours * core_hour_price)} | {_format_number(packing_h)} h |"
        )
    tasks = int(PYRAMID_AREAS[-1].tile_count * TIMES_PER_DAY / TILES_PER_BLOCK)
    print(f"\n{PYRAMID_AREAS[-1].name}, {TIMES_PER_DAY} times: {tasks} tasks of {TILES_PER_BLOCK} tiles, {workers} workers\n")
    print("| | minutes | workers' time that is drawing | tasks lost |\n| --- | --- | --- | --- |")
    for name, per_s, slow, deaths, heaviest in (
        ("as measured, no coordinator's limit", 1e9, 0.0, 0.0, True),
        ("the coordinator alone", figures.coordinator_per_s, 0.0, 0.0, True),
        ("by Dask", figures.dask_per_s, 0.0, 0.0, True),
        ("1 in 100 workers takes five times as long", figures.coordinator_per_s, 0.01, 0.0, True),
        ("and each dies once in 10 hours", figures.coordinator_per_s, 0.01, 0.1, True),
        ("the same, tasks in any order", figures.coordinator_per_s, 0.01, 0.1, False),
    ):
        run = simulate(seconds, tasks, workers, per_s, slow, 5.0, deaths, heaviest)
        print(f"| {name} | {60.0 * run.hours:.1f} | {run.busy_share:.0%} | {run.lost_tasks} |")


def _format_number(value: float) -> str:
    """Format a number with two significant digits, or as a whole number."""
    return f"{value:,.0f}" if value >= 10.0 else f"{value:.2g}"


def main() -> None:
    """Measure, or print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure")
    measuring.add_argument("data", type=Path)
    measuring.add_argument("--json", type=Path, default=Path("scale.json"))
    telling = commands.add_parser("tell")
    telling.add_argument("file", type=Path)
    telling.add_argument("--workers", type=int, default=1000)
    telling.add_argument("--money", type=float, default=0.04)
    args = parser.parse_args()
    if args.command == "measure":
        args.json.write_text(json.dumps(asdict(measure(args.data)), indent=1) + "\n", encoding="utf-8")
    else:
        print_tables(ScaleFigures(**json.loads(args.file.read_text(encoding="utf-8"))), args.workers, args.money)


if __name__ == "__main__":
    main()
