"""Classify points with a small shadow map that decides only with certainty, even with casters thinner than its texels.

The map of Chan and Durand (2004, An Efficient Hybrid Shadow Rendering Algorithm) samples depths at texel centres and misses casters
between them. This conservative map stores bounds over whole texels. In each texel, the depth intervals of casting triangles and
silhouette edges are joined into disjoint runs. A run without an edge is *whole*: it covers each point of the texel by the same
number of layers.

- A point in front of all runs is lit.
- A point behind a whole run of one layer or more is in shadow.
- All other points are masked: shadow volumes decide them.

``docs/conservative-map.md`` defines the terms and proves this.

**Rounding.** Layers are counted at a probe inside the texel, with a margin. Counting too many masks a point, which is safe. None
is counted wrongly: a triangle that is not thin covers a part of the square wherever it covers the surroundings of the probe. The
margin of squares, 1/64 texel, exceeds all rounding of u and v, so that a point's texel is that of its rounded coordinates. The
caller's ``depth_rounding`` is the rounding of a point's depth. Intervals include their own rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.hybrid.conservative_raster import certain_depths
from skugga.terrain.compiled import compiled

LIT, SHADED, MASKED = 255, 0, 128
"""Classes of points (`classify_points`)."""


@dataclass(frozen=True, eq=False)
class ConservativeMap:
    """Depths float64 (rows, cols) at which a map's texels decide with certainty; infinite if a texel has no such bound.

    Attributes
    ----------
    nearest_depth
        Near bound of the nearest run of casters: points in front of it are lit.
    nearest_other_depth
        Near bound of the nearest run, but of the second one if the first is a single layer without an edge. Points on a casting
        triangle in front of it are lit.
    shadow_depth
        Far bound of the nearest run that covers the whole texel: points behind it are in shadow.
    """

    nearest_depth: np.ndarray
    nearest_other_depth: np.ndarray
    shadow_depth: np.ndarray


def conservative_map(size: tuple[int, int], corners: np.ndarray, edges: np.ndarray) -> ConservativeMap:
    """Return the conservative map of casting triangles and their silhouette edges.

    Parameters
    ----------
    size
        Columns and rows, texels.
    corners
        Casting triangles (t, 3, 3) in (u, v, depth), finite. In the map u is in [0, columns] and v in [0, rows]; both may be up to
        4 million texels outside. Depth is linear in u and v, and increases away from the light. Triangles that touch no texel are
        ignored.
    edges
        Silhouette edges (e, 2, 3) in the same coordinates: the ends of each edge that does not cancel in the signed sum over the
        triangles, bit-identical to those in ``corners``.
    """
    cols, rows = size
    corners, edges = np.ascontiguousarray(corners, float), np.ascontiguousarray(edges, float)
    return ConservativeMap(*certain_depths(cols, rows, corners, edges))


def classify_points(
    conservative: ConservativeMap,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    depth_rounding: float | np.ndarray,
    on_caster: bool | np.ndarray = False,
) -> np.ndarray:
    """Return the class of each point by a map: `LIT`, `SHADED` or `MASKED` (undecided), uint8 (n,).

    Parameters
    ----------
    conservative
        The map.
    u, v, depth
        The points (n,), in the coordinates of the map. Points outside of it are masked.
    depth_rounding
        Bound of the rounding error of depths of points and triangles: a number or (n,).
    on_caster
        Whether the points lie on casting triangles of the map: one value or (n,).
    """
    n = len(depth)
    depth_rounding, on_caster = np.broadcast_to(np.asarray(depth_rounding, float), n), np.broadcast_to(on_caster, n)
    return _classify_each_point(
        conservative.nearest_depth,
        conservative.nearest_other_depth,
        conservative.shadow_depth,
        u,
        v,
        depth,
        depth_rounding,
        on_caster,
    )


def clipped_triangles(corners_lamp_m: np.ndarray, z_near_m: float) -> np.ndarray:
    """Clip triangles in lamp space at z >= ``z_near_m`` and return the parts (t', 3, 3) with the same winding.

    ``corners_lamp_m`` (t, 3, 3) are the triangles' corners, metres. A cut bounds a part like a silhouette edge, but is not added to
    the edges. This requires that no caster is nearer to the lamp than sqrt(1 + 2 tangent²) z_near, with the tangent of half the
    map's angle of view. Then all cuts fall outside of the map, and the map misses no clipped part.
    """
    is_in_front = corners_lamp_m[..., 2] >= z_near_m
    front_count = is_in_front.sum(axis=1)
    one_in_front, two_in_front = corners_lamp_m[front_count == 1], corners_lamp_m[front_count == 2]
    tip, left, right = _rotate_corners(one_in_front, np.argmax(is_in_front[front_count == 1], axis=1))
    single_parts = np.stack(
        [tip, _near_plane_intersection(tip, left, z_near_m), _near_plane_intersection(tip, right, z_near_m)], axis=1
    )
    back_corner, left, right = _rotate_corners(two_in_front, np.argmin(is_in_front[front_count == 2], axis=1))
    to_left, to_right = (
        _near_plane_intersection(left, back_corner, z_near_m),
        _near_plane_intersection(right, back_corner, z_near_m),
    )
    double_parts = [np.stack([left, right, to_right], axis=1), np.stack([left, to_right, to_left], axis=1)]
    return np.concatenate([corners_lamp_m[front_count == 3], single_parts, *double_parts])


def clipped_edges(ends_lamp_m: np.ndarray, z_near_m: float) -> np.ndarray:
    """Clip edges in lamp space at z >= ``z_near_m`` and return the parts (e', 2, 3).

    ``ends_lamp_m`` (e, 2, 3) are the edges' ends, metres. The cut points are bit-identical to those of `clipped_triangles`.
    """
    is_in_front = ends_lamp_m[..., 2] >= z_near_m
    front_count = is_in_front.sum(axis=1)
    crossing, first_is_in_front = ends_lamp_m[front_count == 1], is_in_front[front_count == 1, 0]
    a, b = (
        np.where(first_is_in_front[:, None], crossing[:, 0], crossing[:, 1]),
        np.where(first_is_in_front[:, None], crossing[:, 1], crossing[:, 0]),
    )
    return np.concatenate([ends_lamp_m[front_count == 2], np.stack([a, _near_plane_intersection(a, b, z_near_m)], axis=1)])


def _rotate_corners(corners: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the three corners (n, 3) of triangles in their order, starting at index ``first`` (n,)."""
    n = np.arange(len(corners))
    return corners[n, first], corners[n, (first + 1) % 3], corners[n, (first + 2) % 3]


def _near_plane_intersection(front_points: np.ndarray, back_points: np.ndarray, z_near_m: float) -> np.ndarray:
    """Return the intersections (n, 3) of segments with the plane z = ``z_near_m``.

    The segments lead from ``front_points`` (n, 3) ahead of the plane to ``back_points`` (n, 3) behind it. Triangles and edges use
    the same arithmetic, so shared edges have identical cuts.
    """
    share = (front_points[:, 2] - z_near_m) / (front_points[:, 2] - back_points[:, 2])
    intersections = front_points + share[:, None] * (back_points - front_points)
    intersections[:, 2] = z_near_m
    return intersections


@compiled
def _classify_each_point(nearest_depth, nearest_other_depth, shadow_depth, u, v, depth, depth_rounding, on_caster):
    """Return the class (n,) uint8 of each point, by the three depths (rows, cols) of a ``ConservativeMap``.

    The other parameters are those of ``classify_points``, as arrays (n,).
    """
    rows, cols = nearest_depth.shape
    out = np.full(len(depth), MASKED, np.uint8)
    for i in range(len(depth)):
        if 0.0 <= u[i] < cols and 0.0 <= v[i] < rows:
            row, col = int(v[i]), int(u[i])
            if depth[i] + depth_rounding[i] < (nearest_other_depth if on_caster[i] else nearest_depth)[row, col]:
                out[i] = LIT
            elif depth[i] - depth_rounding[i] > shadow_depth[row, col]:
                out[i] = SHADED
    return out
