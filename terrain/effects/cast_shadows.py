"""Cast shadows: where direct light reaches the view, and something can stand in its way.

**Relief.** A ray from ground to the sun that meets ground again has on its way ground that falls away from the sun more steeply
than the ray rises: a facet that does not face the sun. So where every facet of the ground faces the sun, none is shadowed; and
where none does, all of it is turned away, and nothing that is cast would show. Both are read from the facets as they are drawn,
once per ground and zoom: with the slopes (a, b) that a facet's normal (-a, -b, 1) has at the level's anchor, it faces the sun
(e, n, u) if u > a e + b n. Of all facets only how far the slopes reach in ``DIRECTIONS`` directions is kept.

**What stands on the ground** can shade anything in a map; in a perspective view, if in light space it overlaps what is seen.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.slopes import Corridor, above_mesh, above_slopes, grid_slopes, node_count
from skugga.terrain.compiled import compiled
from skugga.terrain.effects.effect import Effect, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, number
from skugga.terrain.gbuffer.covered_nodes import drawn_view
from skugga.terrain.gbuffer.ground_mesh import ground_mesh
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_instances_in_perspective
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.light_space import LightSpace
from skugga.terrain.geo.sun import SUN_RADIUS_DEG, direction_enu
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

COARSE_NODES = 2**18
"""Nodes of the coarse ground that is tried first: where it casts, the finer one does."""

MOST_NODES = 2**21
"""Ground of more nodes is not searched facet by facet (that takes about 0.3 s a million): it may cast."""

MAX_TREES_TESTED = 2000
"""More trees than these in the way, or in view, are not looked at one by one: some of them do shade something."""

MASK_CELLS = 128
"""Cells a side in which what is seen is held against what stands before it."""

DISC_GRAZING = float(np.sin(np.radians(SUN_RADIUS_DEG))) + 1e-4
"""A facet's plane passes this near to the middle of the sun if it cuts the disc, or if float32 normals do not tell: the sine of the
angle between them, times the length of the normal (-a, -b, 1) that slopes as steep as the sun is high have.
"""


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out without a light, by night and under clouds without lamps, and where nothing can stand in the light's way."""
    sun = sun_verdict(descriptor)
    if sun.called_for:
        return sun
    lamps = [lamp.name for lamp in descriptor.lamps if lamp.reaches]
    if not lamps:
        return sun
    if not can_cast(descriptor):
        return Verdict(False, "flat ground without objects: nothing can cast a shadow")
    return Verdict(True, f"casters in the light of {', '.join(lamps)}")


def sun_verdict(descriptor: Descriptor) -> Verdict:
    """Whether the sun casts shadows here."""
    if descriptor.highest_sun_deg is None:
        return Verdict(False, "the level has no sun")
    if descriptor.highest_sun_deg <= 0.0:
        return Verdict(False, f"night: the sun is at most {descriptor.highest_sun_deg:.1f} degrees high anywhere in the level")
    if descriptor.weather.overcast:
        return Verdict(False, "overcast: no direct sunlight")
    if not can_cast(descriptor):
        return Verdict(False, "flat ground without objects: nothing can cast a shadow")
    kinds = [kind for kind in descriptor.casters if sun_kind_verdict(descriptor, kind).called_for]
    if not kinds:
        return Verdict(False, "; ".join(sun_kind_verdict(descriptor, kind).reason for kind in descriptor.casters))
    caster_names = [f"{descriptor.relief_m:.0f} m of relief" if kind == "relief" else kind for kind in kinds]
    return Verdict(True, f"the sun, {descriptor.sun_altitude_deg:.1f} degrees high, can be blocked by {', '.join(caster_names)}")


def sun_kind_verdict(descriptor: Descriptor, kind: str) -> Verdict:
    """Whether casters of a kind can throw the sun's shadow on anything that is seen."""
    facts = descriptor.facts.get("cast_shadows", {})
    if kind != "relief":
        if facts.get(kind, True) and (kind != "forest" or descriptor.facts.get("alpha_test", {}).get("drawn", True)):
            return Verdict(True, f"{kind} can cast shadows into the view")
        return Verdict(False, f"{kind} cannot cast shadows into the view")
    if descriptor.relief_m <= 0.0:
        return Verdict(False, "level ground casts no shadow")
    least, most = number(facts.get("least_slope")), number(facts.get("most_slope"))
    grazing = _grazing(descriptor.sun_altitude_deg or 0.0)
    if least == np.inf:
        return Verdict(False, "no ground between the view and the sun")
    if least is not None and least > grazing:
        return Verdict(
            False, f"no slope is steeper than the sun's rays: per metre, the steepest rises {least:.2g} m less than the rays"
        )
    bare = not any(facts.get(other, True) for other in descriptor.casters if other != "relief")
    if most is not None and most < -grazing and bare:
        return Verdict(
            False, f"all ground faces away from the sun: it falls at least {-most:.2g} per metre more steeply than the rays"
        )
    return Verdict(True, f"some slopes are steeper than the sun's rays ({descriptor.relief_m:.0f} m of relief)")


