"""The settings of shadow volumes, and how they are resolved from a request."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from skugga.shadows.algorithm_settings import AlgorithmSettings, AreaLightSettings, NamedReason, ResolvedSettings, SettingsRequest
from skugga.terrain.level.level import Shadows


class StencilSettings(AlgorithmSettings):
    """The method by which volumes are counted.

    ``stencil`` draws both sides of volumes in one pass, or each in its own. ``counting`` ``auto`` uses z-pass for casters whose
    volume provably misses the near plane and z-fail for the others. ``z_pass`` uses z-pass for all, and is refused where a volume
    may reach the near plane.
    """

    stencil: Literal["one_pass", "two_pass"] = Field(
        default="one_pass", description="`auto`: `one_pass`. `two_pass` draws the same picture."
    )
    counting: Literal["auto", "z_fail", "z_pass"] = Field(
        default="auto",
        description="`auto`: z-pass for casters whose volume provably misses the near plane, z-fail for the others. `z_fail` for "
        "all is as right, in 0.8 to 1.7 times the time. `z_pass` for all, without caps, is refused where a volume may hold "
        "the eye.",
    )


class VolumeSettings(StencilSettings, AreaLightSettings):
    """Settings of shadow volumes: the counting method and the filter.

    ``filter`` 1 shows the hard edges of a point light. ``sun`` shows the penumbra of the light's disc or ball, by the volumes of
    each of many points of it.
    """

    filter: Literal[1, "sun"] = Field(
        default=1, description="`auto`: 1, hard edges; `sun`, penumbrae, for a lamp with a radius. Other values have no effect."
    )

    @property
    def as_overrides(self) -> dict[str, Any]:
        """The settings as keys and values of a level's ``shadows``. Hard edges need no key."""
        overrides = super().as_overrides
        return overrides if self.filter == "sun" else {key: value for key, value in overrides.items() if key != "filter"}


def resolve_volumes(request: SettingsRequest) -> ResolvedSettings:
    """Return the settings of shadow volumes, and the reason for a penumbra or for a filter without effect."""
    settings, reasons = stencil_settings(request.shadows), stencil_reasons(request.shadows)
    if not request.is_area_light:
        return VolumeSettings(**settings), [*request.ignored_filter_reasons("shadow_volume"), *reasons]
    reason = f"the mean of the volumes of {request.light_point_count} points of the light"
    return VolumeSettings(**settings, filter="sun", light_points=request.light_point_count), [
        NamedReason(name="filter sun", reason=reason), *reasons,
    ]  # fmt: skip


def stencil_settings(shadows: Shadows) -> dict[str, Any]:
    """Return the requested counting method as fields of ``StencilSettings``."""
    return {"stencil": "one_pass" if shadows.stencil == "auto" else shadows.stencil, "counting": shadows.counting}


def stencil_reasons(shadows: Shadows) -> list[NamedReason]:
    """Return the condition under which z-pass alone is right, if it is requested."""
    if shadows.counting != "z_pass":
        return []
    reason = "faces before the point are counted, for all casters; refused where a shadow volume may hold the eye"
    return [NamedReason(name="counting z_pass", reason=reason)]
