"""What a view asks of an algorithm, and the algorithms that can serve it."""

from __future__ import annotations

import numpy as np

from shadows.registry import ALGORITHMS, LightKind, Part
from terrain.casters.reach import longest_shadow_m
from terrain.facts.descriptor import Descriptor
from terrain.geo.grid import BLOCK_PX
from terrain.level.level import SUN, AlgorithmName, CasterKind

MOST_BEND_PX = 0.25
"""How far, in pixels, a map may lie off what cameras see of its parts, for an algorithm that draws in the view itself."""

SWEPT_M = 200e3
"""As wide a piece of the round earth is swept at once: across a wider one the sun's rays bend too much for the lines. In Web
Mercator windows of 300 km were swept up to 72 degrees of latitude and of 150 km up to 78, all that were tried.
"""


def kinds_of_lights(descriptor: Descriptor) -> dict[str, LightKind]:
    """The lights of a descriptor in order, each with its kind; one without any has the sun's, which is nowhere."""
    sun: dict[str, LightKind] = {SUN: "sun"} if descriptor.highest_sun_deg is not None or not descriptor.lamps else {}
    return sun | {lamp.name: lamp.kind for lamp in descriptor.lamps}


def parts_of(descriptor: Descriptor, light: LightKind, caster: CasterKind) -> tuple[Part, ...]:
    """What an algorithm is asked to serve, for a light of a kind and a kind of casters."""
    level_ground = descriptor.flat_world and descriptor.relief_m <= 0.0
    view: tuple[Part, ...] = (descriptor.view_kind, "bent map") if descriptor.bend_px > MOST_BEND_PX else (descriptor.view_kind,)
    return (*view, light, caster, "level" if level_ground else "uneven")


def serves(name: AlgorithmName, descriptor: Descriptor, light: str, caster: CasterKind) -> bool:
    """Whether an algorithm can take on a kind of casters under a light of a view."""
    return ALGORITHMS[name].refusal(parts_of(descriptor, kinds_of_lights(descriptor)[light], caster)) is None


def swept_m(descriptor: Descriptor) -> float | None:
    """How far across the ground is that the sun's lines cross at once, if that is known: a map's block and the way of its longest
    shadow, in perspective all of the level, whose area follows from the share of it that is seen. A flat world bends nothing.
    """
    seen = descriptor.lights.get(SUN)
    if descriptor.sun_altitude_deg is None:
        return None
    if descriptor.flat_world:
        return 0.0
    if descriptor.view_kind == "map":
        return BLOCK_PX * descriptor.pixel_m + longest_shadow_m(descriptor.relief_m, descriptor.sun_altitude_deg)
    if descriptor.receivers_light_m is None or seen is None or seen.area_share <= 0.0:
        return None
    right_m, up_m, _ = descriptor.receivers_light_m
    sine = np.sin(np.radians(max(descriptor.sun_altitude_deg, 0.5)))
    with np.errstate(over="ignore"):  # wider than can be said is too wide
        return float(np.sqrt(right_m * up_m / (seen.area_share * sine)))
