"""The settings of reconstructed volumes, and how they are resolved from a request."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from skugga.shadows.algorithm_settings import NamedReason, ResolvedSettings, SettingsRequest
from skugga.shadows.maps.resolve import resolve_uniform_map
from skugga.shadows.maps.settings import LampMapSettings, ShadowMapSettings
from skugga.shadows.volumes.settings import StencilSettings, stencil_reasons, stencil_settings

RECONSTRUCTION_MAP_SIZE = 1024
"""Default size of the map, texels a side. Each texel that casts may become two triangles or more."""

MAX_RECONSTRUCTION_MAP_SIZE = 2048
"""Maximum size of the map, texels a side. Woods in a map of 4096 become 34 million triangles: 100 seconds and 3 GB."""


class ReconstructionSettings(StencilSettings):
    """Settings of reconstructed volumes: those of the depth map and of the count."""

    map: ShadowMapSettings | LampMapSettings = Field(
        description=f"The map: `map_size` ({RECONSTRUCTION_MAP_SIZE}, at most {MAX_RECONSTRUCTION_MAP_SIZE}), `depth_bits`, `fit` "
        "(tight) and `cascades`, as for `shadow_map`."
    )

    @property
    def as_overrides(self) -> dict[str, Any]:
        """The settings as keys and values of a level's ``shadows``.

        The map contributes its size, depth bits, fit and cascades. Its filter, bias and culling are always the same.
        """
        map_overrides = self.map.as_overrides
        keys = ("map_size", "depth_bits", "fit", "cascades")
        return super().as_overrides | {key: map_overrides[key] for key in keys if key in map_overrides}

    @property
    def label_parts(self) -> list[str]:
        """Texels a side and depth bits of the map, and the settings that differ from their defaults."""
        return [str(self.map.map_size), str(self.map.depth_bits), *self.changed_values()]


def resolve_reconstruction(request: SettingsRequest) -> ResolvedSettings:
    """Return the settings under a light, and the reasons for those resolved from ``auto``.

    A larger map than ``MAX_RECONSTRUCTION_MAP_SIZE``, which policies try for maps that are looked up, becomes one of that size.
    """
    shadows, reasons = request.shadows, request.ignored_filter_reasons("reconstructed_volume")
    changes: dict[str, Any] = {"filter": 1, "bias": "receiver_plane", "culling": "none"}
    if shadows.map_size != "auto" and shadows.map_size > MAX_RECONSTRUCTION_MAP_SIZE:
        changes["map_size"] = MAX_RECONSTRUCTION_MAP_SIZE
        reason = f"each texel becomes polygons, so {shadows.map_size} texels a side are too many"
        reasons.append(NamedReason(name=f"map_size {MAX_RECONSTRUCTION_MAP_SIZE}", reason=reason))
    if shadows.map_size == "auto":
        changes["map_size"] = RECONSTRUCTION_MAP_SIZE
        reason = "each texel that casts becomes polygons: few texels keep their number low"
        reasons.append(NamedReason(name=f"map_size {RECONSTRUCTION_MAP_SIZE}", reason=reason))
    if shadows.fit == "auto":
        changes["fit"] = "tight"
        reasons.append(NamedReason(name="fit tight", reason="all texels are spent on what is seen: edges are as coarse as texels"))
    if shadows.depth_bits == "auto":
        changes["depth_bits"] = 32 if request.light in {lamp.name for lamp in request.descriptor.lamps} else 24
        reason = "the surface is interpolated between depths, so their steps must be fine"
        reasons.append(NamedReason(name=f"depth_bits {changes['depth_bits']}", reason=reason))
    map_request = SettingsRequest(request.descriptor, request.light, shadows.model_copy(update=changes))
    map_settings, map_reasons = resolve_uniform_map(map_request)
    reasons += [reason for reason in map_reasons if reason.name.startswith("cascades")] + stencil_reasons(shadows)
    return ReconstructionSettings(map=map_settings, **stencil_settings(shadows)), reasons
