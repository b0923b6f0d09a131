"""What a render process is told at its start. Light: imports nothing that draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from skugga.api.settings import Settings
from skugga.terrain.cores import usable_cores

if TYPE_CHECKING:
    from skugga.api.workers.plan_basis import PlanBasis


@dataclass(frozen=True)
class WorkerConfig:
    """What a render process is told at its start. ``gl_threads`` are the threads of a software rasteriser. It refuses pictures
    that are expected to take more than ``most_ms``, and does not start without OpenGL where it ``needs_opengl``. Without a
    ``basis`` its plans go by the calibration in the user's cache, until it is told another one. Of several OpenGL devices it takes
    that whose turn its ``number`` is.
    """

    gl_threads: int
    expect_renderer: str | None = None
    needs_opengl: bool = False
    most_ms: float | None = None
    basis: PlanBasis | None = None
    number: int = 0


def first_config(settings: Settings) -> WorkerConfig:
    """Return what the first render process of a service is told."""
    return WorkerConfig(
        gl_threads=max(usable_cores() // settings.workers, 1),
        expect_renderer=settings.expect_renderer,
        most_ms=settings.render_timeout_s * 1000.0,
    )
