"""A render process: it owns the one OpenGL context, takes jobs over a pipe and answers with values.

It is started by ``spawn`` and draws with ``render_frame`` like anyone else. It ends when its pipe is closed.
"""

from __future__ import annotations

import logging
import os
import signal
from collections import OrderedDict
from dataclasses import dataclass
from multiprocessing.connection import Connection

from morecantile import tms as matrix_sets

from api.jobs import Answer, Block, BlockJob, Failure, Job, LevelKey, PlanAnswer, Ready
from selector.rules import choose
from shadows.render import render_frame
from terrain.descriptor import describe
from terrain.errors import GraphicsError, RenderError, SkuggaError
from terrain.grid import BLOCK_PX, MapView, tile_grid
from terrain.level import load_level
from terrain.scene import Scene, build_scene

MAX_SCENES = 16
"""Levels that a process keeps open: an overview (some MB) and a file handle each."""

log = logging.getLogger("skugga.worker")


@dataclass(frozen=True)
class WorkerConfig:
    """What a render process is told at its start. ``gl_threads`` are the threads of a software rasteriser."""

    gl_threads: int
    expect_renderer: str | None = None


class Scenes:
    """The scenes used last, by level file; a level or raster that has changed is opened anew."""

    def __init__(self, limit: int = MAX_SCENES) -> None:
        self._limit = limit
        self._scenes: OrderedDict[str, tuple[str, Scene]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._scenes)

    def get(self, key: LevelKey) -> Scene:
        """The scene of a level at a version. Raises ``LevelError`` or ``SourceError``."""
        path = str(key.path)
        version, scene = self._scenes.pop(path, (None, None))
        if scene is not None and version != key.version:
            scene.elevation.close()
            scene = None
        if scene is None:
            scene = build_scene(load_level(key.path))
        self._scenes[path] = key.version, scene
        while len(self._scenes) > self._limit:
            _, (_, oldest) = self._scenes.popitem(last=False)
            oldest.elevation.close()
        return scene


def block_view(job: BlockJob) -> MapView:
    """The view of a block: its pixels are the tile matrix's own."""
    grid = tile_grid(matrix_sets.get(job.matrix_set), job.zoom)
    return MapView(grid, float(job.block_y * BLOCK_PX), float(job.block_x * BLOCK_PX), 1.0, 1.0, BLOCK_PX, BLOCK_PX)


def work(job: Job, scenes: Scenes, renderer: str) -> Block | PlanAnswer:
    """Do a job. Raises ``SkuggaError``."""
    scene = scenes.get(job.level).with_sun(job.sun)
    view = block_view(job) if isinstance(job, BlockJob) else scene.view(job.view)
    plan = choose(describe(scene, view), scene.loaded.level, job.overrides.for_selector())
    if not isinstance(job, BlockJob):
        return PlanAnswer(plan.model_dump_json())
    frame = render_frame(scene, view, plan)
    return Block(
        color=frame.color, visibility=frame.visibility, plan_json=plan.model_dump_json(), headline=plan.headline,
        passes=tuple((record.name, record.ms) for record in frame.passes),
        reach_used_m=frame.reach.used_m, reach_needed_m=frame.reach.needed_m, reach_clipped=bool(frame.reach.clipped),
        renderer=renderer,
    )  # fmt: skip


def worker_main(pipe: Connection, config: WorkerConfig) -> None:
    """Warm up, say so, then answer jobs until the pipe is closed or an error leaves OpenGL in doubt."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the service, which ends this process
    os.environ.setdefault("LP_NUM_THREADS", str(config.gl_threads))
    from api.warm_up import warm_up

    scenes = Scenes()
    try:
        renderer = warm_up(config.expect_renderer)
        pipe.send(Ready(renderer))
        while True:
            answer = _answer(pipe.recv(), scenes, renderer)
            pipe.send(answer)
            if isinstance(answer, Failure) and answer.fatal:
                return
    except SkuggaError as error:
        pipe.send(Failure.of(error, fatal=True))
    except (EOFError, OSError):
        return


def _answer(job: Job, scenes: Scenes, renderer: str) -> Answer:
    try:
        return work(job, scenes, renderer)
    except SkuggaError as error:
        return Failure.of(error, fatal=isinstance(error, GraphicsError))
    except Exception as error:  # a bug, or a driver's own exception: the job fails, and the process with it
        log.exception("a job failed unexpectedly")
        return Failure.of(RenderError(f"{type(error).__name__}: {error}"), fatal=True)
