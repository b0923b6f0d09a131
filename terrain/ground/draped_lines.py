"""Roads and rivers draped over a level's ground. They colour it, and change no height and no shadow.

**Coverage.** A line covers the ground up to half its width from its centre. A pixel is a box on the ground. Its covered share is
the overlap of the box with the line, measured across the line by exact distance. It is a function of the ground's point and of the
pixel's size alone, so neighbouring tiles agree, and a line thinner than a pixel fades instead of breaking into dots.

**Generalisation.** Where pixels are wider than ``FULL_WIDTHS_PER_PIXEL`` times a line's width, the line fades, and it ends at twice
that. A point is therefore only changed by lines within ``REACH_WIDTHS`` of their widths, which bounds the search.

**Index.** Each cell of a square lattice holds the segments that reach it. Cells without segments are not stored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal

ASPHALT, GRAVEL, RIVER = 0, 1, 2
"""Kinds of lines."""

FULL_WIDTHS_PER_PIXEL = 8.0
"""Width of a pixel, in widths of a line, from which on the line fades. At twice this width it is gone."""

REACH_WIDTHS = 0.5 + FULL_WIDTHS_PER_PIXEL
"""Largest distance from a line's centre at which it covers a part of any pixel, in widths of the line."""

MIN_CELL_M = 32.0
_KEY_STRIDE = 2**31


class LineIndex(NamedTuple):
    """Segments of lines and their cells, for compiled loops.

    Attributes
    ----------
    ends_m
        Ends of the segments float64 (n, 4): x, y, x, y in metres east and north of the anchor.
    width_m
        Their widths float64 (n,).
    kind
        Their kinds uint8 (n,).
    cell_m
        Side of the cells.
    cell_keys
        Keys of the cells with segments, ascending int64 (m,).
    first
        int64 (m + 1,), the first member of each cell.
    members
        int32 (k,), the numbers of the segments in the cells.
    """

    ends_m: np.ndarray
    width_m: np.ndarray
    kind: np.ndarray
    cell_m: float
    cell_keys: np.ndarray
    first: np.ndarray
    members: np.ndarray


@dataclass(frozen=True, eq=False)
class DrapedLines:
    """The roads and rivers of a level.

    Attributes
    ----------
    ends_earth_m
        Earth-fixed ends of the segments on the ground float64 (n, 2, 3).
    index
        The segments and their cells.
    notes, warnings
        Statements on what was read, and on values that were ignored.
    """

    ends_earth_m: np.ndarray
    index: LineIndex
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def line_index(ends_m: np.ndarray, width_m: np.ndarray, kind: np.ndarray) -> LineIndex:
    """Return the index of segments with ends (n, 4), widths (n,) and kinds (n,). Of equal coverages the first segment's counts."""
    ends_m = np.ascontiguousarray(ends_m)
    cell_m = max(MIN_CELL_M, float(np.median(width_m)) * REACH_WIDTHS)
    nothing = np.zeros(0, np.int64)
    count = _list_cells(ends_m, width_m, cell_m, nothing, nothing)
    keys, members = np.empty(count, np.int64), np.empty(count, np.int64)
    _list_cells(ends_m, width_m, cell_m, keys, members)
    by_cell = np.argsort(keys, kind="stable")
    cell_keys, first = np.unique(keys[by_cell], return_index=True)
    return LineIndex(ends_m, width_m, kind, cell_m, cell_keys, np.append(first, count), members[by_cell].astype(np.int32))


@compiled
def _list_cells(ends_m, width_m, cell_m, keys, members):
    """Return how many pairs of cells and segments within reach exist. Write them to ``keys`` and ``members``, unless empty."""
    count = 0
    for n in range(len(width_m)):
        reach = REACH_WIDTHS * width_m[n]
        within = reach + 0.7072 * cell_m
        x0, y0, x1, y1 = ends_m[n]
        for iy in range(int(np.floor((min(y0, y1) - reach) / cell_m)), int(np.floor((max(y0, y1) + reach) / cell_m)) + 1):
            for ix in range(int(np.floor((min(x0, x1) - reach) / cell_m)), int(np.floor((max(x0, x1) + reach) / cell_m)) + 1):
                if _square_distance((ix + 0.5) * cell_m, (iy + 0.5) * cell_m, ends_m[n]) <= within * within:
                    if len(keys):
                        keys[count], members[count] = iy * _KEY_STRIDE + ix, n
                    count += 1
    return count


@internal
def _square_distance(x, y, ends):
    """Return the square of the distance of a point from a segment with the ends (4,)."""
    along_x, along_y = ends[2] - ends[0], ends[3] - ends[1]
    share = ((x - ends[0]) * along_x + (y - ends[1]) * along_y) / max(along_x * along_x + along_y * along_y, 1e-12)
    share = min(max(share, 0.0), 1.0)
    dx, dy = x - ends[0] - share * along_x, y - ends[1] - share * along_y
    return dx * dx + dy * dy


@internal
def find_cell(x, y, index):
    """Return the number of the cell of the index at a point, or -1 where no segment reaches."""
    key = int(np.floor(y / index.cell_m)) * _KEY_STRIDE + int(np.floor(x / index.cell_m))
    low, high = 0, len(index.cell_keys)
    while low < high:
        middle = (low + high) // 2
        if index.cell_keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(index.cell_keys) and index.cell_keys[low] == key else -1


@compiled
def pixel_share(distance_m, width_m, pixel_m):
    """Return the share of a pixel that a line covers, faded where pixels are much wider than the line.

    ``distance_m`` is the distance of the pixel's centre from the line's, and ``pixel_m`` the pixel's width across the line.
    """
    half, pixel = 0.5 * width_m, max(pixel_m, 1e-6)
    overlap = min(distance_m + 0.5 * pixel, half) - max(distance_m - 0.5 * pixel, -half)
    fade = min(max(2.0 - pixel / (FULL_WIDTHS_PER_PIXEL * width_m), 0.0), 1.0)
    return fade * min(max(overlap / pixel, 0.0), 1.0)


@internal
def covered_shares(x, y, cell, index, across_m, along_m, view_x, view_y):
    """Return the shares of a pixel that roads and rivers cover, and the kind of the road.

    (``x``, ``y``) is the pixel's centre, in the cell ``cell``. The pixel is ``along_m`` wide in the horizontal direction of view
    (``view_x``, ``view_y``), and ``across_m`` across it.
    """
    road, river, road_kind = 0.0, 0.0, ASPHALT
    for k in range(index.first[cell], index.first[cell + 1]):
        n = index.members[k]
        width, ends = index.width_m[n], index.ends_m[n]
        square = _square_distance(x, y, ends)
        if square >= (REACH_WIDTHS * width) ** 2:
            continue
        along_x, along_y = ends[2] - ends[0], ends[3] - ends[1]
        cosine = (view_y * along_x - view_x * along_y) ** 2 / max(along_x * along_x + along_y * along_y, 1e-12)
        pixel = np.sqrt(along_m * along_m * cosine + across_m * across_m * (1.0 - cosine))
        share = pixel_share(np.sqrt(square), width, pixel)
        if index.kind[n] == RIVER:
            river = max(river, share)
        elif share > road:
            road, road_kind = share, index.kind[n]
    return road, river, road_kind
