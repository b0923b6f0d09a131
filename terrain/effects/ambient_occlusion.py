"""Ambient occlusion: buildings, models and trees hide a part of the sky from what stands beside them.

**Rendering.** In perspective views, the sky light of each point is multiplied by the share of the light from all directions that
reaches it past the meshes and trees nearby (``skugga.terrain.gbuffer.near_occluders``), so that nothing floats above its ground.
It is kept from sun to sun. In maps ``sky_light`` does so, where a style has a sky of its own.

**Predicate.** Some mesh or tree must reach into the view, and darkening all light of the sky must change the brightest surface by
more than a step of 255.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.sky_view import max_darkening_steps, max_sky_lit_color
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.near_occluders import near_occluders, open_share
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view into which a mesh or a tree reaches as far as it hides light, by day.

    Left out: maps; no object near; a dark night.
    """
    if descriptor.view_kind == "map":
        return Verdict(False, "a map, not a perspective view")
    facts = descriptor.facts["ambient_occlusion"]
    bodies, steps = numeric_fact(facts["bodies"]), numeric_fact(facts["steps"])
    if not bodies or steps is None:
        return Verdict(False, "no mesh or tree is near anything in view")
    if steps <= 1.0:
        return Verdict(False, "the sky is too dark for its hidden parts to show")
    return Verdict(True, f"{bodies:.0f} meshes and trees hide the sky from what is near them: up to {steps:.0f} steps of 255")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of ambient occlusion.

    - ``bodies``: number of meshes and trees that reach into the view, each as far as it hides light.
    - ``steps``: number of steps of 1/255 by which the brightest surface darkens that loses all light of the sky.
    """
    if isinstance(view, MapView) or coarse_view is None or scene.objects.caster_kinds == ("relief",):
        return {"bodies": 0, "steps": 0.0}
    buffer = coarse_view.buffer
    occluders = near_occluders(scene.objects.solids, buffer.solids_frame_m, buffer.tree_instances)
    eye, camera_from_frame = view.in_frame(buffer.frame)
    top, left, bottom, right = view.row0 - 1.0, view.col0 - 1.0, view.row0 + view.rows, view.col0 + view.cols
    tangents = np.array([[left, right], [top, bottom]]) * view.step_px / view.focal_px
    count = _count_in_pyramid(occluders.spheres, occluders.reach_m, eye, camera_from_frame, tangents)
    return {"bodies": int(count), "steps": float(max_darkening_steps(max_sky_lit_color(scene, view), 1.0))}


@compiled
def _count_in_pyramid(spheres, reach, eye, rotation, tangents):
    """Return the number of bodies whose reach meets a viewing pyramid (``TreeInstances.in_frustum``)."""
    count = 0
    for n in range(len(reach)):
        x, y, z = spheres[n, 0] - eye[0], spheres[n, 1] - eye[1], spheres[n, 2] - eye[2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        is_inside = depth > -reach[n]
        for axis in range(2):
            across = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z
            low, high = tangents[axis, 0], tangents[axis, 1]
            is_inside = is_inside and across - low * depth > -reach[n] * np.sqrt(1.0 + low * low)
            is_inside = is_inside and high * depth - across > -reach[n] * np.sqrt(1.0 + high * high)
        count += is_inside
    return count


def apply_ambient_occlusion(skylight: np.ndarray, block: ShadingBlock) -> None:
    """Multiply the sky light of a perspective view's points, (rows, cols), by the share that objects nearby leave them."""
    if isinstance(block.view, PerspectiveView):
        skylight *= open_share(block.buffer, block.scene.objects.solids)


EFFECT = Effect(
    "ambient occlusion: less sky light beside buildings, under trees and between things",
    judge,
    facts,
    "skylight",
    apply_ambient_occlusion,
)
