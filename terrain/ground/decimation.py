"""Decimate a grid of heights by view-dependent error: a restricted right-triangulated irregular network (RTIN).

Two right triangles cover a square of 2**k cells a side. Each is halved at the middle of its hypotenuse, and so on down to half
cells (W. Evans, D. Kirkpatrick, G. Townsend 2001, "Right-triangulated irregular networks"). So every node bisects one hypotenuse,
and with it at most two triangles, one on each side.

The distance ``step`` is 1, 2, 4, ... nodes. A node whose row and column are both odd multiples of it is the centre of a square, and
bisects a diagonal of this square. A node with one odd and one even multiple is the middle of a square's side, and bisects this
side. Active nodes are those that the mesh uses. The parents of a node are the apexes of the two triangles that it bisects. If all
parents of active nodes are active, the mesh has no T-junctions, hence no cracks (P. Lindstrom, V. Pascucci 2002, "Terrain
simplification simplified", IEEE TVCG 8(3)).

The square of 2**k cells a side may be larger than the grid and has no nodes beyond it. Triangles that reach beyond the grid are
always halved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.errors import InputError
from skugga.terrain.geo.world import EARTH_RADIUS_M

_PRESENT, _ABSENT, _BOTH = 1, 2, 3
"""Bits for the smallest triangles within a triangle: all have data, all lack data, or both occur (at the outline of the data)."""

MAX_LENGTH_PER_EYE_HEIGHT = 64.0
"""Maximum length of a triangle under the eye, as a multiple of the eye's height above the ground.

