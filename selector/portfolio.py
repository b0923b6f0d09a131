"""The picks that policies choose among: every capable algorithm by itself and in useful company, over map sizes and cascades."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import islice, product

from selector.picks import Pick
from selector.serves import SWEPT_M, serves, swept_m
from terrain.facts.descriptor import Descriptor
from terrain.level.level import SUN, AlgorithmName, CasterKind

MOST = 40
"""Picks of a light, at most; what stands last in ``COMPANY`` is cut off first."""

SHADOW_MAP: AlgorithmName = "shadow_map"
PERSPECTIVE: AlgorithmName = "perspective_shadow_map"
MAP_SIZES = (1024, 2048, 512, 4096)
BESIDE_SIZES = (1024, 2048, 4096)
"""Sizes of the maps of trees beside algorithms that have no maps."""
CASCADES = (1, 2, 4)

COMPANY: tuple[tuple[str, dict[CasterKind, AlgorithmName]], ...] = (
    ("shadow_map", {}),
    (PERSPECTIVE, {"relief": PERSPECTIVE, "meshes": PERSPECTIVE, "forest": PERSPECTIVE}),
    ("shadow_volume", {"relief": "shadow_volume", "meshes": "shadow_volume"}),
    ("hybrid", {"relief": "hybrid", "meshes": "hybrid"}),
    ("planar", {"relief": "planar", "meshes": "planar", "forest": "planar"}),
    ("sweep+shadow_map", {"relief": "sweep"}),
    ("sweep+shadow_volume", {"relief": "sweep", "meshes": "shadow_volume"}),
    ("sweep+perspective_shadow_map", {"relief": "sweep", "meshes": PERSPECTIVE, "forest": PERSPECTIVE}),
    ("sweep+hybrid", {"relief": "sweep", "meshes": "hybrid"}),
    ("shadow_map+shadow_volume", {"meshes": "shadow_volume"}),
)  # fmt: skip
"""Algorithms by kind of casters, by name; kinds that are not named go by shadow maps."""


VOLUMES = {"shadow_volume", "hybrid"}
MOST_VOLUMES = 2**18
"""Triangles of ground from which on volumes of its edges are no candidate: measured, they take ten to twenty times what a sweep
does, and are no better (docs/accuracy.md).
"""


def portfolio(descriptor: Descriptor, light: str, kinds: Collection[CasterKind]) -> list[Pick]:
    """What can be picked for a light, for the kinds of casters that cast at all: at most ``MOST``, no two that come to the same."""
    return list(islice(_distinct(descriptor, light, [kind for kind in descriptor.casters if kind in kinds]), MOST))


def _distinct(descriptor: Descriptor, light: str, kinds: list[CasterKind]) -> Iterator[Pick]:
    seen = set()
    across_m = swept_m(descriptor) or 0.0
    triangles = sum(each.triangles + each.outside_triangles for each in descriptor.stands if each.kind == "relief")
    for company, named in COMPANY:
        algorithm = {kind: named.get(kind, SHADOW_MAP) for kind in kinds}
        if not all(serves(name, descriptor, light, kind) for kind, name in algorithm.items()):
            continue
        if algorithm.get("relief") in VOLUMES and triangles > MOST_VOLUMES:
            continue
        if algorithm.get("relief") == "sweep" and across_m > SWEPT_M:
            continue
        for settings in _settings(descriptor, light, set(algorithm.values())):
            words = [company, *(f"{settings[key]}" if key == "map_size" else f"x{settings[key]}" for key in settings)]
            key = (tuple(algorithm.items()), tuple(settings.items()))
            if key not in seen:
                seen.add(key)
                yield Pick(" ".join(words), algorithm, settings)


def _settings(descriptor: Descriptor, light: str, names: set[AlgorithmName]) -> Iterator[dict[str, int]]:
    """What is turned: texels a side where there are maps, and the number of a perspective view's maps under the sun."""
    if not names & {SHADOW_MAP, PERSPECTIVE}:
        yield {}
        return
    alone = names <= {SHADOW_MAP, PERSPECTIVE, "sweep"}
    cascades = CASCADES if alone and SHADOW_MAP in names and light == SUN and descriptor.bands else (None,)
    for size, count in product(MAP_SIZES if alone else BESIDE_SIZES, cascades):
        yield {"map_size": size} | ({} if count is None or count > len(descriptor.bands) else {"cascades": count})
