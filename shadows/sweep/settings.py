"""Settings of the line sweep, and their resolution from a request."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from skugga.shadows.algorithm import AlgorithmSettings, ResolvedSettings, SettingsRequest


class SweepSettings(AlgorithmSettings):
    """Settings of the line sweep: the lines per column of the ground's grid, and whether the sun is a point or a disc."""

    lines: int = Field(default=8, ge=1, le=16)
    filter: Literal[1, "sun"] = 1


def resolve_sweep(request: SettingsRequest) -> ResolvedSettings:
    """Return the settings of the line sweep, and the reason if a requested filter has no effect: only ``sun`` has one."""
    soft = request.effective_shadows.filter == "sun"
    return SweepSettings(filter="sun" if soft else 1), request.ignored_filter_reasons("sweep", "sun")
