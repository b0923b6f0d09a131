"""Look the points of a map's block up in the sun's depth map, by a loop on the CPU.

The loop does the work of ``shaders/receiver.glsl`` and ``shaders/shadow_map.frag.glsl`` for points of meshes, trees and smooth
ground, in the same float32 operations and the same order. Points of meshes and trees have triangles of their own. A point of the
ground is compared on the triangles round the nearest node of the map's grid. The shader on llvmpipe rounds some quotients
differently: about one comparison in a million, where a depth lies right on a step of the map, falls to the other side.

Most points of a map lie in the open: no texel near them holds a caster. A loop leaves them after two texels; a software rasteriser
transfers sixteen numbers of each point first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.maps.point_lookup import (
    DepthComparison,
    SunMap,
    first_tap,
    is_free_of_casters,
    is_lit,
    lit_share_without_triangle,
    move_off_surface,
    rotate_to_light,
    tap_weight,
    translate_to_light,
    weights_on_triangle,
)
from skugga.terrain.compiled import compiled, internal, run_in_chunks

ON_EDGE_NODES = np.float32(1e-5)
"""Distance, in nodes, within which a point belongs to the triangles on both sides of an edge."""

LIFTED_CREASE_OFFSET = np.float32(1e-9)
"""Increase of the crease of a lifted point: the shader marks lifted points by a negative crease, which 0 cannot be."""

RING_COLS, RING_ROWS = np.array([1, 1, 0, -1, -1, -1, 0, 1]), np.array([0, -1, -1, -1, 0, 1, 1, 1])
"""Columns and rows of the ring of neighbours round a node, counter-clockwise as seen from above."""


class MapPoints(NamedTuple):
    """Points (n,) of a map's block that are looked up, row by row.

    Attributes
    ----------
    valid
        bool (n,): whether a pixel shows a point.
    position
        float64 (n, 3): positions in the frame, metres.
    normal
        float32 (n, 3): unit normals that face the light (``FacingNormals.normal_frame``).
    crease
        float32 (n,): creases (``FacingNormals.crease``).
    corners
        float32 (n, 9): corners of the triangles of meshes and trees, metres; 0 on the ground. Empty (0, 9) if there are none.
    is_lifted
        bool (n,): whether a point lies on the smooth ground, off the triangles. Empty (0,) if none does.
    """

    valid: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    crease: np.ndarray
    corners: np.ndarray
    is_lifted: np.ndarray


class GroundNodes(NamedTuple):
    """The nodes of a map's ground, and the place of its pixels among them.

    Attributes
    ----------
    position_frame_m
        float64 (m, n, 3): positions, metres.
    is_cut_nw_se
        bool (m - 1, n - 1): diagonals of the quads (``Sheet``).
    first_row, first_col
        Row and column of the first pixel.
    row_step, col_step
        Rows and columns from one pixel to the next.
    """

    position_frame_m: np.ndarray
    is_cut_nw_se: np.ndarray
    first_row: np.float32
    first_col: np.float32
    row_step: np.float32
    col_step: np.float32


def look_up_map_points(
    drawn_map: SunMap, comparison: DepthComparison, points: MapPoints, nodes: GroundNodes, visibility: np.ndarray
) -> None:
    """Write the visibility of a block's points in a map of the sun to ``visibility`` (rows, cols) float32.

    The visibility is the share of lit taps, in [0, 1], and 1 in pixels without a point. ``comparison`` tells how depths are
    compared.
    """
    run_in_chunks(len(visibility), _look_up_rows, drawn_map, comparison, points, nodes, visibility)


@compiled
def _look_up_rows(first, last, drawn_map, comparison, points, nodes, visibility):
    """Write the visibility of the rows in [``first``, ``last``). The other parameters are those of ``look_up_map_points``."""
    taps, taps_without_triangle = comparison.taps, comparison.taps_without_triangle
    one, zero = np.float32(1.0), np.float32(0.0)
    corners = points.corners
    has_corners, has_lifted = len(corners) > 0, len(points.is_lifted) > 0
    around = np.empty((9, 3), np.float32)  # in the frame
    beside = np.empty((9, 2), np.float32)  # columns and rows from the node
    ring = np.empty((9, 3), np.float32)  # in the map, relative to the node
    cols = visibility.shape[1]
    for i in range(first, last):
        for j in range(cols):
            n = i * cols + j
            visibility[i, j] = one
            if not points.valid[n]:
                continue
            p = translate_to_light(drawn_map, rotate_to_light(drawn_map, points.position, n, 0))
            crease, is_lifted = points.crease[n], has_lifted and points.is_lifted[n]
            if is_lifted:
                crease += LIFTED_CREASE_OFFSET
            moved_point = move_off_surface(drawn_map, comparison, p, rotate_to_light(drawn_map, points.normal, n, 0), crease)
            if comparison.uses_triangles:
                if is_free_of_casters(drawn_map, p, taps) and is_free_of_casters(drawn_map, moved_point, taps_without_triangle):
                    continue
                lit, total_weight = zero, zero
                if has_corners and (
                    corners[n, 0] != corners[n, 3] or corners[n, 1] != corners[n, 4] or corners[n, 2] != corners[n, 5]
                ):
                    lit, total_weight = weights_on_triangle(drawn_map, comparison, p, corners, n)
                elif not is_lifted:
                    col, row = nodes.first_col + nodes.col_step * np.float32(j), nodes.first_row + nodes.row_step * np.float32(i)
                    middle, count = _write_ring(drawn_map, nodes, row, col, around, beside, ring)
                    lit, total_weight = _weights_on_ring(drawn_map, comparison, p, middle, ring, count)
                if total_weight > zero:
                    visibility[i, j] = lit / total_weight
                    continue
            visibility[i, j] = lit_share_without_triangle(drawn_map, comparison, moved_point)


@internal
def _node_in_light(drawn_map, nodes, row, col):
    """Return the position of a node in the map, metres, as a tuple."""
    return translate_to_light(drawn_map, rotate_to_light(drawn_map, nodes.position_frame_m[row], col, 0))


@internal
def _write_ring(drawn_map, nodes, row, col, around, beside, ring):
    """Write the triangles round the node nearest to a point; return the node's position in the map and their number.

    ``row`` and ``col`` are the point's fractional row and column among ``nodes`` (``GroundNodes``). The other corners of triangle k
    are ``ring[k]`` and ``ring[k + 1]``, in the map, relative to the node. The point's own triangle comes first; where several share
    the point, it is the one that faces the light most. ``around`` and ``beside`` (9, ...) are scratch memory for the ring's
    positions in the frame, and columns and rows.
    """
    half = np.float32(0.5)
    low_row, high_row = np.int64(np.ceil(row - half - ON_EDGE_NODES)), np.int64(np.floor(row + half + ON_EDGE_NODES))
    low_col, high_col = np.int64(np.ceil(col - half - ON_EDGE_NODES)), np.int64(np.floor(col + half + ON_EDGE_NODES))
    node_row, node_col = low_row, low_col
    middle = _node_in_light(drawn_map, nodes, node_row, node_col)
    for k in range(1, 4):  # half-way between nodes, the one nearest to the light
        other_row, other_col = high_row if k // 2 == 1 else low_row, high_col if k % 2 == 1 else low_col
        if other_row == node_row and other_col == node_col:
            continue
        candidate = _node_in_light(drawn_map, nodes, other_row, other_col)
        if candidate[2] < middle[2] or np.isnan(middle[2]):
            node_row, node_col, middle = other_row, other_col, candidate
    aside_col, aside_row = col - np.float32(node_col), row - np.float32(node_row)
    count = 0
    for k in range(8):
        c, r = RING_COLS[k], RING_ROWS[k]
        # The corner of a quad whose diagonal misses the node belongs to no triangle at the node.
        if k % 2 == 1 and nodes.is_cut_nw_se[node_row + min(r, 0), node_col + min(c, 0)] != (c == r):
            continue
        for m in range(3):
            around[count, m] = nodes.position_frame_m[node_row + r, node_col + c, m]
        beside[count, 0], beside[count, 1] = c, r
        count += 1
    around[count], beside[count] = around[0], beside[0]
    centre = nodes.position_frame_m[node_row, node_col]
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    axes = drawn_map.light_from_frame
    own, max_facing = 0, np.float32(-1e30)
    for k in range(count):
        a, b = beside[k], beside[k + 1]
        # Rows run down, so that a point between both sides has no positive cross product.
        if a[0] * aside_row - a[1] * aside_col > ON_EDGE_NODES or aside_col * b[1] - aside_row * b[0] > ON_EDGE_NODES:
            continue
        ux, uy, uz = around[k, 0] - cx, around[k, 1] - cy, around[k, 2] - cz
        vx, vy, vz = around[k + 1, 0] - cx, around[k + 1, 1] - cy, around[k + 1, 2] - cz
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        facing = (x * -axes[2, 0] + y * -axes[2, 1] + z * -axes[2, 2]) / np.sqrt(x * x + y * y + z * z)
        if facing > max_facing:
            max_facing, own = facing, k
    for k in range(count):
        x, y, z = translate_to_light(drawn_map, rotate_to_light(drawn_map, around, (own + k) % count, 0))
        ring[k, 0], ring[k, 1], ring[k, 2] = x - middle[0], y - middle[1], z - middle[2]
    ring[count] = ring[0]
    return middle, count


@internal
def _weights_on_ring(drawn_map, comparison, point_m, middle, ring, count):
    """Return the lit and the total weight of the taps whose texel centres lie in one of a ring's triangles.

    ``middle``, ``ring`` and ``count`` are those of ``_write_ring``. A centre that lies in several triangles, since the ring is
    folded as seen from the light, belongs to the point's own one, otherwise to the one whose depth is nearest to the point's.
    ``point_m`` is the point's position in the map, metres.
    """
    zero, one, half, grid = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(1.0 / 128.0)
    lit, total_weight = zero, zero
    texel, error_m = drawn_map.texel_m, drawn_map.position_error_m
    scale, taps = comparison.bias_scale, comparison.taps
    rounding = half * drawn_map.depth_step if comparison.uses_offset else zero
    left, low, fraction_x, fraction_y = first_tap(drawn_map, point_m, taps)
    for row in range(taps):
        for col in range(taps):
            offset_x = (np.float32(left + col) + half) * texel[0] - middle[0]
            offset_y = (np.float32(low + row) + half) * texel[1] - middle[1]
            nearest, z = np.float32(1e30), zero
            for k in range(count):
                ex, ey, ez, gx, gy, gz = ring[k, 0], ring[k, 1], ring[k, 2], ring[k + 1, 0], ring[k + 1, 1], ring[k + 1, 2]
                area = ex * gy - ey * gx
                u, v = offset_x * gy - offset_y * gx, ex * offset_y - ey * offset_x
                if not (area > zero and u >= zero and v >= zero and u + v <= area):
                    continue
                slope_x, slope_y = (ez * gy - gz * ey) / area, (gz * ex - ez * gx) / area
                depth_m = middle[2] + (slope_x * offset_x + slope_y * offset_y)
                distance = -one if k == 0 else abs(depth_m - point_m[2])
                if distance >= nearest:
                    continue
                slack = abs(slope_x) * (texel[0] * grid + error_m) + abs(slope_y) * (texel[1] * grid + error_m)
                slack = min(slack, np.sqrt(ex * ex + ey * ey + ez * ez) + np.sqrt(gx * gx + gy * gy + gz * gz))
                nearest, z = distance, point_m[2] * (one - scale) + depth_m * scale - slack - error_m
                if k == 0:
                    break
            if nearest == np.float32(1e30):
                continue
            weight = one
            if taps > 1:
                weight = max(tap_weight(taps, col, fraction_x) * tap_weight(taps, row, fraction_y), np.float32(1e-6))
            if is_lit(drawn_map, rounding, low + row, left + col, z):
                lit += weight
            total_weight += weight
    return lit, total_weight
