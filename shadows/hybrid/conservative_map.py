"""The conservative map: what of a light's shadow is certain from a small map, whatever is thinner than its texels.

The map of Chan and Durand (2004, An Efficient Hybrid Shadow Rendering Algorithm) knows depths at texel centres, and misses what
lies between. This one knows bounds over whole texels: for each texel, the depths of casting triangles and silhouette edges, joined
to disjoint runs. A run without an edge is *whole*, and covers each point of the texel by the same number of layers. So a point in
front of all runs is lit, a point behind a whole run of one layer or more is in shadow, and what is not certain is masked: volumes
decide. ``docs/conservative-map.md`` has the terms, the proof and the handling of rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.hybrid.conservative_raster import certain_depths
from skugga.terrain.compiled import compiled

LIT, SHADED, MASKED = 255, 0, 128
"""What `decide` says of a point."""


@dataclass(frozen=True, eq=False)
class ConservativeMap:
    """Depths (rows, cols) float64 from which on a map is certain, per texel.

    ``nearest``: what lies before it is lit. ``nearest_other``: so is what lies before this and is itself on a casting triangle.
    ``shaded_beyond``: what lies beyond it is in shadow. Infinite where there is no such depth.
    """

    nearest: np.ndarray
    nearest_other: np.ndarray
    shaded_beyond: np.ndarray


def conservative_map(size: tuple[int, int], corners: np.ndarray, edges: np.ndarray) -> ConservativeMap:
    """The map of casting triangles and of their silhouette edges.

    Parameters
    ----------
    size
        Columns and rows, texels.
    corners
        Casting triangles (t, 3, 3) in (u, v, depth), finite: u from 0 to the columns and v from 0 to the rows over the map, at
        most 4 million texels outside of it; depth linear in them, and greater farther from the light. What touches no texel is
        left out.
    edges
        Silhouette edges (e, 2, 3) in the same coordinates: of each edge that does not cancel in the signed sum over the triangles,
        the ends, exactly as they are in ``corners``.
    """
    cols, rows = size
    corners, edges = np.ascontiguousarray(corners, float), np.ascontiguousarray(edges, float)
    return ConservativeMap(*certain_depths(cols, rows, corners, edges))


def classify_points(
    known: ConservativeMap,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    slack: float | np.ndarray,
    on_caster: bool | np.ndarray = False,
) -> np.ndarray:
    """What a map knows of points: `LIT`, `SHADED` or `MASKED`, (n,) uint8.

    Parameters
    ----------
    u, v, depth
        The points (n,), in the coordinates of the map. Those outside of it are masked.
    slack
        How far rounding may have moved depths, of the points as of the triangles, one for all or (n,).
    on_caster
        Whether the points lie on casting triangles of the map, for all or (n,).
    """
    n = len(depth)
    slack, on_caster = np.broadcast_to(np.asarray(slack, float), n), np.broadcast_to(on_caster, n)
    return _decided(known.nearest, known.nearest_other, known.shaded_beyond, u, v, depth, slack, on_caster)


def clipped_triangles(corners_lamp_m: np.ndarray, z_near_m: float) -> np.ndarray:
    """The parts (t', 3, 3) of triangles (t, 3, 3) of lamp space that lie at z >= z_near, going round the same way.

    The cuts bound what is left as silhouette edges do, but are none: nothing may cast from nearer to the lamp than
    sqrt(1 + 2 tangent²) z_near, with the tangent of half the map's angle of view. Then cuts fall outside of the map, and
    nothing that is cut off is missed in it.
    """
    ahead = corners_lamp_m[..., 2] >= z_near_m
    number = ahead.sum(axis=1)
    one_ahead, two_ahead = corners_lamp_m[number == 1], corners_lamp_m[number == 2]
    tip, left, right = _turned(one_ahead, np.argmax(ahead[number == 1], axis=1))
    single = np.stack([tip, _cut(tip, left, z_near_m), _cut(tip, right, z_near_m)], axis=1)
    behind, left, right = _turned(two_ahead, np.argmin(ahead[number == 2], axis=1))
    to_left, to_right = _cut(left, behind, z_near_m), _cut(right, behind, z_near_m)
    double = [np.stack([left, right, to_right], axis=1), np.stack([left, to_right, to_left], axis=1)]
    return np.concatenate([corners_lamp_m[number == 3], single, *double])


def clipped_edges(ends_lamp_m: np.ndarray, z_near_m: float) -> np.ndarray:
    """The parts (e', 2, 3) of edges (e, 2, 3) of lamp space that lie at z >= z_near, cut at the very points where
    `clipped_triangles` cuts them.
    """
    ahead = ends_lamp_m[..., 2] >= z_near_m
    number = ahead.sum(axis=1)
    crossing, first = ends_lamp_m[number == 1], ahead[number == 1, 0]
    a, b = np.where(first[:, None], crossing[:, 0], crossing[:, 1]), np.where(first[:, None], crossing[:, 1], crossing[:, 0])
    return np.concatenate([ends_lamp_m[number == 2], np.stack([a, _cut(a, b, z_near_m)], axis=1)])


def _turned(corners: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (n, 3) of triangles in their order, from ``first`` (n,) on."""
    n = np.arange(len(corners))
    return corners[n, first], corners[n, (first + 1) % 3], corners[n, (first + 2) % 3]


def _cut(ahead: np.ndarray, behind: np.ndarray, z_near_m: float) -> np.ndarray:
    """Where the ways (n, 3) from points ahead of the plane z = z_near to points behind it cross it: by the same arithmetic for
    all that share an edge.
    """
    share = (ahead[:, 2] - z_near_m) / (ahead[:, 2] - behind[:, 2])
    point = ahead + share[:, None] * (behind - ahead)
    point[:, 2] = z_near_m
    return point


@compiled
def _decided(nearest, nearest_other, shaded_beyond, u, v, depth, slack, on_caster):
    rows, cols = nearest.shape
    out = np.full(len(depth), MASKED, np.uint8)
    for i in range(len(depth)):
        if 0.0 <= u[i] < cols and 0.0 <= v[i] < rows:
            row, col = int(v[i]), int(u[i])
            if depth[i] + slack[i] < (nearest_other if on_caster[i] else nearest)[row, col]:
                out[i] = LIT
            elif depth[i] - slack[i] > shaded_beyond[row, col]:
                out[i] = SHADED
    return out
