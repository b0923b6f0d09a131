"""Fake render processes that draw nothing. A job's view or tile tells them what to do, so that tests control their behaviour."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Semaphore

import numpy as np

from skugga.api.workers.block_tiles import BLOCK_SIDE_TILES
from skugga.api.workers.jobs import (
    BlockJob,
    BlockTiles,
    Failure,
    FilmCheckJob,
    FilmCheckResult,
    FilmPicture,
    FilmPlanState,
    FrameJob,
    HeartbeatRequest,
    HeartbeatResponse,
    PlanJob,
    PlanResult,
    PreparationProgress,
    WorkerReady,
)
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.worker_config import WorkerConfig
from skugga.selector.map_probes import MapClass
from skugga.terrain.errors import GraphicsError, InputError, RenderError

RENDERER, VERSION = "fake", "1"
UNPROBED_CLASS = MapClass(4, -1)
FILM_ROWS, FILM_COLS = 4, 6
TILE_POSITIONS = [(row, col) for row in range(BLOCK_SIDE_TILES) for col in range(BLOCK_SIDE_TILES)]


def scripted(
    pipe: Connection,
    config: WorkerConfig,
    job_started: Semaphore | None = None,
    may_finish: Semaphore | None = None,
    command_for_all: str | None = None,
) -> None:
    """Answer at once. If ``may_finish`` is given, signal ``job_started`` for each job and wait for ``may_finish``.

    The view of a plan is a command, unless ``command_for_all`` is the command for all jobs. Commands are ``crash``, ``hang``,
    ``refuse`` (wrong input), ``fail`` and ``break_opengl`` (an OpenGL error, after which the process is replaced).
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe.send(WorkerReady(RENDERER))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if isinstance(job, HeartbeatRequest):
            pipe.send(HeartbeatResponse())
            continue
        if job_started is not None:
            job_started.release()
        if may_finish is not None:
            may_finish.acquire()
        command = command_for_all or "draw" if isinstance(job, BlockJob) else getattr(job, "view", "described")
        if command == "crash":
            os._exit(9)
        if command == "hang":
            signal.pause()
        pipe.send(_answer(command))


def planning(
    pipe: Connection, config: WorkerConfig, job_started: Semaphore | None = None, may_finish: Semaphore | None = None
) -> None:
    """Answer with the version of the measurements that plans use.

    A plan has the name of its policy, a tile the version of its plans. With a calibration, a tile reports a missing probe
    until its level has one. Gated like ``scripted``.
    """
    measurements = config.measurements or PlanMeasurements()
    pipe.send(WorkerReady(RENDERER, measurements.device, VERSION))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if isinstance(job, HeartbeatRequest):
            pipe.send(HeartbeatResponse())
            continue
        if isinstance(job, PlanMeasurements):
            measurements = job
            continue
        if job_started is not None:
            job_started.release()
        if may_finish is not None:
            may_finish.acquire()
        if isinstance(job, PlanJob):
            pipe.send(PlanResult(f'{{"policy": "{"rules" if measurements.device is None else "predict"}"}}'))
        else:
            version = measurements.version_of(job.level)
            unprobed_class = None if measurements.device is None or measurements.probes_of(job.level).classes else UNPROBED_CLASS
            tiles = dict.fromkeys(TILE_POSITIONS, version.encode())
            pipe.send(replace(_answer("draw"), tiles=tiles, plan_version=version, unprobed_class=unprobed_class))


def filming(
    pipe: Connection,
    config: WorkerConfig,
    job_started: Semaphore | None = None,
    may_finish: Semaphore | None = None,
    commands: tuple[tuple[int, str], ...] = (),
) -> None:
    """Draw frames that hold the number of frames planned one after the other. Answer all other jobs like ``scripted``.

    Gated like ``scripted``, except that film checks are answered at once. ``commands`` are pairs of frame number and command:
    ``crash``, ``fail``.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe.send(WorkerReady(RENDERER))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if isinstance(job, HeartbeatRequest):
            pipe.send(HeartbeatResponse())
            continue
        if isinstance(job, FilmCheckJob):
            failure = Failure.from_error(
                InputError("path, frame 2 (60 s): eye", "3 m under the ground", "a camera above the ground")
            )
            pipe.send(failure if job.view == "refuse" else FilmCheckResult(1500.0))
            continue
        if job_started is not None:
            job_started.release()
        if may_finish is not None:
            may_finish.acquire()
        if not isinstance(job, FrameJob):
            pipe.send(_answer("draw"))
            continue
        command = dict(commands).get(job.frame_number)
        if command == "crash":
            os._exit(9)
        planned = 1 if job.previous_plan_state is None else job.previous_plan_state.state + 1
        picture = FilmPicture(np.full((FILM_ROWS, FILM_COLS, 3), planned, np.uint8), FilmPlanState(planned))  # type: ignore[arg-type]
        pipe.send(picture if command is None else _answer(command))


def hanging(pipe: Connection, config: WorkerConfig) -> None:
    """Never return from a job."""
    pipe.send(WorkerReady(RENDERER))
    pipe.recv()
    signal.pause()


def failing_at_start(pipe: Connection, config: WorkerConfig) -> None:
    """Fail to start."""
    pipe.send(Failure.from_error(GraphicsError("libEGL at /secret/place is broken"), is_fatal=True))


def compiling(
    pipe: Connection,
    config: WorkerConfig,
    may_finish: Semaphore | None = None,
    steps: int = 0,
    step_s: float = 0.0,
    missing: int = 0,
) -> None:
    """Report compilation before the process is ready, until ``may_finish``, and in some steps before each job.

    ``missing`` loops remain to be compiled.
    """
    pipe.send(PreparationProgress("compiling loops for map tiles", 3, 9))
    if may_finish is not None:
        may_finish.acquire()
    pipe.send(WorkerReady(RENDERER, missing_loop_count=missing))
    while True:
        try:
            pipe.recv()
        except EOFError:
            return
        for step in range(steps):
            pipe.send(PreparationProgress("compiling loops for points", step, steps))
            time.sleep(step_s)
        pipe.send(_answer("draw"))


def exiting_at_start(pipe: Connection, config: WorkerConfig) -> None:
    """End the process during its start."""
    os._exit(9)


def never_ready(pipe: Connection, config: WorkerConfig) -> None:
    """Never finish the warm-up."""
    signal.pause()


def leaking_errors(pipe: Connection, config: WorkerConfig) -> None:
    """Fail with a message that must not reach clients."""
    pipe.send(WorkerReady(RENDERER))
    while True:
        try:
            pipe.recv()
        except EOFError:
            return
        pipe.send(Failure.from_error(RenderError("/secret/place/dem.tif: a part of the raster cannot be read")))


def _answer(command: str) -> BlockTiles | PlanResult | Failure:
    """Return the answer of a render process to a command.

    A command is ``draw``, ``refuse``, ``fail``, ``break_opengl``, or the name of a view to plan.
    """
    if command == "refuse":
        return Failure.from_error(InputError("view", command, "another command"))
    if command == "fail":
        return Failure.from_error(RenderError("it went wrong"))
    if command == "break_opengl":
        return Failure.from_error(GraphicsError("OpenGL left an error behind"), is_fatal=True)
    if command != "draw":
        return PlanResult(f'{{"view": "{command}"}}')
    return BlockTiles(dict.fromkeys(TILE_POSITIONS, b"tile"), 0.0, "none", (("geometry", 1.0),), 0.0, 0.0, False, RENDERER)
