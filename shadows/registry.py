"""The shadow algorithms by name. Each is declared in its own module, as a record (``shadows.algorithm``)."""

from __future__ import annotations

from collections.abc import Iterable

from skugga.shadows import none, planar
from skugga.shadows.algorithm import Algorithm, Requirement, is_area, requirements_of
from skugga.shadows.hybrid import hybrid
from skugga.shadows.maps import perspective_shadow_map, shadow_map
from skugga.shadows.sweep import sweep
from skugga.shadows.truth import truth
from skugga.shadows.volumes import shadow_volume
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES, REFERENCE_NAMES, AlgorithmName
from skugga.terrain.level.level import CasterKind, Shadows

MODULES = (shadow_map, perspective_shadow_map, shadow_volume, hybrid, planar, sweep, truth, none)
"""Those that come with Skugga."""

ALGORITHMS: dict[AlgorithmName, Algorithm] = {module.ALGORITHM.name: module.ALGORITHM for module in MODULES}


def register_algorithm(algorithm: Algorithm) -> None:
    """Make an algorithm known to levels, plans, the selector and the report of this process, in the place of one of its name."""
    ALGORITHMS[algorithm.name] = algorithm
    if algorithm.name not in ALGORITHM_NAMES:
        ALGORITHM_NAMES.append(algorithm.name)
    if algorithm.served and algorithm.name in REFERENCE_NAMES:
        REFERENCE_NAMES.remove(algorithm.name)
    if not algorithm.served and algorithm.name not in REFERENCE_NAMES:
        REFERENCE_NAMES.append(algorithm.name)


FALLBACK: AlgorithmName = shadow_map.ALGORITHM.name
"""What serves every view, light and kind of casters, and is taken where nothing speaks for another."""

NO_SHADOWS: AlgorithmName = none.ALGORITHM.name
"""What casts no shadows."""


def selectable_algorithms() -> list[Algorithm]:
    """The algorithms among which the selector chooses: those that throw shadows, but for the reference."""
    return [each for each in ALGORITHMS.values() if each.passes and each.served]


def algorithms_serving(parts: Iterable[Requirement]) -> list[AlgorithmName]:
    """The algorithms to choose from that can serve all of these together."""
    parts = tuple(parts)
    return [algorithm.name for algorithm in selectable_algorithms() if algorithm.refusal(parts) is None]


def can_serve(name: AlgorithmName, descriptor: Descriptor, light: str, caster: CasterKind, asked: Shadows | None = None) -> bool:
    """Whether an algorithm can take on a kind of casters under a light of a view, if that is ``asked`` of its shadows."""
    area = is_area(descriptor, light, asked or Shadows())
    return ALGORITHMS[name].refusal(requirements_of(descriptor, descriptor.light_kinds[light], caster, area)) is None
