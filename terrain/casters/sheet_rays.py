"""Trace rays in one direction through sheets of nodes, with rotated nodes and a small acceleration structure.

In the plane perpendicular to the rays a ray is a point. It stops at any triangle that covers the point and lies farther on. So
nodes are rotated until the rays run along the third axis. A pyramid of bounding boxes over tiles of quads finds the triangles
that can cover a point. It corresponds to maximum mipmaps over heights (Tevs, Ihrke and Seidel 2008). Building it takes one pass
over the nodes, where a sorted tree (BVH) takes seconds.

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
"""Quads along a side of the lowest tiles. All quads of a tile are tested where a ray meets the tile's box."""


class Pyramids(NamedTuple):
    """Concatenated arrays of all sheets for the compiled loops.

    Attributes
    ----------
    node
        float64 (n, 3), nodes rotated so that rays run along the third axis.
    falls
        bool (m,), the cuts of the quads.
    sheet
        int64 (k, 5) for each sheet: its first node, the nodes of a row, its first quad, and its first and last index in ``level``.
    level
        int64 (l, 3) for each pyramid level: its first box, and its rows and columns of boxes.
    box
        float64 (b, 5), bounds of a box: minimum and maximum of the first and of the second coordinate, and maximum of the third
        one.
    """

    node: np.ndarray
    falls: np.ndarray
    sheet: np.ndarray
    level: np.ndarray
    box: np.ndarray


