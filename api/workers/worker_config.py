"""The start configuration of a render process. This module imports no rendering code, so that a service starts fast."""

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
        Whether the process must fail to start if there is no OpenGL.
    limit_ms : float or None
        Limit of a picture's expected time in milliseconds. The process refuses pictures that are expected to take longer.
    basis : PlanBasis or None
        The measurements that plans use. ``None``: the calibration in the user's cache, until the service sends a basis.
    number : int
        Number of the process, counted from 0. Processes with successive numbers use the OpenGL devices in turn.
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
