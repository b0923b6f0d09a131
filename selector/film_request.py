"""What is asked of a film, as values; ``film`` draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from skugga.terrain.level.camera_file import CameraPathSpec

MOST_FRAMES = 10_000
"""Of a film: almost seven minutes at 25 a second."""

ALONG_PATH = "path"
"""What plans call the view of a camera that moves."""


@dataclass(frozen=True)
class FilmSpan:
    """When a film plays: the number of its frames and the seconds between two of them, the date of the first one (``None``: the
    sun rests), and what the clock of what moves shows there (``None``: what the level says).
    """

    frames: int
    step_s: float
    start: datetime | None = None
    first_second: float | None = None

    def time_of(self, number: int) -> datetime | None:
        """The date and time of a frame."""
        return None if self.start is None else self.start + timedelta(seconds=number * self.step_s)

    @property
    def length_s(self) -> float:
        """From the first frame to the last one."""
        return (self.frames - 1) * self.step_s


@dataclass(frozen=True)
class FilmRequest:
    """What a film shows: one of the level's views, as ``Scene.view`` makes it of its parameters, or along a ``path`` what a camera
    sees that moves. ``size`` is (width, height). ``overrides`` are what is asked of the shadows.
    """

    span: FilmSpan
    view: str = "map"
    path: CameraPathSpec | None = None
    size: tuple[int, int] | None = None
    bounds: tuple[float, float, float, float] | None = None
    crs: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @property
    def view_name(self) -> str:
        """What plans call the view."""
        return self.view if self.path is None else ALONG_PATH
