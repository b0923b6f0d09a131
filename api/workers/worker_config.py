"""The start configuration of a render process. Imports nothing that draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from skugga.api.settings import Settings
from skugga.terrain.cores import usable_cores

if TYPE_CHECKING:
    from skugga.api.workers.plan_basis import PlanBasis


@dataclass(frozen=True)
class WorkerConfig:
    """Start configuration of a render process.

    Attributes
    ----------
    gl_threads : int
        Number of threads of a software rasteriser.
    expect_renderer : str or None
        Text that the renderer's name must contain.
    needs_opengl : bool
        Whether the process must not start without OpenGL.
    limit_ms : float or None
        Limit of a picture's expected time in milliseconds; the process refuses costlier pictures.
    basis : PlanBasis or None
        Inputs of plans; ``None`` uses the calibration in the user's cache until the process receives a basis.
    number : int
        Number of the process, which selects one of several OpenGL devices in turn.
    """

    gl_threads: int
    expect_renderer: str | None = None
    needs_opengl: bool = False
    limit_ms: float | None = None
    basis: PlanBasis | None = None
    number: int = 0


def first_config(settings: Settings) -> WorkerConfig:
    """Return the start configuration of a service's first render process."""
    return WorkerConfig(
        gl_threads=max(usable_cores() // settings.workers, 1),
        expect_renderer=settings.expect_renderer,
        limit_ms=settings.render_timeout_s * 1000.0,
    )
