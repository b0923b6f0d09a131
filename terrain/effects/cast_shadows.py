"""Cast shadows: needed if direct light reaches the view and an occluder can block it.

**Relief** (the ground). Suppose that a ray from the ground to the sun hits ground again. On its way there is a facet (a triangle of
the ground) that does not face the sun, since the ground must rise above the ray. It follows that

- if every facet of the ground faces the sun, no ground is in cast shadow;
- if no facet faces the sun, all ground is unlit anyway, and no cast shadow is visible.

Both conditions are evaluated on the facets as drawn. A facet with the normal (-a, -b, 1) in east, north and up at the level's
anchor has the slope (a, b). It faces the sun in the direction (e, n, u) if u > a e + b n. The maximum slopes in several directions
bound those of all facets; they are computed once for each ground and zoom (``skugga.terrain.casters.slopes``).

**Objects on the ground** can shade any point of a map. In a perspective view they can cast a visible shadow only if they overlap
visible surfaces in light space.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.slopes import Corridor, facing_range_of_mesh, facing_range_of_slopes, node_count, slope_support
from skugga.terrain.compiled import compiled
from skugga.terrain.effects.effect import Effect, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.ground_mesh import ground_mesh
from skugga.terrain.gbuffer.supersampling import supersampled_view
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_instances_in_perspective
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.light_space import LightSpace
from skugga.terrain.geo.sun import SUN_RADIUS_DEG, direction_enu
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

MAX_COARSE_NODES = 2**18
"""Maximum number of nodes of the coarse ground that is tested first. If coarse ground casts shadows, finer ground does, too."""

MAX_TESTED_NODES = 2**21
"""Maximum number of nodes of ground that is tested facet by facet, which takes about 0.3 s per million. Larger ground counts as a
possible caster.
"""

MAX_TREES_TESTED = 2000
"""Maximum number of trees that are tested one by one. If more are in view or towards the light, some of them cast shadows."""

DEPTH_GRID_SIDE_CELLS = 128
"""Number of cells along each side of the depth grid in which visible points are compared with possible occluders."""

SUN_DISC_SINE_TOLERANCE = float(np.sin(np.radians(SUN_RADIUS_DEG))) + 1e-4
"""Tolerance of the test whether a facet faces the sun: the sine of the sun's angular radius, and a margin for float32 normals.

A facet whose plane is closer than this to the centre of the sun may cut the disc. The value is for unit normals. A test with the
normal (-a, -b, 1) multiplies it by the length of this normal, for a slope as steep as the sun's rays.
"""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: direct light reaches the level, and something can stand in its way: a facet of the ground hides a part of the sun's
    disc, or meshes or trees throw their shadow on visible surfaces.

    Left out: no light; night, or a fully clouded sky, without lamps; ground from which the sun's whole disc is visible everywhere,
    or which faces away from it everywhere; bare ground at one height.
    """
    sun = sun_verdict(descriptor)
    if sun.is_needed:
        return sun
    lamps = [lamp.name for lamp in descriptor.lamps if lamp.reaches]
    if not lamps:
        return sun
    if not has_casters(descriptor):
        return Verdict(False, "flat ground without objects: nothing can cast a shadow")
    return Verdict(True, f"casters in the light of {', '.join(lamps)}")


def sun_verdict(descriptor: Descriptor) -> Verdict:
    """Return whether the sun can cast shadows in the view, with the reason."""
    if descriptor.highest_sun_deg is None:
        return Verdict(False, "the level has no sun")
    if descriptor.highest_sun_deg <= 0.0:
        return Verdict(False, f"night: the sun is at most {descriptor.highest_sun_deg:.1f} degrees high anywhere in the level")
    if descriptor.weather.is_overcast:
        return Verdict(False, "overcast: no direct sunlight")
    if not has_casters(descriptor):
        return Verdict(False, "flat ground without objects: nothing can cast a shadow")
    kinds = [kind for kind in descriptor.casters if sun_caster_verdict(descriptor, kind).is_needed]
    if not kinds:
        return Verdict(False, "; ".join(sun_caster_verdict(descriptor, kind).reason for kind in descriptor.casters))
    caster_names = [f"{descriptor.relief_m:.0f} m of relief" if kind == "relief" else kind for kind in kinds]
    return Verdict(True, f"the sun, {descriptor.sun_altitude_deg:.1f} degrees high, can be blocked by {', '.join(caster_names)}")