def _grazing(altitude_deg: float) -> float:
    return DISC_GRAZING / max(float(np.cos(np.radians(altitude_deg))), 0.02)


def can_cast(descriptor: Descriptor) -> bool:
    """Whether anything stands on the ground or the ground has any relief."""
    return descriptor.relief_m > 0.0 or any(kind != "relief" for kind in descriptor.casters)


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """``least_slope`` and ``most_slope``: how much the sun's slope exceeds that of the ground's facets towards it, least and most
    (``None``: not known); ``meshes`` and ``forest``: whether their shadows can fall on what a perspective view sees.
    """
    if not scene.sun_is_up:
        return {}
    least, most = _slopes_under_sun(scene, view, coarse_view)
    found: dict[str, Fact] = {"least_slope": least, "most_slope": most}
    if coarse_view is not None and isinstance(view, PerspectiveView):
        found |= {kind: _stands_before(scene, view, kind, coarse_view) for kind in scene.objects.kinds if kind != "relief"}
    return found


def _slopes_under_sun(
    scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None
) -> tuple[float | None, float | None]:
    assert scene.sun is not None
    if np.ptp(scene.height_range_m) <= 0.0 or scene.elevation.surface == "blocks":  # walls are steeper than any ray
        return None, None
    to_sun = direction_enu(scene.sun.azimuth_deg, scene.sun.altitude_deg)
    if isinstance(view, PerspectiveView):
        assert coarse_view is not None
        ground, frame = ground_mesh(scene, view), coarse_view.buffer.frame
        return above_mesh(scene.world, ground, frame, _corridor(scene, view, coarse_view), to_sun)
    drawn = drawn_view(scene, view)  # a coarse map's shadows are those of finer ground
    assert isinstance(drawn, MapView)
    grid = drawn.grid
    nodes = node_count(scene.world, scene.elevation, grid)
    coarser = max(int(np.ceil(np.log2(max(nodes / COARSE_NODES, 1.0)) / 2.0)), 0)
    least, most = above_slopes(grid_slopes(scene.world, scene.elevation, grid.coarser(coarser)), to_sun)
    if coarser == 0 or (least is not None and most is not None and least <= 0.0 and most >= 0.0):
        return least, most
    if nodes > MOST_NODES:
        return None, None
    return above_slopes(grid_slopes(scene.world, scene.elevation, grid), to_sun)


@cached("scene", 256 * MIB)
def trees_seen(objects: SceneObjects, view: PerspectiveView, coarse_view: CoarseView) -> tuple[TreeInstances | None, bool]:
    """The trees round an eye, and whether leaves of any are in view."""
    stand = tree_instances_in_perspective(objects, coarse_view.buffer.frame, tuple(view.eye_earth_m), view.focal_px)
    if stand is None:
        return None, False
    eye, camera_from_frame = view.in_frame(coarse_view.buffer.frame)
    ends = [[start - view.step, start + count * view.step] for start, count in ((view.col0, view.cols), (view.row0, view.rows))]
    tangents = np.array(ends) / view.focal_px
    near = stand.in_cone(eye, camera_from_frame, tangents)
    if not 0 < len(near) <= MAX_TREES_TESTED:
        return stand, len(near) > 0
    in_camera = (stand.some(near).outlines() - eye) @ camera_from_frame.T
    # Outside are those that lie beyond one of the pyramid's sides as a whole.
    beyond = [
        side * (in_camera[..., k] - tangents[k, end] * in_camera[..., 2]) > 0.0
        for k in (0, 1)
        for end, side in ((0, -1.0), (1, 1.0))
    ]
    outside = np.logical_or.reduce([one.all(axis=-1) for one in (*beyond, in_camera[..., 2] <= 0.0)])
    return stand, not outside.all()


