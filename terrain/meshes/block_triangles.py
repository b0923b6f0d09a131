"""Triangulate blocks: polygons extruded upwards, with roof, walls and floor. A block is closed for every outline."""

from __future__ import annotations

from collections import deque

import mapbox_earcut
import numpy as np

from skugga.terrain.meshes.roofs import Roof


def block_triangles(polygon_triangles: np.ndarray, ring_ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (m, 3) of a block, and the mask (m,) of those on its roof.

    ``polygon_triangles`` (k, 3) are the triangles of the polygon, which has n corners. ``ring_ends`` holds the end index of each of
    its rings in the corners. Vertices [0, n) of the block are the roof's, [n, 2 n) the floor's. Rings have the building on their
    left.
    """
    count = int(ring_ends[-1])
    corner, next_corner = np.arange(count), next_corners(ring_ends)
    walls = np.concatenate([
        np.column_stack([corner + count, next_corner + count, next_corner]), np.column_stack([corner + count, next_corner, corner])
    ])  # fmt: skip
    triangles = np.concatenate([polygon_triangles, walls, polygon_triangles[:, ::-1] + count]).astype(np.int32)
    return triangles, np.arange(len(triangles)) < len(polygon_triangles)


def sloped_block_triangles(roof: Roof) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (m, 3) of a block of four corners under a sloped roof, and the mask (m,) of those on its roof.

    Vertices 0 to 3 are the eaves and 4 to 7 the floor. The points of the ridge follow.
    """
    block, _ = block_triangles(np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.array([4]))
    slopes = np.where(roof.triangles >= 4, roof.triangles + 4, roof.triangles).astype(np.int32)
    triangles = np.concatenate([slopes, block[2:]])
    return triangles, np.arange(len(triangles)) < roof.roof_triangle_count


def roof_triangles(xy: np.ndarray, ring_ends: np.ndarray) -> np.ndarray:
    """Triangulate a polygon with holes: return counter-clockwise triangles (m, 3) of its corners (n, 2).

    ``ring_ends`` holds the end index of each ring in the corners. Every edge of every ring is the edge of one triangle.
    """
    clipped = mapbox_earcut.triangulate_float64(np.ascontiguousarray(xy), ring_ends.astype(np.uint32)).reshape(-1, 3)
    triangles = _counter_clockwise(clipped.astype(np.int32), xy)
    # Ear clipping skips corners that become collinear on the way. Without them the roof and the walls would have gaps.
    missing = len(xy) + 2 * (len(ring_ends) - 1) - 2 - len(triangles)  # n corners and h holes give n + 2 h - 2 triangles
    return triangles if missing <= 0 else _insert_skipped_corners(triangles, xy, ring_ends, missing)


def _insert_skipped_corners(triangles: np.ndarray, xy: np.ndarray, ring_ends: np.ndarray, missing_count: int) -> np.ndarray:
    """Split up to ``missing_count`` triangles at corners of the polygon that lie inside one of their edges.

    Returns all triangles.
    """
    from scipy.spatial import cKDTree

    rings = set(zip(range(len(xy)), next_corners(ring_ends).tolist(), strict=True))
    corners, tree = triangles.tolist(), cKDTree(xy)
    edges = {edge: k for k, (i, j, l) in enumerate(corners) for edge in ((i, j), (j, l), (l, i))}
    queue = deque(edges)
    while queue and missing_count:
        a, b = queue.popleft()
        if (a, b) not in edges or (b, a) in edges or (a, b) in rings:
            continue
        k = edges[a, b]
        c = next(corner for corner in corners[k] if corner not in (a, b))
        edge_vector = xy[b] - xy[a]
        nearby_corners = np.array(sorted(tree.query_ball_point((xy[a] + xy[b]) / 2, 0.5 * np.hypot(*edge_vector) * (1 + 1e-9))))
        offset = xy[nearby_corners] - xy[a]
        share = offset @ edge_vector / (edge_vector @ edge_vector)
        distance = np.abs(edge_vector[0] * offset[:, 1] - edge_vector[1] * offset[:, 0]) / (edge_vector @ edge_vector)
        inner_corners = nearby_corners[(distance < 1e-9) & (share > 1e-9) & (share < 1 - 1e-9) & (nearby_corners != c)].tolist()
        if not inner_corners:
            continue
        middle, new_triangle = inner_corners[0], len(corners)
        del edges[a, b]
        corners[k] = [a, middle, c]
        corners.append([middle, b, c])
        edges |= {
            (a, middle): k,
            (middle, c): k,
            (c, a): k,
            (middle, b): new_triangle,
            (b, c): new_triangle,
            (c, middle): new_triangle,
        }
        queue += [(a, middle), (middle, b)]
        missing_count -= 1
    return np.array(corners, np.int32)


def next_corners(ring_ends: np.ndarray) -> np.ndarray:
    """Return for each corner the index (n,) of the next corner in its ring."""
    next_corner = np.arange(1, int(ring_ends[-1]) + 1)
    next_corner[ring_ends - 1] = np.concatenate([[0], ring_ends[:-1]])
    return next_corner


def _counter_clockwise(triangles: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return the triangles (m, 3) that have an area, all of them counter-clockwise."""
    a, b, c = np.moveaxis(xy[triangles], 1, 0)
    double_area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    oriented = np.where(double_area[:, None] < 0, triangles[:, ::-1], triangles)
    longest = np.max([np.einsum("ij,ij->i", side, side) for side in (b - a, c - b, a - c)], axis=0)
    return oriented[np.abs(double_area) > 1e-12 * longest]