def sun_caster_verdict(descriptor: Descriptor, kind: str) -> Verdict:
    """Return whether casters of one kind can cast the sun's shadow on a visible surface, with the reason."""
    facts = descriptor.facts.get("cast_shadows", {})
    if kind != "relief":
        if facts.get(kind, True) and (kind != "forest" or descriptor.facts.get("alpha_test", {}).get("drawn", True)):
            return Verdict(True, f"{kind} can cast shadows into the view")
        return Verdict(False, f"{kind} cannot cast shadows into the view")
    if descriptor.relief_m <= 0.0:
        return Verdict(False, "flat ground casts no shadow")
    min_excess, max_excess = numeric_fact(facts.get("least_slope")), numeric_fact(facts.get("most_slope"))
    tolerance = _facing_tolerance(descriptor.sun_altitude_deg or 0.0)
    if min_excess == np.inf:
        return Verdict(False, "no ground between the view and the sun")
    if min_excess is not None and min_excess > tolerance:
        return Verdict(
            False, f"no slope is steeper than the sun's rays: per metre, the steepest rises {min_excess:.2g} m less than the rays"
        )
    is_terrain_only = not any(facts.get(other, True) for other in descriptor.casters if other != "relief")
    if max_excess is not None and max_excess < -tolerance and is_terrain_only:
        return Verdict(
            False, f"all ground faces away from the sun: it falls at least {-max_excess:.2g} per metre more steeply than the rays"
        )
    return Verdict(True, f"some slopes are steeper than the sun's rays ({descriptor.relief_m:.0f} m of relief)")


def _facing_tolerance(altitude_deg: float) -> float:
    """Return the tolerance of ``least_slope`` and ``most_slope`` (``facts``), as a rise per metre of the sun's rays.

    Facets within it may face the sun or not, since the sun has a disc. ``altitude_deg`` is the sun's altitude.
    """
    return SUN_DISC_SINE_TOLERANCE / max(float(np.cos(np.radians(altitude_deg))), 0.02)


