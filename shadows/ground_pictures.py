"""Draw shaded pictures of bare ground in maps, without a geometry buffer for each position of the sun.

The map service and films draw mostly such pictures. Where heights alone determine visibility and shading, a block's colour and the
opacity of its shadow need no triangles. Shadows are computed at the nodes of the ground's grid (``skugga.shadows.supersampling``),
as in any picture. The ground is cached across positions of the sun and shaded in one pass (``skugga.terrain.gbuffer.bare_ground``).
The pictures equal those of ``render_frame``; ``skugga.shadows.draw`` chooses the path.

Most pictures have pixels between the nodes. Their ground comes from one geometry buffer for all positions of the sun.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.shadows.passes import ATTACHED_PASS, CASTERS_PASS, GEOMETRY_PASS, PassLog
from skugga.shadows.picture import Needs, Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import REFRACTION_PASS, SHADING_PASS
from skugga.shadows.sky_light.sky_light import sky_light_factor
from skugga.shadows.supersampling import edge_supersampling, mean_visibilities, needs_heights_only, supersampling
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import NO_CASTERS
from skugga.terrain.casters.reach import find_reach_of_nodes
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.sky_view import apply_sky_view
from skugga.terrain.effects.texture_shading import texture_factor
from skugga.terrain.gbuffer.bare_ground import BareGround, bare_ground
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.gbuffer.landforms import generalised_normals, locally_lit_normals
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, ground_imagery
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.sky_view_factor import SkyView, sky_view
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene
from skugga.terrain.shading import shaded_ground_srgb, slope_sky_view_factor
from skugga.terrain.style import has_directional_sky

SKY_VIEW_PASS = "sky_view"
"""Name of the effect that darkens ground with little visible sky, and of its pass."""

TEXTURE_PASS = "texture_shading"
"""Name of the effect that brightens ridges and darkens valleys, and of its pass."""

SKY_LIGHT_PASS = "sky_light"
"""Name of the effect that lights ground by the whole sky, and of its pass."""

SUPPORTED_EFFECTS = frozenset({"cast_shadows", CASTERS_PASS, SKY_VIEW_PASS, SKY_LIGHT_PASS, TEXTURE_PASS, REFRACTION_PASS})
"""Effects that this path supports."""


MIN_SUN_COSINE = 0.05
"""Lower bound of the cosine between a smooth normal and the sun's direction.

