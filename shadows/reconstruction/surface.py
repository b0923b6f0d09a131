"""Rebuild the surface that a light sees from a depth map: links between texels, and depths at the corners of texels.

A texel knows the depth at its centre only. Two neighbours are *linked* if one surface may pass through both centres. Around each
corner of the lattice, linked texels share a vertex. Its depth is the mean of four linked texels' depths, which is exact on a plane,
or is extrapolated by the texels' own slopes beside an edge.

**Offset.** The surface must not lie nearer to the light than the receivers that the map saw. A vertex is therefore moved away
from the light by a bound of what interpolation loses. In a crease whose slope changes by c (depth per texel), a share f <= 1/2
of a texel from a centre, it loses at most c (1 - f) (f + 1/2) / 2. The second difference of the depths at that centre is
c (1 - f), so half of it suffices, along either axis. Beside it come the steps of the map's depths, the float32 error of
positions, and the rasteriser's grid, as in ``docs/shadow-maps.md``. A round body's slope grows towards its outline: its rim is
moved by what a ball may gain there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled, internal

EMPTY_DEPTH = 1.0
"""Depth of a texel without a caster, in front of which all receivers lie."""

AGREEMENT_SLOPE = 0.5
"""Difference of slopes, as tangents in light space, up to which two links in a row belong to one plane."""

MAX_SLOPE_GROWTH = 3.0
"""Factor by which the slope of a round body may grow from one texel to the next towards its outline."""

ROUNDNESS_FACTOR = 8.0
"""Factor of the growth of slopes by which a rim is moved away from the light, up to the last slope itself.

A ball's slope grows without bound towards its outline: in the last half texel its depth grows up to 1.4 times as much as in the
texel before.
"""

UNKNOWN_SLOPE = 3.0
"""Tangent in light space that is allowed for at a texel without a linked neighbour along an axis."""

GRID_SHARE = 1.0 / 64.0
"""Share of a texel by which the rasteriser's grid may move a depth along a slope, with a margin."""

PLANE_TOLERANCE = 0.01
"""Distance from a plane, as a share of a texel's side, up to which corners count as lying in it."""

NO_VERTEX = -1
"""Vertex of an empty texel."""


@dataclass(frozen=True)
class DepthScale:
    """How depths of a map relate to texels and metres. The reciprocal distance at depth d is w = ``reciprocals`` @ (1, d).

    Attributes
    ----------
    texel_depth
        Depth along which a surface at 45 degrees to the light moves in a texel, for w = 1 (across, up). It grows with w.
    error_depth
        The float32 error of positions as a depth, for w = 1. It grows with w squared.
    step
        Step of the map's depths.
    reciprocals
        Factors of w: (1, 0) for the sun.
    max_slope
        Tangent in light space up to which neighbours are linked whatever lies beside them.
    """

    texel_depth: tuple[float, float]
    error_depth: float
    step: float
    reciprocals: tuple[float, float]
    max_slope: float

    @property
    def as_array(self) -> np.ndarray:
        """The fields in their order, float64 (7,), for compiled loops."""
        return np.array([*self.texel_depth, self.error_depth, self.step, *self.reciprocals, self.max_slope])


@dataclass(frozen=True, eq=False)
class Surface:
    """The rebuilt surface of a depth map.

    Attributes
    ----------
    vertices
        float64 (n, 3): column, row and depth in the map; columns and rows count from the map's corner.
    corners
        int32 (rows, cols, 4): the vertices of each texel at its corners of lower row, then higher row, the lower column first.
        ``NO_VERTEX`` for empty texels.
    linked_right, linked_up
        bool (rows, cols): whether a texel is linked to the one of the next column or row.
    """

    vertices: np.ndarray
    corners: np.ndarray
    linked_right: np.ndarray
    linked_up: np.ndarray


def rebuild_surface(depths: np.ndarray, scale: DepthScale) -> Surface:
    """Return the surface of a map's ``depths`` (rows, cols), float32 in [0, 1]."""
    values = scale.as_array
    right, up = _link_texels(depths, values)
    slopes, offsets = _slopes_and_offsets(depths, right, up, values)
    max_depth = np.inf if scale.reciprocals[1] == 0.0 else EMPTY_DEPTH  # a lamp's depths end at its farthest receiver
    vertices, corners = _place_vertices(depths, right, up, slopes, offsets, max_depth)
    return Surface(vertices, corners, right, up)


