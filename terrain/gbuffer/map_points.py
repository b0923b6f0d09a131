"""Compute the points that a map's pixels show, by arithmetic instead of rasterising.

The ground is a sheet: a mesh of nodes in rows and columns, whose quads are cut into two triangles (facets) each. The position of a
pixel's centre on the sheet selects a quad and one of its triangles. The point is computed on this triangle in float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.lift import is_smooth, lift_distance, write_up

FACET_EDGE_TOLERANCE_NODES = 1e-6
"""Distance, in nodes, within which a point counts as lying on a facet's edge, so that the facets on both sides share it."""


class MapPoints(NamedTuple):
    """Points of a map's ground, and what ``GeometryBuffer`` holds of them. Arrays have the shape (rows, cols, ...).

    Attributes
    ----------
    valid
        bool, whether a pixel shows ground. Other pixels hold NaN; those that were not selected hold 0, and NaN heights.
    position
        float64 (rows, cols, 3), metres.
    height
        float32, metres.
    normal, smooth_normal
        float32 (rows, cols, 3), unit normals.
    crease
        float32.
    triangle
        int32 (rows, cols, 3), -1 without a triangle.
    """

    valid: np.ndarray
    position: np.ndarray
    height: np.ndarray
    normal: np.ndarray
    smooth_normal: np.ndarray
    crease: np.ndarray
    triangle: np.ndarray


def map_points(
    position: np.ndarray,
    height: np.ndarray,
    node_valid: np.ndarray,
    is_cut_nw_se: np.ndarray,
    facet_normals: np.ndarray,
    smooth_normals: np.ndarray,
    row: np.ndarray,
    col: np.ndarray,
    pixel_mask: np.ndarray,
) -> MapPoints:
    """Return the points that pixels at fractional rows and columns of a sheet of nodes show.

    Parameters
    ----------
    position, height, node_valid
        Positions (m, n, 3), heights (m, n) and valid mask (m, n) of the nodes.
    is_cut_nw_se, facet_normals
        Diagonals of the quads (``Sheet``), and the normals (m - 1, n - 1, 2, 3) of their triangles.
    smooth_normals
        (m, n, 3), the nodes' smooth unit normals.
    row, col
        Fractional rows (rows,) and columns (cols,) of the pixels on the sheet.
    pixel_mask
        (rows, cols), selects pixels. A selected pixel shows a surface if it lies on a triangle and the nearest node is valid.
        Half-way between nodes one valid node of the nearest ones suffices.
    """
    shape = row.size, col.size
    # Memory of zeros is not touched before it is written: few pixels may be selected.
    points = MapPoints(
        np.zeros(shape, np.bool_), np.zeros((*shape, 3)), np.full(shape, np.nan, np.float32), np.zeros((*shape, 3), np.float32),
        np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32), np.zeros((*shape, 3), np.int32),
    )  # fmt: skip
    run_in_chunks(
        row.size, _write_map_points, position, height, node_valid, is_cut_nw_se, facet_normals, smooth_normals, row, col,
        pixel_mask, points,
    )  # fmt: skip
    return points


@compiled
def _write_map_points(
    first, last, position, height, node_valid, is_cut_nw_se, facet_normals, smooth_normals, row, col, pixel_mask, points
):
    """Write the selected pixels of the rows in [``first``, ``last``) to ``points`` (``MapPoints``).

    The other parameters are those of ``map_points``.
    """
    valid, point, point_height, normal, shading_normal, crease, triangle = points
    facets = np.empty((8, 3), np.int64)
    for i in range(first, last):
        for j in range(col.size):
            if not pixel_mask[i, j]:
                continue
            count = 0
            if _is_nearest_node_valid(node_valid, row[i], col[j]):
                count = facets_at(facet_normals, is_cut_nw_se, row[i], col[j], facets)
            if count == 0:
                for k in range(3):
                    point[i, j, k], normal[i, j, k], shading_normal[i, j, k], triangle[i, j, k] = np.nan, np.nan, np.nan, -1
                continue
            valid[i, j] = True
            r, c, half = facets[0]
            triangle[i, j, 0], triangle[i, j, 1], triangle[i, j, 2] = r, c, half
            (o0, o1), (a0, a1), (b0, b1) = facet_corners(is_cut_nw_se[r, c], half)
            u, v = _barycentric(is_cut_nw_se[r, c], half, row[i] - r, col[j] - c)
            for k in range(3):
                o = position[r + o0, c + o1, k]
                point[i, j, k] = o + u * (position[r + a0, c + a1, k] - o) + v * (position[r + b0, c + b1, k] - o)
            h = np.float64(height[r + o0, c + o1])
            point_height[i, j] = h + u * (height[r + a0, c + a1] - h) + v * (height[r + b0, c + b1] - h)
            _mean_normal(facet_normals, facets, count, normal[i, j])
            crease[i, j] = crease_at(facet_normals, is_cut_nw_se, row[i], col[j], normal[i, j])
            _smooth_normal(smooth_normals, row[i], col[j], normal[i, j], shading_normal[i, j])


