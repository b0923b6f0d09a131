"""Test runs of seeding: a level, its task table, and a runner that draws in the test's own process."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from skugga.api.matrices import ZoomRange
from skugga.api.request import ProductRequest, RequestedSettings
from skugga.api.seed.drawing import TaskDrawer
from skugga.api.seed.messages import Task, TaskFailure, TaskResult
from skugga.api.seed.planning import PlannedRun, SeedRequest, plan_run
from skugga.api.seed.running import TaskCompletion
from skugga.api.seed.seeding import SeedResult, draw_and_publish
from skugga.api.seed.storage import FolderStore
from skugga.api.seed.task_table import TaskTable
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from tests.rasters import write_geotiff

LOW_SUN = SunSpec(azimuth=225.0, altitude=12.0)

FailureInjector = Callable[[Task], TaskFailure | None]


def rough_ground(cells: int, seed: int = 3) -> np.ndarray:
    """Return ridges and noise of some hundred metres, float32 (cells, cells)."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:cells, :cells]
    ridges = 200.0 * np.sin(row / 17.0) * np.cos(col / 23.0) + 80.0 * np.sin((row + 2 * col) / 7.0)
    return (600.0 + ridges + rng.normal(0.0, 4.0, (cells, cells))).astype(np.float32)


def write_ground(path: Path, heights: np.ndarray) -> Path:
    """Write ground with cells of 30 m in a UTM zone."""
    return write_geotiff(path, heights, "EPSG:32633", 500e3, 5200e3, 30.0)


class InProcessRunner:
    """Runner that draws in this process, one task at a time. ``inject_failure`` may replace the result of a task."""

    def __init__(self, run: PlannedRun, store: FolderStore, inject_failure: FailureInjector | None = None) -> None:
        self._drawer, self._inject_failure = TaskDrawer(run.spec, store), inject_failure
        self._queue: deque[Task] = deque()
        self.drawn: list[Task] = []

    def free_worker_queues(self) -> Sequence[int]:
        return [0] * (2 - len(self._queue))

    def submit(self, task: Task, worker_queue: int) -> None:
        self._queue.append(task)

    def wait(self, timeout_s: float) -> Sequence[TaskResult | TaskFailure]:
        task = self._queue.popleft()
        if self._inject_failure is not None and (failure := self._inject_failure(task)) is not None:
            return [failure]
        self.drawn.append(task)
        return [self._drawer.draw(task)]

    def close(self) -> None:
        self._drawer.close()


@dataclass
class Run:
    """``skugga seed`` without its command: a level's tiles, an output, and a work folder beside it."""

    level: Path
    output: Path
    zooms: tuple[int, int]
    layer: str = "shadow"
    suns: tuple[SunSpec | None, ...] = (LOW_SUN,)
    settings: dict[str, object] = field(default_factory=dict)
    style: dict[str, object] = field(default_factory=dict)

    @property
    def store(self) -> FolderStore:
        """The store of the run's shards."""
        return FolderStore(self.work / "shards")

    @property
    def work(self) -> Path:
        """Folder of the run's tasks and shards."""
        return self.output.with_name(self.output.name + ".seed")

    @property
    def request(self) -> SeedRequest:
        """The request that the run answers."""
        source = LevelSource(path=self.level.resolve())
        product_request = ProductRequest(product=self.layer, overrides=RequestedSettings.of(self.settings), **self.style)
        return SeedRequest(source, ZoomRange(*self.zooms), self.suns, product_request, "png")

    def __call__(self, inject_failure: FailureInjector | None = None, **options: object) -> tuple[SeedResult, list[Task]]:
        """Seed, and return the result and the tasks that were drawn."""
        runners: list[InProcessRunner] = []
        with TaskTable(self.work / "tasks.sqlite") as table:
            run = plan_run(table, self.request, lambda text: None)

            def start() -> InProcessRunner:
                runners.append(InProcessRunner(run, self.store, inject_failure))
                return runners[-1]

            outputs = {name: self.output_of(number) for number, name in enumerate(run.sun_names)}
            result = draw_and_publish(
                table, run, self.store, str(self.work / "shards"), outputs, start, self.on_progress, **options
            )
        return result, [task for runner in runners for task in runner.drawn]

    def output_of(self, number: int) -> Path:
        """Return the output of one of several suns."""
        return self.output if len(self.suns) == 1 else self.output.with_stem(f"{self.output.stem}-{number}")

    def on_progress(self, progress: TaskCompletion) -> None:
        """Show nothing."""