class SheetRays:
    """Ray queries on sheets in one frame. Coordinates are relative to its point ``centre_m`` (3,)."""

    def __init__(self, sheets: Iterable[Sheet], centre_m: np.ndarray) -> None:
        self._sheets = [sheet for sheet in sheets if sheet.falls.size]
        self._centre_m = centre_m
        self._last: tuple[tuple[float, ...], Pyramids] | None = None
        self.nbytes = 2 * sum(sheet.position_frame_m.nbytes for sheet in self._sheets)

    def blocked(self, start_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return whether rays from starts (n, 3) towards one unit direction (3,) meet a triangle: bool (n,)."""
        if not self._sheets:
            return np.zeros(len(start_m), bool)
        axes, pyramids = _axes_along(direction), self._along(tuple(map(float, direction)))
        parts = np.array_split((start_m - self._centre_m) @ axes.T, CORES)
        return np.concatenate(map_on_cores(partial(_blocked, pyramids), parts))

    def _along(self, direction: tuple[float, ...]) -> Pyramids:
        """Return the sheets rotated along a direction. The last ones are cached."""
        if self._last is None or self._last[0] != direction:
            self._last = direction, self._turned(direction)
        return self._last[1]

    def _turned(self, direction: tuple[float, ...]) -> Pyramids:
        axes = _axes_along(np.array(direction))
        levels: list[tuple[int, int, int]] = []
        sheets, node, quad, box = [], 0, 0, 0
        for each in self._sheets:
            rows, cols = each.falls.shape
            first = len(levels)
            tall, wide = -(-rows // MIN_TILE_QUADS), -(-cols // MIN_TILE_QUADS)
            while True:
                levels.append((box, tall, wide))
                box += tall * wide
                if tall == wide == 1:
                    break
                tall, wide = -(-tall // 2), -(-wide // 2)
            sheets.append((node, cols + 1, quad, first, len(levels) - 1))
            node, quad = node + (rows + 1) * (cols + 1), quad + rows * cols
        falls = np.concatenate([each.falls.ravel() for each in self._sheets])
        pyramids = Pyramids(np.empty((node, 3)), falls, np.array(sheets), np.array(levels), np.empty((box, 5)))

        def build(number: int) -> None:
            _build(pyramids, number, self._sheets[number].position_frame_m, self._centre_m, axes)

        map_on_cores(build, range(len(self._sheets)))
        return pyramids


def _axes_along(direction: np.ndarray) -> np.ndarray:
    """Return unit axes (3, 3) with the last one along a direction.

    The first one is horizontal where possible, so that boxes of ground are flattest.
    """
    along = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    level = np.cross([0.0, 0.0, 1.0] if abs(along[2]) < 0.999 else [0.0, 1.0, 0.0], along)
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(along, level), along])


@compiled
def _build(pyramids, number, position, centre, axes):
    """Write a sheet's rotated nodes and its boxes."""
    first, per_row, _, low, high = pyramids.sheet[number]
    rows, cols, _ = position.shape
    node, box, level = pyramids.node, pyramids.box, pyramids.level
    for r in range(rows):
        for c in range(cols):
            x, y, z = position[r, c, 0] - centre[0], position[r, c, 1] - centre[1], position[r, c, 2] - centre[2]
            for k in range(3):
                node[first + r * per_row + c, k] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
    begin, tall, wide = level[low]
    for i in range(tall):
        for j in range(wide):
            a0, a1, b0, b1, d1 = np.inf, -np.inf, np.inf, -np.inf, -np.inf
            for r in range(i * MIN_TILE_QUADS, min((i + 1) * MIN_TILE_QUADS + 1, rows)):
                for c in range(j * MIN_TILE_QUADS, min((j + 1) * MIN_TILE_QUADS + 1, cols)):
                    a, b, d = node[first + r * per_row + c]
                    if np.isfinite(d):
                        a0, a1, b0, b1, d1 = min(a0, a), max(a1, a), min(b0, b), max(b1, b), max(d1, d)
            _fill(box, begin + i * wide + j, a0, a1, b0, b1, d1)
    for above in range(low + 1, high + 1):
        under, under_tall, under_wide = level[above - 1]
        begin, tall, wide = level[above]
        for i in range(tall):
            for j in range(wide):
                a0, a1, b0, b1, d1 = np.inf, -np.inf, np.inf, -np.inf, -np.inf
                for r in range(2 * i, min(2 * i + 2, under_tall)):
                    for c in range(2 * j, min(2 * j + 2, under_wide)):
                        part = box[under + r * under_wide + c]
                        a0, a1, b0, b1 = min(a0, part[0]), max(a1, part[1]), min(b0, part[2]), max(b1, part[3])
                        d1 = max(d1, part[4])
                _fill(box, begin + i * wide + j, a0, a1, b0, b1, d1)


@internal
def _fill(box, at, a0, a1, b0, b1, d1):
    box[at, 0], box[at, 1], box[at, 2], box[at, 3], box[at, 4] = a0, a1, b0, b1, d1


@compiled
def _blocked(pyramids, start):
    """Return which rotated starts (n, 3) have a triangle ahead, bool (n,)."""
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
    """Return whether a ray meets a triangle of a sheet."""
    _, _, _, low, high = pyramids.sheet[number]
    box, level = pyramids.box, pyramids.level
    if not _may_hit_box(box, level[high, 0], a, b, d):
        return False
    stack[0, 0], stack[0, 1], stack[0, 2] = high, 0, 0
    stack_size = 1
    while stack_size > 0:
        stack_size -= 1
        at, i, j = stack[stack_size]
        if at == low:
            if _hits_tile(pyramids, number, i, j, a, b, d):
                return True
            continue
        under, under_tall, under_wide = level[at - 1]
        for r in range(2 * i, min(2 * i + 2, under_tall)):
            for c in range(2 * j, min(2 * j + 2, under_wide)):
                if _may_hit_box(box, under + r * under_wide + c, a, b, d):
                    stack[stack_size, 0], stack[stack_size, 1], stack[stack_size, 2] = at - 1, r, c
                    stack_size += 1
    return False


@internal
def _may_hit_box(box, at, a, b, d):
    """Return whether the contents of a box may cover a point, farther along the rays."""
    return box[at, 2] <= b and b <= box[at, 3] and box[at, 0] <= a and a <= box[at, 1] and box[at, 4] > d


@internal
def _hits_tile(pyramids, number, i, j, a, b, d):
    """Return whether a ray meets a triangle of a tile of quads."""
    first, per_row, first_quad, _, _ = pyramids.sheet[number]
    last = pyramids.sheet[number + 1, 2] if number + 1 < len(pyramids.sheet) else len(pyramids.falls)
    node, cols = pyramids.node, per_row - 1
    rows = (last - first_quad) // cols
    for r in range(i * MIN_TILE_QUADS, min((i + 1) * MIN_TILE_QUADS, rows)):
        for c in range(j * MIN_TILE_QUADS, min((j + 1) * MIN_TILE_QUADS, cols)):
            at = first + r * per_row + c
            below = at + per_row
            # Test the third axis first: most triangles round a start lie behind it.
            if not (node[at, 2] > d or node[at + 1, 2] > d or node[below, 2] > d or node[below + 1, 2] > d):
                continue
            if node[at, 1] < b and node[at + 1, 1] < b and node[below, 1] < b and node[below + 1, 1] < b:
                continue
            if node[at, 1] > b and node[at + 1, 1] > b and node[below, 1] > b and node[below + 1, 1] > b:
                continue
            if pyramids.falls[first_quad + r * cols + c]:
                if _hits_triangle(node, at, below + 1, at + 1, a, b, d) or _hits_triangle(node, at, below + 1, below, a, b, d):
                    return True
            elif _hits_triangle(node, below, at + 1, at, a, b, d) or _hits_triangle(node, below, at + 1, below + 1, a, b, d):
                return True
    return False


@internal
def _hits_triangle(node, p, q, r, a, b, d):
    """Return whether a triangle of three nodes covers a point, with its sides and corners, farther along the rays.

    Triangles seen edge-on, or with a missing corner, cover nothing.
    """
    pa, pb, qa, qb, ra, rb = node[p, 0] - a, node[p, 1] - b, node[q, 0] - a, node[q, 1] - b, node[r, 0] - a, node[r, 1] - b
    # Swapping the two nodes of an edge negates its edge function exactly.
    e, f, g = qa * rb - qb * ra, ra * pb - rb * pa, pa * qb - pb * qa
    if not ((e >= 0.0 and f >= 0.0 and g >= 0.0) or (e <= 0.0 and f <= 0.0 and g <= 0.0)):
        return False
    area = e + f + g
    return area != 0.0 and (e * (node[p, 2] - d) + f * (node[q, 2] - d) + g * (node[r, 2] - d)) / area > 0.0
