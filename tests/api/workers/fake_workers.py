"""Render processes that draw nothing: they do what a job's name or place tells them, so that tests control them."""

from __future__ import annotations

import os
import signal
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Semaphore

import numpy as np

from api.workers.jobs import BlockJob, Failure, PlanAnswer, Ready, RenderedBlock
from api.workers.render_worker import WorkerConfig
from terrain.errors import GraphicsError, InputError, RenderError
from terrain.geo.grid import BLOCK_PX

RENDERER = "fake"


def obedient(pipe: Connection, config: WorkerConfig, begun: Semaphore | None = None, go: Semaphore | None = None) -> None:
    """Answers at once, or where ``go`` is given says that a job has ``begun`` and waits to be let ``go``.

    A plan's view is an order: ``crash``, ``hang``, ``refuse`` (wrong input), ``fail``, ``doubt`` (broken OpenGL).
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe.send(Ready(RENDERER))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if begun is not None:
            begun.release()
        if go is not None:
            go.acquire()
        order = "draw" if isinstance(job, BlockJob) else job.view
        if order == "crash":
            os._exit(9)
        if order == "hang":
            signal.pause()
        pipe.send(_answer(order))


def hanging(pipe: Connection, config: WorkerConfig) -> None:
    """Never comes back from a job."""
    pipe.send(Ready(RENDERER))
    pipe.recv()
    signal.pause()


def unable(pipe: Connection, config: WorkerConfig) -> None:
    """Cannot start."""
    pipe.send(Failure.of(GraphicsError("libEGL at /secret/place is broken"), fatal=True))


def stillborn(pipe: Connection, config: WorkerConfig) -> None:
    """Dies while it starts."""
    os._exit(9)


def never_ready(pipe: Connection, config: WorkerConfig) -> None:
    """Warms up for ever."""
    signal.pause()


def leaky(pipe: Connection, config: WorkerConfig) -> None:
    """Fails with words that are not for clients."""
    pipe.send(Ready(RENDERER))
    while True:
        try:
            pipe.recv()
        except EOFError:
            return
        pipe.send(Failure.of(RenderError("/secret/place/dem.tif: a part of the raster cannot be read")))


def _answer(order: str) -> RenderedBlock | PlanAnswer | Failure:
    if order == "refuse":
        return Failure.of(InputError("view", order, "another order"))
    if order == "fail":
        return Failure.of(RenderError("it went wrong"))
    if order == "doubt":
        return Failure.of(GraphicsError("OpenGL left an error behind"), fatal=True)
    if order != "draw":
        return PlanAnswer(f'{{"view": "{order}"}}')
    side = BLOCK_PX
    return RenderedBlock(
        np.zeros((side, side, 3), np.uint8), np.ones((side, side), np.float32), np.zeros((side, side), np.uint8), "{}", "none",
        (("geometry", 1.0),), 0.0, 0.0, False, RENDERER,
    )  # fmt: skip
