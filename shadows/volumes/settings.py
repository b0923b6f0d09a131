"""Settings of shadow volumes, and what they are resolved from."""

from __future__ import annotations

from typing import Any, Literal

from shadows.algorithm import AlgorithmSettings, ResolvedSettings, SettingsRequest
from terrain.level.level import Shadows


class VolumeSettings(AlgorithmSettings):
    """Settings of shadow volumes: both sides of the volumes in one pass or in one each, and what is counted: ``auto`` takes
    z-pass for casters whose volume provably misses the near plane and z-fail for the others.
    """

    stencil: Literal["one_pass", "two_pass"] = "one_pass"
    counting: Literal["auto", "z_fail"] = "auto"


def resolve_volumes(request: SettingsRequest) -> ResolvedSettings:
    """Settings of shadow volumes; there is nothing to give reasons for."""
    return VolumeSettings(**stencil_settings(request.shadows)), request.without_filter("shadow_volume")


def stencil_settings(shadows: Shadows) -> dict[str, Any]:
    """How volumes are counted."""
    return {"stencil": "one_pass" if shadows.stencil == "auto" else shadows.stencil, "counting": shadows.counting}
