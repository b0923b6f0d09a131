"""The start configuration of a render process. This module imports no rendering code, so that a service starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from skugga.api.settings import Settings
from skugga.terrain.cores import usable_cores

if TYPE_CHECKING:
    from skugga.api.workers.plan_measurements import PlanMeasurements


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
    max_picture_ms : float or None
        Maximum expected time of a picture in milliseconds. The process rejects pictures that are expected to take longer.
    measurements : PlanMeasurements or None
        The measurements that plans use. ``None``: the calibration in the user's cache, until the service sends others.
    number : int
        Number of the process, counted from 0. Processes with successive numbers use the OpenGL devices in turn.
    """

    gl_threads: int
    expect_renderer: str | None = None
    needs_opengl: bool = False
    max_picture_ms: float | None = None
    measurements: PlanMeasurements | None = None
    number: int = 0


def first_config(settings: Settings) -> WorkerConfig:
    """Return the start configuration of a service's first render process."""
    return WorkerConfig(
        gl_threads=max(usable_cores() // settings.workers, 1),
        expect_renderer=settings.expect_renderer,
        max_picture_ms=settings.render_timeout_s * 1000.0,
    )
