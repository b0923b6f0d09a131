"""Settings of shadow volumes, and what they are resolved from."""

from __future__ import annotations

from typing import Any, Literal

from skugga.shadows.algorithm import AlgorithmSettings, AreaSettings, Reasoned, ResolvedSettings, SettingsRequest
from skugga.terrain.level.level import Shadows


class StencilSettings(AlgorithmSettings):
    """How volumes are counted: both sides of them in one pass or in one each, and what is counted: ``auto`` takes z-pass for
    casters whose volume provably misses the near plane and z-fail for the others.
    """

    stencil: Literal["one_pass", "two_pass"] = "one_pass"
    counting: Literal["auto", "z_fail"] = "auto"


class VolumeSettings(StencilSettings, AreaSettings):
    """Settings of shadow volumes: how they are counted; and ``filter``, 1 for the hard edges of a light that is a point, or ``sun``
    for the penumbra of its disc or ball: the volumes of each of many points of it.
    """

    filter: Literal[1, "sun"] = 1

    @property
    def asked_as(self) -> dict[str, Any]:
        """The same as a level's ``shadows`` would ask for them: hard edges need not be asked for."""
        asked = super().asked_as
        return asked if self.filter == "sun" else {key: value for key, value in asked.items() if key != "filter"}


def resolve_volumes(request: SettingsRequest) -> ResolvedSettings:
    """Settings of shadow volumes, and the reason for a penumbra."""
    settings = stencil_settings(request.shadows)
    if not request.is_area:
        return VolumeSettings(**settings), request.without_filter("shadow_volume")
    reason = f"the mean of the volumes of {request.light_points} points of the light"
    return VolumeSettings(**settings, filter="sun", light_points=request.light_points), [Reasoned(name="filter sun", reason=reason)]


def stencil_settings(shadows: Shadows) -> dict[str, Any]:
    """How volumes are counted."""
    return {"stencil": "one_pass" if shadows.stencil == "auto" else shadows.stencil, "counting": shadows.counting}
