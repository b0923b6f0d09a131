"""Settings of the line sweep, and their resolution from a request."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from skugga.shadows.algorithm_settings import AlgorithmSettings, ResolvedSettings, SettingsRequest


class SweepSettings(AlgorithmSettings):
    """Settings of the line sweep.

    ``lines`` is the number of sweep lines per column of the ground's grid. ``filter`` is 1 for a sun that is a point, and ``sun``
    for a sun that is a disc, which gives soft edges.
    """

    lines: int = Field(default=8, ge=1, le=16)
    filter: Literal[1, "sun"] = 1


def resolve_sweep(request: SettingsRequest) -> ResolvedSettings:
    """Return the settings of the line sweep, and reasons for a requested filter without effect.

    The only filter that has an effect is ``sun``.
    """
    soft = request.effective_shadows.filter == "sun"
    return SweepSettings(filter="sun" if soft else 1), request.ignored_filter_reasons("sweep", "sun")
