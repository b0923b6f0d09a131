"""Maps of bare ground as they are shown, without a geometry buffer: what the map service draws most.

Where heights alone say what is seen and how it is shaded, a block's colour and its shadow's opacity need no triangles: shadows are
swept over nodes (``shadows.coarse_pixels``, as in any picture), and ground that is kept from sun to sun is shaded in one pass
(``terrain.gbuffer.bare_ground``). The pictures are those of ``render_frame``. Masks, data layers and all else are drawn there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shadows.coarse_pixels import coarse_pixels, halved_pixels, heights_say_all, mean_visibilities
from shadows.passes import ATTACHED_PASS, CASTERS_PASS, GEOMETRY_PASS, PassLog, PassRecord
from shadows.plan import Plan
from shadows.render import REFRACTION_PASS, SHADING_PASS, render_frame
from shadows.visibility import with_apparent_sun
from terrain.casters.reach import NO_CASTERS, Reach, reach_over
from terrain.gbuffer.bare_ground import BareGround, bare_ground
from terrain.gbuffer.bare_nodes import bare_nodes
from terrain.gbuffer.covered_nodes import is_bare
from terrain.gbuffer.picture import imagery_of
from terrain.geo.grid import MapView
from terrain.ground.sky_view_factor import sky_view
from terrain.level.level import SUN
from terrain.scene import Scene
from terrain.shading import shaded_ground

SKY_PASS = "sky_view"

DRAWN_HERE = frozenset({"cast_shadows", CASTERS_PASS, SKY_PASS, REFRACTION_PASS})
"""Effects that may run in such a map."""


LEAST_SUNWARD = 0.05
"""Least cosine between a smooth normal and the sun's direction from which on no triangle round it is taken to be turned away."""


@dataclass(frozen=True, eq=False)
class ShownMap:
    """A map's block as it is shown: ``color`` (rows, cols, 3) uint8 sRGB, ``opacity`` (rows, cols) uint8 of the first light's
    shadow, ``there`` bool, where there is a surface; the rest is as in a ``Frame``.
    """

    color: np.ndarray
    opacity: np.ndarray
    there: np.ndarray
    passes: tuple[PassRecord, ...]
    reach: Reach


def shown_map(scene: Scene, view: MapView, plan: Plan) -> ShownMap:
    """Execute a plan for a block of a map's pixels, as far as it is shown. Raises as ``render_frame``."""
    drawn = _ground_picture(scene, view, plan) if _ground_alone(scene, view, plan) else None
    if drawn is not None:
        return drawn
    frame = render_frame(scene, view, plan)
    return ShownMap(frame.color, frame.opacity, frame.there, frame.passes, frame.reach)


def _ground_alone(scene: Scene, view: MapView, plan: Plan) -> bool:
    """Whether heights alone say what is seen, and the sun and the sky how it is shaded."""
    level = scene.loaded.level
    plain = is_bare(scene) and level.water is None and imagery_of(scene) is None and scene.sun is not None
    return (
        plain
        and view.on_nodes
        and plan.runs <= DRAWN_HERE
        and (heights_say_all(scene, plan) or not plan.casts or not scene.sun_is_up)
    )


def _ground_picture(scene: Scene, view: MapView, plan: Plan) -> ShownMap | None:
    log = PassLog()
    if REFRACTION_PASS in plan.runs:
        with log.run(REFRACTION_PASS):
            scene = with_apparent_sun(scene, plan.runs)
    else:
        scene = with_apparent_sun(scene, plan.runs)
    with log.run(GEOMETRY_PASS):
        sky = sky_view(scene.elevation, scene.world) if SKY_PASS in plan.runs else None
        ground = bare_ground(scene, view, sky)
    if ground is None:
        return None
    if not ground.there.any():
        nothing = np.zeros(ground.there.shape, np.uint8)
        return ShownMap(np.zeros((*nothing.shape, 3), np.uint8), nothing, ground.there, (), NO_CASTERS.reach)
    with log.run(GEOMETRY_PASS):
        reach = reach_over(scene, bare_nodes(scene, ground.window_view, 1))
    lit = _lit_shares(scene, ground, plan, log)
    if lit is None:
        return None
    if SKY_PASS in plan.runs:
        with log.run(SKY_PASS):
            pass  # the ground has its share of the sky
    with log.run(SHADING_PASS):
        color = shaded_ground(ground, scene, lit)
        opacity = np.rint(255.0 * (1.0 - np.where(ground.there, lit, np.float32(1.0)))).astype(np.uint8)
    return ShownMap(color, opacity, ground.there, tuple(log.records.values()), reach)


def _faces_sun(ground: BareGround, scene: Scene) -> bool:
    """Whether all ground faces the sun, so surely that its triangles do, too: then none of it is in attached shadow."""
    assert scene.sun is not None
    facing = ground.normal_frame @ scene.sun.in_frame(ground.frame).astype(np.float32)
    return float(facing[ground.there[ground.window]].min(initial=1.0)) > LEAST_SUNWARD


def _lit_shares(scene: Scene, ground: BareGround, plan: Plan, log: PassLog) -> np.ndarray | None:
    """The share (rows, cols) float32 of each pixel that the sun lights; ``None`` where heights do not say."""
    if not scene.sun_is_up:
        with log.run(ATTACHED_PASS):
            return np.zeros(ground.there.shape, np.float32)
    if not plan.casts:
        with log.run(ATTACHED_PASS):
            return np.ones(ground.there.shape, np.float32) if _faces_sun(ground, scene) else None
    pixels = coarse_pixels(scene, ground.view, plan) or halved_pixels(scene, ground.view, plan)
    if pixels is None or not pixels.bare:
        return None
    return mean_visibilities(pixels, ground, log)[SUN]
