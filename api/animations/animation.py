"""One animation: what was asked for, how far it is, and how it ended."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal, get_args

from skugga.api.animations.film_file import FilmFile
from skugga.api.animations.film_order import FilmOrder
from skugga.terrain.errors import SkuggaError

AnimationStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
"""How far an animation is: the words of OGC API - Processes, part 1 (18-062r2), section 7.12."""

STATUSES: tuple[AnimationStatus, ...] = get_args(AnimationStatus)


def now() -> datetime:
    """The time, to the second."""
    return datetime.now(UTC).replace(microsecond=0)


@dataclass(eq=False)
class Animation:
    """A job: ``frames_done`` were drawn of those of its ``order``; ``message`` says why it was dismissed, ``error`` why it failed,
    and ``film`` is there once it was successful, until it ``expires`` at the latest.

    A frame is expected to take ``frame_s`` seconds. ``running_since_s`` is the event loop's time; ``ending`` is when it is
    forgotten or, before it has ended, given up.
    """

    id: str
    order: FilmOrder
    frame_s: float
    created: datetime = field(default_factory=now)
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
    work: asyncio.Task[None] | None = None
    ending: asyncio.TimerHandle | None = None

    @property
    def film_bytes(self) -> int:
        """Bytes of its film; 0 where there is none."""
        return 0 if self.film is None else self.film.nbytes

    @property
    def ended(self) -> bool:
        """Whether nothing more is done for it."""
        return self.status not in ("accepted", "running")

    def begin(self, loop_s: float) -> None:
        """It is its turn."""
        self.status, self.started, self.running_since_s = "running", now(), loop_s

    def advance(self, frames_done: int) -> None:
        """So many frames are drawn."""
        self.frames_done, self.updated = frames_done, now()

    def end(self, status: AnimationStatus, age_s: float, message: str | None = None, error: SkuggaError | None = None) -> None:
        """Nothing more is done for it; it is forgotten after ``age_s``."""
        self.status, self.message, self.error, self.finished = status, message, error, now()
        self.updated, self.expires = self.finished, self.finished + timedelta(seconds=age_s)

    def let_go(self) -> None:
        """Give back what it holds: the film, its timer."""
        if self.ending is not None:
            self.ending.cancel()
        if self.film is not None:
            self.film.close()
            self.film = None
