"""Ray casting against meshes with a bounding volume hierarchy (BVH).

The BVH is a binary tree of boxes. The surface area heuristic (SAH) chooses each split: it minimises box area times number of
triangles, summed over the two children (I. Wald 2007, "On fast construction of SAH-based bounding volume hierarchies"). The
ray-triangle test is that of T. Moeller and B. Trumbore 1997.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.facts.probes import ProbeRays, Probes
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene_objects import SceneObjects

MAX_LEAF_TRIANGLES = 4
"""Maximum number of triangles in a leaf of the BVH."""

SAH_BINS = 16
"""Number of bins along a box, whose boundaries are the candidate splits."""

RAY_OFFSET_SHARE = 2.0**-20
"""Offset of the start of a ray from its surface, as a share of the meshes' extent (1 mm per km)."""

MAX_SUN_RAY_OFFSET_M = 0.01
"""Maximum offset of the start of a ray to the sun from its surface, metres. Parapets must still cast in levels of any extent."""


@dataclass(frozen=True, eq=False)
class Bvh:
    """Bounding volume hierarchy of triangles. All coordinates are float64 metres from ``origin_earth_m``.

    Attributes
    ----------
    origin_earth_m
        Origin of the coordinates (3,), earth-fixed metres.
    extent_m
        Longest side of the bounding box of all triangles, metres.
    box_low, box_high
        Minimum and maximum corner of each node's box (nodes, 3).
    first_child_or_triangle
        For an inner node i its first child; the second is ``first_child_or_triangle[i] + 1``. For a leaf its first triangle.
    leaf_triangle_count
        Number of triangles of a leaf; 0 for an inner node.
    corner, edge_a, edge_b
        One corner and the two sides from it of each triangle (m, 3), in the order of the leaves.
    """

    origin_earth_m: np.ndarray
    extent_m: float
    box_low: np.ndarray
    box_high: np.ndarray
    first_child_or_triangle: np.ndarray
    leaf_triangle_count: np.ndarray
    corner: np.ndarray
    edge_a: np.ndarray
    edge_b: np.ndarray


def is_blocked_by_meshes(objects: SceneObjects, probes: Probes, rays: ProbeRays) -> np.ndarray:
    """Return whether each ray (1 + k, n) hits the casters of the meshes before it reaches the light, bool."""
    tree = caster_bvh(objects)
    frame = probes.frame
    side = np.where(np.einsum("ij,ij->i", probes.normal_frame, rays.direction_frame[0]) < 0.0, -1.0, 1.0)
    lift = (RAY_OFFSET_SHARE * tree.extent_m * side)[:, None] * probes.normal_frame
    start = frame.directions_to_earth(rays.start_frame_m + lift) + (frame.origin_earth_m - tree.origin_earth_m)
    return any_hit(tree, start, frame.directions_to_earth(rays.direction_frame), rays.length_m)


def is_sun_blocked(
    tree: Bvh, frame: LocalFrame, position_frame_m: np.ndarray, normal_frame: np.ndarray, towards_sun: np.ndarray
) -> np.ndarray:
    """Return whether the triangles of a BVH hide the sun from points (n, 3) of a frame, bool (n,).

    Rays start beside the points, on the side of the surface to which the unit normals (n, 3) point. ``towards_sun`` (3,) is a unit
    vector of the frame.
    """
    start = position_frame_m + min(RAY_OFFSET_SHARE * tree.extent_m, MAX_SUN_RAY_OFFSET_M) * normal_frame
    start_m = frame.directions_to_earth(start) + (frame.origin_earth_m - tree.origin_earth_m)
    directions = np.broadcast_to(frame.directions_to_earth(towards_sun), start.shape)
    return any_hit(tree, start_m, directions, np.full(len(start), np.inf))


def any_hit(tree: Bvh, start_m: np.ndarray, direction: np.ndarray, length_m: np.ndarray) -> np.ndarray:
    """Return whether each ray hits a triangle within its length (...), bool.

    Starts (..., 3) are in metres from the origin of the BVH.
    """
    return np.isfinite(_find_hits(tree, start_m, direction, length_m, False)[0])


