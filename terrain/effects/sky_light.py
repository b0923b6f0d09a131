"""Light of the whole sky in maps: a clear or an overcast sky, part of which ground and buildings hide from each point.

**Rendering.** The sky light of each point is that of a CIE standard sky above the point's own horizons, on its own slope
(``skugga.shadows.sky_light``). It replaces the sky-view factor, and the style's sky that is brighter towards the sun. Trees keep
the light of the open sky.

**Predicate.** The style decides: ``sky: clear`` or ``sky: overcast``, in maps with relief or objects.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.style import has_directional_sky


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a map in a style with ``sky: clear`` or ``overcast``, as ``swiss``; it takes the place of ``sky_view``.

    Left out: an even sky; perspective views; level ground without objects.
    """
    if descriptor.view_kind != "map":
        return Verdict(False, "a perspective view, not a map")
    facts = descriptor.facts["sky_light"]
    sky = facts["sky"]
    if sky == "even":
        return Verdict(False, "the style has an even sky")
    if facts["relief_m"] == 0.0 and not set(descriptor.casters) - {"relief"}:
        return Verdict(False, "level ground: all of it sees the whole sky")
    return Verdict(True, f"the style has a sky of its own: {sky}")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of the sky's light.

    - ``sky``: the style's sky.
    - ``relief_m``: range of the ground's heights, metres.
    """
    low, high = scene.height_range_m
    return {"sky": scene.style.sky, "relief_m": float(high - low)}


def apply_sky_light(skylight: np.ndarray, block: ShadingBlock) -> None:
    """Replace the sky light of a map's ground and buildings. A perspective view, and a style with an even sky, do not change."""
    if not isinstance(block.view, MapView) or block.sky_light_factor is None or not has_directional_sky(block.scene.style):
        return
    is_lit = block.buffer.valid & (block.buffer.surface_kind != FOREST)
    np.copyto(skylight, block.sky_light_factor(block), where=is_lit)


EFFECT = Effect("a clear or overcast sky over maps, instead of `sky_view`", judge, facts, "skylight", apply_sky_light)