def has_casters(descriptor: Descriptor) -> bool:
    """Return whether the scene has any casters: relief, or objects on the ground."""
    return descriptor.relief_m > 0.0 or any(kind != "relief" for kind in descriptor.casters)


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of cast shadows. Empty while the sun is down.

    - ``least_slope``, ``most_slope``: minimum over the casting facets, and maximum over the visible facets, of the rise of the
      sun's rays minus the rise of the facet along them, per metre of the ray; ``None`` if unknown. A facet faces the sun if it is
      positive.
    - ``meshes``, ``forest``: whether shadows of meshes or of trees can fall on a visible surface of a perspective view.
    """
    if not scene.sun_is_up:
        return {}
    min_excess, max_excess = _sun_facing_range(scene, view, coarse_view)
    result: dict[str, Fact] = {"least_slope": min_excess, "most_slope": max_excess}
    if coarse_view is not None and isinstance(view, PerspectiveView):
        result |= {
            kind: _can_occlude_view(scene, view, kind, coarse_view) for kind in scene.objects.caster_kinds if kind != "relief"
        }
    return result


def _sun_facing_range(
    scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None
) -> tuple[float | None, float | None]:
    """Return the facts ``least_slope`` and ``most_slope`` (``facts``); ``None`` where they are unknown.

    Coarse ground of a map is tested first, since finer ground has at least its range of slopes.
    """
    assert scene.sun is not None
    if np.ptp(scene.height_range_m) <= 0.0 or scene.elevation.surface == "blocks":  # walls are steeper than any ray
        return None, None
    to_sun = direction_enu(scene.sun.azimuth_deg, scene.sun.altitude_deg)
    if isinstance(view, PerspectiveView):
        assert coarse_view is not None
        ground, frame = ground_mesh(scene, view), coarse_view.buffer.frame
        return facing_range_of_mesh(scene.world, ground, frame, _corridor(scene, view, coarse_view), to_sun)
    sampled_view = supersampled_view(scene, view)  # shadows of a coarse map are computed on finer ground
    assert isinstance(sampled_view, MapView)
    grid = sampled_view.grid
    nodes = node_count(scene.world, scene.elevation, grid)
    halvings = max(int(np.ceil(np.log2(max(nodes / MAX_COARSE_NODES, 1.0)) / 2.0)), 0)
    min_excess, max_excess = facing_range_of_slopes(slope_support(scene.world, scene.elevation, grid.coarser(halvings)), to_sun)
    if halvings == 0 or (min_excess is not None and max_excess is not None and min_excess <= 0.0 and max_excess >= 0.0):
        return min_excess, max_excess
    if nodes > MAX_TESTED_NODES:
        return None, None
    return facing_range_of_slopes(slope_support(scene.world, scene.elevation, grid), to_sun)


@cached("scene", 256 * MIB)
def find_visible_trees(objects: SceneObjects, view: PerspectiveView, coarse_view: CoarseView) -> tuple[TreeInstances | None, bool]:
    """Return the trees of the whole level as a view draws them, and whether any of them may be in view.

    The trees stand in all directions from the view's eye: those outside of the view can cast shadows into it. They are ``None`` in
    a level without trees; the second value is then ``False``.
    """
    trees = tree_instances_in_perspective(objects, coarse_view.buffer.frame, tuple(view.eye_earth_m), view.focal_px)
    if trees is None:
        return None, False
    eye, camera_from_frame = view.in_frame(coarse_view.buffer.frame)
    ends = [
        [start - view.step_px, start + count * view.step_px] for start, count in ((view.col0, view.cols), (view.row0, view.rows))
    ]
    tangents = np.array(ends) / view.focal_px
    candidates = trees.in_frustum(eye, camera_from_frame, tangents)
    if not 0 < len(candidates) <= MAX_TREES_TESTED:
        return trees, len(candidates) > 0
    in_camera = (trees.select(candidates).outlines() - eye) @ camera_from_frame.T
    # A tree is outside of the view frustum if it lies entirely beyond one of its sides.
    is_beyond_side = [
        side * (in_camera[..., k] - tangents[k, end] * in_camera[..., 2]) > 0.0
        for k in (0, 1)
        for end, side in ((0, -1.0), (1, 1.0))
    ]
    outside = np.logical_or.reduce([corner_mask.all(axis=-1) for corner_mask in (*is_beyond_side, in_camera[..., 2] <= 0.0)])
    return trees, not outside.all()


def _sample_radius_m(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> np.ndarray:
    """Return the radius round each point of a coarse view within which it represents the visible surfaces, (n,), metres.

    A coarse view samples every few pixels and ignores trees. The radius is the spacing of the samples at the point's distance, plus
    the height of the tallest object if trees are in view.
    """
    return coarse_view.distance_m * coarse_view.spacing_tangent + (
        scene.objects.tallest_object_m if find_visible_trees(scene.objects, view, coarse_view)[1] else 0.0
    )


def _corridor(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> Corridor:
    """Return the region between the visible points and the sun, for ``facing_range_of_mesh``.

    The region's two coordinates are affine functions of positions in the local frame of the coarse view. The first one runs to the
    right in light space, the second one horizontally towards the sun. The second has no upper bound.
    """
    assert scene.light_space is not None
    rotation, translation = scene.light_space.transform_from_frame(coarse_view.buffer.frame)
    rows = np.stack([rotation[0], scene.light_space.horizontal_sunward_m(rotation.T)])
    offsets = np.array([translation[0], scene.light_space.horizontal_sunward_m(translation)])
    in_light, tolerance_m = coarse_view.points_frame_m @ rows.T + offsets, _sample_radius_m(scene, view, coarse_view)[:, None]
    low, high = (
        ((in_light - tolerance_m).min(axis=0), (in_light + tolerance_m).max(axis=0))
        if len(in_light)
        else (np.full(2, np.inf), np.full(2, -np.inf))
    )
    return rows, offsets, np.array([[low[0], high[0]], [low[1], np.inf]])


def _can_occlude_view(scene: Scene, view: PerspectiveView, kind: str, coarse_view: CoarseView) -> bool:
    """Return whether casters of a kind (``meshes`` or ``forest``) may occlude a visible surface from the sun.

    Trees in view always count as occluders.
    """
    assert scene.light_space is not None
    objects, frame = scene.objects, coarse_view.buffer.frame
    if kind == "meshes":
        box_low, box_high = _boxes_of_meshes(objects, scene.light_space)
    else:
        trees, in_view = find_visible_trees(scene.objects, view, coarse_view)
        if trees is None or in_view:
            return in_view
        rotation, translation = scene.light_space.transform_from_frame(frame)
        points = coarse_view.points_frame_m @ rotation.T + translation
        tolerance_m = _sample_radius_m(scene, view, coarse_view)[:, None]
        low, high = (
            ((points - tolerance_m).min(axis=0), (points + tolerance_m).max(axis=0)) if len(points) else (np.ones(3), np.zeros(3))
        )
        candidates = trees.in_box(rotation, translation, np.array([low[0], low[1], -np.inf]), high)
        if not 0 < len(candidates) <= MAX_TREES_TESTED:
            return len(candidates) > 0
        in_light = trees.select(candidates).outlines() @ rotation.T + translation
        box_low, box_high = (end.reshape(-1, 3) for end in (in_light.min(axis=2), in_light.max(axis=2)))
    rotation, translation = scene.light_space.transform_from_frame(frame)
    return bool(
        _any_occludes(
            box_low,
            box_high,
            coarse_view.points_frame_m @ rotation.T + translation,
            _sample_radius_m(scene, view, coarse_view),
            DEPTH_GRID_SIDE_CELLS,
        )
    )


@cached("light", 256 * MIB)
def _boxes_of_meshes(objects: SceneObjects, light: LightSpace) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding boxes of the meshes' casting triangles in light space. They do not depend on the camera."""
    assert objects.solids is not None
    return _triangle_boxes(light.points_from_earth(objects.solids.caster_vertices_earth_m), objects.solids.caster_triangles)


