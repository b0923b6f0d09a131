"""Settings of the hybrid, and what they are resolved from."""

from __future__ import annotations

from typing import Any, Literal

from skugga.shadows.algorithm import Reasoned, ResolvedSettings, SettingsRequest
from skugga.shadows.maps.resolve import resolve_uniform_map
from skugga.shadows.maps.settings import LampMapSettings, ShadowMapSettings
from skugga.shadows.volumes.settings import StencilSettings, stencil_settings

HYBRID_TEXELS = 768
"""Texels a side of a hybrid's map, unless the level says otherwise: it need not be fine, since volumes decide at edges."""


class HybridSettings(StencilSettings):
    """Settings of the hybrid: its map, how the pixels are found in which volumes decide (``original``: Chan and Durand's
    comparison of two by two texels), and those of its volumes.
    """

    map: ShadowMapSettings | LampMapSettings
    mask: Literal["conservative", "original"] = "conservative"

    @property
    def asked_as(self) -> dict[str, Any]:
        """The same as a level's ``shadows`` would ask for them, those of the map among them."""
        return super().asked_as | self.map.asked_as

    @property
    def label(self) -> list[str]:
        """Texels a side, how pixels are marked, and what is not as it is by itself."""
        return [str(self.map.map_size), self.mask, *self.changed("mask")]


def resolve_hybrid(request: SettingsRequest) -> ResolvedSettings:
    """Settings of the hybrid under a light, and the reasons for what was left to choose."""
    asked = request.shadows
    size = HYBRID_TEXELS if asked.map_size == "auto" else asked.map_size
    wish = asked.model_copy(update={"map_size": size, "cascades": 1, "filter": 2, "bias": "normal_offset", "culling": "none"})
    settings, _ = resolve_uniform_map(SettingsRequest(request.descriptor, request.light, wish))
    mask = "conservative" if asked.mask == "auto" else asked.mask
    reasons = request.without_filter("hybrid")
    if asked.map_size == "auto":
        reasons.append(Reasoned(name=f"map_size {size}", reason="small map: shadow volumes decide where it cannot"))
    if asked.mask == "auto":
        reasons.append(Reasoned(name=f"mask {mask}", reason="the map decides only pixels where it is provably right"))
    return HybridSettings(map=settings, mask=mask, **stencil_settings(asked)), reasons
