"""Build the polygons of the volume behind a rebuilt surface: its caps, the sides where it is torn, and its far end.

The volume is closed: each polygon's edge is used once in either direction, with the same two vertices. So a count of its faces is 0
or 1 everywhere, whatever their number. The sides of a texel lie between it and each neighbour, from the vertices of one to those of
the other, where they differ. Beside an empty texel, and at the map's rim, a side extends to infinity. Where three sides or more
meet on a ray of the light, polygons without area join their vertices, so that rounding opens no gap.

**Squares.** Linked texels whose vertices lie in one plane are drawn as one square of a quadtree: two triangles, or a fan around its
middle if other polygons use more vertices on its rim than its corners. Neighbours see the same used vertices, so none lies within
another polygon's edge, where a rasteriser would leave gaps.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.reconstruction.surface import NO_VERTEX, PLANE_TOLERANCE, DepthScale, Surface
from skugga.terrain.compiled import compiled, internal

MAX_SQUARE_TEXELS = 64
"""Upper bound of the side of a square, in texels: a power of two."""


def volume_polygons(
    surface: Surface, scale: DepthScale, is_lamp: bool, max_square: int = MAX_SQUARE_TEXELS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices (n, 3), the vertices on whose rays far ones lie, int64 (k,), and the faces int32 (m, 3) of a volume.

    Faces are counter-clockwise with columns, rows and depths as axes. Number n + i in a face is the far vertex i. Under a lamp it
    lies on the ray through vertex i of the second array. Under the sun it is the only one, where all rays meet. ``max_square`` is
    the largest side of a square, in texels; 1 draws each texel by itself.
    """
    sides = _merge_texels(
        surface.vertices, surface.corners, surface.linked_right, surface.linked_up, scale.as_array, max_square
    )  # fmt: skip
    is_used, is_middle = _used_vertices(surface.corners, sides, len(surface.vertices))
    is_kept = is_used | is_middle
    new_number = np.append(np.where(is_kept, np.cumsum(is_kept) - 1, NO_VERTEX), NO_VERTEX).astype(np.int32)
    vertices = surface.vertices[is_kept]
    count = len(vertices)
    starts_ray = np.ones(count, bool)  # vertices on one ray follow one another
    starts_ray[1:] = (vertices[1:, :2] != vertices[:-1, :2]).any(axis=1) if is_lamp else False
    far_vertex = (count + np.cumsum(starts_ray) - 1).astype(np.int32)
    faces = _build_faces(
        new_number[surface.corners], sides, is_used[is_kept], is_middle[is_kept], far_vertex, is_lamp
    )  # fmt: skip
    return vertices, np.flatnonzero(starts_ray), faces


@compiled
def _merge_texels(vertices, corners, linked_right, linked_up, scale, max_square):
    """Return the sides of squares, in texels, int16 (rows, cols) at their first texels; 0 elsewhere.

    ``vertices``, ``corners``, ``linked_right`` and ``linked_up`` are those of a ``Surface``, and ``scale`` is a ``DepthScale``.
    """
    rows, cols = linked_right.shape
    sides = np.zeros((rows, cols), np.int16)
    for i in range(rows):
        for j in range(cols):
            if corners[i, j, 0] != NO_VERTEX:
                sides[i, j] = 1
    half = 1
    while 2 * half <= max_square:
        side = 2 * half
        for i in range(0, rows - side + 1, side):
            for j in range(0, cols - side + 1, side):
                if sides[i, j] != half or sides[i, j + half] != half:
                    continue
                if sides[i + half, j] != half or sides[i + half, j + half] != half:
                    continue
                if _is_plane_square(vertices, corners, linked_right, linked_up, scale, i, j, side):
                    sides[i, j + half] = sides[i + half, j] = sides[i + half, j + half] = 0
                    sides[i, j] = side
        half = side
    return sides


