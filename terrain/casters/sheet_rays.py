"""Trace parallel rays through grid meshes of the ground (sheets), with rotated nodes and a pyramid of bounding boxes.

The nodes are rotated so that the rays run along the third axis. Projected along that axis, a ray is a point. The ray stops at any
triangle that covers the point and lies farther along the axis than the ray's start. A pyramid of bounding boxes over tiles of quads
finds the triangles that can cover a point. It corresponds to maximum mipmaps over heights (Tevs, Ihrke and Seidel 2008). Building
it takes one pass over the nodes, where a sorted tree (BVH) takes seconds.

The tests are watertight: two triangles that share a side evaluate the same edge function of the same two nodes, with exactly
opposite signs, so no ray passes between them. All numbers are float64.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import CORES, compiled, internal, map_on_cores
from skugga.terrain.ground.sheet import Sheet

MIN_TILE_QUADS = 4
"""Quads along a side of the smallest tiles. All quads of such a tile are tested if a ray meets the tile's box."""


class Pyramids(NamedTuple):
    """Concatenated arrays of all sheets for the compiled loops, each sheet with a pyramid of bounding boxes.

    Attributes
    ----------
    node
        float64 (n, 3), nodes rotated so that rays run along the third axis.
    is_cut_nw_se
        bool (m,), whether a quad is cut from its north-west to its south-east corner (``Sheet``).
    sheet
        int64 (k, 5) for each sheet: index of its first node, nodes per row, index of its first quad, and first and last index in
        ``pyramid_level``, from the finest level to the coarsest.
    pyramid_level
        int64 (l, 3) for each pyramid level: index of its first box, and its rows and columns of boxes.
    box
        float64 (b, 5), bounds of a box: minimum and maximum of the first and of the second coordinate, and maximum of the third
        one.
    """

    node: np.ndarray
    is_cut_nw_se: np.ndarray
    sheet: np.ndarray
    pyramid_level: np.ndarray
    box: np.ndarray


