"""Find rectangles that contain all marked pixels of a picture and few others, and cull the shadow volumes' faces in each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled, internal

CULLING_TILE_PX = 8
"""Side in pixels of the tiles that rectangles consist of."""

RECTANGLE_COST = 4e4
"""Cost of another rectangle, as tiles times faces. With few faces, drawing additional tiles costs next to nothing."""

MIN_RECTANGLE_COST = 8
"""Lower bound of the cost of another rectangle, in tiles."""

RECTANGLE_GROUP_SIZE = 16
"""Number of consecutive rectangles for which faces beside all of them are culled together."""

OUTSIDE, PARTIAL, COVERS = 0, 1, 2
"""Positions of a triangle relative to a rectangle."""

DEPTH_MARGIN = 1e-4
"""Margin, as a share of a depth, by which a face must lie beyond the depth to count as beyond it."""


def marked_tiles(rows: np.ndarray, cols: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return which tiles of a picture contain a pixel of the given rows and columns (n,), bool (tile rows, tile columns).

    ``size`` is the rows and columns of the picture.
    """
    return _compute_tile_mask(rows, cols, *(-(-side // CULLING_TILE_PX) for side in size))


def covering_rectangles(tiles: np.ndarray, size: tuple[int, int], face_count: int) -> np.ndarray:
    """Return rectangles of tiles that contain all marked ones, int32 (k, 4): first column, first row, columns and rows, in pixels.

    Consecutive rectangles are neighbours. ``face_count`` is the number of faces to draw in them. Another rectangle costs
    ``RECTANGLE_COST`` divided by ``face_count`` tiles. The bounding rectangle is cut in two, and its parts again, in two cases. The
    cut saves more tiles than a rectangle costs, or a side has more than twice as many tiles as a rectangle costs. Within small
    rectangles depths vary little, and few faces matter. ``size`` is the rows and columns of the picture.
    """
    merged = _cover_tiles(tiles, max(RECTANGLE_COST / max(face_count, 1), MIN_RECTANGLE_COST)) * CULLING_TILE_PX
    merged[:, 2:] = np.minimum(merged[:, 2:], np.array([size[1], size[0]]) - merged[:, :2])
    return merged.astype(np.int32)


def depth_bounds(
    rows: np.ndarray, cols: np.ndarray, depth: np.ndarray, rectangles: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Return the minimum and maximum depth (k, 2) of the pixels (n,) in each rectangle; (inf, -inf) without any.

    ``rectangles`` (k, 4) are those of ``covering_rectangles``, and ``size`` is the rows and columns of the picture.
    """
    tiles = tuple(-(-side // CULLING_TILE_PX) for side in size)
    tile_depths = _tile_depth_bounds(rows, cols, depth, *tiles)
    out = np.empty((len(rectangles), 2))
    for number, (col, row, width, height) in enumerate(rectangles.tolist()):
        part = tile_depths[
            row // CULLING_TILE_PX : -(-(row + height) // CULLING_TILE_PX),
            col // CULLING_TILE_PX : -(-(col + width) // CULLING_TILE_PX),
        ]
        out[number] = part[..., 0].min(), part[..., 1].max()
    return out


@dataclass(frozen=True, eq=False)
class CulledFaces:
    """The faces to draw in rectangles.

    Attributes
    ----------
    face_numbers
        int32 (f,): numbers of the faces, rectangle by rectangle.
    rectangle_starts
        int64 (k + 1,): index of each rectangle's first face.
    added_layers
        int64 (k,): number that culled faces add to the count of each pixel of a rectangle, the same in all of them.
    """

    face_numbers: np.ndarray
    rectangle_starts: np.ndarray
    added_layers: np.ndarray


def cull_faces(
    clip_points: np.ndarray,
    faces: np.ndarray,
    counts_behind: bool,
    rectangles: np.ndarray,
    depth_ranges: np.ndarray,
    size: tuple[int, int],
    clamps_depth: bool = False,
) -> CulledFaces:
    """Return the faces (m, 3) that matter in each rectangle, given bounds (k, 2) of its pixels' depths. Greater depths are nearer.

    ``clip_points`` (n, 4) are homogeneous clip coordinates. ``counts_behind`` is true if faces behind the pixels' points count
    (z-fail), and false if those in front of them do (z-pass). Two kinds of faces are culled: faces beside a rectangle, and faces
    wholly on the side that does not count. Faces that cover all of a rectangle, wholly on the side that counts, add the same number
    everywhere (T. Aila and T. Akenine-Moller, A Hierarchical Shadow Volume Algorithm, 2004). Faces in front of the near plane, at
    depths above 1, are not drawn and add nothing, unless ``clamps_depth`` is true.

    A pixel (x, y, 1) that a triangle of corners p0, p1, p2 in (x, y, w) covers is a sum of the corners with no negative weight. The
    weights are, but for a common factor, the pixel's products with p1 x p2, p2 x p0 and p0 x p1, of the sign of the determinant (M.
    Olano and T. Greer, Triangle Scan Conversion Using 2D Homogeneous Coordinates, 1997). Nothing needs clipping, neither at the eye
    nor at infinity. Depth is the same sum of the corners' z, and therefore linear over the picture.
    """
    px = np.array([size[1], size[0]]) / 2.0
    points = np.column_stack([(clip_points[:, :2] + clip_points[:, 3:]) * px, clip_points[:, 3], clip_points[:, 2]])
    near_plane = np.inf if clamps_depth else 1.0
    return CulledFaces(*_cull_triangles(points, faces, counts_behind, rectangles.astype(np.float64), depth_ranges, near_plane))


def all_faces(face_count: int, rectangle_count: int) -> CulledFaces:
    """Return all faces for each of some rectangles, none of them culled."""
    return CulledFaces(
        np.tile(np.arange(face_count, dtype=np.int32), rectangle_count),
        np.arange(rectangle_count + 1) * face_count,
        np.zeros(rectangle_count, np.int64),
    )


@compiled
def _cover_tiles(tiles, cost):
    """Return rectangles (k, 4) int64 that contain all marked tiles, in tiles (``covering_rectangles``).

    ``tiles`` bool (tile rows, tile columns) is the mask of the marked ones. ``cost`` is the number of tiles that another rectangle
    must save.
    """
    pending = [(0, tiles.shape[0], 0, tiles.shape[1])]
    result = []
    while pending:
        top, bottom, left, right = pending.pop()
        while top < bottom and not tiles[top, left:right].any():
            top += 1
        if top == bottom:
            continue
        while not tiles[bottom - 1, left:right].any():
            bottom -= 1
        while not tiles[top:bottom, left].any():
            left += 1
        while not tiles[top:bottom, right - 1].any():
            right -= 1
        part = tiles[top:bottom, left:right]
        saved_rows, at_row = _best_cut(part)
        saved_cols, at_col = _best_cut(part.T)
        if max(saved_rows, saved_cols) <= cost and max(bottom - top, right - left) > 2.0 * cost:
            if bottom - top > right - left:
                pending.append(((top + bottom) // 2, bottom, left, right))
                pending.append((top, (top + bottom) // 2, left, right))
            else:
                pending.append((top, bottom, (left + right) // 2, right))
                pending.append((top, bottom, left, (left + right) // 2))
        elif max(saved_rows, saved_cols) <= cost:
            result.append((left, top, right - left, bottom - top))
        elif saved_rows >= saved_cols:
            pending.append((top + at_row, bottom, left, right))
            pending.append((top, top + at_row, left, right))
        else:
            pending.append((top, bottom, left + at_col, right))
            pending.append((top, bottom, left, left + at_col))
    out = np.empty((len(result), 4), np.int64)
    for n in range(len(result)):
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = result[n]
    return out


@internal
def _best_cut(part):
    """Return the cut between rows of tiles that leaves the most tiles outside of the bounds of both halves.

    ``part`` bool (rows, cols) is the mask of the marked tiles of a rectangle. The result is the number of tiles outside of the
    bounds, and the index of the first row after the cut; 0 and 0 if no cut saves a tile.
    """
    rows, cols = part.shape
    first, last = np.full(rows, cols), np.zeros(rows, np.int64)
    for row in range(rows):
        for col in range(cols):
            if part[row, col]:
                first[row] = min(first[row], col)
                last[row] = col + 1
    after = np.zeros(rows + 1, np.int64)  # tiles in the bounds of the rows from here on
    low, high, end = cols, 0, 0
    for row in range(rows - 1, -1, -1):
        if last[row] > 0:
            low, high = min(low, first[row]), max(high, last[row])
            end = rows - row
        after[row] = max(high - low, 0) * end
    best, cut_row = 0, 0
    low, high, end = cols, 0, 0
    for row in range(rows - 1):
        if last[row] > 0:
            low, high, end = min(low, first[row]), max(high, last[row]), row + 1
        saved = rows * cols - max(high - low, 0) * end - after[row + 1]
        if saved > best:
            best, cut_row = saved, row + 1
    return best, cut_row


@compiled
def _compute_tile_mask(rows, cols, tile_rows, tile_cols):
    """Return which tiles (``tile_rows``, ``tile_cols``) contain one of the pixels at ``rows`` and ``cols`` (n,), bool."""
    out = np.zeros((tile_rows, tile_cols), np.bool_)
    for n in range(len(rows)):
        out[rows[n] // CULLING_TILE_PX, cols[n] // CULLING_TILE_PX] = True
    return out


@compiled
def _tile_depth_bounds(rows, cols, depth, tile_rows, tile_cols):
    """Return the minimum and maximum depth of the pixels in each tile (``tile_rows``, ``tile_cols``, 2).

    ``rows``, ``cols`` and ``depth`` (n,) are those of the pixels. A tile without any has (inf, -inf).
    """
    out = np.empty((tile_rows, tile_cols, 2))
    out[..., 0], out[..., 1] = np.inf, -np.inf
    for n in range(len(rows)):
        bounds = out[rows[n] // CULLING_TILE_PX, cols[n] // CULLING_TILE_PX]
        bounds[0], bounds[1] = min(bounds[0], depth[n]), max(bounds[1], depth[n])
    return out


@compiled
def _cull_triangles(points, triangles, counts_behind, rectangles, depth_ranges, near_plane):
    """Return the arrays of ``CulledFaces`` in the order of its fields.

    ``points`` (n, 4) are x, y and w in pixels, and z; ``triangles`` (m, 3) holds indices of points. ``rectangles`` (k, 4) and
    ``depth_ranges`` (k, 2) are those of ``cull_faces``. Depths above ``near_plane`` are not drawn. ``counts_behind`` is that of
    ``cull_faces``.
    """
    m, k = len(triangles), len(rectangles)
    lines, sign = _weight_functions(points, triangles)
    starts, added = np.zeros(k + 1, np.int64), np.zeros(k, np.int64)
    kept_faces = np.empty(4 * m, np.int32)
    candidates, count = np.empty(m, np.int32), 0
    for group in range(0, k, RECTANGLE_GROUP_SIZE):
        group_rectangles = rectangles[group : group + RECTANGLE_GROUP_SIZE]
        left, top = group_rectangles[:, 0].min(), group_rectangles[:, 1].min()
        right, bottom = (
            (group_rectangles[:, 0] + group_rectangles[:, 2]).max(),
            (group_rectangles[:, 1] + group_rectangles[:, 3]).max(),
        )
        candidate_count = 0
        for t in range(m):
            if sign[t] != 0 and _classify_triangle(lines[t], left, top, right, bottom) != OUTSIDE:
                candidates[candidate_count] = t
                candidate_count += 1
        for number in range(group, min(group + RECTANGLE_GROUP_SIZE, k)):
            left, top = rectangles[number, 0], rectangles[number, 1]
            right, bottom = left + rectangles[number, 2], top + rectangles[number, 3]
            # faces beyond one bound count, faces beyond the other do not; the margin is for float32
            farthest, nearest = depth_ranges[number, 0] * (1.0 - DEPTH_MARGIN), depth_ranges[number, 1] * (1.0 + DEPTH_MARGIN)
            if count + candidate_count > len(kept_faces):
                grown = np.empty(2 * len(kept_faces) + candidate_count, np.int32)
                grown[:count] = kept_faces[:count]
                kept_faces = grown
            for n in range(candidate_count):
                t = candidates[n]
                relation = _classify_triangle(lines[t], left, top, right, bottom)
                if relation == OUTSIDE:
                    continue
                low, high = _range_in_rectangle(lines[t, 3], left, top, right, bottom)
                is_behind, is_in_front = high < farthest, low > nearest
                if is_in_front if counts_behind else is_behind or low > near_plane:
                    continue
                crosses_near_plane = high > near_plane * (1.0 - DEPTH_MARGIN)
                if relation == COVERS and (is_behind if counts_behind else is_in_front and not crosses_near_plane):
                    added[number] += sign[t] if counts_behind else -sign[t]
                    continue
                kept_faces[count] = t
                count += 1
            starts[number + 1] = count
    return kept_faces[:count].copy(), starts, added


@internal
def _classify_triangle(weight_functions, left, top, right, bottom):
    """Return a triangle's position relative to a rectangle: ``OUTSIDE``, ``PARTIAL`` or ``COVERS``.

    ``weight_functions`` (4, 3) (from ``_weight_functions``) are the triangle's weights as linear functions of a pixel. The
    rectangle's sides ``left``, ``top``, ``right`` and ``bottom`` are in pixels.
    """
    relation = COVERS
    for n in range(3):
        low, high = _range_in_rectangle(weight_functions[n], left, top, right, bottom)
        slack = abs(weight_functions[n, 0]) + abs(weight_functions[n, 1])  # one pixel, for the rasteriser's grid
        if high < -slack:
            return OUTSIDE
        if low <= slack:
            relation = PARTIAL
    return relation


@internal
def _weight_functions(points, triangles):
    """Return each triangle's weights and depth as linear functions of a pixel (m, 4, 3), and the sign of its determinant (m,).

    ``points`` and ``triangles`` are those of ``_cull_triangles``. A function holds the factors of x and y, and a constant. The sign
    is 0 for a degenerate triangle.
    """
    m = len(triangles)
    lines, sign = np.zeros((m, 4, 3)), np.zeros(m, np.int64)
    for t in range(m):
        p, q, r = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        for n in range(3):
            a, b = (q, r) if n == 0 else (r, p) if n == 1 else (p, q)
            lines[t, n, 0], lines[t, n, 1], lines[t, n, 2] = (
                a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            )  # fmt: skip
        determinant = lines[t, 0, 0] * p[0] + lines[t, 0, 1] * p[1] + lines[t, 0, 2] * p[2]
        if determinant == 0.0:
            continue
        sign[t] = 1 if determinant > 0.0 else -1
        for axis in range(3):
            lines[t, 0, axis] /= determinant
            lines[t, 1, axis] /= determinant
            lines[t, 2, axis] /= determinant
            lines[t, 3, axis] = p[3] * lines[t, 0, axis] + q[3] * lines[t, 1, axis] + r[3] * lines[t, 2, axis]
    return lines, sign


@internal
def _range_in_rectangle(line, left, top, right, bottom):
    """Return the minimum and maximum of a linear function over a rectangle.

    ``line`` (3,) holds the function's factors of x and y, and its constant. The rectangle's sides ``left``, ``top``, ``right`` and
    ``bottom`` are in the unit of x and y.
    """
    x, y, z = line
    return (
        z + min(x * left, x * right) + min(y * top, y * bottom),
        z + max(x * left, x * right) + max(y * top, y * bottom),
    )
