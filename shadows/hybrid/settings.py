"""The settings of the hybrid, and how they are resolved from a request."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from skugga.shadows.algorithm_settings import NamedReason, ResolvedSettings, SettingsRequest
from skugga.shadows.maps.resolve import resolve_uniform_map
from skugga.shadows.maps.settings import LampMapSettings, ShadowMapSettings
from skugga.shadows.volumes.settings import StencilSettings, stencil_reasons, stencil_settings

HYBRID_MAP_SIZE = 768
"""Default size of a hybrid's map, texels a side. A small map suffices, since volumes decide at edges."""


class HybridSettings(StencilSettings):
    """Settings of the hybrid: those of its map and its volumes, and the ``mask`` of pixels that volumes decide.

    ``original`` is Chan and Durand's comparison of 2 x 2 texels. Without a mask (``off``) volumes decide all pixels.
    """

    map: ShadowMapSettings | LampMapSettings = Field(
        description=f"The map: `map_size` ({HYBRID_MAP_SIZE}) and `depth_bits`. More texels mark fewer pixels, but the "
        "conservative map is made on the processor."
    )
    mask: Literal["conservative", "original", "off"] = Field(
        default="conservative",
        description="Pixels that volumes decide. `auto`: `conservative`, all that the map does not provably decide. "
        "`original`, the paper's: where two by two texels disagree. It misses bars thinner than a texel and "
        "contact shadows. `off`: all pixels, to see what the map saves.",
    )

    @property
    def as_overrides(self) -> dict[str, Any]:
        """The settings as keys and values of a level's ``shadows``.

        The map contributes its size and depth bits. Its filter, bias, culling and cascades are always the same.
        """
        map_overrides = self.map.as_overrides
        return super().as_overrides | {key: map_overrides[key] for key in ("map_size", "depth_bits") if key in map_overrides}

    @property
    def label_parts(self) -> list[str]:
        """Texels a side, the mask, and the settings that differ from their defaults."""
        mask = "no_mask" if self.mask == "off" else self.mask
        return [str(self.map.map_size), mask, *self.changed_values("mask")]


def resolve_hybrid(request: SettingsRequest) -> ResolvedSettings:
    """Return the hybrid's settings under a light, and the reasons for those resolved from ``auto``."""
    shadows = request.shadows
    size = HYBRID_MAP_SIZE if shadows.map_size == "auto" else shadows.map_size
    map_shadows = shadows.model_copy(
        update={
            "map_size": size, "cascades": 1, "filter": 2, "bias": "normal_offset", "bias_scale": "auto", "culling": "none",
        }
    )  # fmt: skip
    settings, _ = resolve_uniform_map(SettingsRequest(request.descriptor, request.light, map_shadows))
    mask = "conservative" if shadows.mask == "auto" else shadows.mask
    reasons = [*request.ignored_filter_reasons("hybrid"), *stencil_reasons(shadows)]
    if shadows.map_size == "auto":
        reasons.append(NamedReason(name=f"map_size {size}", reason="a small map: shadow volumes decide where it cannot"))
    if shadows.mask == "auto":
        reasons.append(NamedReason(name=f"mask {mask}", reason="the map decides only pixels where it is provably right"))
    elif shadows.mask == "off":
        reasons.append(NamedReason(name="mask off", reason="to compare with: volumes decide all pixels, and the map none"))
    return HybridSettings(map=settings, mask=mask, **stencil_settings(shadows)), reasons
