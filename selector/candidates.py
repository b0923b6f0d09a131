"""Candidate plans of the accuracy report: every capable algorithm with several settings, and combinations by kind of casters."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any

from skugga.selector.mixes import MIXES
from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHMS, FALLBACK_ALGORITHM, NO_SHADOWS
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import SUN, Level
from skugga.terrain.scene import Scene

MAX_CANDIDATES = 48
"""Maximum number of candidates of a view."""

DEFAULT_PLAN_FILTERS: tuple[int | str, ...] = (1, 3, "sun")
"""Values of the setting ``filter`` for variants of the default plan: taps along a side, or the sun's disc."""


def candidates(scene: Scene, view: MapView | PerspectiveView, name: str = "map", light: str = SUN) -> list[Plan]:
    """Return the plans that the accuracy report compares under a light, at most ``MAX_CANDIDATES`` with unique names.

    - The default plan is first, followed by variants with other filters, which show the effect of the filter on edges.
    - Next are algorithms with their default settings, several map sizes and filters, combinations by kind of casters, and variants
      of single settings.
    - An algorithm that cannot draw the shadows of all casters draws those of relief and meshes under the sun, or of relief alone.
      Shadow maps draw all others.
    """
    descriptor, level = describe(scene, view, name, "points"), scene.loaded.level
    plans: dict[str, Plan] = {}
    for plan in _plans(descriptor, level, light):
        plans.setdefault(name_of(plan, light), plan)
    return list(islice(plans.values(), MAX_CANDIDATES))


def name_of(plan: Plan, light: str = SUN) -> str:
    """Return a short name of a plan's algorithms and settings under a light.

    Examples: ``shadow_map-2048-3-16``, ``relief=sweep,meshes=shadow_volume``. The numbers of a shadow map are its texels per side,
    its filter taps per side and its depth bits. Other settings follow if they differ from the defaults.
    """
    kinds: dict[str, list[str]] = {}
    for kind, name in plan.algorithm.get(light, {}).items():
        settings = plan.settings.get(light, {}).get(kind)
        kinds.setdefault("-".join([name, *([] if settings is None else settings.label_parts)]), []).append(kind)
    if len(kinds) <= 1:
        return next(iter(kinds), NO_SHADOWS)
    return ",".join(f"{'+'.join(algorithm_kinds)}={name}" for name, algorithm_kinds in kinds.items())


def _plans(descriptor: Descriptor, level: Level, light: str) -> Iterator[Plan]:
    """Yield the plans that ``candidates`` describes, in its order; several may have the same name."""
    with suppress(UnsupportedError):  # the level's own algorithm may not serve this view
        default = make_plan(descriptor, level)
        yield default
        for taps in DEFAULT_PLAN_FILTERS:
            with suppress(UnsupportedError):  # not every algorithm has every filter
                yield make_plan(descriptor, level, {"algorithm": {light: default.algorithm.get(light, {})}, "filter": taps})
    algorithms = [algorithm for algorithm in ALGORITHMS.values() if algorithm.is_selectable]
    compared_overrides = [
        {"algorithm": algorithm.name, **overrides} for algorithm in algorithms for overrides in algorithm.search.resolution_variants
    ]
    for algorithm_overrides in [*({"algorithm": algorithm.name} for algorithm in algorithms), *compared_overrides]:
        yield from _widest_served_plans(descriptor, level, light, algorithm_overrides)
    if light == SUN and {"relief", "meshes"} <= set(descriptor.casters):
        for mix in (mix for mix in MIXES if mix.in_report):
            by_kind = {kind: mix.algorithm.get(kind, FALLBACK_ALGORITHM) for kind in ("relief", "meshes")}
            yield from _served_plans(descriptor, level, light, {"algorithm": by_kind})
    for algorithm in reversed(algorithms):
        for overrides in algorithm.search.other_variants:
            yield from _widest_served_plans(descriptor, level, light, {"algorithm": algorithm.name, **overrides})


def _widest_served_plans(descriptor: Descriptor, level: Level, light: str, overrides: dict[str, Any]) -> list[Plan]:
    """Return a list with the plan that uses ``overrides["algorithm"]`` for the most kinds of casters that it can serve.

    These are all kinds, or under the sun relief and meshes, or relief alone. The list is empty if there is no such plan.
    ``overrides`` are values by field of ``Shadows``.
    """
    name: AlgorithmName = overrides["algorithm"]
    parts = [name, *([{"relief": name, "meshes": name}, {"relief": name}] if light == SUN else [])]
    return next(filter(None, (_served_plans(descriptor, level, light, overrides | {"algorithm": part}) for part in parts)), [])


def _served_plans(descriptor: Descriptor, level: Level, light: str, overrides: dict[str, Any]) -> list[Plan]:
    """Return a list with the plan for ``overrides`` (values by field of ``Shadows``).

    The list is empty if the requested algorithm cannot draw the view. It is also empty if the plan has shadows, but does not use
    the algorithm under the light.
    """
    with suppress(UnsupportedError):
        plan = make_plan(descriptor, level, overrides, choices={})  # other kinds use shadow maps
        requested = overrides["algorithm"]
        names = set(requested.values()) if isinstance(requested, dict) else {requested}
        if names & set(plan.algorithm.get(light, {}).values()) or not plan.algorithm:
            return [plan]
    return []
