"""The shadow algorithms by name. Each is declared as a record (``skugga.shadows.algorithm``) in its own module.

``perspective_shadow_map`` is the method of Stamminger and Drettakis 2002, "Perspective shadow maps".
"""

from __future__ import annotations

from collections.abc import Iterable

from skugga.shadows import none, planar
from skugga.shadows.algorithm import Algorithm
from skugga.shadows.hybrid import hybrid
from skugga.shadows.maps import light_space_perspective_map, perspective_shadow_map, shadow_map
from skugga.shadows.reconstruction import reconstructed_volume
from skugga.shadows.requirements import Requirement, is_area_light, requirements_of
from skugga.shadows.sweep import sweep
from skugga.shadows.truth import truth
from skugga.shadows.volumes import shadow_volume
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES, REFERENCE_NAMES, AlgorithmName
from skugga.terrain.level.level import CasterKind, Shadows

ALGORITHM_MODULES = (
    shadow_map, perspective_shadow_map, light_space_perspective_map, shadow_volume, hybrid,
    reconstructed_volume, planar, sweep, truth, none,
)  # fmt: skip
"""The modules of the algorithms that come with Skugga."""

ALGORITHMS: dict[AlgorithmName, Algorithm] = {module.ALGORITHM.name: module.ALGORITHM for module in ALGORITHM_MODULES}
"""The registered algorithms by name."""


def register_algorithm(algorithm: Algorithm) -> None:
    """Register an algorithm for levels, plans, the selector and the report of this process.

    Parameters
    ----------
    algorithm
        The record of the algorithm. It replaces an algorithm of the same name.
    """
    ALGORITHMS[algorithm.name] = algorithm
    if algorithm.name not in ALGORITHM_NAMES:
        ALGORITHM_NAMES.append(algorithm.name)
    if algorithm.is_selectable and algorithm.name in REFERENCE_NAMES:
        REFERENCE_NAMES.remove(algorithm.name)
    if not algorithm.is_selectable and algorithm.name not in REFERENCE_NAMES:
        REFERENCE_NAMES.append(algorithm.name)


FALLBACK_ALGORITHM: AlgorithmName = shadow_map.ALGORITHM.name
"""The algorithm that serves every view, light and kind of casters. It is used where no other algorithm is preferred."""

NO_SHADOWS: AlgorithmName = none.ALGORITHM.name
"""The algorithm that casts no shadows."""


def selectable_algorithms() -> list[Algorithm]:
    """Return the algorithms among which the selector chooses.

    Returns
    -------
    list of Algorithm
        The algorithms that cast shadows, without the references.
    """
    return [algorithm for algorithm in ALGORITHMS.values() if algorithm.passes and algorithm.is_selectable]


def algorithms_serving(requirements: Iterable[Requirement]) -> list[AlgorithmName]:
    """Return the names of the selectable algorithms that serve some requirements together.

    Parameters
    ----------
    requirements
        The requirements.

    Returns
    -------
    list of str
        The names, in the order of registration.
    """
    requirements = tuple(requirements)
    return [algorithm.name for algorithm in selectable_algorithms() if algorithm.refusal_reason(requirements) is None]


def can_serve(
    algorithm_name: AlgorithmName,
    descriptor: Descriptor,
    light: str,
    caster_kind: CasterKind,
    requested_shadows: Shadows | None = None,
) -> bool:
    """Return whether an algorithm can serve a kind of casters under a light of a view.

    Parameters
    ----------
    algorithm_name
        The name of the algorithm.
    descriptor
        The facts of the view.
    light
        The name of the light.
    caster_kind
        The kind of casters.
    requested_shadows
        The requested shadow settings; ``None``: the defaults.

    Returns
    -------
    bool
        Whether the algorithm refuses none of the requirements.

    Raises
    ------
    KeyError
        The name is not registered, or the view has no such light.
    """
    area = is_area_light(descriptor, light, requested_shadows or Shadows())
    return (
        ALGORITHMS[algorithm_name].refusal_reason(requirements_of(descriptor, descriptor.light_kinds[light], caster_kind, area))
        is None
    )
