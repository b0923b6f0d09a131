"""The specification of an animation: the content of its film, and its file format. Equal specifications share one animation."""

from __future__ import annotations

from typing import Literal

from skugga.api.workers.jobs import Film

FilmFormat = Literal["webp", "mp4"]


class AnimationSpec(Film):
    """A film to draw, its file format, whether a WebP film is lossless, and its frames per second.

    ``level_name`` is the level's name in the service's URLs.
    """

    level_name: str
    format: FilmFormat = "webp"
    lossless: bool = False
    fps: float = 10.0
