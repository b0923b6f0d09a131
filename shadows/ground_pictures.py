"""Maps of bare ground as they are shown, without a geometry buffer for each sun: what the map service and films draw most.

Where heights alone say what is seen and how it is shaded, a block's colour and its shadow's opacity need no triangles: shadows are
swept over nodes (``skugga.shadows.coarse_pixels``, as in any picture), and ground that is kept from sun to sun is shaded in one
pass (``skugga.terrain.gbuffer.bare_ground``). The pictures are those of ``render_frame``. Masks, data layers and all else are drawn
there.

Pixels that are no nodes, as those of most pictures, take their ground from a geometry buffer once for all suns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.coarse_pixels import coarse_pixels, halved_pixels, heights_say_all, mean_visibilities
from skugga.shadows.passes import ATTACHED_PASS, CASTERS_PASS, GEOMETRY_PASS, PassLog, PassRecord
from skugga.shadows.plan import Plan
from skugga.shadows.render import REFRACTION_PASS, SHADING_PASS, render_frame
from skugga.shadows.visibility import with_apparent_sun
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.reach import NO_CASTERS, Reach, reach_over
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.sky_view import apply_sky_view
from skugga.terrain.gbuffer.bare_ground import BareGround, bare_ground
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.gbuffer.covered_nodes import is_bare
from skugga.terrain.gbuffer.picture import geometry_of, imagery_of
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView, blocks_of
from skugga.terrain.ground.sky_view_factor import SkyView, sky_view
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene
from skugga.terrain.shading import open_sky, shaded_ground

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


def shown_color(scene: Scene, view: MapView | PerspectiveView, plan: Plan) -> np.ndarray:
    """The colour (rows, cols, 3) uint8 sRGB of a view's picture by a plan. Raises as ``render_frame``."""
    if not isinstance(view, MapView) or not needs_no_gl(scene, view, plan):
        return render_frame(scene, view, plan).color
    out = np.zeros((view.rows, view.cols, 3), np.uint8)
    for block, row, col in blocks_of(view):
        inside = slice(max(-row, 0), view.rows - row), slice(max(-col, 0), view.cols - col)
        part = shown_map(scene, block, plan).color[inside]
        out[max(row, 0) : max(row, 0) + part.shape[0], max(col, 0) : max(col, 0) + part.shape[1]] = part
    return out


def needs_no_gl(scene: Scene, view: MapView | PerspectiveView, plan: Plan) -> bool:
    """Whether a view's picture by a plan is drawn by loops alone, so that any thread can draw it."""
    return isinstance(view, MapView) and _ground_alone(scene, view, plan)


def _ground_alone(scene: Scene, view: MapView, plan: Plan) -> bool:
    """Whether heights alone say what is seen, and the sun and the sky how it is shaded."""
    level = scene.loaded.level
    plain = is_bare(scene) and level.water is None and imagery_of(scene) is None and scene.sun is not None
    return plain and plan.runs <= DRAWN_HERE and (heights_say_all(scene, plan) or not plan.casts or not scene.sun_is_up)


def _ground_picture(scene: Scene, view: MapView, plan: Plan) -> ShownMap | None:
    log = PassLog()
    if REFRACTION_PASS in plan.runs:
        with log.run(REFRACTION_PASS):
            scene = with_apparent_sun(scene, plan.runs)
    else:
        scene = with_apparent_sun(scene, plan.runs)
    with log.run(GEOMETRY_PASS):
        sky = sky_view(scene.elevation, scene.world) if SKY_PASS in plan.runs else None
        ground = bare_ground(scene, view, sky) if view.on_nodes else _ground_between_nodes(scene, view, sky)
    if ground is None:
        return None
    if not ground.there.any():
        nothing = np.zeros(ground.there.shape, np.uint8)
        return ShownMap(np.zeros((*nothing.shape, 3), np.uint8), nothing, ground.there, (), NO_CASTERS.reach)
    with log.run(GEOMETRY_PASS):
        reach = reach_over(scene, bare_nodes(scene, _nodes_under(ground.window_view), 1))
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


def _made_from(scene: Scene, view: MapView, sky: SkyView | None) -> tuple[object, ...]:
    return scene.world, scene.elevation, view, sky


@cached("scene", 448 * MIB, key=_made_from)
def _ground_between_nodes(scene: Scene, view: MapView, sky: SkyView | None) -> BareGround:
    """The bare ground in the pixels of a map that are no nodes; its share of the sky with what ground hides of it, or without."""
    buffer = geometry_of(scene, view)
    share = open_sky(buffer, scene)
    if sky is not None:
        apply_sky_view(share, ShadingBlock(scene, view, buffer, {}))
    up = buffer.position_frame_m - scene.world.up_from(buffer.frame)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    whole = slice(0, view.rows), slice(0, view.cols)
    return BareGround(
        view, buffer.frame, buffer.there, whole, buffer.height_m, buffer.shading_normal_frame, up.astype(np.float32), share
    )


def _nodes_under(view: MapView) -> MapView:
    """The nodes of a map's grid that its pixels lie between."""
    if view.on_nodes:
        return view
    ends = []
    for first, step, count in ((view.row0, view.row_step, view.rows), (view.col0, view.col_step, view.cols)):
        begin = int(np.floor(first))
        ends.append((begin, int(np.ceil(first + (count - 1) * step)) - begin + 1))
    (row0, rows), (col0, cols) = ends
    return MapView(view.grid, float(row0), float(col0), 1.0, 1.0, rows, cols)


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
