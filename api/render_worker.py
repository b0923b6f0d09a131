"""A render process: it owns the one OpenGL context, takes jobs over a pipe and answers with values.

It is started by ``spawn`` and draws with ``render_frame`` like anyone else. It ends when its pipe is closed.
"""

from __future__ import annotations

import logging
import os
import signal
import time as clock
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from morecantile import tms as matrix_sets

from api.jobs import Answer, Block, BlockJob, Failure, Job, LevelKey, PlanAnswer, PlanJob, Ready, Result, Snapshot, SnapshotJob
from api.layers import encode_picture, picture_of
from selector.rules import choose
from shadows.render import render_frame
from terrain.descriptor import describe
from terrain.errors import GraphicsError, RenderError, SkuggaError
from terrain.grid import BLOCK_PX, MapView, tile_grid
from terrain.level import load_level
from terrain.scene import Scene, build_scene

MAX_SCENES = 16
"""Levels that a process keeps open: an overview (some MB), a file handle, trees and meshes (up to hundreds of MB) each."""

MAX_PROCESS_BYTES = 3 * 2**30
"""Memory of a process beyond which it keeps only the level that it draws; with a software rasteriser it takes about 1.5 GB."""

log = logging.getLogger("skugga.worker")


@dataclass(frozen=True)
class WorkerConfig:
    """What a render process is told at its start. ``gl_threads`` are the threads of a software rasteriser."""

    gl_threads: int
    expect_renderer: str | None = None


def resident_bytes() -> int:
    """Memory that this process takes now; 0 where the system has no ``/proc`` to say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


class Scenes:
    """The scenes used last, by level file; a level of which a file has changed is opened anew."""

    def __init__(self, limit: int = MAX_SCENES, process_bytes: Callable[[], int] = resident_bytes) -> None:
        self._limit = limit
        self._process_bytes = process_bytes
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
        limit = 1 if self._process_bytes() > MAX_PROCESS_BYTES else self._limit
        while len(self._scenes) > limit:
            _, (_, oldest) = self._scenes.popitem(last=False)
            oldest.elevation.close()
        return scene


def block_view(job: BlockJob) -> MapView:
    """The view of a block: its pixels are the tile matrix's own."""
    grid = tile_grid(matrix_sets.get(job.matrix_set), job.zoom)
    return MapView(grid, float(job.block_y * BLOCK_PX), float(job.block_x * BLOCK_PX), 1.0, 1.0, BLOCK_PX, BLOCK_PX)


def work(job: Job, scenes: Scenes, renderer: str) -> Result:
    """Do a job. Raises ``SkuggaError``."""
    scene = scenes.get(job.level).with_sun(job.sun)
    name = "map" if isinstance(job, BlockJob) else job.view
    if isinstance(job, BlockJob):
        view = block_view(job)
    elif isinstance(job, SnapshotJob):
        scene = scene.at_second(job.seconds)
        view = scene.view(name, size=job.size)
    else:
        view = scene.view(name)
    plan = choose(describe(scene, view, name), scene.loaded.level, job.overrides.for_selector())
    if isinstance(job, PlanJob):
        return PlanAnswer(plan.model_dump_json())
    frame = render_frame(scene, view, plan)
    facts = {
        "headline": plan.headline, "passes": tuple((record.name, record.ms) for record in frame.passes), "renderer": renderer,
        "reach_used_m": frame.reach.used_m, "reach_needed_m": frame.reach.needed_m, "reach_clipped": bool(frame.reach.clipped),
    }  # fmt: skip
    if isinstance(job, BlockJob):
        return Block(color=frame.color, visibility=frame.visibility, plan_json=plan.model_dump_json(), **facts)
    start = clock.perf_counter()
    body = encode_picture(picture_of(frame.under(job.light), job.layer), f".{job.format}")
    return Snapshot(body=body, encode_ms=(clock.perf_counter() - start) * 1000.0, **facts)


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
