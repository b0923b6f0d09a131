"""Settings of the line sweep, and their resolution from a request."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from skugga.shadows.algorithm_settings import AreaLightSettings, NamedReason, ResolvedSettings, SettingsRequest

MAX_SWEEP_LIGHT_POINTS = 20
"""Upper bound of the points of the sun's disc, each with a sweep of its own.

In a tile of ``jacksboro`` ``soft_error`` against rays is up to 15 % larger with 20 points (0.0006 to 0.0012) than with 32. The time
is 0.6 of that of 32.
"""


class SweepSettings(AreaLightSettings):
    """Settings of the line sweep.

    ``lines`` is the number of sweep lines per column of the ground's grid. ``filter`` is 1 for a sun that is a point, and ``sun``
    for a sun that is a disc, whose penumbra is the mean over ``light_points`` sweeps.
    """

    lines: int = Field(default=8, ge=1, le=16)
    light_points: int = Field(default=MAX_SWEEP_LIGHT_POINTS, ge=1)
    filter: Literal[1, "sun"] = Field(
        default=1, description="`auto`: 1, hard edges. `sun`: penumbrae, the mean of sweeps from 20 points of the sun's disc."
    )


def resolve_sweep(request: SettingsRequest) -> ResolvedSettings:
    """Return the settings of the line sweep, and the reason for a penumbra or for a filter without effect."""
    if not request.is_area_light:
        return SweepSettings(), request.ignored_filter_reasons("sweep")
    light_points = min(request.light_point_count, MAX_SWEEP_LIGHT_POINTS)
    reason = f"the mean of the sweeps for {light_points} points of the light"
    return SweepSettings(filter="sun", light_points=light_points), [NamedReason(name="filter sun", reason=reason)]