class SheetRays:
    """Ray queries on sheets in one frame. Coordinates are taken relative to the frame's point ``centre_m`` (3,)."""

    def __init__(self, sheets: Iterable[Sheet], centre_m: np.ndarray) -> None:
        self._sheets = [sheet for sheet in sheets if sheet.is_cut_nw_se.size]
        self._centre_m = centre_m
        self._cached_pyramids: tuple[tuple[float, ...], Pyramids] | None = None
        self.nbytes = 2 * sum(sheet.position_frame_m.nbytes for sheet in self._sheets)

    def is_blocked(self, start_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return whether rays from starts (n, 3) towards one unit direction (3,) meet a triangle: bool (n,)."""
        if not self._sheets:
            return np.zeros(len(start_m), bool)
        axes, pyramids = _axes_along(direction), self._pyramids_along(tuple(map(float, direction)))
        parts = np.array_split((start_m - self._centre_m) @ axes.T, CORES)
        return np.concatenate(map_on_cores(partial(_are_blocked, pyramids), parts))

    def _pyramids_along(self, direction: tuple[float, ...]) -> Pyramids:
        """Return the pyramids of the sheets for rays in a direction. Those of the last direction are cached."""
        if self._cached_pyramids is None or self._cached_pyramids[0] != direction:
            self._cached_pyramids = direction, self._build_pyramids(direction)
        return self._cached_pyramids[1]

    def _build_pyramids(self, direction: tuple[float, ...]) -> Pyramids:
        """Return the pyramids of the sheets for rays in a unit direction (3,)."""
        axes = _axes_along(np.array(direction))
        levels: list[tuple[int, int, int]] = []
        sheets, node, quad, box = [], 0, 0, 0
        for sheet in self._sheets:
            rows, cols = sheet.is_cut_nw_se.shape
            first = len(levels)
            box_rows, box_cols = -(-rows // MIN_TILE_QUADS), -(-cols // MIN_TILE_QUADS)
            while True:
                levels.append((box, box_rows, box_cols))
                box += box_rows * box_cols
                if box_rows == box_cols == 1:
                    break
                box_rows, box_cols = -(-box_rows // 2), -(-box_cols // 2)
            sheets.append((node, cols + 1, quad, first, len(levels) - 1))
            node, quad = node + (rows + 1) * (cols + 1), quad + rows * cols
        is_cut_nw_se = np.concatenate([sheet.is_cut_nw_se.ravel() for sheet in self._sheets])
        pyramids = Pyramids(np.empty((node, 3)), is_cut_nw_se, np.array(sheets), np.array(levels), np.empty((box, 5)))

        def build(number: int) -> None:
            _build_pyramid(pyramids, number, self._sheets[number].position_frame_m, self._centre_m, axes)

        map_on_cores(build, range(len(self._sheets)))
        return pyramids


def _axes_along(direction: np.ndarray) -> np.ndarray:
    """Return orthogonal unit axes as rows (3, 3), the last one along a direction.

    The first axis is horizontal, so that the bounding boxes of ground are as flat as possible. For a nearly vertical direction it
    is perpendicular to the frame's second axis instead.
    """
    axis = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    horizontal = np.cross([0.0, 0.0, 1.0] if abs(axis[2]) < 0.999 else [0.0, 1.0, 0.0], axis)
    horizontal /= np.linalg.norm(horizontal)
    return np.stack([horizontal, np.cross(axis, horizontal), axis])


@compiled
def _build_pyramid(pyramids, number, position, centre, axes):
    """Write the rotated nodes and the boxes of the sheet ``number`` to ``pyramids``."""
    first, per_row, _, low, high = pyramids.sheet[number]
    rows, cols, _ = position.shape
    node, box, pyramid_level = pyramids.node, pyramids.box, pyramids.pyramid_level
    for r in range(rows):
        for c in range(cols):
            x, y, z = position[r, c, 0] - centre[0], position[r, c, 1] - centre[1], position[r, c, 2] - centre[2]
            for k in range(3):
                node[first + r * per_row + c, k] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
    begin, box_rows, box_cols = pyramid_level[low]
    for i in range(box_rows):
        for j in range(box_cols):
            a0, a1, b0, b1, d1 = np.inf, -np.inf, np.inf, -np.inf, -np.inf
            for r in range(i * MIN_TILE_QUADS, min((i + 1) * MIN_TILE_QUADS + 1, rows)):
                for c in range(j * MIN_TILE_QUADS, min((j + 1) * MIN_TILE_QUADS + 1, cols)):
                    a, b, d = node[first + r * per_row + c]
                    if np.isfinite(d):
                        a0, a1, b0, b1, d1 = min(a0, a), max(a1, a), min(b0, b), max(b1, b), max(d1, d)
            _set_box(box, begin + i * box_cols + j, a0, a1, b0, b1, d1)
    for parent_level in range(low + 1, high + 1):
        child_begin, child_rows, child_cols = pyramid_level[parent_level - 1]
        begin, box_rows, box_cols = pyramid_level[parent_level]
        for i in range(box_rows):
            for j in range(box_cols):
                a0, a1, b0, b1, d1 = np.inf, -np.inf, np.inf, -np.inf, -np.inf
                for r in range(2 * i, min(2 * i + 2, child_rows)):
                    for c in range(2 * j, min(2 * j + 2, child_cols)):
                        part = box[child_begin + r * child_cols + c]
                        a0, a1, b0, b1 = min(a0, part[0]), max(a1, part[1]), min(b0, part[2]), max(b1, part[3])
                        d1 = max(d1, part[4])
                _set_box(box, begin + i * box_cols + j, a0, a1, b0, b1, d1)


@internal
def _set_box(box, box_index, a0, a1, b0, b1, d1):
    """Write the bounds of a box to the row ``box_index`` of ``box`` (``Pyramids.box``).

    ``a0`` and ``a1`` bound the first coordinate, ``b0`` and ``b1`` the second one. ``d1`` is the maximum of the third one.
    """
    box[box_index, 0], box[box_index, 1], box[box_index, 2], box[box_index, 3], box[box_index, 4] = a0, a1, b0, b1, d1


@compiled
def _are_blocked(pyramids, start):
    """Return whether rays from starts (n, 3), in the rotated axes, meet a triangle of any sheet, bool (n,)."""
    out = np.zeros(len(start), np.bool_)
    stack = np.empty((256, 3), np.int64)
    for n in range(len(start)):
        a, b, d = start[n]
        for number in range(len(pyramids.sheet)):
            if _hits_sheet(pyramids, number, a, b, d, stack):
                out[n] = True
                break
    return out


@internal
def _hits_sheet(pyramids, number, a, b, d, stack):
    """Return whether a ray from (a, b, d), in the rotated axes, meets a triangle of a sheet. ``stack`` is work space."""
    _, _, _, low, high = pyramids.sheet[number]
    box, pyramid_level = pyramids.box, pyramids.pyramid_level
    if not _may_hit_box(box, pyramid_level[high, 0], a, b, d):
        return False
    stack[0, 0], stack[0, 1], stack[0, 2] = high, 0, 0
    stack_size = 1
    while stack_size > 0:
        stack_size -= 1
        level_number, i, j = stack[stack_size]
        if level_number == low:
            if _hits_tile(pyramids, number, i, j, a, b, d):
                return True
            continue
        child_begin, child_rows, child_cols = pyramid_level[level_number - 1]
        for r in range(2 * i, min(2 * i + 2, child_rows)):
            for c in range(2 * j, min(2 * j + 2, child_cols)):
                if _may_hit_box(box, child_begin + r * child_cols + c, a, b, d):
                    stack[stack_size, 0], stack[stack_size, 1], stack[stack_size, 2] = level_number - 1, r, c
                    stack_size += 1
    return False


@internal
def _may_hit_box(box, box_index, a, b, d):
    """Return whether a ray from (a, b, d), in the rotated axes, may meet geometry in a box."""
    return (
        box[box_index, 2] <= b
        and b <= box[box_index, 3]
        and box[box_index, 0] <= a
        and a <= box[box_index, 1]
        and box[box_index, 4] > d
    )


@internal
def _hits_tile(pyramids, number, i, j, a, b, d):
    """Return whether a ray from (a, b, d), in the rotated axes, meets a triangle of the tile (i, j) of a sheet's quads."""
    first, per_row, first_quad, _, _ = pyramids.sheet[number]
    last = pyramids.sheet[number + 1, 2] if number + 1 < len(pyramids.sheet) else len(pyramids.is_cut_nw_se)
    node, cols = pyramids.node, per_row - 1
    rows = (last - first_quad) // cols
    for r in range(i * MIN_TILE_QUADS, min((i + 1) * MIN_TILE_QUADS, rows)):
        for c in range(j * MIN_TILE_QUADS, min((j + 1) * MIN_TILE_QUADS, cols)):
            nw = first + r * per_row + c
            sw = nw + per_row
            # Test the third axis first: most triangles round a start lie behind it.
            if not (node[nw, 2] > d or node[nw + 1, 2] > d or node[sw, 2] > d or node[sw + 1, 2] > d):
                continue
            if node[nw, 1] < b and node[nw + 1, 1] < b and node[sw, 1] < b and node[sw + 1, 1] < b:
                continue
            if node[nw, 1] > b and node[nw + 1, 1] > b and node[sw, 1] > b and node[sw + 1, 1] > b:
                continue
            if pyramids.is_cut_nw_se[first_quad + r * cols + c]:
                if _hits_triangle(node, nw, sw + 1, nw + 1, a, b, d) or _hits_triangle(node, nw, sw + 1, sw, a, b, d):
                    return True
            elif _hits_triangle(node, sw, nw + 1, nw, a, b, d) or _hits_triangle(node, sw, nw + 1, sw + 1, a, b, d):
                return True
    return False


@internal
def _hits_triangle(node, p, q, r, a, b, d):
    """Return whether a ray from (a, b, d), in the rotated axes, meets the triangle of the nodes p, q and r.

    The triangle's sides and corners belong to it. Triangles parallel to the rays, or with a missing corner, are never met.
    """
    pa, pb, qa, qb, ra, rb = node[p, 0] - a, node[p, 1] - b, node[q, 0] - a, node[q, 1] - b, node[r, 0] - a, node[r, 1] - b
    # Swapping the two nodes of an edge negates its edge function exactly.
    e, f, g = qa * rb - qb * ra, ra * pb - rb * pa, pa * qb - pb * qa
    if not ((e >= 0.0 and f >= 0.0 and g >= 0.0) or (e <= 0.0 and f <= 0.0 and g <= 0.0)):
        return False
    area = e + f + g
    return area != 0.0 and (e * (node[p, 2] - d) + f * (node[q, 2] - d) + g * (node[r, 2] - d)) / area > 0.0
