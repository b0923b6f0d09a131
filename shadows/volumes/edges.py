"""Edges of triangle meshes, and their connected parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.errors import InputError


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of triangles, for any light.

    Vertices at the same float32 position count as one. A triangle with two corners at one position is degenerate: its sides lie on
    no edge.

    Attributes
    ----------
    ends
        int32 (e, 2): vertex numbers, one per position; the first is the smaller.
    triangle_edges
        int32 (m, 3): the edge of each side, from a triangle's corners 0 to 1, 1 to 2 and 2 to 0; -1 for a degenerate triangle.
    side_signs
        int8 (m, 3): +1 where a side runs from the edge's first end to its second, -1 the other way, 0 for a degenerate triangle.
    """

    ends: np.ndarray
    triangle_edges: np.ndarray
    side_signs: np.ndarray


def find_edges(vertices: np.ndarray, triangles: np.ndarray) -> Edges:
    """Return the edges of triangles (m, 3) of vertices (n, 3). Vertices at one float32 position count as one.

    Raises ``InputError`` for a triangle with a vertex number out of range.
    """
    vertex_numbers = _welded_vertices(np.asarray(vertices, np.float32).reshape(-1, 3))
    triangles = np.asarray(triangles).reshape(-1, 3)
    if triangles.size and not (0 <= triangles.min() and triangles.max() < len(vertex_numbers)):
        worst = triangles.min() if triangles.min() < 0 else triangles.max()
        raise InputError("triangles", int(worst), f"vertex numbers below {len(vertex_numbers)}")
    start = vertex_numbers[triangles]
    end = np.roll(start, -1, axis=1)
    has_length = (start != end).all(axis=1)
    keys = _packed_pairs(np.minimum(start, end)[has_length].ravel(), np.maximum(start, end)[has_length].ravel())
    number, first = _unique_numbers(keys)
    triangle_edges = np.full(triangles.shape, -1, np.int32)
    triangle_edges[has_length] = number.reshape(-1, 3)
    side_signs = np.where(start < end, np.int8(1), np.int8(-1)) * has_length[:, None]
    ends = np.stack([keys[first] >> np.uint64(32), keys[first] & np.uint64(0xFFFFFFFF)], axis=-1)
    return Edges(ends.astype(np.int32), triangle_edges, side_signs)


def signed_side_counts(edges: Edges, orientations: np.ndarray) -> np.ndarray:
    """Return the signed number of sides along each edge, int32 (e,): from its first end to its second, minus the other way.

    ``orientations`` (m,) orients the triangles: +1 keeps them, -1 flips them, and 0 leaves them out.
    """
    weights = (edges.side_signs * np.asarray(orientations, np.int8)[:, None]).ravel()
    # Bin 0 collects the sides of degenerate triangles.
    sums = np.bincount(edges.triangle_edges.ravel() + 1, weights, minlength=len(edges.ends) + 1)
    return sums[1:].astype(np.int32)


def connected_parts(edges: Edges) -> np.ndarray:
    """Return the number (m,) int32 of each triangle's part. A part is a set of triangles connected through edges."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(edges.side_signs)
    triangle, side = np.nonzero(edges.side_signs)
    nodes = count + len(edges.ends)
    incidence = coo_array(
        (np.ones(len(triangle), np.int8), (triangle, count + edges.triangle_edges[triangle, side])), (nodes, nodes)
    )
    return connected_components(incidence, directed=False)[1][:count].astype(np.int32)


def closed_part_mask(edges: Edges) -> np.ndarray:
    """Return which triangles (m,), bool, belong to a part that bounds a body: closed and consistently oriented.

    Each edge of such a part has as many sides in one direction as in the other, so the part's signed boundary is zero.
    """
    part = connected_parts(edges)
    unbalanced = signed_side_counts(edges, np.ones(len(part), np.int8)) != 0
    triangle, side = np.nonzero(edges.side_signs)
    open_part = np.zeros(int(part.max(initial=-1)) + 1, bool)
    open_part[part[triangle[unbalanced[edges.triangle_edges[triangle, side]]]]] = True
    return ~open_part[part]


def _welded_vertices(vertices: np.ndarray) -> np.ndarray:
    """Return the number (n,) int32 of the first vertex at each vertex's position.

    All vertices at one position thus have one number.
    """
    bits = (vertices + np.float32(0.0)).view(np.uint32)  # -0 becomes 0
    column, _ = _unique_numbers(_packed_pairs(bits[:, 0], bits[:, 1]))
    number, first = _unique_numbers(_packed_pairs(column, bits[:, 2]))
    return first[number]


def _packed_pairs(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Return pairs of 32 bits, ``high`` and ``low`` (n,), as one number each, (n,) uint64."""
    return high.astype(np.uint64) << np.uint64(32) | low.astype(np.uint64)


@compiled
def _unique_numbers(keys):
    """Return the numbers (n,) int32 of keys (n,) uint64 in the order of their first appearance, and each key's first index, int32.

    The keys are held in a hash table with open addressing, at most half full. Their bits are mixed as in SplitMix64 (Steele, Lea
    and Flood 2014, "Fast splittable pseudorandom number generators", OOPSLA).
    """
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, -1, np.int32)
    number, first = np.empty(len(keys), np.int32), np.empty(len(keys), np.int32)
    key_count = 0
    for n in range(len(keys)):
        mixed = keys[n]
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        slot = np.int64((mixed ^ (mixed >> np.uint64(31))) & np.uint64(size - 1))
        while table[slot] >= 0 and keys[first[table[slot]]] != keys[n]:
            slot = (slot + 1) % size
        if table[slot] < 0:
            table[slot], first[key_count] = key_count, n
            key_count += 1
        number[n] = table[slot]
    return number, first[:key_count].copy()
