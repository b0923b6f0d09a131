"""What a view asks of an algorithm, and the algorithms that can serve it."""

from __future__ import annotations

from shadows.registry import ALGORITHMS, LightKind, Part
from terrain.descriptor import Descriptor
from terrain.level import SUN, AlgorithmName, CasterKind

MOST_BEND_PX = 0.25
"""How far, in pixels, a map may lie off what cameras see of its parts, for an algorithm that draws in the view itself."""


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
