"""Highlights: the sun mirrored by glossy models, by their roughness and metallic factor.

**Rendering.** A normalised Blinn-Phong lobe, whose exponent follows from the roughness of glTF: 2 / roughness^4 - 2. What is
mirrored lacks in the diffuse light, so that no surface sends out more light than it receives. A metal has no diffuse light of the
sun; in the sky's light it keeps its colour, which stands for the mirrored sky.

**Predicate.** The effect is needed where a model of such a material is in view in direct sunlight. Snow covers the gloss: it is
left out. Rough metals, the default of glTF, follow Lambert's law without it.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.model_surfaces import surfaces_in_view, visible_triangles
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.texture_loops import write_gloss_rows
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view with such a model in it, and direct sunlight.

    Left out: maps; no glossy model in view; rough metals, the default of glTF, which scatter light as Lambert's law says; night, a
    covered sky; snow.
    """
    facts = descriptor.facts["highlights"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows models without highlights")
    if not facts["glossy"]:
        return Verdict(False, "no glossy model is in view")
    if not facts["sunlit"]:
        return Verdict(False, "there is no direct sunlight")
    if facts["snow"]:
        return Verdict(False, "snow covers the gloss of models")
    return Verdict(True, f"{facts['glossy']:.0f} glossy materials are in view in sunlight")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of highlights.

    - ``glossy``: the number of glossy materials of models in view.
    - ``sunlit``: whether direct sunlight reaches the level.
    - ``snow``: whether snow lies.
    """
    glossy = {id(item.bounds.material) for item in surfaces_in_view(scene, view) if item.bounds.material.is_glossy}
    sunlit = scene.sun_is_up and bool(daylight_of(scene).sun_irradiance.any())
    return {"glossy": len(glossy), "sunlit": sunlit, "snow": scene.loaded.level.weather.snow}


def apply_highlights(gloss: np.ndarray, block: ShadingBlock) -> None:
    """Write the sunlight that glossy models mirror to ``gloss`` (rows, cols, 4)."""
    visible, surface, sun = visible_triangles(block), block.scene.objects.surface, block.scene.sun
    if visible is None or surface is None or sun is None or block.scene.loaded.level.weather.snow:
        return
    to_sun = sun.in_frame(block.buffer.frame)
    run_in_chunks(len(gloss), write_gloss_rows, visible, surface.atlas, block.buffer.shading_normal_frame, to_sun, gloss)


EFFECT = Effect("the sun mirrored by glossy models", judge, facts, stage="gloss", apply=apply_highlights)
