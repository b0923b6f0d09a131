"""The frames of an animation, drawn one after the other by render processes, and its film."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from pathlib import Path

import numpy as np

from skugga.api.animations.animations import Draw
from skugga.api.animations.film_order import FilmOrder
from skugga.api.errors import LevelChangedError
from skugga.api.film_files import write_film
from skugga.api.workers.jobs import CarriedPlans, FilmPicture, FrameJob, LevelKey
from skugga.api.workers.pool import Pool


def frame_job(order: FilmOrder, number: int, before: CarriedPlans | None = None) -> FrameJob:
    """The job of a frame of a film, counted from 0."""
    film = {name: getattr(order, name) for name in FrameJob.model_fields if name in FilmOrder.model_fields}
    return FrameJob(**film, number=number, before=before)


def frames_drawn_by(pool: Pool, level_now: Callable[[str], Awaitable[LevelKey]]) -> Draw:
    """What draws films: a frame at a time, so that what others ask for comes between. A frame whose process dies is begun again by
    the pool, from the same plans.

    Raises ``LevelChangedError`` where ``level_now``, which is given the level's name, says that it is another one by then, and what
    it and ``Pool.run`` raise.
    """

    async def draw(order: FilmOrder) -> AsyncGenerator[np.ndarray, None]:
        before: CarriedPlans | None = None
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