@compiled
def _triangle_boxes(points, triangles):
    """Return the minimum and the maximum coordinates, (m, 3) each, of triangles (m, 3) with the vertices ``points`` (n, 3)."""
    box_low, box_high = np.empty((len(triangles), 3)), np.empty((len(triangles), 3))
    for m in range(len(triangles)):
        for k in range(3):
            a, b, c = points[triangles[m, 0], k], points[triangles[m, 1], k], points[triangles[m, 2], k]
            box_low[m, k], box_high[m, k] = min(a, b, c), max(a, b, c)
    return box_low, box_high


@compiled
def _any_occludes(box_low, box_high, points, tolerance_m, cells):
    """Return whether any box occludes any point, in light space.

    Boxes extend from ``box_low`` to ``box_high`` (n, 3). Points (m, 3) have a tolerance ``tolerance_m`` (m,). The third coordinate
    is the depth, away from the sun. A grid of ``cells`` x ``cells`` cells holds the maximum depth of the points in each cell. A box
    occludes a point if its minimum depth is at most that of a cell that it overlaps.
    """
    if len(points) == 0 or len(box_low) == 0:
        return False
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for m in range(len(points)):
        for k in range(2):
            low[k], high[k] = min(low[k], points[m, k] - tolerance_m[m]), max(high[k], points[m, k] + tolerance_m[m])
    scale = cells / np.maximum(high - low, 1e-6)
    deepest = np.full((cells, cells), -np.inf)
    for m in range(len(points)):
        i0, i1 = int((points[m, 0] - tolerance_m[m] - low[0]) * scale[0]), int((points[m, 0] + tolerance_m[m] - low[0]) * scale[0])
        j0, j1 = int((points[m, 1] - tolerance_m[m] - low[1]) * scale[1]), int((points[m, 1] + tolerance_m[m] - low[1]) * scale[1])
        for i in range(i0, min(i1, cells - 1) + 1):
            for j in range(j0, min(j1, cells - 1) + 1):
                deepest[i, j] = max(deepest[i, j], points[m, 2] + tolerance_m[m])
    for n in range(len(box_low)):
        if not (box_high[n, 0] >= low[0] and box_low[n, 0] <= high[0] and box_high[n, 1] >= low[1] and box_low[n, 1] <= high[1]):
            continue
        i0, i1 = max(int((box_low[n, 0] - low[0]) * scale[0]), 0), int((box_high[n, 0] - low[0]) * scale[0])
        j0, j1 = max(int((box_low[n, 1] - low[1]) * scale[1]), 0), int((box_high[n, 1] - low[1]) * scale[1])
        for i in range(i0, min(i1, cells - 1) + 1):
            for j in range(j0, min(j1, cells - 1) + 1):
                if deepest[i, j] >= box_low[n, 2]:
                    return True
    return False


EFFECT = Effect("the shadows that things cast on each other", judge, facts, verdict_without_facts=None)
