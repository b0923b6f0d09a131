"""Textures of models: pictures and colours of vertices, instead of one colour for each triangle.

**Rendering.** The albedo of a model is its texture's, filtered over the pixel's footprint on the triangle
(``skugga.terrain.meshes.texture_loops``), times the colours of vertices and of the material. Maps show the mean colour of each
triangle, and so does the picture without the effect.

**Predicate.** A pixel's footprint is at least as wide as the pixel at the nearest point of a sphere around the model. All values of
the texture lie within the range of the mip level of that width. The effect is not needed if this range, and that of the colours of
vertices, changes no colour by more than a step of 255 in the brightest light.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.model_surfaces import surfaces_in_view, visible_steps, visible_triangles
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.texture_loops import write_texture_rows
from skugga.terrain.scene import Scene


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view in which a textured model lies so near that its texture changes colours by more than a step of 255.

    Left out: maps, which show the mean colour of each triangle; no textured model in view, or all so far away that pixels show the
    mean; even textures.
    """
    steps = numeric_fact(descriptor.facts["textures"]["steps"])
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows the mean colour of each triangle")
    if steps is None:
        return Verdict(False, "no textured model is in view")
    if steps <= 1.0:
        return Verdict(False, f"textures in view change colours by at most {steps:.2g} steps of 255")
    return Verdict(True, f"textures of models change colours by up to {steps:.0f} steps of 255")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the fact ``steps``: an upper bound of the change, in steps of 255; ``None`` if no textured model is in view."""
    steps = []
    for bounds, pixel_m in surfaces_in_view(scene, view):
        if bounds.material.texture is not None or np.ptp(bounds.color_range, axis=0).any():
            (low, high), (least, most) = bounds.shown_range(pixel_m), bounds.albedo_range
            steps.append(visible_steps(scene, np.concatenate([low, least]), np.concatenate([most, high])))
    return {"steps": max(steps, default=None)}


def apply_textures(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Replace the albedo (rows, cols, 3) of models by that of their textures, in place."""
    visible, surface = visible_triangles(block), block.scene.objects.surface
    if visible is not None and surface is not None:
        run_in_chunks(len(albedo), write_texture_rows, visible, surface.atlas, albedo)


EFFECT = Effect("pictures and vertex colours on models", judge, facts, stage="albedo", apply=apply_textures)
