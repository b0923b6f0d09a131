"""The shadow algorithms and what they can do, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from shadows import shadow_map, truth
from terrain.level import AlgorithmName, CasterKind, LightName

ViewKind = Literal["map"]


@dataclass(frozen=True)
class Algorithm:
    """An algorithm's name, the lights, casters and views it serves, the passes it runs, and a sentence about it."""

    name: AlgorithmName
    lights: frozenset[LightName]
    casters: frozenset[CasterKind]
    views: frozenset[ViewKind]
    passes: tuple[str, ...]
    about: str
    served: bool = True
    """Whether a request over HTTP may ask for it."""


ALGORITHMS: dict[AlgorithmName, Algorithm] = {
    "shadow_map": Algorithm(
        "shadow_map", frozenset({"sun"}), frozenset({"relief"}), frozenset({"map"}), shadow_map.PASSES,
        "orthographic depth map that follows what is looked at",
    ),
    "truth": Algorithm(
        "truth",
        frozenset({"sun"}),
        frozenset({"relief"}),
        frozenset({"map"}),
        truth.PASSES,
        "rays: the reference, not for real time",
        served=False,
    ),
    "none": Algorithm(
        "none", frozenset({"sun"}), frozenset({"relief"}), frozenset({"map"}), (), "no cast shadows",
    ),
}  # fmt: skip
