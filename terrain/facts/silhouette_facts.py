"""Measure the silhouettes of the meshes under a light: number of edges, length in the picture, and layers of shadow volumes.

An edge belongs to the silhouette if one of its triangles faces the light and the other does not, or if it is the boundary of an
open surface. A side of a shadow volume is the infinite quad from a silhouette edge away from the light (F. Crow 1977, "Shadow
algorithms for computer graphics").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.scene_objects import SceneObjects

if TYPE_CHECKING:
    from skugga.terrain.meshes.assemble import Placement

MAX_VOLUME_SIDES = 4096
"""Maximum number of shadow-volume sides that are tested against the eye's rays. More sides are sampled evenly and scaled up."""

MAX_EYE_RAYS = 48
"""Maximum number of rays from the eye that are tested against the sides."""


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """Edges of a mesh with their adjacent triangles.

    Attributes
    ----------
    ends
        Vertex numbers (e, 2), int32.
    triangle_pair
        Adjacent triangles (e, 2), int32; -1 for none. If more than two triangles share an edge, it lists two of them.
    """

    ends: np.ndarray
    triangle_pair: np.ndarray


def mesh_edges(merged_triangles: np.ndarray, triangles: np.ndarray) -> MeshEdges:
    """Return the edges of triangles (m, 3). ``merged_triangles`` (m, 3) are the same triangles with coincident vertices merged."""
    start, end = merged_triangles.ravel().astype(np.int64), np.roll(merged_triangles, -1, axis=1).ravel().astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    keys = low * (int(high.max(initial=0)) + 1) + high
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    is_shared = np.diff(first, append=len(keys)) > 1
    second = np.where(is_shared, order[np.minimum(first + 1, len(keys) - 1)] // 3, -1)
    half_edge = order[first]
    ends = np.stack([triangles.ravel()[half_edge], np.roll(triangles, -1, axis=1).ravel()[half_edge]], axis=1)
    return MeshEdges(ends.astype(np.int32), np.stack([half_edge // 3, second], axis=1).astype(np.int32))


@cached("scene", 256 * MIB)
def _edges_of_bodies(placement: Placement) -> MeshEdges:
    """Return the edges of all bodies that cast shadows. They do not depend on time. Bodies share no edges."""
    merged_triangles, triangles, merged_count, vertex_count = [], [], 0, 0
    for placed in placement.casting_bodies:
        merged = placed.body.merged_triangles
        merged_triangles.append(merged + np.int64(merged_count))
        triangles.append(placed.body.triangles + np.int64(vertex_count))
        merged_count += int(merged.max(initial=-1)) + 1
        vertex_count += len(placed.body.vertices_m)
    return mesh_edges(np.concatenate(merged_triangles), np.concatenate(triangles))


@cached("scene", 256 * MIB)
def _face_normals_and_corners(objects: SceneObjects) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals (m, 3) and the first corners (m, 3) of the triangles that cast shadows, earth-fixed.

    The length of a normal is twice the area of its triangle.
    """
    solids = objects.solids
    assert solids is not None
    a, b, c = np.moveaxis(solids.caster_vertices_earth_m[solids.caster_triangles], 1, 0)
    return np.cross(b - a, c - a), a


def silhouette_edges_of(objects: SceneObjects, light_earth: np.ndarray, is_positional: bool) -> np.ndarray:
    """Return both ends of the silhouette edges of the meshes, shape (k, 2, 3), float64, earth-fixed metres.

    ``light_earth`` (3,) is the direction to the light, or its position if ``is_positional``.
    """
    assert objects.solids is not None and objects.placement is not None
    edges, (normal, corner) = _edges_of_bodies(objects.placement), _face_normals_and_corners(objects)
    chosen = _silhouette_edges(
        normal, corner, edges.triangle_pair, np.asarray(light_earth, np.float64), 1.0 if is_positional else 0.0
    )
    return objects.solids.caster_vertices_earth_m[edges.ends[chosen]]


@compiled
def _silhouette_edges(normal, corner, triangle_pair, light, light_w):
    """Return the indices (k,) of the edges that belong to the silhouette.

    ``normal`` and ``corner`` (m, 3) are a normal and one corner of each triangle, and ``triangle_pair`` (e, 2) are the triangles
    beside each edge (``MeshEdges``). ``light`` (3,) is the light's position if ``light_w`` is 1, and the direction to it if
    ``light_w`` is 0.
    """
    facing = np.empty(len(normal), np.bool_)
    for t in range(len(normal)):
        facing[t] = (
            normal[t, 0] * (light[0] - light_w * corner[t, 0]) + normal[t, 1] * (light[1] - light_w * corner[t, 1])
            + normal[t, 2] * (light[2] - light_w * corner[t, 2])
        ) > 0.0  # fmt: skip
    out = np.empty(len(triangle_pair), np.int64)
    count = 0
    for e in range(len(triangle_pair)):
        if triangle_pair[e, 1] < 0 or facing[triangle_pair[e, 0]] != facing[triangle_pair[e, 1]]:
            out[count] = e
            count += 1
    return out[:count].copy()


def projected_edge_length(ends_camera: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Return the total length of edges (k, 2, 3), in camera axes, inside a picture from ``low`` to ``high`` (2,), as tangents."""
    return float(_clipped_length(ends_camera, low, high))


@compiled
def _clipped_length(ends, low, high):
    """Return the total length of projected edges, clipped at the sides of the view frustum (M. Cyrus, J. Beck 1978).

    The parameters are those of ``projected_edge_length``.
    """
    total = 0.0
    for e in range(len(ends)):
        first, last = 0.0, 1.0
        for plane in range(4):
            k, bound, side = plane // 2, low[plane // 2] if plane % 2 == 0 else high[plane // 2], 1.0 if plane % 2 == 0 else -1.0
            a = side * (ends[e, 0, k] - bound * ends[e, 0, 2])
            b = side * (ends[e, 1, k] - bound * ends[e, 1, 2])
            if a < 0.0 and b < 0.0:
                first = 2.0
            elif a < 0.0:
                first = max(first, a / (a - b))
            elif b < 0.0:
                last = min(last, a / (a - b))
        if first >= last:
            continue
        projected_ends = np.empty((2, 2))
        is_ahead = True
        for i in range(2):
            s = first if i == 0 else last
            z = ends[e, 0, 2] + s * (ends[e, 1, 2] - ends[e, 0, 2])
            is_ahead = is_ahead and z > 0.0
            for k in range(2):
                projected_ends[i, k] = (ends[e, 0, k] + s * (ends[e, 1, k] - ends[e, 0, k])) / z
        if is_ahead:
            total += np.hypot(projected_ends[1, 0] - projected_ends[0, 0], projected_ends[1, 1] - projected_ends[0, 1])
    return total


def mean_volume_layers(
    ends_earth_m: np.ndarray, light_earth: np.ndarray, is_positional: bool, start_earth_m: np.ndarray, segment_m: np.ndarray
) -> float:
    """Return the mean number of shadow-volume sides that a ray crosses.

    The sides start at edges (k, 2, 3) and extend away from the light. Ray i runs from ``start_earth_m[i]`` along ``segment_m[i]``;
    both arrays are (n, 3).
    """
    if not len(ends_earth_m) or not len(segment_m):
        return 0.0
    count = min(len(ends_earth_m), MAX_VOLUME_SIDES)
    sampled_ends = ends_earth_m[(np.arange(count) * (len(ends_earth_m) / count)).astype(np.int64)]
    near = start_earth_m[0]  # origin near the rays, for precision
    light = light_earth - near if is_positional else light_earth
    return (
        _count_crossings(sampled_ends - near, start_earth_m - near, segment_m, light, float(is_positional))
        / len(segment_m)
        * len(ends_earth_m)
        / count
    )


@compiled
def _count_crossings(ends, start, segment, light, light_w):
    """Count the crossings of rays with the strips that extend from edges away from a light.

    The strip of an edge from a to b runs along a - l from a, and along b - l from b, with the light at l. If the light is a
    direction l, it runs along -l from both. ``ends`` (k, 2, 3) are the edges. Ray i runs from ``start[i]`` to ``start[i] +
    segment[i]``. ``light`` (3,) is a position if ``light_w`` is 1, and a direction if it is 0.
    """
    crossings = 0
    for e in range(len(ends)):
        a0, a1, a2 = ends[e, 0, 0], ends[e, 0, 1], ends[e, 0, 2]
        b0, b1, b2 = ends[e, 1, 0] - a0, ends[e, 1, 1] - a1, ends[e, 1, 2] - a2
        # The strip lies in the plane of the edge and the light.
        u0, u1, u2 = light_w * a0 - light[0], light_w * a1 - light[1], light_w * a2 - light[2]
        v0, v1, v2 = u0 + light_w * b0, u1 + light_w * b1, u2 + light_w * b2
        n0, n1, n2 = b1 * u2 - b2 * u1, b2 * u0 - b0 * u2, b0 * u1 - b1 * u0
        # Normals in the plane that point into the strip from its edge and from its two sides.
        e0, e1, e2 = n1 * b2 - n2 * b1, n2 * b0 - n0 * b2, n0 * b1 - n1 * b0
        if e0 * u0 + e1 * u1 + e2 * u2 < 0.0:
            e0, e1, e2 = -e0, -e1, -e2
        f0, f1, f2 = n1 * u2 - n2 * u1, n2 * u0 - n0 * u2, n0 * u1 - n1 * u0
        if f0 * b0 + f1 * b1 + f2 * b2 < 0.0:
            f0, f1, f2 = -f0, -f1, -f2
        g0, g1, g2 = n1 * v2 - n2 * v1, n2 * v0 - n0 * v2, n0 * v1 - n1 * v0
        if g0 * b0 + g1 * b1 + g2 * b2 > 0.0:
            g0, g1, g2 = -g0, -g1, -g2
        for i in range(len(start)):
            segment_dot_normal = n0 * segment[i, 0] + n1 * segment[i, 1] + n2 * segment[i, 2]
            x, y, z = start[i, 0] - a0, start[i, 1] - a1, start[i, 2] - a2
            s = -(n0 * x + n1 * y + n2 * z)
            if segment_dot_normal < 0.0:
                segment_dot_normal, s = -segment_dot_normal, -s
            if not (0.0 < s < segment_dot_normal):
                continue
            s /= segment_dot_normal
            x, y, z = x + s * segment[i, 0], y + s * segment[i, 1], z + s * segment[i, 2]
            if (
                e0 * x + e1 * y + e2 * z > 0.0 and f0 * x + f1 * y + f2 * z > 0.0
                and g0 * (x - b0) + g1 * (y - b1) + g2 * (z - b2) > 0.0
            ):  # fmt: skip
                crossings += 1
    return crossings