@internal
def _depth_at(depths, row, col):
    """Return the depth of a texel; that of an empty one outside of the map."""
    if row < 0 or col < 0 or row >= depths.shape[0] or col >= depths.shape[1]:
        return EMPTY_DEPTH
    return np.float64(depths[row, col])


@internal
def _is_linked(depths, row, col, down, right, texel_depth, step, max_slope):
    """Return whether a texel and the one (``down``, ``right``) beside it may lie on one surface.

    They do in four cases. The slope between them is small. The slope beside them is the same. The nearer side slopes towards the
    deeper one and bends on. Or three texels of the deeper side lie on a plane that passes in front of the nearer one: then both
    sides meet in a ridge between them.
    """
    first, second = _depth_at(depths, row, col), _depth_at(depths, row + down, col + right)
    if first >= EMPTY_DEPTH or second >= EMPTY_DEPTH:
        return False
    difference = second - first
    if abs(difference) <= max_slope * texel_depth + 2.0 * step:
        return True
    tolerance = AGREEMENT_SLOPE * texel_depth + 4.0 * step + 0.02 * abs(difference)
    before = _depth_at(depths, row - down, col - right)
    if before < EMPTY_DEPTH and abs(first - before - difference) <= tolerance:
        return True
    after = _depth_at(depths, row + 2 * down, col + 2 * right)
    if after < EMPTY_DEPTH and abs(after - second - difference) <= tolerance:
        return True
    near_slope = first - before if difference > 0.0 else second - after
    near_end = before if difference > 0.0 else after
    if near_end < EMPTY_DEPTH and 0.0 < abs(difference) <= MAX_SLOPE_GROWTH * near_slope:
        return True
    if difference > 0.0:
        last = _depth_at(depths, row + 3 * down, col + 3 * right)
        slope, other_slope = after - second, last - after
    else:
        last = _depth_at(depths, row - 2 * down, col - 2 * right)
        after, slope, other_slope = before, before - first, last - before
    if after >= EMPTY_DEPTH or last >= EMPTY_DEPTH or abs(slope - other_slope) > tolerance:
        return False
    return slope >= abs(difference) - tolerance


@compiled
def _link_texels(depths, scale):
    """Return whether each texel is linked to the one of the next column, and of the next row: bool (rows, cols) each."""
    rows, cols = depths.shape
    right, up = np.zeros((rows, cols), np.bool_), np.zeros((rows, cols), np.bool_)
    across, along, step, w0, w1, max_slope = scale[0], scale[1], scale[3], scale[4], scale[5], scale[6]
    for i in range(rows):
        for j in range(cols):
            w = w0 + w1 * np.float64(depths[i, j])
            right[i, j] = j + 1 < cols and _is_linked(depths, i, j, 0, 1, across * w, step, max_slope)
            up[i, j] = i + 1 < rows and _is_linked(depths, i, j, 1, 0, along * w, step, max_slope)
    return right, up


@internal
def _roundness(depth, neighbour, next_neighbour):
    """Return the offset of a rim whose body bends away from the light, given the depths of the texels before it."""
    slope = depth - neighbour
    return max(min(ROUNDNESS_FACTOR * (slope - (neighbour - next_neighbour)), slope), 0.0)


@internal
def _slope_and_offset(depths, linked, row, col, down, right, texel_depth):
    """Return a texel's slope along an axis, depth per texel, and the offset that the axis adds.

    ``linked`` (rows, cols) is whether a texel is linked to the one (``down``, ``right``) beside it.
    """
    depth = np.float64(depths[row, col])
    before, after = _depth_at(depths, row - down, col - right), _depth_at(depths, row + down, col + right)
    has_before, has_after = row >= down and col >= right and linked[row - down, col - right], linked[row, col]
    if has_before and has_after:
        return 0.5 * (after - before), 0.5 * max(2.0 * depth - before - after, 0.0)
    if has_before:
        is_known = row >= 2 * down and col >= 2 * right and linked[row - 2 * down, col - 2 * right]
        return depth - before, _roundness(depth, before, _depth_at(depths, row - 2 * down, col - 2 * right)) if is_known else 0.0
    if has_after:
        is_known = linked[row + down, col + right]
        return after - depth, _roundness(depth, after, _depth_at(depths, row + 2 * down, col + 2 * right)) if is_known else 0.0
    return 0.0, 0.5 * UNKNOWN_SLOPE * texel_depth


