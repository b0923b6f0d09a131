"""The portfolio: the choices of algorithms and settings from which policies select.

It has every algorithm that can draw the view, alone and in useful combinations, with several settings.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import product
from typing import Any, get_args

from skugga.selector.choices import Choice
from skugga.selector.mixes import MIXES
from skugga.shadows.algorithm import Algorithm
from skugga.shadows.registry import ALGORITHMS, FALLBACK_ALGORITHM, can_serve, selectable_algorithms
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind, Shadows

SETTING_FORMATS = {"map_size": "{}", "cascades": "x{}"}
"""Formats of values of settings in the name of a choice. All other settings are written with their key."""


def combinations() -> list[tuple[str, Mapping[CasterKind, AlgorithmName]]]:
    """Return combinations of algorithms by kind of casters, each with a name.

    Each algorithm alone comes first, for the kinds of casters whose shadows it can draw. Then follow the combinations of ``MIXES``.
    Shadow maps draw the kinds without an entry.
    """
    by_themselves = [
        (
            _name_without_companion(algorithm),
            {kind: algorithm.name for kind in get_args(CasterKind) if kind not in algorithm.refusals},
        )
        for algorithm in selectable_algorithms()
    ]
    return [*by_themselves, *((mix.name, mix.algorithm) for mix in MIXES if mix.in_portfolio)]


def tuned_settings() -> tuple[str, ...]:
    """Return the fields of ``Shadows`` for which choices try different values."""
    return tuple(dict.fromkeys(key for algorithm in selectable_algorithms() for key in algorithm.search.search_space))


def portfolio(
    descriptor: Descriptor, light: str, kinds: Collection[CasterKind], requested_shadows: Shadows | None = None
) -> list[Choice]:
    """Return the choices for a light and the kinds of casters that cast shadows under it.

    No two of them have the same algorithms and settings. All of them are possible together with the requested shadow settings.
    """
    return list(_distinct_choices(descriptor, light, [kind for kind in descriptor.casters if kind in kinds], requested_shadows))


def _name_without_companion(algorithm: Algorithm) -> str:
    """Return the name of a choice of one algorithm. It includes the fallback's name if the algorithm cannot draw meshes."""
    return f"{algorithm.name}+{FALLBACK_ALGORITHM}" if "meshes" in algorithm.refusals else algorithm.name


def _distinct_choices(
    descriptor: Descriptor, light: str, kinds: list[CasterKind], requested_shadows: Shadows | None
) -> Iterator[Choice]:
    """Yield the choices of ``portfolio``. ``kinds`` are the kinds of casters that cast shadows, in the order of the descriptor."""
    yielded = set()
    for combination, named_algorithms in combinations():
        algorithm = {kind: named_algorithms.get(kind, FALLBACK_ALGORITHM) for kind in kinds}
        if not all(can_serve(name, descriptor, light, kind, requested_shadows) for kind, name in algorithm.items()):
            continue
        if any(ALGORITHMS[name].search.is_excluded(descriptor, kind) for kind, name in algorithm.items()):
            continue
        for settings in _settings_to_try(descriptor, light, [ALGORITHMS[name] for name in dict.fromkeys(algorithm.values())]):
            words = [combination, *(SETTING_FORMATS.get(key, f"{key} {{}}").format(value) for key, value in settings.items())]
            key = (tuple(algorithm.items()), tuple(settings.items()))
            if key not in yielded:
                yielded.add(key)
                yield Choice(" ".join(words), algorithm, settings)


def _settings_to_try(descriptor: Descriptor, light: str, algorithms: list[Algorithm]) -> Iterator[dict[str, Any]]:
    """Yield the settings, by field of ``Shadows``, to try for algorithms that a choice uses together."""
    search_space: dict[str, tuple[Any, ...]] = {}
    for name in algorithms:
        for key, values in name.search.search_space.items():
            possible = [value if name.search.is_tunable(descriptor, light, key, value) else None for value in values]
            search_space[key] = tuple(dict.fromkeys([*search_space.get(key, ()), *possible]))
    companion_sizes = [
        name.search.map_sizes_for_other_casters for name in algorithms if name.search.map_sizes_for_other_casters is not None
    ]
    if companion_sizes and "map_size" in search_space:
        search_space = {"map_size": companion_sizes[0]}
    for values in product(*search_space.values()):
        yield {key: value for key, value in zip(search_space, values, strict=True) if value is not None}
