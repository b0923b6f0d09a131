"""What an animation shows and how it is written: equal orders are one animation."""

from __future__ import annotations

from typing import Literal

from skugga.api.workers.jobs import Film

FilmFormat = Literal["webp", "mp4"]


class FilmOrder(Film):
    """A film, the format of its file, and how many frames it shows in a second. ``level_name`` is the level's in addresses."""

    level_name: str
    format: FilmFormat = "webp"
    fps: float = 10.0
