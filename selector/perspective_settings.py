"""Settings of perspective shadow maps from rules, and why."""

from __future__ import annotations

from shadows.plan import PerspectiveMapSettings, Reasoned
from terrain.descriptor import Descriptor
from terrain.level import Shadows


def perspective_map_settings(descriptor: Descriptor, light: str, asked: Shadows) -> tuple[PerspectiveMapSettings, list[Reasoned]]:
    """Settings of a light's perspective shadow map, and the reasons for what was left to choose."""
    raise NotImplementedError
