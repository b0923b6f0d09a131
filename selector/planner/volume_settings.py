"""Settings of shadow volumes and of the hybrid from rules, and why."""

from __future__ import annotations

from typing import Any

from selector.planner.map_settings import lamp_map_settings, sun_map_settings
from shadows.plan import HybridSettings, LampMapSettings, Reasoned, ShadowMapSettings, VolumeSettings
from terrain.facts.descriptor import Descriptor
from terrain.level.level import SUN, Shadows

HYBRID_TEXELS = 768
"""Texels a side of a hybrid's map, unless the level says otherwise: it need not be fine, since volumes decide at edges."""


def volume_settings(asked: Shadows) -> VolumeSettings:
    """Settings of shadow volumes."""
    return VolumeSettings(**_ways(asked))


def hybrid_settings(descriptor: Descriptor, light: str, asked: Shadows) -> tuple[HybridSettings, list[Reasoned]]:
    """Settings of the hybrid under a light, and the reasons for what was left to choose."""
    size = HYBRID_TEXELS if asked.map_size == "auto" else asked.map_size
    wish = asked.model_copy(update={"map_size": size, "cascades": 1, "filter": 2, "bias": "normal_offset", "culling": "none"})
    settings: ShadowMapSettings | LampMapSettings
    if light == SUN:
        settings, _ = sun_map_settings(descriptor, wish)
    else:
        settings, _ = lamp_map_settings(descriptor, next(lamp for lamp in descriptor.lamps if lamp.name == light), wish)
    mask = "conservative" if asked.mask == "auto" else asked.mask
    reasons = []
    if asked.map_size == "auto":
        reasons.append(Reasoned(name=f"map_size {size}", reason="a small map: where it cannot decide, volumes do"))
    if asked.mask == "auto":
        reasons.append(Reasoned(name=f"mask {mask}", reason="the pixels that the map decides are those in which it provably can"))
    return HybridSettings(map=settings, mask=mask, **_ways(asked)), reasons


def _ways(asked: Shadows) -> dict[str, Any]:
    return {
        "stencil": "one_pass" if asked.stencil == "auto" else asked.stencil,
        "counting": asked.counting,
    }
