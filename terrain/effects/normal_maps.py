"""Normal maps: the relief of a model's surface in its light.

**Rendering.** The shading normal of a model is tilted by its normal map, filtered as textures are. Shadows do not change: they
follow from the triangles.

**Predicate.** As that of ``textures``: no normal within the pixel's footprint is tilted more than the steepest one of the mip level
that is as wide as the nearest pixel. The effect is not needed if a tilt by as much changes no white surface by more than a step of
255. On glossy models any tilt counts.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.model_surfaces import MAX_STEPS, surfaces_in_view, visible_steps, visible_triangles
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.texture_loops import write_normal_rows
from skugga.terrain.scene import Scene


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view in which a normal map tilts normals so far that white surfaces change by more than a step of 255; on
    glossy models, any tilt.

    Left out: maps; no normal map in view, or all so far away that their tilts cancel; flat normal maps.
    """
    steps = numeric_fact(descriptor.facts["normal_maps"]["steps"])
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows the triangles of models alone")
    if steps is None:
        return Verdict(False, "no model with a normal map is in view")
    if steps <= 1.0:
        return Verdict(False, f"normal maps in view change colours by at most {steps:.2g} steps of 255")
    return Verdict(True, f"normal maps of models change colours by up to {steps:.0f} steps of 255")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the fact ``steps``: an upper bound of the change, in steps of 255; ``None`` if no normal map is in view."""
    steps = []
    for bounds, pixel_m in surfaces_in_view(scene, view):
        if bounds.material.normal_map is not None:
            tilt = bounds.tilt(pixel_m)
            steps.append(
                MAX_STEPS if tilt > 0.0 and bounds.material.is_glossy else visible_steps(scene, np.zeros(1), np.array([tilt]))
            )
    return {"steps": max(steps, default=None)}


def apply_normal_maps(normal: np.ndarray, block: ShadingBlock) -> None:
    """Tilt the shading normals (rows, cols, 3) of models by their normal maps, in place."""
    visible, surface = visible_triangles(block), block.scene.objects.surface
    if visible is not None and surface is not None and len(surface.atlas.normals):
        run_in_chunks(len(normal), write_normal_rows, visible, surface.atlas, normal)


EFFECT = Effect("relief of a model's surface", judge, facts, stage="normal", apply=apply_normal_maps)