@internal
def _is_plane_square(vertices, corners, linked_right, linked_up, scale, row, col, side):
    """Return whether the halves of a square at ``row``, ``col`` are linked, and its vertices lie in a plane."""
    half = side // 2
    for k in range(side):
        if not linked_right[row + k, col + half - 1] or not linked_up[row + half - 1, col + k]:
            return False
    origin = vertices[corners[row, col, 0], 2]
    across = (vertices[corners[row, col + side - 1, 1], 2] - origin) / side
    along = (vertices[corners[row + side - 1, col, 2], 2] - origin) / side
    w = scale[4] + scale[5] * origin
    tolerance = PLANE_TOLERANCE * min(scale[0], scale[1]) * w + scale[3] + scale[2] * w * w
    for i in range(side):
        for j in range(side):
            for k in range(4):
                plane = origin + across * (j + k % 2) + along * (i + k // 2)
                if abs(vertices[corners[row + i, col + j, k], 2] - plane) > tolerance:
                    return False
    return True


@internal
def _rim_vertex(corners, row, col, side, number):
    """Return a vertex on the rim of a square, counter-clockwise from its first corner; ``number`` is below 4 ``side``."""
    k, last = number % side, side - 1
    if number < side:
        return corners[row, col + k, 0]
    if number < 2 * side:
        return corners[row + k, col + last, 1]
    if number < 3 * side:
        return corners[row + last, col + last - k, 3]
    return corners[row + last - k, col, 2]


@internal
def _middle_vertex(corners, row, col, side):
    """Return the vertex in the middle of a square of at least two texels a side."""
    return corners[row + side // 2, col + side // 2, 0]


@compiled
def _used_vertices(corners, sides, vertex_count):
    """Return which of ``vertex_count`` vertices are on rims of polygons, and which are middles of fans: bool (n,) each.

    ``corners`` (rows, cols, 4) are those of a ``Surface``, and ``sides`` (rows, cols) those of the squares.
    """
    rows, cols = sides.shape
    is_used, is_middle = np.zeros(vertex_count, np.bool_), np.zeros(vertex_count, np.bool_)
    for i in range(rows):
        for j in range(cols):
            side = sides[i, j]
            for number in range(4 if side > 0 else 0):
                is_used[_rim_vertex(corners, i, j, side, number * side)] = True
            for direction in range(2):  # the texel of the next column, and of the next row
                r, c = i + direction, j + 1 - direction
                inside = r < rows and c < cols
                a = corners[i, j, 1 if direction == 0 else 3]
                b = corners[i, j, 3 if direction == 0 else 2]
                other_a = corners[r, c, 0 if direction == 0 else 1] if inside else np.int32(NO_VERTEX)
                other_b = corners[r, c, 2 if direction == 0 else 0] if inside else np.int32(NO_VERTEX)
                if a != other_a or b != other_b:
                    if a != NO_VERTEX:
                        is_used[a] = is_used[b] = True
                    if other_a != NO_VERTEX:
                        is_used[other_a] = is_used[other_b] = True
            if corners[i, j, 0] != NO_VERTEX:
                if j == 0:
                    is_used[corners[i, j, 0]] = is_used[corners[i, j, 2]] = True
                if i == 0:
                    is_used[corners[i, j, 0]] = is_used[corners[i, j, 1]] = True
    for i in range(rows):
        for j in range(cols):
            side = sides[i, j]
            if side > 1 and _count_rim(corners, is_used, i, j, side) > 4:
                is_middle[_middle_vertex(corners, i, j, side)] = True
    return is_used, is_middle


@internal
def _count_rim(corners, is_used, row, col, side):
    """Return the number of used vertices on the rim of a square."""
    count = 0
    for number in range(4 * side):
        vertex = _rim_vertex(corners, row, col, side, number)
        count += vertex >= 0 and is_used[vertex]
    return count


@internal
def _add_face(faces, count, a, b, c):
    """Write the face (a, b, c) at the index ``count`` of ``faces``, unless two vertices are one; return the next index."""
    if a == b or b == c or c == a:
        return count
    faces[count, 0], faces[count, 1], faces[count, 2] = a, b, c
    return count + 1


@internal
def _add_side(faces, count, a, b, other_a, other_b, far_vertex):
    """Write the side between a texel's edge from ``a`` to ``b`` and its neighbour's, from ``other_b`` to ``other_a``.

    Either may be empty (``NO_VERTEX``): its vertices are then infinitely far away. Returns the next index.
    """
    if a == other_a and b == other_b:
        return count
    if other_a == NO_VERTEX:
        other_a, other_b = far_vertex[a], far_vertex[b]
    elif a == NO_VERTEX:
        a, b = far_vertex[other_a], far_vertex[other_b]
    count = _add_face(faces, count, b, a, other_a)
    return _add_face(faces, count, b, other_a, other_b)


@internal
def _add_join(faces, count, corners, row, col, far_vertex):
    """Write the polygons that join the vertices of the four texels around the corner ``row``, ``col``. Returns the next index."""
    rows, cols = corners.shape[:2]
    low, high, left, right = row > 0, row < rows, col > 0, col < cols
    a = corners[row - 1, col - 1, 3] if low and left else np.int32(NO_VERTEX)
    b = corners[row - 1, col, 2] if low and right else np.int32(NO_VERTEX)
    c = corners[row, col - 1, 1] if high and left else np.int32(NO_VERTEX)
    d = corners[row, col, 0] if high and right else np.int32(NO_VERTEX)
    if (a == b and c == d) or (a == c and b == d):
        return count
    far = far_vertex[max(max(a, b), max(c, d))]
    a, b = far if a == NO_VERTEX else a, far if b == NO_VERTEX else b
    c, d = far if c == NO_VERTEX else c, far if d == NO_VERTEX else d
    count = _add_face(faces, count, a, b, d)
    return _add_face(faces, count, a, d, c)


@internal
def _add_cap(faces, count, a, b, c, far_vertex, is_lamp):
    """Write a face of the near cap and, under a lamp, its image at the far end. Returns the next index."""
    count = _add_face(faces, count, a, b, c)
    if is_lamp:
        count = _add_face(faces, count, far_vertex[c], far_vertex[b], far_vertex[a])
    return count


@internal
def _add_square(faces, count, corners, is_used, is_middle, row, col, side, far_vertex, is_lamp):
    """Write the caps of a square: two triangles, or a fan around its middle. Returns the next index."""
    first = _rim_vertex(corners, row, col, side, 0)
    middle = _middle_vertex(corners, row, col, side) if side > 1 else np.int32(NO_VERTEX)
    if middle == NO_VERTEX or not is_middle[middle]:
        second, third = _rim_vertex(corners, row, col, side, side), _rim_vertex(corners, row, col, side, 2 * side)
        count = _add_cap(faces, count, first, second, third, far_vertex, is_lamp)
        return _add_cap(faces, count, first, third, _rim_vertex(corners, row, col, side, 3 * side), far_vertex, is_lamp)
    before = first
    for number in range(1, 4 * side + 1):
        vertex = _rim_vertex(corners, row, col, side, number) if number < 4 * side else first
        if vertex != NO_VERTEX and is_used[vertex]:
            count = _add_cap(faces, count, before, vertex, middle, far_vertex, is_lamp)
            before = vertex
    return count


@compiled
def _build_faces(corners, sides, is_used, is_middle, far_vertex, is_lamp):
    """Return the faces int32 (m, 3) of a volume.

    ``corners`` (rows, cols, 4) are the kept vertices of each texel, ``sides`` (rows, cols) those of the squares. ``is_used`` and
    ``is_middle`` (n,) are those of ``_used_vertices`` for the kept vertices, and ``far_vertex`` (n,) is the far vertex of each.
    ``is_lamp`` is that of ``volume_polygons``.
    """
    rows, cols = sides.shape
    faces, count = np.empty((rows * cols + 1024, 3), np.int32), 0
    room, none = 64 * (cols + MAX_SQUARE_TEXELS), np.int32(NO_VERTEX)
    for i in range(rows + 1):
        if count + room > len(faces):
            grown = np.empty((2 * len(faces) + room, 3), np.int32)
            grown[:count] = faces[:count]
            faces = grown
        for j in range(cols + 1):
            count = _add_join(faces, count, corners, i, j, far_vertex)
        for j in range(cols if i < rows else 0):
            if sides[i, j] > 0:
                count = _add_square(faces, count, corners, is_used, is_middle, i, j, sides[i, j], far_vertex, is_lamp)
            v0, v1, v2, v3 = corners[i, j, 0], corners[i, j, 1], corners[i, j, 2], corners[i, j, 3]
            has_right, has_up = j + 1 < cols, i + 1 < rows
            count = _add_side(
                faces, count, v1, v3, corners[i, j + 1, 0] if has_right else none, corners[i, j + 1, 2] if has_right else none,
                far_vertex,
            )  # fmt: skip
            count = _add_side(
                faces, count, v3, v2, corners[i + 1, j, 1] if has_up else none, corners[i + 1, j, 0] if has_up else none, far_vertex
            )
            if j == 0:
                count = _add_side(faces, count, v2, v0, none, none, far_vertex)
            if i == 0:
                count = _add_side(faces, count, v0, v1, none, none, far_vertex)
    return faces[:count].copy()
