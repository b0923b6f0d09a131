"""Draw the frames of an animation one after the other on the worker pool, and write its film."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from pathlib import Path

import numpy as np

from skugga.api.animations.animation_spec import AnimationSpec
from skugga.api.animations.animations import DrawFrames
from skugga.api.errors import ExhaustedError, LevelChangedError, WorkerStartError, error_report_of
from skugga.api.film_files import write_film
from skugga.api.workers.jobs import FilmPicture, FilmPlanState, FrameJob, LevelKey
from skugga.api.workers.pool import Pool

MAX_FRAME_ATTEMPTS = 5
"""Maximum number of tries of a frame while no render process can start. The pauses are those that clients are told; together they
take some 20 seconds."""


def frame_job(spec: AnimationSpec, frame_number: int, previous_plan_state: FilmPlanState | None = None) -> FrameJob:
    """Return the job that draws one frame of a film.

    ``frame_number`` counts frames from 0. ``previous_plan_state`` is the planning state after the previous
    frame, which this frame continues.
    """
    film = {name: getattr(spec, name) for name in FrameJob.model_fields if name in AnimationSpec.model_fields}
    return FrameJob(**film, frame_number=frame_number, previous_plan_state=previous_plan_state)


def frame_renderer(pool: Pool, current_level: Callable[[str], Awaitable[LevelKey]]) -> DrawFrames:
    """Return a function that draws the frames of a film on a worker pool.

    Each frame is a job, so other requests run between two frames. If a worker crashes, the pool draws the frame again from the same
    planning state. ``current_level`` returns the current key of a level, given the level's name. The returned function raises
    ``LevelChangedError`` if that key has changed, and the errors of ``current_level`` and ``Pool.run``.
    """

    async def draw(spec: AnimationSpec) -> AsyncGenerator[np.ndarray, None]:
        previous_plan_state: FilmPlanState | None = None
        for number in range(spec.span.frames):
            if await current_level(spec.level_name) != spec.level:
                raise LevelChangedError(f"Level {spec.level_name} has changed while it was drawn. Request the animation again.")
            picture = await _draw_frame(pool, frame_job(spec, number, previous_plan_state))
            previous_plan_state = picture.next_plan_state
            yield picture.color

    return draw


async def _draw_frame(pool: Pool, job: FrameJob) -> FilmPicture:
    """Draw a frame, and retry if no render process could start or the machine lacks resources.

    An animation is a background job, so it waits here. The client of a single picture gets the error and retries by itself. Raises
    the errors of ``Pool.run``.
    """
    for attempt in range(1, MAX_FRAME_ATTEMPTS + 1):
        try:
            picture = await pool.run(job)
        except (WorkerStartError, ExhaustedError) as error:
            if attempt == MAX_FRAME_ATTEMPTS:
                raise
            await asyncio.sleep(error_report_of(error).retry_after_s or 1)
        else:
            assert isinstance(picture, FilmPicture)
            return picture
    raise AssertionError  # the last try has returned or raised


def write_animation(path: Path, frames: Iterable[np.ndarray], spec: AnimationSpec) -> None:
    """Write a film. Raises ``OSError``."""
    write_film(path, frames, spec.span.frames, spec.fps, spec.lossless)
