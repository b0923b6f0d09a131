"""Alpha-tested casters: light passes between the leaves of trees, since shadow passes sample the alpha of the foliage texture.

The effect is off if no foliage can cast a visible shadow. Then the shaders need no texture look-up.
"""

from __future__ import annotations

from skugga.terrain.effects import cast_shadows
from skugga.terrain.effects.effect import Effect, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.gbuffer.supersampling import supersampled_view
from skugga.terrain.gbuffer.tree_instances import map_draws_trees, tree_instances_in_perspective
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: the shadow of foliage can fall on a visible surface, or a lamp shines.

    Left out: there is no foliage, all its trees are too small to be drawn, or none of its shadow can be visible.
    """
    if "forest" not in descriptor.casters:
        return Verdict(False, "there is no foliage")
    if not descriptor.facts.get("alpha_test", {}).get("drawn", True):
        return Verdict(False, "no tree is large enough to be drawn")
    if any(lamp.reaches for lamp in descriptor.lamps):
        return Verdict(True, "foliage in the light of lamps")
    return cast_shadows.sun_caster_verdict(descriptor, "forest")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the fact ``drawn``: whether the view draws any tree after the decimation of small trees. Empty without trees."""
    if scene.objects.trees is None:
        return {}
    sampled_view = supersampled_view(scene, view)
    if isinstance(sampled_view, MapView):
        pixel_m = map_pixel_m(scene.world, sampled_view)
        return {"drawn": map_draws_trees(scene.objects.trees, pixel_m)}
    trees = tree_instances_in_perspective(
        scene.objects, sampled_view.frame(scene.world), tuple(sampled_view.eye_earth_m), sampled_view.focal_px
    )
    return {"drawn": trees is not None and len(trees) > 0}


EFFECT = Effect(
    "light through holes in the texture of foliage", judge, facts, required_effects=("cast_shadows",), verdict_without_facts=None
)
