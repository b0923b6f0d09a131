"""The record of one animation: its specification, its progress and its result."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal, get_args

from skugga.api.animations.animation_spec import AnimationSpec
from skugga.api.animations.film_file import FilmFile
from skugga.terrain.errors import SkuggaError

AnimationStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
"""Statuses of OGC API - Processes, part 1 (18-062r2), section 7.12."""

STATUSES: tuple[AnimationStatus, ...] = get_args(AnimationStatus)


def utc_now() -> datetime:
    """Return the current time in UTC, to the second."""
    return datetime.now(UTC).replace(microsecond=0)


@dataclass(eq=False)
class Animation:
    """An animation, as a job.

    Attributes
    ----------
    id
        The unguessable identifier.
    spec
        The film to draw: level, view, times, file format and frames per second.
    expected_frame_s
        Expected seconds for each frame.
    created, started, updated, finished
        Times in UTC.
    status
        The status, in the terms of OGC API - Processes.
    expires
        The time at which the film is deleted at the latest.
    frames_done
        The number of drawn frames.
    message
        The reason of a dismissal.
    error
        The reason of a failure.
    film
        The film of a successful animation.
    running_since_s
        The time of the event loop, in seconds, at which drawing began.
    drawing_task
        The task that draws it.
    expiry_timer
        The timer that deletes an ended animation, or dismisses an animation that no client asks about.
    """

    id: str
    spec: AnimationSpec
    expected_frame_s: float
    created: datetime = field(default_factory=utc_now)
    status: AnimationStatus = "accepted"
    started: datetime | None = None
    updated: datetime | None = None
    finished: datetime | None = None
    expires: datetime | None = None
    frames_done: int = 0
    message: str | None = None
    error: SkuggaError | None = None
    film: FilmFile | None = None
    running_since_s: float | None = None
    drawing_task: asyncio.Task[None] | None = None
    expiry_timer: asyncio.TimerHandle | None = None

    @property
    def film_bytes(self) -> int:
        """Bytes of the film; 0 without one."""
        return 0 if self.film is None else self.film.nbytes

    @property
    def has_ended(self) -> bool:
        """Whether the animation has succeeded, failed or been dismissed."""
        return self.status not in ("accepted", "running")

    def begin(self, now_s: float) -> None:
        """Record that drawing begins. ``now_s`` is the time of the event loop in seconds."""
        self.status, self.started, self.running_since_s = "running", utc_now(), now_s

    def advance(self, frames_done: int) -> None:
        """Record the number of drawn frames."""
        self.frames_done, self.updated = frames_done, utc_now()

    def end(
        self, status: AnimationStatus, retention_s: float, message: str | None = None, error: SkuggaError | None = None
    ) -> None:
        """Record the animation's end with a final status. The animation expires after ``retention_s`` seconds.

        ``message`` is the reason of a dismissal, and ``error`` that of a failure.
        """
        self.status, self.message, self.error, self.finished = status, message, error, utc_now()
        self.updated, self.expires = self.finished, self.finished + timedelta(seconds=retention_s)

    def release(self) -> None:
        """Release the film, and cancel the timer."""
        if self.expiry_timer is not None:
            self.expiry_timer.cancel()
        if self.film is not None:
            self.film.close()
            self.film = None
