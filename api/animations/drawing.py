"""Draw the frames of an animation one after the other on the worker pool, and write its film."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from pathlib import Path

import numpy as np

from skugga.api.animations.animations import Draw
from skugga.api.animations.film_order import FilmOrder
from skugga.api.errors import LevelChangedError
from skugga.api.film_files import write_film
from skugga.api.workers.jobs import FilmPicture, FrameJob, LevelKey, PlanHandover
from skugga.api.workers.pool import Pool


def frame_job(order: FilmOrder, number: int, before: PlanHandover | None = None) -> FrameJob:
    """Return the job of a frame of a film. ``number`` counts from 0, and ``before`` are the plans of the frame before it."""
    film = {name: getattr(order, name) for name in FrameJob.model_fields if name in FilmOrder.model_fields}
    return FrameJob(**film, number=number, before=before)


def frame_renderer(pool: Pool, level_now: Callable[[str], Awaitable[LevelKey]]) -> Draw:
    """Return a function that draws the frames of a film on a pool.

    Each frame is a job, so other requests run between two frames. The pool repeats a frame whose worker crashes, from the same
    plans. ``level_now`` returns the current key of a level by its name. The function raises ``LevelChangedError`` if that key has
    changed, and the errors of ``level_now`` and ``Pool.run``.
    """

    async def draw(order: FilmOrder) -> AsyncGenerator[np.ndarray, None]:
        before: PlanHandover | None = None
        for number in range(order.span.frames):
            if await level_now(order.level_name) != order.level:
                raise LevelChangedError(f"Level {order.level_name} has changed while it was drawn: ask for the animation again.")
            picture = await pool.run(frame_job(order, number, before))
            assert isinstance(picture, FilmPicture)
            before = picture.after
            yield picture.color

    return draw


def write_animation(path: Path, frames: Iterable[np.ndarray], order: FilmOrder) -> None:
    """Write a film. Raises ``OSError``."""
    write_film(path, frames, order.span.frames, order.fps, lossless=True)