def first_mesh_hits(
    objects: SceneObjects, frame: LocalFrame, start_frame_m: np.ndarray, direction_frame: np.ndarray, length_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance along each ray to the first hit with the casters of the meshes (n,), and the hit's normal (n, 3).

    Rays have starts (n, 3), directions (n, 3) and lengths (n,). The distance is infinite without a hit within the length. Unit
    normals point towards the start.
    """
    tree = caster_bvh(objects)
    start = frame.directions_to_earth(start_frame_m) + (frame.origin_earth_m - tree.origin_earth_m)
    distance_m, triangle = _find_hits(tree, start, frame.directions_to_earth(direction_frame), length_m, True)
    normal = frame.directions_from_earth(np.cross(tree.edge_a[triangle], tree.edge_b[triangle]))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return distance_m, np.where(np.einsum("ij,ij->i", normal, direction_frame)[:, None] > 0.0, -normal, normal)


def _find_hits(
    tree: Bvh, start_m: np.ndarray, direction: np.ndarray, length_m: np.ndarray, find_nearest: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (...) along each ray to the nearest or to any hit, infinite without one, and its triangle (...)."""
    start, directions = (np.ascontiguousarray(v).reshape(-1, 3) for v in (start_m, direction))
    boxes = tree.box_low, tree.box_high, tree.first_child_or_triangle, tree.leaf_triangle_count
    hits = _trace(*boxes, tree.corner, tree.edge_a, tree.edge_b, start, directions, np.ravel(length_m), find_nearest)
    return hits[0].reshape(np.shape(length_m)), hits[1].reshape(np.shape(length_m))


@cached("scene", 512 * MIB)
def caster_bvh(objects: SceneObjects) -> Bvh:
    """Return the BVH of the meshes' triangles that cast shadows."""
    solids = objects.solids
    assert solids is not None
    return bvh_of(solids.caster_vertices_earth_m, solids.caster_triangles)


def bvh_of(vertices: np.ndarray, triangles: np.ndarray) -> Bvh:
    """Build the BVH of triangles (m, 3), m > 0, with vertices (n, 3)."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origin, extent = (low + high) / 2, max(float(np.max(high - low)), 1e-9)
    points = (vertices - origin)[triangles]
    order, low, high, first, count = _build_bvh(points.min(axis=1), points.max(axis=1), MAX_LEAF_TRIANGLES, SAH_BINS)
    corner, b, c = (np.ascontiguousarray(points[order, k]) for k in range(3))
    return Bvh(origin, extent, low, high, first, count, corner, b - corner, c - corner)


@compiled
def _build_bvh(box_low, box_high, max_leaf_triangles, bins):
    """Return the order of m triangles in the leaves of their BVH, and the arrays of its nodes as in ``Bvh``.

    ``box_low`` and ``box_high`` (m, 3) are the corners of the triangles' boxes. Node 0 is the root.
    """
    m = len(box_low)
    order = np.arange(m)
    middle = 0.5 * (box_low + box_high)
    low, high = np.full((2 * m, 3), np.inf), np.full((2 * m, 3), -np.inf)
    first, count = np.zeros(2 * m, np.int32), np.zeros(2 * m, np.int32)
    count[0] = m
    nodes, node = 1, 0
    bin_low, bin_high, bin_count = np.empty((bins, 3)), np.empty((bins, 3)), np.empty(bins, np.int64)
    cost_left = np.empty(bins)
    while node < nodes:
        start, end = first[node], first[node] + count[node]
        centre_low, centre_high = np.full(3, np.inf), np.full(3, -np.inf)
        for i in range(start, end):
            for k in range(3):
                low[node, k], high[node, k] = min(low[node, k], box_low[order[i], k]), max(high[node, k], box_high[order[i], k])
                centre_low[k], centre_high[k] = min(centre_low[k], middle[order[i], k]), max(centre_high[k], middle[order[i], k])
        if end - start > max_leaf_triangles:
            best, best_axis, best_bin = np.inf, -1, 0
            for axis in range(3):
                if not centre_high[axis] > centre_low[axis]:
                    continue
                scale = bins / (centre_high[axis] - centre_low[axis])
                bin_low[:], bin_high[:], bin_count[:] = np.inf, -np.inf, 0
                for i in range(start, end):
                    at = min(int((middle[order[i], axis] - centre_low[axis]) * scale), bins - 1)
                    bin_count[at] += 1
                    for k in range(3):
                        bin_low[at, k] = min(bin_low[at, k], box_low[order[i], k])
                        bin_high[at, k] = max(bin_high[at, k], box_high[order[i], k])
                for direction in range(2):
                    a, b, bin_total = np.full(3, np.inf), np.full(3, -np.inf), 0
                    for j in range(bins - 1):
                        at = j if direction == 0 else bins - 1 - j
                        bin_total += bin_count[at]
                        for k in range(3):
                            a[k], b[k] = min(a[k], bin_low[at, k]), max(b[k], bin_high[at, k])
                        x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
                        cost = (x * y + y * z + z * x) * bin_total if bin_total > 0 else np.inf
                        if direction == 0:
                            cost_left[at] = cost
                        elif cost + cost_left[at - 1] < best:
                            best, best_axis, best_bin = cost + cost_left[at - 1], axis, at
            cut = start
            if best_axis >= 0:
                scale = bins / (centre_high[best_axis] - centre_low[best_axis])
                for i in range(start, end):
                    t = order[i]
                    if min(int((middle[t, best_axis] - centre_low[best_axis]) * scale), bins - 1) < best_bin:
                        order[i], order[cut] = order[cut], t
                        cut += 1
            if cut == start or cut == end:  # all centres coincide
                cut = (start + end) // 2
            first[nodes], count[nodes] = start, cut - start
            first[nodes + 1], count[nodes + 1] = cut, end - cut
            first[node], count[node] = nodes, 0
            nodes += 2
        node += 1
    return order, low[:nodes].copy(), high[:nodes].copy(), first[:nodes].copy(), count[:nodes].copy()


@compiled
def _trace(low, high, first, count, corner, edge_a, edge_b, start, direction, length, find_nearest):
    """Return the distance (n,) along each ray to a hit, infinite without one, and the index (n,) of the triangle that is hit.

    The hit is the nearest one if ``find_nearest``, else any. The first seven parameters are arrays of a ``Bvh``. Rays have starts
    (n, 3) from its origin, directions (n, 3) and lengths (n,), metres.
    """
    hit_distance, hit_triangle = np.full(len(start), np.inf), np.zeros(len(start), np.int64)
    stack = np.empty(256, np.int64)
    for n in range(len(start)):
        x, y, z = start[n, 0], start[n, 1], start[n, 2]
        dx, dy, dz = direction[n, 0], direction[n, 1], direction[n, 2]
        ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
        max_distance = length[n]
        stack[0], stack_size = 0, 1
        while stack_size > 0 and (find_nearest or hit_distance[n] == np.inf):
            stack_size -= 1
            node = stack[stack_size]
            # The product of 0 and infinity is NaN, with which all comparisons fail: a ray in the plane of a face may miss the box.
            a, b = (low[node, 0] - x) * ix, (high[node, 0] - x) * ix
            near, far = max(0.0, min(a, b)), min(max_distance, max(a, b))
            a, b = (low[node, 1] - y) * iy, (high[node, 1] - y) * iy
            near, far = max(near, min(a, b)), min(far, max(a, b))
            a, b = (low[node, 2] - z) * iz, (high[node, 2] - z) * iz
            near, far = max(near, min(a, b)), min(far, max(a, b))
            if not near <= far:
                continue
            if count[node] == 0:
                stack[stack_size], stack[stack_size + 1] = first[node], first[node] + 1
                stack_size += 2
                continue
            for t in range(first[node], first[node] + count[node]):
                ax, ay, az = edge_a[t, 0], edge_a[t, 1], edge_a[t, 2]
                bx, by, bz = edge_b[t, 0], edge_b[t, 1], edge_b[t, 2]
                px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
                det = ax * px + ay * py + az * pz
                if det == 0.0:
                    continue
                ox, oy, oz = x - corner[t, 0], y - corner[t, 1], z - corner[t, 2]
                u = (ox * px + oy * py + oz * pz) / det
                if u < 0.0 or u > 1.0:
                    continue
                qx, qy, qz = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
                v = (dx * qx + dy * qy + dz * qz) / det
                if v < 0.0 or u + v > 1.0:
                    continue
                s = (bx * qx + by * qy + bz * qz) / det
                if 0.0 < s < max_distance:
                    hit_distance[n], hit_triangle[n] = s, t
                    if not find_nearest:
                        break
                    max_distance = s
    return hit_distance, hit_triangle
