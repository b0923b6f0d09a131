"""The sun at a map's own points of bare ground, without a geometry buffer: what masks of large rasters are made of.

The answers are those of ``render_frame``'s masks: the same sweep over the same nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.attached import attached
from skugga.shadows.coarse_pixels import CoarsePixels, coarse_pixels, heights_say_all, lit_nodes
from skugga.shadows.passes import CASTERS_PASS, PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.visibility import with_apparent_sun
from skugga.terrain.cache import MIB, cached
from skugga.terrain.gbuffer.bare_ground import bare_ground
from skugga.terrain.gbuffer.bare_nodes import HALO, bare_nodes
from skugga.terrain.gbuffer.covered_nodes import is_bare
from skugga.terrain.gbuffer.geometry import GeometryBuffer, map_geometry
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class SunlitGround:
    """A map's own points: ``there`` bool (rows, cols), where there is ground, and whether the sun is seen there: ``lit``."""

    there: np.ndarray
    lit: np.ndarray


def sunlit_ground(scene: Scene, view: MapView, plan: Plan) -> SunlitGround | None:
    """Execute a plan at the points of a map on its grid's nodes; ``None`` where heights alone do not say what is seen, and where
    pixels are so coarse that they show means. Raises as ``render_frame``.
    """
    if not (view.on_nodes and is_bare(scene) and scene.sun is not None):
        return None
    ground = bare_ground(scene, view, None)
    if ground is None:
        return None
    if not scene.sun_is_up or not ground.there.any():
        return SunlitGround(ground.there, np.zeros(ground.there.shape, np.bool_))
    scene = with_apparent_sun(scene, plan.runs)
    if not heights_say_all(scene, plan) or coarse_pixels(scene, view, plan) is not None:
        return None
    _, seen = lit_nodes(CoarsePixels(scene, plan, view.grid, 1, bare=True), view, CASTERS_PASS in plan.runs, PassLog())
    lit, rim = seen[SUN] & ground.there, rim_points(scene, view)
    if rim is not None:
        lit &= ~(rim.there & attached(rim, scene, SUN))
    return SunlitGround(ground.there, lit)


@cached("scene", 448 * MIB, key=lambda scene, view: (scene.world, scene.elevation, view), most=1)
def rim_points(scene: Scene, view: MapView) -> GeometryBuffer | None:
    """The points of a map on the rim of its ground, if there are any: kept, for many suns may be asked for one after the other."""
    ground = bare_ground(scene, view, None)
    rim = np.zeros((view.rows, view.cols), np.bool_) if ground is None else _rim(scene, view) & ground.there
    if ground is None or not rim.any():
        return None
    return map_geometry(scene.surface(view.grid), view, ground.frame, wanted=rim)


def _rim(scene: Scene, view: MapView) -> np.ndarray:
    """Which nodes (rows, cols) miss one of the eight beside them. Inside, the facet that a node's way to the sun leads over shades
    it if all are turned away; here there may be none.
    """
    there = bare_nodes(scene, view, 1).surface.there
    rows, cols = there.shape
    inner = np.ones((view.rows, view.cols), np.bool_)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            inner &= there[HALO + down : rows - HALO + down, HALO + right : cols - HALO + right]
    return ~inner


def cosine_of_incidence(scene: Scene, view: MapView) -> np.ndarray:
    """The cosine of the angle between the sun and the ground's smooth normal at a map's own points (rows, cols) float32: negative
    where the ground faces away, NaN where there is none. Objects and water on it do not count.
    """
    assert scene.sun is not None
    out = np.full((view.rows, view.cols), np.nan, np.float32)
    ground = bare_ground(scene, view, None) if view.on_nodes else None
    if ground is None:
        frame = scene.world.frame_near(view.grid.crs, *view.centre)
        points = map_geometry(scene.surface(view.grid), view, frame)
        facing = points.shading_normal_frame @ scene.sun.in_frame(frame).astype(np.float32)
        return np.where(points.there, facing, np.float32(np.nan))
    facing = ground.normal_frame @ scene.sun.in_frame(ground.frame).astype(np.float32)
    out[ground.window] = np.where(ground.there[ground.window], facing, np.float32(np.nan))
    return out