Above it no adjacent triangle is assumed to face away.
"""


def heights_determine_shading(scene: Scene, plan: Plan) -> bool:
    """Return whether heights, sun and sky alone determine what a map shows."""
    level = scene.loaded.level
    plain = is_terrain_only(scene) and level.water is None and ground_imagery(scene) is None and scene.sun is not None
    return (
        plain
        and plan.effect_names <= SUPPORTED_EFFECTS
        and (needs_heights_only(scene, plan) or not plan.casts_shadows or not scene.sun_is_up)
    )


def ground_picture(scene: Scene, view: MapView, plan: Plan, needs: Needs, log: PassLog) -> Picture | None:
    """Draw a block of bare ground by a plan from heights alone; return ``None`` where its triangles are needed.

    Raises the errors of ``render_frame``.
    """
    with log.record_pass(GEOMETRY_PASS):
        sky = sky_view(scene.elevation, scene.world) if SKY_VIEW_PASS in plan.effect_names else None
        ground = bare_ground(scene, view, sky) if view.is_on_nodes else _ground_between_nodes(scene, view, sky)
        if ground is None:
            return None
        if not ground.valid.any():
            zeros = np.zeros(ground.valid.shape, np.uint8)
            return Picture(ground.valid, (), np.zeros((*zeros.shape, 3), np.uint8), zeros, reach=NO_CASTERS.reach)
        reach = (
            find_reach_of_nodes(scene, bare_nodes(scene, _nodes_around_pixels(ground.window_view), 1)) if "reach" in needs else None
        )
    lit = _sunlit_shares(scene, ground, plan, log)
    if lit is None:
        return None
    first_pixel = ground.window[0].start, ground.window[1].start
    with log.record_pass(GEOMETRY_PASS):
        if scene.style.generalisation_at(map_pixel_m(scene.world, view)) > 0.0:
            ground = replace(ground, normal_frame=_generalised_ground_normals(scene, view, ground))
    if SKY_VIEW_PASS in plan.effect_names:
        with log.record_pass(SKY_VIEW_PASS):
            pass  # the ground already includes its sky view
    if SKY_LIGHT_PASS in plan.effect_names:
        with log.record_pass(SKY_LIGHT_PASS):
            if has_directional_sky(scene.style):
                share = sky_light_factor(scene, view, ground.frame, ground.normal_frame, ground.up_frame, first_pixel=first_pixel)
                ground = replace(ground, visible_sky_share=share)
    if TEXTURE_PASS in plan.effect_names:
        with log.record_pass(TEXTURE_PASS):
            textured_share = ground.visible_sky_share * texture_factor(scene, ground.window_view)
            ground = replace(ground, visible_sky_share=textured_share)
    with log.record_pass(SHADING_PASS):
        normal = locally_lit_normals(scene, view, ground.frame, ground.normal_frame, ground.up_frame, first_pixel=first_pixel)
        color = shaded_ground_srgb(replace(ground, normal_frame=normal), scene, lit) if "color" in needs else None
        opacity = _shadow_opacity(ground, lit) if "opacity" in needs else None
    return Picture(ground.valid, (), color, opacity, reach=reach)


def _shadow_opacity(ground: BareGround, lit: np.ndarray) -> np.ndarray:
    """Return the opacity of the shadow, uint8 (rows, cols), from the shares ``lit`` of the pixels that the sun lights."""
    return np.rint(255.0 * (1.0 - np.where(ground.valid, lit, np.float32(1.0)))).astype(np.uint8)


def _cache_key(scene: Scene, view: MapView, sky: SkyView | None) -> tuple[object, ...]:
    """Return the cache key of ``_ground_between_nodes``: its result does not depend on the sun."""
    return scene.world, scene.elevation, view, sky


@cached("scene", 448 * MIB, key=_cache_key)
def _ground_between_nodes(scene: Scene, view: MapView, sky: SkyView | None) -> BareGround:
    """Return the bare ground at pixels of a map that lie between nodes.

    Its sky view accounts for the ground's own horizon if ``sky`` is given.
    """
    buffer = geometry_buffer(scene, view)
    share = slope_sky_view_factor(buffer, scene)
    if sky is not None:
        apply_sky_view(share, ShadingBlock(scene, view, buffer, {}))
    up = buffer.position_frame_m - scene.world.up_origin(buffer.frame)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    full_window = slice(0, view.rows), slice(0, view.cols)
    return BareGround(
        view, buffer.frame, buffer.valid, full_window, buffer.height_m, buffer.shading_normal_frame, up.astype(np.float32), share
    )


def _normals_key(scene: Scene, view: MapView, ground: BareGround) -> tuple[object, ...]:
    """Return the cache key of ``_generalised_ground_normals``: its result does not depend on the sun."""
    return scene.world, scene.elevation, view, scene.style.generalisation


@cached("scene", 160 * MIB, key=_normals_key)
def _generalised_ground_normals(scene: Scene, view: MapView, ground: BareGround) -> np.ndarray:
    """Return the generalised normals (r, c, 3) float32 of a map's bare ground."""
    first_pixel = ground.window[0].start, ground.window[1].start
    return generalised_normals(scene, view, ground.frame, ground.normal_frame, ground.up_frame, first_pixel=first_pixel)


def _nodes_around_pixels(view: MapView) -> MapView:
    """Return the nodes of a map's grid between which its pixels lie, as a map view with one node in each pixel."""
    if view.is_on_nodes:
        return view
    ends = []
    for first, step, count in ((view.row0, view.row_step, view.rows), (view.col0, view.col_step, view.cols)):
        begin = int(np.floor(first))
        ends.append((begin, int(np.ceil(first + (count - 1) * step)) - begin + 1))
    (row0, rows), (col0, cols) = ends
    return MapView(view.grid, float(row0), float(col0), 1.0, 1.0, rows, cols)


def _faces_sun(ground: BareGround, scene: Scene) -> bool:
    """Return whether all ground faces the sun by the margin ``MIN_SUN_COSINE``.

    The ground's triangles then face the sun, too, so none is in attached shadow.
    """
    assert scene.sun is not None
    facing = ground.normal_frame @ scene.sun.in_frame(ground.frame).astype(np.float32)
    return float(facing[ground.valid[ground.window]].min(initial=1.0)) > MIN_SUN_COSINE


def _sunlit_shares(scene: Scene, ground: BareGround, plan: Plan, log: PassLog) -> np.ndarray | None:
    """Return the share of each pixel that the sun lights, float32 (rows, cols); ``None`` where heights do not suffice."""
    if not scene.sun_is_up:
        with log.record_pass(ATTACHED_PASS):
            return np.zeros(ground.valid.shape, np.float32)
    if not plan.casts_shadows:
        with log.record_pass(ATTACHED_PASS):
            return np.ones(ground.valid.shape, np.float32) if _faces_sun(ground, scene) else None
    pixels = supersampling(scene, ground.view, plan) or edge_supersampling(scene, ground.view, plan)
    if pixels is None or not pixels.uses_heights_only:
        return None
    return mean_visibilities(pixels, ground, log)[SUN]
