"""Value types of a request for a film, which ``skugga.selector.film`` draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from skugga.terrain.level.camera_file import CameraPathSpec

MAX_FRAMES = 10_000
"""Maximum number of frames of a film: almost seven minutes at 25 frames per second."""

PATH_VIEW_NAME = "path"
"""Name of the view in the plans of a moving camera."""


@dataclass(frozen=True)
class FilmSpan:
    """The time span of a film.

    Attributes
    ----------
    frames
        Number of frames.
    step_s
        Seconds between two frames.
    start
        Date and time of the first frame. ``None`` keeps the sun fixed.
    first_second
        Clock of moving objects in the first frame, seconds. ``None`` uses the clock of the scene.
    """

    frames: int
    step_s: float
    start: datetime | None = None
    first_second: float | None = None

    def frame_time(self, number: int) -> datetime | None:
        """Return the date and time of the frame with index ``number``; ``None`` for a fixed sun."""
        return None if self.start is None else self.start + timedelta(seconds=number * self.step_s)

    @property
    def length_s(self) -> float:
        """Seconds from the first frame to the last one."""
        return (self.frames - 1) * self.step_s


@dataclass(frozen=True)
class FilmRequest:
    """A request for a film.

    Attributes
    ----------
    span
        Time span.
    view
        Name of the level's view, if the camera does not move.
    path
        Path of a moving camera. It replaces ``view``, ``bounds`` and ``crs``.
    size
        Width and height of the pictures, pixels.
    bounds
        Bounds of a map view (``Scene.view``).
    crs
        CRS of the bounds.
    overrides
        Shadow settings of the request: values by field of ``Shadows``.
    """

    span: FilmSpan
    view: str = "map"
    path: CameraPathSpec | None = None
    size: tuple[int, int] | None = None
    bounds: tuple[float, float, float, float] | None = None
    crs: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @property
    def camera_moves(self) -> bool:
        """Whether the camera moves from frame to frame."""
        return self.path is not None and self.span.frames > 1

    @property
    def view_name(self) -> str:
        """Name of the view in plans."""
        return self.view if self.path is None else PATH_VIEW_NAME