def map_lifts(
    position: np.ndarray,
    is_cut_nw_se: np.ndarray,
    facet_normals: np.ndarray,
    smooth_normals: np.ndarray,
    up_origin: np.ndarray,
    row: np.ndarray,
    col: np.ndarray,
    points: MapPoints,
    stencil_radius: int,
) -> np.ndarray:
    """Return the height of the smooth ground above each point of ``map_points``, float32 (rows, cols), metres.

    The smooth ground is estimated from the tangent planes at the corners of the point's facet (``skugga.terrain.gbuffer.lift``). If
    the sheet is finer than the raster, with ``stencil_radius`` > 1 nodes per cell, single facets are too small for that. Then the
    tangent planes at four points are used, half a cell away along both axes. The mean of their four lifts is doubled. The result is
    NaN beside a crease, and on nodes unless the sheet is finer than the raster, and 0 without a point.

    ``points`` is the result of ``map_points``, and most other parameters are its parameters. ``up_origin`` is the frame point from
    which up vectors point away.
    """
    out = np.zeros((row.size, col.size), np.float32)
    run_in_chunks(
        row.size, _write_map_lifts, position, is_cut_nw_se, facet_normals, smooth_normals, up_origin, row, col, points,
        stencil_radius, out,
    )  # fmt: skip
    return out