Positions are float32. Points of a triangle whose corners are E metres away are resolved to 4.8e-7 E. For a sun 8 degrees high,
this displaces the end of a ray by 3.4e-6 E. From a distance of E / 75, that is a quarter of a pixel of 0.001 radians.
"""


@dataclass(frozen=True, eq=False)
class NodeErrors:
    """View-independent errors of the nodes of a surface.

    Attributes
    ----------
    height_m
        float32 (rows, cols), metres; nodes that are not finite are absent.
    spacing_m
        Distance between neighbouring nodes, metres.
    error_m
        float32 (rows, cols): vertical distance of a node from the middle of the hypotenuse that it bisects, metres. Infinite where
        the outline of the data needs the node, 0 where nothing is drawn.
    bisected_count
        uint8 (rows, cols): number of the triangles that a node bisects, counting only triangles with data everywhere, 0 to 2.
    triangle_count
        Number of triangles of the mesh that uses all nodes: halves of cells whose three corners have data.
    """

    height_m: np.ndarray
    spacing_m: float
    error_m: np.ndarray
    bisected_count: np.ndarray
    triangle_count: int


@dataclass(frozen=True, eq=False)
class DecimatedMesh:
    """A conforming triangulation of some nodes of a grid.

    Attributes
    ----------
    nodes
        int32 (n, 2), row and column of the nodes used.
    triangles
        int32 (m, 3), indices into ``nodes``, counter-clockwise from above where columns run east and rows south.
    tolerance_rad
        Angle in radians: all nodes whose error exceeds this share of their distance to the eye are used.
    """

    nodes: np.ndarray
    triangles: np.ndarray
    tolerance_rad: float


def node_errors(heights_m: np.ndarray, spacing_m: float, is_curved: bool) -> NodeErrors:
    """Return the errors of all nodes of a grid of heights (rows, cols), metres, NaN where the surface is absent.

    ``is_curved`` adds the bulge of the earth above a hypotenuse, length**2 / (8 R), with the earth's mean radius R. Raises
    ``InputError`` if the heights are not a two-dimensional array or the spacing is not positive.
    """
    height = np.ascontiguousarray(heights_m, np.float32)
    if height.ndim != 2:
        raise InputError("heights_m", height.shape, "an array of rows and columns")
    if not 0.0 < spacing_m < np.inf:
        raise InputError("spacing_m", spacing_m, "a positive number of metres")
    bulge_per_m2 = 1.0 / (8.0 * EARTH_RADIUS_M) if is_curved else 0.0
    error, bisected_count = _node_errors(height, bulge_per_m2 * spacing_m**2)
    return NodeErrors(height, float(spacing_m), error, bisected_count, int(_count_smallest_triangles(height)))


def decimate(
    errors: NodeErrors, eye_row_col_m: tuple[float, float, float], tolerance: float, max_triangles: int, min_distance_m: float = 1.0
) -> DecimatedMesh:
    """Return the mesh of the nodes whose omission an eye at (row, col, height in metres) could see.

    A node is used if its error exceeds ``tolerance`` (radians) times its distance to the eye, which counts as at least
    ``min_distance_m``. A node is also used if omitting it moves the ground nearest to the eye by more than ``tolerance``, seen from
    the eye.

    If more than ``max_triangles`` triangles result, the tolerance rises to the smallest one that stays within the limit. The
    outline of the data is kept even if it alone exceeds the limit. Raises ``InputError`` for arguments that are not finite or not
    positive (the tolerance may be 0).
    """
    if not np.isfinite(eye_row_col_m).all():
        raise InputError("eye_row_col_m", eye_row_col_m, "finite row, column and height")
    if not 0.0 <= tolerance < np.inf:
        raise InputError("tolerance", tolerance, "a finite angle of 0 or more, in radians")
    if max_triangles < 1:
        raise InputError("max_triangles", max_triangles, "1 or more")
    if not 0.0 < min_distance_m < np.inf:
        raise InputError("min_distance_m", min_distance_m, "a positive number of metres")
    if errors.triangle_count == 0:
        return DecimatedMesh(np.zeros((0, 2), np.int32), np.zeros((0, 3), np.int32), float(tolerance))
    row, col, up = (float(v) for v in eye_row_col_m)
    removal_tolerance, nearest_m = _tolerances_from_own_error(
        errors.error_m, errors.height_m, errors.spacing_m, row, col, up, float(min_distance_m)
    )
    _raise_near_eye(removal_tolerance, errors.error_m, row, col, nearest_m)
    _split_under_eye(removal_tolerance, errors.height_m, row, col, up, errors.spacing_m, float(min_distance_m))
    _propagate_to_parents(removal_tolerance)
    tolerance = float(tolerance)
    triangles = errors.triangle_count - _count_saved_triangles(removal_tolerance, errors.bisected_count, tolerance)
    if triangles > max_triangles:
        raised = _smallest_saving_tolerance(removal_tolerance, errors.bisected_count, errors.triangle_count - max_triangles)
        tolerance = max(tolerance, float(raised))
        triangles = errors.triangle_count - _count_saved_triangles(removal_tolerance, errors.bisected_count, tolerance)
    nodes, corners = _bisect(removal_tolerance, errors.height_m, tolerance, triangles)
    return DecimatedMesh(nodes, corners, tolerance)


@compiled
def _node_errors(height, bulge_m):
    """Return each node's error (rows, cols) and the number of wholly present triangles that it bisects.

    ``bulge_m`` is the earth's bulge above a hypotenuse as long as the distance between neighbouring nodes.
    """
    rows, cols = height.shape
    error = np.zeros((rows, cols), np.float32)
    parts = np.zeros((rows, cols), np.uint8)
    step = 1
    while step < max(rows, cols) - 1:
        _fill_errors(height, bulge_m, error, parts, 0, step, 2 * step, 0, step)
        _fill_errors(height, bulge_m, error, parts, step, 0, 2 * step, step, 0)
        for row in (step, 3 * step):
            for col in (step, 3 * step):
                # The diagonal passes through the centre of the square that is twice as large.
                _fill_errors(height, bulge_m, error, parts, row, col, 4 * step, step, step if row == col else -step)
        step *= 2
    for row in range(rows):
        for col in range(cols):
            p = parts[row, col]
            parts[row, col] = (p & 3 == _PRESENT) + (p >> 2 == _PRESENT)
    return error, parts


@internal
def _fill_errors(height, bulge_m, error, parts, first_row, first_col, stride, down, right):
    """Write ``error`` and ``parts`` of nodes ``stride`` apart, from (first_row, first_col) on.

    The hypotenuse that such a node bisects ends at the offset (down, right) from it and at the opposite offset. The nodes within
    the bisected triangles must be done. ``parts`` (rows, cols) holds two bits for the triangle whose apex comes before the node in
    reading order, and above them two bits for the triangle whose apex comes after it. ``height`` and ``bulge_m`` are those of
    ``_node_errors``.
    """
    rows, cols = height.shape
    bulge_m *= 4.0 * (down * down + right * right)
    for row in range(first_row, rows, stride):
        for col in range(first_col, cols, stride):
            if row + down >= rows or col + abs(right) >= cols:
                error[row, col], parts[row, col] = np.inf, _BOTH | _BOTH << 2
                continue
            ends_there = np.isfinite(height[row - down, col - right]) and np.isfinite(height[row + down, col + right])
            both_parts, is_needed = 0, False
            for side in range(2):
                rotation_sign = 2 * side - 1 if right > 0 else 1 - 2 * side
                apex_row, apex_col = row + rotation_sign * right, col - rotation_sign * down
                if 0 <= apex_row < rows and 0 <= apex_col < cols:
                    part = _parts_of_halves(height, parts, row, col, down, right, apex_row, apex_col)
                    # A triangle with three present corners is drawn, so one whose parts are all absent must be halved.
                    is_needed |= part == _ABSENT and ends_there and np.isfinite(height[apex_row, apex_col])
                elif apex_row < 0 or apex_col < 0 or (row == rows - 1 if down == 0 else col == cols - 1):
                    part = _ABSENT
                else:
                    part = _BOTH
                is_needed |= part == _BOTH
                both_parts |= part << 2 * side
            parts[row, col] = both_parts
            if is_needed:
                error[row, col] = np.inf
            elif (both_parts | both_parts >> 2) & _PRESENT:
                ends = np.float64(height[row - down, col - right]) + np.float64(height[row + down, col + right])
                error[row, col] = abs(height[row, col] - 0.5 * ends) + bulge_m


@internal
def _parts_of_halves(height, parts, row, col, down, right, apex_row, apex_col):
    """Return whether the halves of a triangle have data, as the union of their bits (``_PRESENT``, ``_ABSENT``).

    The corners of a half are the bisecting node (``row``, ``col``), the triangle's apex (``apex_row``, ``apex_col``) and an end of
    its hypotenuse. The ends lie at the offset (``down``, ``right``) from the bisecting node, and at the opposite offset. ``parts``
    is that of ``_fill_errors``.
    """
    part = 0
    for end in (-1, 1):
        half_down, half_right = apex_row - row + end * down, apex_col - col + end * right
        if half_down & 1:
            is_present = np.isfinite(height[row, col]) and np.isfinite(height[apex_row, apex_col])
            is_present = is_present and np.isfinite(height[row + end * down, col + end * right])
            part |= _PRESENT if is_present else _ABSENT
        else:
            # This node is the half's apex. It comes before or after the node that bisects the half.
            apex_before = half_down > 0 or (half_down == 0 and half_right > 0)
            part |= parts[row + (half_down >> 1), col + (half_right >> 1)] >> (0 if apex_before else 2) & 3
    return part


@compiled
def _count_smallest_triangles(height):
    """Return the number of half cells whose three corners have data.

    The diagonals that halve cells join nodes whose row and column are both even or both odd.
    """
    count = 0
    for row in range(height.shape[0] - 1):
        for col in range(height.shape[1] - 1):
            falling = (row + col) % 2 == 0
            left, right = (0, 1) if falling else (1, 0)
            if np.isfinite(height[row, col + left]) and np.isfinite(height[row + 1, col + right]):
                count += np.isfinite(height[row, col + right])
                count += np.isfinite(height[row + 1, col + left])
    return count


@compiled
def _tolerances_from_own_error(error, height, spacing_m, eye_row, eye_col, eye_m, min_distance_m):
    """Return each node's removal tolerance (rows, cols) float32, in radians, and the eye's distance to the nearest node, metres.

    A node can be removed at its removal tolerance or a larger one. Here it is the node's error over its distance to the eye.
    ``error`` and ``height`` (rows, cols) are metres. The eye is at the fractional row and column ``eye_row`` and ``eye_col``, and
    at the height ``eye_m``. ``spacing_m`` is the distance of nodes; distances count as at least ``min_distance_m``.
    """
    rows, cols = height.shape
    removal_tolerance = np.empty((rows, cols), np.float32)
    nearest = np.inf
    for row in range(rows):
        south2 = ((row - eye_row) * spacing_m) ** 2
        for col in range(cols):
            east, up = (col - eye_col) * spacing_m, height[row, col] - eye_m
            distance2 = south2 + east * east + (up * up if np.isfinite(up) else 0.0)
            distance2 = max(distance2, min_distance_m * min_distance_m)
            nearest = min(nearest, distance2)
            removal_tolerance[row, col] = error[row, col] / np.sqrt(distance2)
    return removal_tolerance, np.sqrt(nearest)


@compiled
def _raise_near_eye(removal_tolerance, error, eye_row, eye_col, nearest_m):
    """Raise the removal tolerances of nodes whose errors change the ground nearest to the eye, which may be far nearer.

    Omitting a node changes the triangles that it bisects like a tent: most at the node, and not at all at their other edges. If the
    eye is over the tent, the change just below the eye may subtend a larger angle than the change at the node. ``nearest_m`` is the
    eye's distance to the nearest node. The other parameters are those of ``_tolerances_from_own_error``.
    """
    rows, cols = removal_tolerance.shape
    eye_row, eye_col = min(max(eye_row, 0.0), rows - 1.0), min(max(eye_col, 0.0), cols - 1.0)
    step = 1
    while step < max(rows, cols) - 1:
        middle_row = int(eye_row) // (2 * step) * 2 * step + step
        middle_col = int(eye_col) // (2 * step) * 2 * step + step
        for down, right in ((0, 0), (-step, 0), (step, 0), (0, -step), (0, step)):
            row, col = middle_row + down, middle_col + right
            if row < rows and col < cols:
                south, east = abs(eye_row - row), abs(eye_col - col)
                tent = 1.0 - (south + east if down or right else max(south, east)) / step
                if tent > 0.0:
                    removal_tolerance[row, col] = max(removal_tolerance[row, col], np.float32(error[row, col] * tent / nearest_m))
        step *= 2


@compiled
def _split_under_eye(removal_tolerance, height, eye_row, eye_col, eye_m, spacing_m, min_distance_m):
    """Require the nodes that halve overlong triangles under or next to the eye: set their removal tolerances to infinity.

    ``MAX_LENGTH_PER_EYE_HEIGHT`` bounds the length of these triangles. "Next to" means within 1/32 of a triangle's leg. This
    includes all triangles that meet in a node right under the eye. The parameters are those of ``_tolerances_from_own_error``.
    """
    rows, cols = removal_tolerance.shape
    eye_row, eye_col = min(max(eye_row, 0.0), rows - 1.0), min(max(eye_col, 0.0), cols - 1.0)
    ground_m = height[int(round(eye_row)), int(round(eye_col))]
    if not np.isfinite(ground_m):
        return
    largest_m = MAX_LENGTH_PER_EYE_HEIGHT * max(abs(eye_m - ground_m), min_distance_m)
    step = 1
    while step < max(rows, cols) - 1:
        if 2 * step * spacing_m > largest_m:
            for south, east in ((1, 2), (2, 1), (1, -2), (2, -1), (-1, 2), (-2, 1), (-1, -2), (-2, -1)):
                _require_nodes_at(removal_tolerance, eye_row + south * step / 32.0, eye_col + east * step / 32.0, step)
        step *= 2


@internal
def _require_nodes_at(removal_tolerance, at_row, at_col, step):
    """Require the nodes of one ``step`` that halve a triangle which contains the fractional position (``at_row``, ``at_col``)."""
    middle_row = int(np.floor(at_row)) // (2 * step) * 2 * step + step
    middle_col = int(np.floor(at_col)) // (2 * step) * 2 * step + step
    for down, right in ((0, 0), (-step, 0), (step, 0), (0, -step), (0, step)):
        row, col = middle_row + down, middle_col + right
        south, east = abs(at_row - row), abs(at_col - col)
        over = (south + east if down or right else max(south, east)) < step
        if over and 0 <= row < removal_tolerance.shape[0] and 0 <= col < removal_tolerance.shape[1]:
            removal_tolerance[row, col] = np.float32(np.inf)


@compiled
def _propagate_to_parents(removal_tolerance):
    """Raise each node's removal tolerance to that of the nodes whose parent it is, from the smallest triangles to the largest."""
    rows, cols = removal_tolerance.shape
    step = 1
    while step < max(rows, cols) - 1:
        half = step // 2
        for row in range(0, rows if half else 0, step):
            for col in range(step * (1 - row // step % 2), cols, 2 * step):
                north = max(
                    _value_at(removal_tolerance, row - half, col - half), _value_at(removal_tolerance, row - half, col + half)
                )
                south = max(
                    _value_at(removal_tolerance, row + half, col - half), _value_at(removal_tolerance, row + half, col + half)
                )
                removal_tolerance[row, col] = max(removal_tolerance[row, col], north, south)
        for row in range(step, rows, 2 * step):
            for col in range(step, cols, 2 * step):
                north_south = max(removal_tolerance[row - step, col], _value_at(removal_tolerance, row + step, col))
                west_east = max(removal_tolerance[row, col - step], _value_at(removal_tolerance, row, col + step))
                removal_tolerance[row, col] = max(removal_tolerance[row, col], north_south, west_east)
        step *= 2


@internal
def _value_at(values, row, col):
    """Return the value of a node, or 0 outside of the grid ``values`` (rows, cols)."""
    inside = 0 <= row < values.shape[0] and 0 <= col < values.shape[1]
    return values[row, col] if inside else np.float32(0.0)


@compiled
def _count_saved_triangles(removal_tolerance, bisected_count, tolerance):
    """Return the number of triangles that a tolerance saves: one for each triangle with data everywhere that is not bisected."""
    saved = 0
    for row in range(removal_tolerance.shape[0]):
        for col in range(removal_tolerance.shape[1]):
            saved += bisected_count[row, col] if removal_tolerance[row, col] <= tolerance else 0
    return saved


@compiled
def _smallest_saving_tolerance(removal_tolerance, bisected_count, min_saved_triangles):
    """Return the smallest tolerance that saves at least ``min_saved_triangles`` triangles, or else the one that saves most.

    A radix selection finds it, by the upper and then by the lower 16 bits of the removal tolerances. Positive floats have the same
    order as their bits.
    """
    half, mask = np.uint32(16), np.uint32(0xFFFF)
    bits, bisected_count = removal_tolerance.ravel().view(np.uint32), bisected_count.ravel()
    counts = np.zeros(1 << 16, np.int64)
    for n in range(bits.size):
        counts[bits[n] >> half] += bisected_count[n]
    saved = np.cumsum(counts[:0x7F80])  # removal tolerances from 0x7F80 on are infinite
    min_saved_triangles = min(min_saved_triangles, saved[-1])
    upper = np.searchsorted(saved, min_saved_triangles)
    counts[:] = 0
    for n in range(bits.size):
        if bits[n] >> half == upper:
            counts[bits[n] & mask] += bisected_count[n]
    lower = np.searchsorted(np.cumsum(counts), min_saved_triangles - (saved[upper - 1] if upper > 0 else 0))
    return np.array([upper << 16 | lower], np.uint32).view(np.float32)[0]


@compiled
def _bisect(removal_tolerance, height, tolerance, count):
    """Return the nodes (n, 2) and triangles (count, 3) of the mesh for a tolerance.

    Traverses the triangles depth first, from the two of the whole square. Halves a triangle if the removal tolerance of the node
    that bisects it exceeds the tolerance. ``removal_tolerance`` and ``height`` are (rows, cols). ``count`` is the known number of
    triangles.
    """
    rows, cols = height.shape
    side = 1
    while side < max(rows, cols) - 1:
        side *= 2
    triangles = np.empty((count, 3), np.int32)
    nodes = np.empty((min(3 * count, rows * cols), 2), np.int32)
    index = np.zeros((rows, cols), np.int32)  # index + 1; 0 marks nodes not yet used
    triangle_count, node_count = 0, 0
    # Stack of triangles: row and column of the apex, then of the hypotenuse's ends, counter-clockwise. Each level adds one.
    stack = np.empty((128, 6), np.int64)
    stack[0], stack[1] = (0, side, 0, 0, side, side), (side, 0, side, side, 0, 0)
    top = 2
    while top > 0:
        top -= 1
        ar, ac, br, bc, cr, cc = stack[top]
        exceeds_grid = max(ar, br, cr) >= rows or max(ac, bc, cc) >= cols
        if exceeds_grid and (min(ar, br, cr) >= rows - 1 or min(ac, bc, cc) >= cols - 1):
            continue
        smallest = (br + cr) % 2 == 1 or (bc + cc) % 2 == 1
        mr, mc = (br + cr) // 2, (bc + cc) // 2
        if not smallest and (exceeds_grid or removal_tolerance[mr, mc] > tolerance):
            stack[top], stack[top + 1] = (mr, mc, ar, ac, br, bc), (mr, mc, cr, cc, ar, ac)
            top += 2
        elif not exceeds_grid and np.isfinite(height[ar, ac]) and np.isfinite(height[br, bc]) and np.isfinite(height[cr, cc]):
            for corner, (row, col) in enumerate(((ar, ac), (br, bc), (cr, cc))):
                if index[row, col] == 0:
                    nodes[node_count] = row, col
                    node_count += 1
                    index[row, col] = node_count
                triangles[triangle_count, corner] = index[row, col] - 1
            triangle_count += 1
    return nodes[:node_count].copy(), triangles[:triangle_count]
