"""Land cover: polygons of a level that say what its ground bears, with an index for compiled loops.

**Coverage.** The even-odd rule decides exactly whether a point lies in a polygon. Near an edge the share of a pixel that the
polygon covers is a ramp over the pixel's width across that edge. Where polygons meet their shares sum to 1. A later polygon covers
an earlier one.

**Index.** A lattice of square cells covers all polygons. Each cell holds its candidates: the polygons that contain the cell's
centre or have an edge within ``EDGE_REACH_M`` of the cell, and these edges. The path from the centre to a point stays near the
cell, so the parity of its crossings with these edges decides whether the point lies on the centre's side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import internal

(
    MEADOW, CROP, RIPE_CROP, STUBBLE, PLOUGHED, ORCHARD, FOREST_FLOOR, SCRUB, WETLAND, ROCK, SCREE, SAND, EARTH, YARD, PAVED, WATER,
    ICE,
) = range(17)  # fmt: skip
"""Classes of land cover."""

FIELD_CLASSES = (CROP, STUBBLE, PLOUGHED, RIPE_CROP)
"""Classes of arable land. A file of land cover does not tell them apart: each field has one of them."""

EDGE_REACH_M = 12.0
"""Distance from a cell up to which edges count. Pixels that are more than twice as wide get a narrower ramp."""

MIN_CELL_M, MAX_CELLS = 16.0, 4_000_000
"""Smallest side of the cells, and their maximum number. Larger regions have larger cells."""


class LandCoverIndex(NamedTuple):
    """Polygons of land cover and their cells, for compiled loops.

    Attributes
    ----------
    west_m, south_m
        The south-west corner of the lattice, metres east and north of the anchor.
    cell_m
        Side of the cells.
    cell_counts
        int64 (2,): rows and columns of the lattice.
    first
        int64 (cells + 1,), the first candidate of each cell. Those of a cell are in the order of precedence.
    polygon
        int32 (k,), the polygon of each candidate.
    has_centre
        bool (k,): whether the candidate contains the centre of the cell.
    first_edge
        int64 (k + 1,), the first edge of each candidate in ``edges_m``.
    edges_m
        float64 (m, 4): ends x, y, x, y of the candidates' edges, metres from the anchor.
    cover
        uint8 (n,), the class of each polygon.
    row_direction
        float64 (n, 2), unit vector along the rows of each field: that of its longest side.
    """

    west_m: float
    south_m: float
    cell_m: float
    cell_counts: np.ndarray
    first: np.ndarray
    polygon: np.ndarray
    has_centre: np.ndarray
    first_edge: np.ndarray
    edges_m: np.ndarray
    cover: np.ndarray
    row_direction: np.ndarray


@dataclass(frozen=True, eq=False)
class LandCover:
    """The land cover of a level.

    Attributes
    ----------
    index
        The polygons and their cells.
    notes, warnings
        Statements on what was read, and on values that were ignored.
    """

    index: LandCoverIndex
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def land_cover_index(edges_m: np.ndarray, polygon: np.ndarray, cover: np.ndarray, row_direction: np.ndarray) -> LandCoverIndex:
    """Return the index of n polygons, the first of which takes precedence.

    Parameters
    ----------
    edges_m
        (m, 4): ends x, y, x, y of all edges, in metres from the anchor.
    polygon
        int (m,), the polygon of each edge.
    cover, row_direction
        (n,) and (n, 2): see ``LandCoverIndex``.
    """
    west, south = edges_m[:, [0, 2]].min(), edges_m[:, [1, 3]].min()
    extent = np.array([edges_m[:, [1, 3]].max() - south, edges_m[:, [0, 2]].max() - west])
    cell_m = max(MIN_CELL_M, float(np.sqrt(extent.prod() / MAX_CELLS)))
    west, south = west - EDGE_REACH_M - cell_m, south - EDGE_REACH_M - cell_m
    counts = np.ceil((extent + 2.0 * (EDGE_REACH_M + cell_m)) / cell_m).astype(np.int64)
    in_cells = (edges_m - np.array([west, south, west, south])) / cell_m
    polygons = len(cover)
    inside = _cells_with_centre_inside(in_cells, polygon, counts, polygons)
    cell, edge = _cells_near_edges(in_cells, EDGE_REACH_M / cell_m, counts)
    key = cell * polygons + polygon[edge]
    candidates = np.unique(np.concatenate([inside, key]))
    by_candidate = np.argsort(key, kind="stable")
    return LandCoverIndex(
        float(west), float(south), cell_m, counts,
        np.searchsorted(candidates, np.arange(int(counts.prod()) + 1) * polygons),
        (candidates % polygons).astype(np.int32), np.isin(candidates, inside),
        np.append(np.searchsorted(key[by_candidate], candidates), len(key)),
        np.ascontiguousarray(edges_m[edge[by_candidate]]), cover.astype(np.uint8), np.ascontiguousarray(row_direction),
    )  # fmt: skip


def _cells_with_centre_inside(ends: np.ndarray, polygon: np.ndarray, counts: np.ndarray, polygons: int) -> np.ndarray:
    """Return keys (k,), ``cell * polygons + polygon``, of the cells whose centres lie in a polygon.

    ``ends`` (m, 4) are the ends of edges in units of cells. Along the row of centres with a number r, y = r + 0.5, a polygon covers
    the spans between its crossings.
    """
    low, high = np.minimum(ends[:, 1], ends[:, 3]), np.maximum(ends[:, 1], ends[:, 3])
    first = np.ceil(low - 0.5).astype(np.int64)
    rows = np.maximum(np.ceil(high - 0.5).astype(np.int64) - first, 0)
    edge = np.repeat(np.arange(len(ends)), rows)
    row = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(rows) - rows, rows)
    x0, y0, x1, y1 = ends[edge].T
    x = x0 + (row + 0.5 - y0) / (y1 - y0) * (x1 - x0)
    order = np.lexsort((x, row, polygon[edge]))
    row, x, crossed = row[order], x[order], polygon[edge][order]
    start = np.ceil(x[0::2] - 0.5).astype(np.int64)
    cells = np.maximum(np.ceil(x[1::2] - 0.5).astype(np.int64) - start, 0)
    span = np.repeat(np.arange(len(start)), cells)
    col = start[span] + np.arange(len(span)) - np.repeat(np.cumsum(cells) - cells, cells)
    return np.asarray((row[0::2][span] * counts[1] + col) * polygons + crossed[0::2][span])


def _cells_near_edges(ends: np.ndarray, reach: float, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells (k,) within reach of edges, and the edges (k,). Ends (m, 4) and the reach are in units of cells."""
    low = np.floor(np.minimum(ends[:, :2], ends[:, 2:]) - reach).astype(np.int64)
    size = np.floor(np.maximum(ends[:, :2], ends[:, 2:]) + reach).astype(np.int64) - low + 1
    total = size.prod(axis=1)
    edge = np.repeat(np.arange(len(ends)), total)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(total) - total, total)
    col, row = low[edge, 0] + number % size[edge, 0], low[edge, 1] + number // size[edge, 0]
    start, along = ends[edge, :2], ends[edge, 2:] - ends[edge, :2]
    offset = np.stack([col + 0.5, row + 0.5], axis=1) - start
    share = np.clip((offset * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    is_near = ((offset - share[:, None] * along) ** 2).sum(axis=1) <= (reach + 0.7072) ** 2
    return (row * counts[1] + col)[is_near], edge[is_near]


@internal
def covered_share(
    x, y, candidate, centre_x, centre_y, has_centre, first_edge, edges, across_m, along_m, view_x, view_y, softness_m
):  # fmt: skip
    """Return the share of a pixel that the polygon of a candidate covers.

    (``x``, ``y``) is the pixel's centre, in a cell with the centre (``centre_x``, ``centre_y``). The arrays are those of a
    ``LandCoverIndex``. The pixel is ``along_m`` wide in the horizontal direction of view (``view_x``, ``view_y``), and ``across_m``
    across it. Borders blend over ``softness_m`` at least.
    """
    is_inside = has_centre[candidate]
    first, last = first_edge[candidate], first_edge[candidate + 1]
    nearest, normal_x, normal_y = np.inf, 1.0, 0.0
    for k in range(first, last):
        ax, ay, bx, by = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
        # The path runs along the row of the centre, then along the column of the point.
        if (ay > centre_y) != (by > centre_y):
            crossing = ax + (centre_y - ay) / (by - ay) * (bx - ax)
            if (crossing > centre_x) != (crossing > x):
                is_inside = not is_inside
        if (ax > x) != (bx > x):
            crossing = ay + (x - ax) / (bx - ax) * (by - ay)
            if (crossing > centre_y) != (crossing > y):
                is_inside = not is_inside
        along_x, along_y = bx - ax, by - ay
        share = ((x - ax) * along_x + (y - ay) * along_y) / max(along_x * along_x + along_y * along_y, 1e-12)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * along_x, y - ay - share * along_y
        square = dx * dx + dy * dy
        if square < nearest:
            nearest, normal_x, normal_y = square, -along_y, along_x
    if nearest >= EDGE_REACH_M * EDGE_REACH_M:
        return 1.0 if is_inside else 0.0
    cosine = (view_x * normal_x + view_y * normal_y) ** 2 / max(normal_x * normal_x + normal_y * normal_y, 1e-12)
    width = np.sqrt(along_m * along_m * cosine + across_m * across_m * (1.0 - cosine))
    width = min(max(width, softness_m), 2.0 * EDGE_REACH_M)
    distance = np.sqrt(nearest) if is_inside else -np.sqrt(nearest)
    return min(max(0.5 + distance / max(width, 1e-6), 0.0), 1.0)
