"""Combinations of algorithms for different kinds of casters. They belong to no single algorithm's module.

``perspective_shadow_map`` is the method of Stamminger and Drettakis 2002, "Perspective shadow maps".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind


@dataclass(frozen=True)
class Mix:
    """A named combination of algorithms, each for some kinds of casters.

    Attributes
    ----------
    name
        Name of the combination.
    algorithm
        Algorithm by kind of casters. Other kinds use ``skugga.shadows.registry.FALLBACK_ALGORITHM``.
    in_portfolio
        Whether policies may choose it.
    in_report
        Whether the accuracy report compares it.
    """

    name: str
    algorithm: Mapping[CasterKind, AlgorithmName]
    in_portfolio: bool = True
    in_report: bool = True


MIXES = (
    Mix("sweep+shadow_volume", {"relief": "sweep", "meshes": "shadow_volume"}),
    Mix(
        "sweep+perspective_shadow_map",
        {"relief": "sweep", "meshes": "perspective_shadow_map", "forest": "perspective_shadow_map"},
        in_report=False,
    ),
    Mix("sweep+hybrid", {"relief": "sweep", "meshes": "hybrid"}),
    Mix("shadow_map+shadow_volume", {"meshes": "shadow_volume"}),
    Mix(
        "perspective_shadow_map+shadow_volume", {"relief": "perspective_shadow_map", "meshes": "shadow_volume"}, in_portfolio=False
    ),
    Mix("shadow_map+perspective_shadow_map", {"meshes": "perspective_shadow_map"}, in_portfolio=False),
)
"""The combinations, the most useful first. The last ones are dropped if the number of candidates exceeds its limit."""