@compiled
def _write_map_lifts(
    first, last, position, is_cut_nw_se, facet_normals, smooth_normals, up_origin, row, col, points, stencil_radius, out
):
    """Write the lifts of the points in the rows [``first``, ``last``) to ``out`` (rows, cols).

    The other parameters are those of ``map_lifts``.
    """
    point, triangle = points.position, points.triangle
    up, neighbour, neighbour_normal = np.empty(3), np.empty(3), np.empty(3)
    for i in range(first, last):
        for j in range(col.size):
            if not points.valid[i, j]:
                continue
            r, c, half = triangle[i, j]
            write_up(point[i, j], up_origin, up)
            face = facet_normals[r, c, half]
            if stencil_radius > 1:
                lift = 0.0
                for k in range(4):
                    a = row[i] + (0.5 * stencil_radius if k // 2 else -0.5 * stencil_radius)
                    b = col[j] + (0.5 * stencil_radius if k % 2 else -0.5 * stencil_radius)
                    _interpolate(position, a, b, neighbour)
                    _interpolate(smooth_normals, a, b, neighbour_normal)
                    lift += (
                        0.5 * lift_distance(neighbour, neighbour_normal, point[i, j], up)
                        if is_smooth(face, neighbour_normal)
                        else np.nan
                    )
                out[i, j] = lift
            elif (
                abs(row[i] - np.rint(row[i])) <= FACET_EDGE_TOLERANCE_NODES
                and abs(col[j] - np.rint(col[j])) <= FACET_EDGE_TOLERANCE_NODES
            ):
                out[i, j] = np.nan
            else:
                u, v = _barycentric(is_cut_nw_se[r, c], half, row[i] - r, col[j] - c)
                weights = (1.0 - u - v, u, v)
                corners = facet_corners(is_cut_nw_se[r, c], half)
                lift = 0.0
                for k in range(3):
                    a, b = r + corners[k][0], c + corners[k][1]
                    bulge = lift_distance(position[a, b], smooth_normals[a, b], point[i, j], up)
                    lift += weights[k] * bulge if is_smooth(face, smooth_normals[a, b]) else np.nan
                out[i, j] = lift


@internal
def _interpolate(values, row, col, out):
    """Write the vector (3,) at a fractional row and column, interpolated bilinearly between ``values`` (rows, cols, 3) at nodes."""
    r, c = int(np.floor(row)), int(np.floor(col))
    fr, fc = row - r, col - c
    for k in range(3):
        out[k] = 0.0
    for m in range(4):
        w = (fr if m // 2 else 1.0 - fr) * (fc if m % 2 else 1.0 - fc)
        if w > 0.0:
            for k in range(3):
                out[k] += w * values[r + m // 2, c + m % 2, k]


@internal
def facets_at(facet_normals, is_cut_nw_se, row, col, facets):
    """Write the facets that a position on a sheet lies on to ``facets`` (8, 3), and return their number.

    A facet is stored as row and column of its quad, and 0 for the triangle on the quad's north side or 1 for the other.
    ``facet_normals`` (rows, cols, 2, 3) holds the facets' normals, NaN if a corner is missing. Facets of the quad south-east of the
    position come first.
    """
    r0, c0 = int(np.floor(row + FACET_EDGE_TOLERANCE_NODES)), int(np.floor(col + FACET_EDGE_TOLERANCE_NODES))
    fr0, fc0 = row - r0, col - c0
    count = 0
    for k in range(4):
        up, left = k // 2, k % 2
        if (up == 1 and fr0 > FACET_EDGE_TOLERANCE_NODES) or (left == 1 and fc0 > FACET_EDGE_TOLERANCE_NODES):
            continue
        r, c, fr, fc = r0 - up, c0 - left, fr0 + up, fc0 + left
        for half in range(2):
            side_distance = fc - fr if is_cut_nw_se[r, c] else 1.0 - fr - fc  # from the diagonal towards the north side
            if (
                side_distance >= -FACET_EDGE_TOLERANCE_NODES if half == 0 else side_distance <= FACET_EDGE_TOLERANCE_NODES
            ) and np.isfinite(facet_normals[r, c, half, 2]):
                facets[count, 0], facets[count, 1], facets[count, 2] = r, c, half
                count += 1
    return count


@internal
def crease_at(facet_normals, is_cut_nw_se, row, col, normal):
    """Return the largest distance between a unit normal (3,) and the unit normals of the facets round the nearest node.

    ``row`` and ``col`` are a position on the sheet. Half-way between nodes, the facets round each of the nearest nodes count.
    """
    first_r, last_r, first_c, last_c = _nearest_nodes(row, col)
    widest = _crease_at_node(facet_normals, is_cut_nw_se, first_r, first_c, normal)
    if last_r > first_r:
        widest = max(widest, _crease_at_node(facet_normals, is_cut_nw_se, last_r, first_c, normal))
    if last_c > first_c:
        widest = max(widest, _crease_at_node(facet_normals, is_cut_nw_se, first_r, last_c, normal))
    if last_r > first_r and last_c > first_c:
        widest = max(widest, _crease_at_node(facet_normals, is_cut_nw_se, last_r, last_c, normal))
    return widest


@internal
def _crease_at_node(facet_normals, is_cut_nw_se, nearest_row, nearest_col, normal):
    """Return the largest distance between a unit normal (3,) and the unit normals of the facets round a node of a sheet."""
    widest = 0.0
    for k in range(8):
        down, right, half = k // 4, k // 2 % 2, k % 2
        r, c = nearest_row - 1 + down, nearest_col - 1 + right
        # Only one facet of the quad has the node as a corner, unless the diagonal ends there.
        diagonal_ends_here = (down == right) == is_cut_nw_se[r, c]
        if not diagonal_ends_here and half != 1 - down:
            continue
        squared_distance = 0.0
        for m in range(3):
            squared_distance += (facet_normals[r, c, half, m] - normal[m]) ** 2
        if squared_distance > widest:  # False for a missing facet, whose normal is NaN
            widest = squared_distance
    return np.sqrt(widest)


@internal
def _nearest_nodes(row, col):
    """Return first row, last row, first column and last column of the nodes nearest to a position.

    First and last differ where the position is half-way between nodes.
    """
    return (
        int(np.ceil(row - 0.5 - FACET_EDGE_TOLERANCE_NODES)), int(np.floor(row + 0.5 + FACET_EDGE_TOLERANCE_NODES)),
        int(np.ceil(col - 0.5 - FACET_EDGE_TOLERANCE_NODES)), int(np.floor(col + 0.5 + FACET_EDGE_TOLERANCE_NODES)),
    )  # fmt: skip


@internal
def _is_nearest_node_valid(node_valid, row, col):
    """Return whether the node nearest to a position is valid; half-way between nodes, whether any of the nearest ones is."""
    low_r, high_r, low_c, high_c = _nearest_nodes(row, col)
    return node_valid[low_r, low_c] or node_valid[low_r, high_c] or node_valid[high_r, low_c] or node_valid[high_r, high_c]


@internal
def facet_corners(is_cut_nw_se, facet_in_quad):
    """Return the row and column offsets of a facet's three corners from its quad's north-west corner.

    The corner that is not on the quad's diagonal comes first, then the others counter-clockwise. ``facet_in_quad`` is 0 for the
    facet on the quad's north side, 1 for the other.
    """
    if is_cut_nw_se:
        return ((0, 1), (0, 0), (1, 1)) if facet_in_quad == 0 else ((1, 0), (1, 1), (0, 0))
    return ((0, 0), (1, 0), (0, 1)) if facet_in_quad == 0 else ((1, 1), (0, 1), (1, 0))


@internal
def _barycentric(is_cut_nw_se, facet_in_quad, row_fraction, col_fraction):
    """Return the weights of the second and third corner of ``facet_corners`` at a position in a quad.

    ``row_fraction`` and ``col_fraction`` are the position's row and column from the quad's north-west corner.
    """
    if is_cut_nw_se:
        return (1.0 - col_fraction, row_fraction) if facet_in_quad == 0 else (col_fraction, 1.0 - row_fraction)
    return (row_fraction, col_fraction) if facet_in_quad == 0 else (1.0 - row_fraction, 1.0 - col_fraction)


@internal
def _is_same_quad(facets, first, second):
    """Return whether two facets belong to one quad. ``first`` and ``second`` are rows of the list ``facets`` of ``facets_at``."""
    return facets[first, 0] == facets[second, 0] and facets[first, 1] == facets[second, 1]


@internal
def _mean_normal(facet_normals, facets, count, out):
    """Write the mean unit normal (3,) of ``count`` facets.

    Two facets of one quad have half the weight each, so that the diagonal along which a plane quad is cut does not matter.
    """
    if count == 1:
        for k in range(3):
            out[k] = facet_normals[facets[0, 0], facets[0, 1], facets[0, 2], k]
        return
    x, y, z = 0.0, 0.0, 0.0
    for n in range(count):
        face = facet_normals[facets[n, 0], facets[n, 1], facets[n, 2]]
        paired = (n > 0 and _is_same_quad(facets, n, n - 1)) or (n + 1 < count and _is_same_quad(facets, n, n + 1))
        weight = 0.5 if paired else 1.0
        x, y, z = x + weight * face[0], y + weight * face[1], z + weight * face[2]
    length = np.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = x / length, y / length, z / length


@internal
def _smooth_normal(smooth_normals, row, col, normal, out):
    """Write the smooth unit normal (3,) at a position: the bilinear mean over the nodes round it that have a smooth normal.

    If none of them has one, the result is ``normal``, that of the facets.
    """
    r0, c0 = int(np.floor(row)), int(np.floor(col))
    fr, fc = row - r0, col - c0
    x, y, z = 0.0, 0.0, 0.0
    for m in range(4):
        w = (fr if m // 2 else 1.0 - fr) * (fc if m % 2 else 1.0 - fc)
        if w > 0.0:
            s = smooth_normals[r0 + m // 2, c0 + m % 2]
            if np.isfinite(s[2]):
                x, y, z = x + w * s[0], y + w * s[1], z + w * s[2]
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        out[0], out[1], out[2] = x / length, y / length, z / length
    else:
        for k in range(3):
            out[k] = normal[k]
