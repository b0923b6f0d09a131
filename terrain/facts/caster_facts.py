"""Measure the shadow casters of a scene and a view: one ``CasterFacts`` for each kind."""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import PATCH_QUADS
from skugga.terrain.casters.casting import closed_caster_mask
from skugga.terrain.casters.reach import FULL_DETAIL_NODES, longest_shadow_m
from skugga.terrain.facts.fact_types import CasterFacts
from skugga.terrain.gbuffer.ground_mesh import ground_mesh, ground_nodes
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_instances_in_map, tree_instances_in_perspective
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView, step_at_anchor_m
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

TRIANGLES_PER_TREE = 6
"""A tree is three quads."""


def caster_facts_of(scene: Scene, view: MapView | PerspectiveView, trees: TreeInstances | None) -> tuple[CasterFacts, ...]:
    """Return the facts of each kind of casters in a scene. Trees are counted as the view draws them."""
    objects, facts = scene.objects, [_relief_facts(scene, view)]
    if objects.solids is not None:
        facts.append(_mesh_facts(objects))
    if trees is not None:
        facts.append(_forest_facts(trees))
    return tuple(facts)


def drawn_trees_of(scene: Scene, view: MapView | PerspectiveView) -> TreeInstances | None:
    """Return the trees as a view draws them, or ``None`` if the level has none. A map uses the local frame at the anchor."""
    if isinstance(view, PerspectiveView):
        return tree_instances_in_perspective(scene.objects, view.frame(scene.world), tuple(view.eye_earth_m), view.focal_px)
    frame = scene.world.frame_near_earth(scene.world.anchor_earth_m)
    return tree_instances_in_map(scene.objects, frame, map_pixel_m(scene.world, view))


def _relief_facts(scene: Scene, view: MapView | PerspectiveView) -> CasterFacts:
    """Return the facts of the ground as a caster.

    In perspective ``nodes`` counts the nodes of the elevation grid before decimation, and ``triangles`` the triangles after it. In
    a map ``nodes`` is ``None``, since a map's ground is not decimated.
    """
    low, high = scene.height_range_m
    if isinstance(view, PerspectiveView):
        ground, nodes = ground_mesh(scene, view), ground_nodes(scene).height_m.size
        return CasterFacts(kind="relief", triangles=len(ground.triangles), nodes=nodes, height_m=high - low)
    rows, cols = (min(size, BLOCK_PX) * step for size, step in ((view.rows, view.row_step), (view.cols, view.col_step)))
    outside = _outside_triangles(scene, step_at_anchor_m(scene.world, view.grid), rows, cols)
    return CasterFacts(kind="relief", triangles=int(2 * rows * cols), outside_triangles=outside, height_m=high - low)


def _outside_triangles(scene: Scene, node_m: float, rows: float, cols: float) -> int:
    """Estimate the number of triangles of the ground patches between a block and the sun.

    ``skugga.terrain.casters.reach`` lays out these patches. They are as wide as the block plus the margin of a patch, and as long
    as the longest shadow of the level's relief. Their resolution halves at each doubling of the distance. ``rows`` and ``cols`` are
    the size of the block in nodes, ``node_m`` is the distance between nodes in metres.
    """
    if not scene.sun_is_up or scene.light_space is None or np.ptp(scene.height_range_m) <= 0.0:
        return 0
    level_m = float(np.hypot(*scene.elevation.shape)) * scene.elevation.cell_size_m(scene.world.metres_per_unit)
    relief_m, world = float(np.ptp(scene.height_range_m)), scene.world
    longest_m = longest_shadow_m(relief_m, scene.light_space.altitude_deg, not world.is_flat, world.radius_m)
    far = min(longest_m, max(level_m - min(rows, cols) * node_m, 0.0)) / node_m
    total, near, level = 0.0, 0.0, 0
    while near < far:
        end, quads = FULL_DETAIL_NODES * 2**level, PATCH_QUADS * 2**level
        length = np.ceil((min(far, end) - near) / quads) * quads
        total += 2.0 * length * (max(rows, cols) + quads) / 4**level
        near, level = end, level + 1
    return int(total)


@cached("scene", MIB)
def _mesh_facts(objects: SceneObjects) -> CasterFacts:
    """Return the facts of the meshes that cast shadows. The objects must contain such meshes."""
    assert objects.placement is not None
    casting = objects.placement.casting_bodies
    sizes = np.array([np.ptp(placed.body.vertices_m, axis=0) for placed in casting])
    closed = closed_caster_mask(objects)
    return CasterFacts(
        kind="meshes", count=len(casting), triangles=len(closed), closed_share=float(closed.mean()) if len(closed) else 0.0,
        height_m=float(np.median(sizes[:, 2])), width_m=float(np.median(sizes[:, :2].max(axis=1))),
    )  # fmt: skip


@cached("scene", MIB)
def _forest_facts(trees: TreeInstances) -> CasterFacts:
    """Return the facts of the trees as drawn. Where trees are decimated, the remaining ones are larger."""
    sizes = np.median(trees.quad_sizes_m, axis=0) if len(trees) else np.zeros(4)
    gaps = leaf_gap_shares()[2 * trees.variant] * trees.quad_sizes_m[:, 2] if len(trees) else np.zeros(1)
    return CasterFacts(
        kind="forest", count=len(trees), triangles=TRIANGLES_PER_TREE * len(trees), alpha_share=1.0,
        height_m=float(sizes[2]), width_m=2.0 * float(sizes[0]), leaf_gap_m=float(np.median(gaps)),
    )  # fmt: skip


@cached("process", MIB)
def leaf_gap_shares() -> np.ndarray:
    """Return the mean width (2 * variants,) of leaves and gaps in each picture of a tree, as a share of the picture's side.

    The width is the mean length of successive leaf texels, or of successive gap texels, along the rows within the tree's outline.
    """
    means = []
    for alpha in foliage().mip_levels[0][..., 3]:
        leaf = alpha >= ALPHA_THRESHOLD * 255
        changes = np.count_nonzero(leaf[:, 1:] != leaf[:, :-1], axis=1)
        first, last = leaf.argmax(axis=1), leaf.shape[1] - leaf[:, ::-1].argmax(axis=1)
        outline_width = np.where(leaf.any(axis=1), last - first, 0)
        means.append(outline_width.sum() / max(int(np.maximum(changes - 1, 1)[outline_width > 0].sum()), 1) / leaf.shape[1])
    return np.array(means)


@cached("scene", MIB)
def slopes_deg(world: World, elevation: Elevation) -> tuple[float, float, float]:
    """Return the mean, 95th percentile and maximum slope between neighbouring cells of the overview, in degrees.

    All three are 0 if the overview has no neighbouring cells with data.
    """
    cell_m = elevation.cell_size_m(world.metres_per_unit) * 2**elevation.overview.lod
    heights = elevation.overview.mean_heights_m.astype(np.float64)
    if min(heights.shape) < 2:
        return 0.0, 0.0, 0.0
    down = (heights[1:, :-1] - heights[:-1, :-1]) / cell_m
    right = (heights[:-1, 1:] - heights[:-1, :-1]) / cell_m
    slope = np.degrees(np.arctan(np.hypot(down, right)))
    slope = slope[np.isfinite(slope)]
    if not slope.size:
        return 0.0, 0.0, 0.0
    max_slope = float(slope.max())  # an upper bound: the mean of equal slopes may exceed them by rounding
    return min(float(slope.mean()), max_slope), min(float(np.percentile(slope, 95)), max_slope), max_slope
