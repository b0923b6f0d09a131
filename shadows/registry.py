"""The shadow algorithms and what they can do, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from shadows import shadow_map, truth
from terrain.level import AlgorithmName, CasterKind

ViewKind = Literal["map", "perspective"]
LightKind = Literal["sun", "spot", "omni"]

EVERY_LIGHT = frozenset(get_args(LightKind))
EVERY_CASTER = frozenset(get_args(CasterKind))
EVERY_VIEW = frozenset(get_args(ViewKind))


@dataclass(frozen=True)
class Algorithm:
    """An algorithm's name, the lights, casters and views it serves, the passes it runs for each, and a sentence about it."""

    name: AlgorithmName
    lights: frozenset[LightKind]
    casters: frozenset[CasterKind]
    views: frozenset[ViewKind]
    passes: tuple[str, ...]
    about: str
    served: bool = True
    """Whether a request over HTTP may ask for it."""


ALGORITHMS: dict[AlgorithmName, Algorithm] = {
    "shadow_map": Algorithm(
        "shadow_map", EVERY_LIGHT, EVERY_CASTER, EVERY_VIEW, shadow_map.PASSES,
        "depth map from the light, which follows what is looked at",
    ),
    "truth": Algorithm(
        "truth", EVERY_LIGHT, EVERY_CASTER, EVERY_VIEW, truth.PASSES, "rays: the reference, not for real time", served=False,
    ),
    "none": Algorithm("none", EVERY_LIGHT, EVERY_CASTER, EVERY_VIEW, (), "no cast shadows"),
}  # fmt: skip