def _seen_m(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> np.ndarray:
    """How far from each point that is looked at the picture goes on unseen, metres (n,); trees in view rise above it."""
    return coarse_view.away_m * coarse_view.spacing + (
        scene.objects.tallest_m if trees_seen(scene.objects, view, coarse_view)[1] else 0.0
    )


def _corridor(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> Corridor:
    """What lies between what is seen and the sun, as ``above_mesh`` takes it: right of the light, and towards the sun."""
    assert scene.light is not None
    rotation, translation = scene.light.from_frame(coarse_view.buffer.frame)
    rows = np.stack([rotation[0], scene.light.towards_sun_m(rotation.T)])
    offsets = np.array([translation[0], scene.light.towards_sun_m(translation)])
    in_light, slack = coarse_view.points_frame_m @ rows.T + offsets, _seen_m(scene, view, coarse_view)[:, None]
    low, high = (
        ((in_light - slack).min(axis=0), (in_light + slack).max(axis=0))
        if len(in_light)
        else (np.full(2, np.inf), np.full(2, -np.inf))
    )
    return rows, offsets, np.array([[low[0], high[0]], [low[1], np.inf]])


def _stands_before(scene: Scene, view: PerspectiveView, kind: str, coarse_view: CoarseView) -> bool:
    """Whether trees or meshes hide, as the sun sees them, something that is seen; or are trees that are seen themselves."""
    assert scene.light is not None
    objects, frame = scene.objects, coarse_view.buffer.frame
    if kind == "meshes":
        first, last = _boxes_of_meshes(objects, scene.light)
    else:
        stand, seen = trees_seen(scene.objects, view, coarse_view)
        if stand is None or seen:
            return seen
        rotation, translation = scene.light.from_frame(frame)
        points = coarse_view.points_frame_m @ rotation.T + translation
        slack = _seen_m(scene, view, coarse_view)[:, None]
        low, high = ((points - slack).min(axis=0), (points + slack).max(axis=0)) if len(points) else (np.ones(3), np.zeros(3))
        before = stand.reaching(rotation, translation, np.array([low[0], low[1], -np.inf]), high)
        if not 0 < len(before) <= MAX_TREES_TESTED:
            return len(before) > 0
        in_light = stand.some(before).outlines() @ rotation.T + translation
        first, last = (end.reshape(-1, 3) for end in (in_light.min(axis=2), in_light.max(axis=2)))
    rotation, translation = scene.light.from_frame(frame)
    return bool(
        _hide(first, last, coarse_view.points_frame_m @ rotation.T + translation, _seen_m(scene, view, coarse_view), MASK_CELLS)
    )


@cached("light", 256 * MIB)
def _boxes_of_meshes(objects: SceneObjects, light: LightSpace) -> tuple[np.ndarray, np.ndarray]:
    """The boxes of the triangles that stand for the meshes, in light space: the same wherever an eye is."""
    assert objects.solids is not None
    return _boxes(light.from_earth(objects.solids.caster_vertices_earth_m), objects.solids.caster_triangles)


@compiled
def _boxes(points, triangles):
    """Least and largest coordinates (m, 3) of triangles (m, 3) of points (n, 3)."""
    first, last = np.empty((len(triangles), 3)), np.empty((len(triangles), 3))
    for m in range(len(triangles)):
        for k in range(3):
            a, b, c = points[triangles[m, 0], k], points[triangles[m, 1], k], points[triangles[m, 2], k]
            first[m, k], last[m, k] = min(a, b, c), max(a, b, c)
    return first, last


@compiled
def _hide(first, last, points, slack, cells):
    """Whether boxes (n, 3) from ``first`` to ``last`` lie before any of some points (m, 3), as the light sees them, or within its
    slack (m,) of one: points are entered in a grid of cells with the largest depth in each.
    """
    if len(points) == 0 or len(first) == 0:
        return False
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for m in range(len(points)):
        for k in range(2):
            low[k], high[k] = min(low[k], points[m, k] - slack[m]), max(high[k], points[m, k] + slack[m])
    scale = cells / np.maximum(high - low, 1e-6)
    deepest = np.full((cells, cells), -np.inf)
    for m in range(len(points)):
        i0, i1 = int((points[m, 0] - slack[m] - low[0]) * scale[0]), int((points[m, 0] + slack[m] - low[0]) * scale[0])
        j0, j1 = int((points[m, 1] - slack[m] - low[1]) * scale[1]), int((points[m, 1] + slack[m] - low[1]) * scale[1])
        for i in range(i0, min(i1, cells - 1) + 1):
            for j in range(j0, min(j1, cells - 1) + 1):
                deepest[i, j] = max(deepest[i, j], points[m, 2] + slack[m])
    for n in range(len(first)):
        if not (last[n, 0] >= low[0] and first[n, 0] <= high[0] and last[n, 1] >= low[1] and first[n, 1] <= high[1]):
            continue
        i0, i1 = max(int((first[n, 0] - low[0]) * scale[0]), 0), int((last[n, 0] - low[0]) * scale[0])
        j0, j1 = max(int((first[n, 1] - low[1]) * scale[1]), 0), int((last[n, 1] - low[1]) * scale[1])
        for i in range(i0, min(i1, cells - 1) + 1):
            for j in range(j0, min(j1, cells - 1) + 1):
                if deepest[i, j] >= first[n, 2]:
                    return True
    return False


EFFECT = Effect("cast shadows", called_for, facts, unknown=None)