@compiled
def _slopes_and_offsets(depths, right, up, scale):
    """Return the slopes (rows, cols, 2) of texels along columns and rows, and their offsets (rows, cols); 0 for empty ones."""
    rows, cols = depths.shape
    slopes, offsets = np.zeros((rows, cols, 2), np.float64), np.zeros((rows, cols), np.float64)
    across, along, error, step, w0, w1 = scale[0], scale[1], scale[2], scale[3], scale[4], scale[5]
    for i in range(rows):
        for j in range(cols):
            depth = np.float64(depths[i, j])
            if depth >= EMPTY_DEPTH:
                continue
            w = w0 + w1 * depth
            u, offset_u = _slope_and_offset(depths, right, i, j, 0, 1, across * w)
            v, offset_v = _slope_and_offset(depths, up, i, j, 1, 0, along * w)
            slopes[i, j, 0], slopes[i, j, 1] = u, v
            plane = 2.0 * (PLANE_TOLERANCE * min(across, along) * w + step + error * w * w)
            offsets[i, j] = offset_u + offset_v + 2.0 * step + 4.0 * error * w * w + GRID_SHARE * (abs(u) + abs(v)) + plane
    return slopes, offsets


@compiled
def _place_vertices(depths, right, up, slopes, offsets, max_depth):
    """Return the vertices (n, 3) at the corners of texels, and the vertices (rows, cols, 4) of each texel.

    No depth exceeds ``max_depth``. The others are those of a map and of its texels.
    """
    rows, cols = depths.shape
    corners = np.full((rows, cols, 4), np.int32(NO_VERTEX), np.int32)
    vertices, count = np.empty((max(rows * cols, 64), 3), np.float64), 0
    group, row_of, col_of = np.empty(4, np.int64), np.empty(4, np.int64), np.empty(4, np.int64)
    for i in range(rows + 1):
        if count + 4 * (cols + 1) > len(vertices):
            grown = np.empty((2 * len(vertices) + 4 * (cols + 1), 3), np.float64)
            grown[:count] = vertices[:count]
            vertices = grown
        for j in range(cols + 1):
            # the texels around the corner: those of the lower row first; 0 and 1, 2 and 3, 0 and 2, 1 and 3 are neighbours
            for k in range(4):
                r, c = i - 1 + k // 2, j - 1 + k % 2
                row_of[k], col_of[k] = r, c
                filled = 0 <= r < rows and 0 <= c < cols and depths[r, c] < EMPTY_DEPTH
                group[k] = k if filled else -1
            for _ in range(2):  # two rounds carry the smallest number around the ring
                if group[0] >= 0 and group[1] >= 0 and right[i - 1, j - 1]:
                    group[0] = group[1] = min(group[0], group[1])
                if group[1] >= 0 and group[3] >= 0 and up[i - 1, j]:
                    group[1] = group[3] = min(group[1], group[3])
                if group[2] >= 0 and group[3] >= 0 and right[i, j - 1]:
                    group[2] = group[3] = min(group[2], group[3])
                if group[0] >= 0 and group[2] >= 0 and up[i - 1, j - 1]:
                    group[0] = group[2] = min(group[0], group[2])
            for first in range(4):
                if group[first] != first:
                    continue
                members, mean, extrapolated, offset = 0, 0.0, 0.0, 0.0
                for k in range(first, 4):
                    if group[k] == first:
                        r, c = row_of[k], col_of[k]
                        depth = np.float64(depths[r, c])
                        members += 1
                        mean += depth
                        side_u, side_v = 0.5 - k % 2, 0.5 - k // 2
                        extrapolated += depth + side_u * slopes[r, c, 0] + side_v * slopes[r, c, 1]
                        offset = max(offset, offsets[r, c])
                        corners[r, c, 3 - k] = count
                value = (mean if members == 4 else extrapolated) / members + offset
                vertices[count, 0], vertices[count, 1] = j, i
                vertices[count, 2] = min(max(value, 0.0), max_depth)
                count += 1
    return vertices[:count].copy(), corners
