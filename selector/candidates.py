"""The plans that are compared: every capable algorithm over a grid of settings and by kind of casters, most telling ones first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice, product
from typing import Any

from selector.planner.planner import choose
from shadows.plan import HybridSettings, LampMapSettings, PerspectiveMapSettings, Plan, Settings, ShadowMapSettings
from shadows.registry import ALGORITHMS
from terrain.describe import describe
from terrain.errors import UnsupportedError
from terrain.facts.descriptor import Descriptor
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView
from terrain.level.level import SUN, AlgorithmName, Level
from terrain.scene import Scene

MOST = 40
"""Candidates of a view, at most."""

MAP_SIZES = (2048, 1024, 4096, 512)
PERSPECTIVE_SIZES = (1024, 2048, 512)
FILTERS = (1, 3)

Asked = dict[str, Any]

GRID: list[Asked] = [
    *({"algorithm": "shadow_map", "map_size": size, "filter": taps} for size, taps in product(MAP_SIZES, FILTERS)),
    *(
        {"algorithm": "perspective_shadow_map", "map_size": size, "filter": taps}
        for size, taps in product(PERSPECTIVE_SIZES, FILTERS)
    ),
]
"""Texels and taps."""

MIXES: list[Asked] = [
    {"algorithm": {"relief": relief, "meshes": meshes}}
    for relief, meshes in (
        ("sweep", "shadow_map"), ("sweep", "shadow_volume"), ("sweep", "hybrid"), ("shadow_map", "shadow_volume"),
        ("perspective_shadow_map", "shadow_volume"), ("shadow_map", "perspective_shadow_map"),
    )
]  # fmt: skip
"""Kinds of casters apart, where there are both; what casts besides (forest) goes by a shadow map."""

WAYS: list[Asked] = [
    {"algorithm": "hybrid", "mask": "original"},
    {"algorithm": "hybrid", "map_size": 2048},
    {"algorithm": "shadow_volume", "stencil": "two_pass"},
    {"algorithm": "shadow_volume", "counting": "z_fail"},
    {"algorithm": "sweep", "filter": "sun"},
]
"""Ways of marking, counting and sweeping."""

MIDDLE: Asked = {"algorithm": "shadow_map", "map_size": 1024, "filter": 1}
TURNS: list[Asked] = [
    {"cascades": 1}, {"cascades": 2}, {"cascades": 4}, {"filter": "sun"}, {"filter": 5}, {"depth_bits": 16}, {"depth_bits": 24},
    {"depth_bits": 32}, {"bias": "normal_offset"}, {"bias": "polygon_offset"}, {"fit": "tight"}, {"culling": "front"},
]  # fmt: skip
"""What is turned one at a time, from a map of the middle's settings."""


def candidates(scene: Scene, view: MapView | PerspectiveView, name: str = "map", light: str = SUN) -> list[Plan]:
    """The plans to compare under a light, at most ``MOST``, no two of one name.

    First comes what is taken where nothing more is asked, and the algorithms as they are by themselves; then texels and taps,
    mixes of algorithms by kind of casters, and what is turned one at a time. An algorithm that cannot serve everything takes on
    the sun's relief and meshes, or relief alone, beside shadow maps.
    """
    descriptor, level = describe(scene, view, name), scene.loaded.level
    plans: dict[str, Plan] = {}
    for plan in _plans(descriptor, level, light):
        plans.setdefault(name_of(plan, light), plan)
    return list(islice(plans.values(), MOST))


def name_of(plan: Plan, light: str = SUN) -> str:
    """A plan's algorithms and settings under a light in few words: ``shadow_map-2048-3-16``, ``relief=sweep,meshes=shadow_volume``.

    A map is named by texels a side, taps a side and bits; what is not as it is by itself is added.
    """
    kinds: dict[str, list[str]] = {}
    for kind, name in plan.algorithm.get(light, {}).items():
        settings = plan.settings.get(light, {}).get(kind)
        kinds.setdefault("-".join([name, *([] if settings is None else _words(settings))]), []).append(kind)
    if len(kinds) <= 1:
        return next(iter(kinds), "none")
    return ",".join(f"{'+'.join(its)}={name}" for name, its in kinds.items())


def _plans(descriptor: Descriptor, level: Level, light: str) -> Iterator[Plan]:
    with suppress(UnsupportedError):  # what the level asks for may not serve this view
        yield choose(descriptor, level)
    shown = [name for name in ALGORITHMS if name != "truth"]
    for asked in [*({"algorithm": name} for name in shown), *GRID]:
        yield from _as_far_as_it_serves(descriptor, level, light, asked)
    if light == SUN and {"relief", "meshes"} <= set(descriptor.casters):
        yield from (plan for asked in MIXES for plan in _served(descriptor, level, light, asked))
    for asked in [*WAYS, *(MIDDLE | turn for turn in TURNS)]:
        yield from _as_far_as_it_serves(descriptor, level, light, asked)


def _as_far_as_it_serves(descriptor: Descriptor, level: Level, light: str, asked: Asked) -> list[Plan]:
    name: AlgorithmName = asked["algorithm"]
    parts = [name, *([{"relief": name, "meshes": name}, {"relief": name}] if light == SUN else [])]
    return next(filter(None, (_served(descriptor, level, light, asked | {"algorithm": part}) for part in parts)), [])


def _served(descriptor: Descriptor, level: Level, light: str, asked: Asked) -> list[Plan]:
    """The plan of what is asked, if it is served and really taken under the light."""
    with suppress(UnsupportedError):  # to whoever asks for it by name it says why
        plan = choose(descriptor, level, asked, picks={})  # what is not named goes by shadow maps
        wanted = asked["algorithm"]
        names = set(wanted.values()) if isinstance(wanted, dict) else {wanted}
        if names & set(plan.algorithm.get(light, {}).values()) or not plan.algorithm:
            return [plan]
    return []


def _words(settings: Settings) -> list[str]:
    if isinstance(settings, HybridSettings):
        return [str(settings.map.map_size), settings.mask, *_changed(settings, "stencil", "counting")]
    if not isinstance(settings, ShadowMapSettings | LampMapSettings | PerspectiveMapSettings):
        return _changed(settings, "stencil", "counting", "filter")
    words = [str(settings.map_size), str(settings.filter), str(settings.depth_bits)]
    if isinstance(settings, ShadowMapSettings) and len(settings.cascades) > 1:
        words.append(f"{len(settings.cascades)}cascades")
    return [*words, *_changed(settings, "fit", "bias", "culling")]


def _changed(settings: Settings, *names: str) -> list[str]:
    """The values of those fields that are not as they are by themselves."""
    fields = type(settings).model_fields
    return [str(getattr(settings, name)) for name in names if name in fields and getattr(settings, name) != fields[name].default]
