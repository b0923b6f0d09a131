"""Draw the sun's visibility at a map's own points of bare ground, without a geometry buffer: the path for masks of large rasters.

The masks equal the visibility that ``render_frame`` draws, since both compute shadows at the same nodes.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import ATTACHED_PASS, CASTERS_PASS, GEOMETRY_PASS, PassLog
from skugga.shadows.picture import Needs, Picture
from skugga.shadows.plan import Plan
from skugga.shadows.supersampling import Supersampling, lit_nodes, needs_heights_only, supersampling
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import NO_CASTERS
from skugga.terrain.casters.reach import find_reach_of_nodes
from skugga.terrain.gbuffer.bare_ground import bare_ground
from skugga.terrain.gbuffer.bare_nodes import HALO_NODES, bare_nodes
from skugga.terrain.gbuffer.geometry import GeometryBuffer, map_geometry
from skugga.terrain.gbuffer.ground_normals import ground_normals
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene


def heights_determine_visibility(scene: Scene, view: MapView, plan: Plan) -> bool:
    """Return whether the heights of bare ground determine the sun's visibility at a map's own points."""
    if not (view.is_on_nodes and is_terrain_only(scene) and scene.sun is not None and plan.lights[0] == SUN):
        return False
    return not scene.sun_is_up or (needs_heights_only(scene, plan) and supersampling(scene, view, plan) is None)


def sunlit_picture(scene: Scene, view: MapView, plan: Plan, needs: Needs, log: PassLog) -> Picture | None:
    """Draw the sun's visibility in a block of bare ground by a plan; return ``None`` where its triangles are needed.

    Raises the errors of ``render_frame``.
    """
    with log.record_pass(GEOMETRY_PASS):
        ground = bare_ground(scene, view, None)
        if ground is None:
            return None
        visibility = np.where(ground.valid, np.float32(0.0), np.float32(np.nan))
        if not ground.valid.any():
            return Picture(ground.valid, (), visibility=visibility, reach=NO_CASTERS.reach)
        reach = find_reach_of_nodes(scene, bare_nodes(scene, view, 1)) if "reach" in needs else None
    if scene.sun_is_up:
        _, visibilities = lit_nodes(
            Supersampling(scene, plan, view.grid, 1, uses_heights_only=True), view, CASTERS_PASS in plan.effect_names, log
        )
        lit = visibilities[SUN] & ground.valid
        with log.record_pass(ATTACHED_PASS):
            rim = rim_points(scene, view)
            if rim is not None:
                lit[ground.window] &= ~(rim.valid & attached_shadow_mask(rim, scene, SUN))
        visibility[lit] = 1.0
    return Picture(ground.valid, (), visibility=visibility, reach=reach)


@cached("scene", 448 * MIB, key=lambda scene, view: (scene.world, scene.elevation, view), max_entries=1)
def rim_points(scene: Scene, view: MapView) -> GeometryBuffer | None:
    """Return the geometry buffer of a map's points on the rim of its ground; ``None`` without any.

    It covers the window of the ground (``BareGround.window``). It is cached for many positions of the sun in sequence.
    """
    ground = bare_ground(scene, view, None)
    if ground is None:
        return None
    rim = (_rim_mask(scene, view) & ground.valid)[ground.window]
    if not rim.any():
        return None
    return map_geometry(scene.surface(view.grid), ground.window_view, ground.frame, pixel_mask=rim)


def _rim_mask(scene: Scene, view: MapView) -> np.ndarray:
    """Return which nodes (rows, cols) lack one of their eight neighbours, bool.

    Other nodes need no test of their facets: if all of these face away, the one on the way to the sun shades the node. At the rim
    this facet may be missing.
    """
    valid = bare_nodes(scene, view, 1).surface.valid
    rows, cols = valid.shape
    inner = np.ones((view.rows, view.cols), np.bool_)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            inner &= valid[HALO_NODES + down : rows - HALO_NODES + down, HALO_NODES + right : cols - HALO_NODES + right]
    return ~inner


def cosine_of_incidence(scene: Scene, view: MapView) -> np.ndarray:
    """Return the cosine between the sun's direction and the ground's smooth normal at a map's own points, (rows, cols) float32.

    It is negative where the ground faces away, and NaN off the ground. Objects and water are ignored.
    """
    assert scene.sun is not None
    normal_frame, frame = ground_normals(scene, view)
    return normal_frame @ scene.sun.in_frame(frame).astype(np.float32)
