"""Ray casting through foliage: the first hit with a leaf of the trees as a view draws them.

The result is exact except for two simplifications that do not matter on average. The alpha of a texture is read at the nearest
texel. All trees stand along the third axis of the frame, even far from its origin, where the earth's vertical differs. A uniform
grid of cells holds the trees. Rays traverse its cells in order (J. Amanatides, A. Woo 1987, "A fast voxel traversal algorithm for
ray tracing").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.facts.probes import ProbeRays
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

TREES_PER_CELL = 3
"""Mean number of trees per cell of the grid."""

MAX_CELLS_PER_SIDE = 512
"""Maximum number of cells along a side of the grid."""

MIN_LEAF_DISTANCE_M = 0.01
"""Minimum hit distance. A nearer leaf is the one on which the ray starts."""


class TreeGrid(NamedTuple):
    """Uniform grid of trees. The trees of cell k = row * cols + col are ``tree_number[first[k] : first[k + 1]]``.

    Attributes
    ----------
    corner_m
        Corner of the first cell (2,), metres.
    cell_m
        Side of a cell, metres.
    max_tree_top_m
        Maximum height of the trees of each cell (rows, cols), metres.
    first_entry
        Index of each cell's first entry in ``tree_number`` (rows * cols + 1,).
    tree_number
        Tree numbers (k,), int32, ordered by cell.
    tree_disc
        Position of each entry of ``tree_number`` from the corner ``corner_m``, and its radius (k, 3), float32, metres.
    """

    corner_m: np.ndarray
    cell_m: float
    max_tree_top_m: np.ndarray
    first_entry: np.ndarray
    tree_number: np.ndarray
    tree_disc: np.ndarray


class TreeArrays(NamedTuple):
    """Arrays of a ``TreeInstances``, and the leaf masks of the textures (``leaf_masks``).

    Attributes
    ----------
    base_frame_m, quad_sizes_m, yaw_cos_sin, variant
        Position, size, rotation and texture of each tree, as in ``TreeInstances``.
    leaf_mask
        Leaf masks of the textures (2 * variants, side, side), bool.
    """

    base_frame_m: np.ndarray
    quad_sizes_m: np.ndarray
    yaw_cos_sin: np.ndarray
    variant: np.ndarray
    leaf_mask: np.ndarray


@cached("scene", 64 * MIB)
def tree_grid_of(trees: TreeInstances) -> TreeGrid:
    """Return the uniform grid of some trees. Recent grids are cached."""
    radius_m = 1.4143 * trees.quad_sizes_m[:, :2].max(axis=1)
    base_xy = trees.base_frame_m[:, :2]
    low, high = (base_xy - radius_m[:, None]).min(axis=0), (base_xy + radius_m[:, None]).max(axis=0)
    extent = np.maximum(high - low, 1e-3)
    cell = max(float(np.sqrt(np.prod(extent) * TREES_PER_CELL / len(trees))), float(extent.max()) / MAX_CELLS_PER_SIDE)
    cols, rows = (int(n) for n in np.ceil(extent / cell))
    top, first, tree, disc = _build_grid(trees.base_frame_m, trees.quad_sizes_m, radius_m, low, cell, rows, cols)
    return TreeGrid(low, cell, top, first, tree, disc)


@compiled
def _build_grid(base, quad_sizes, radius_m, low, cell, rows, cols):
    """Return the arrays of a ``TreeGrid``: ``max_tree_top_m``, ``first_entry``, ``tree_number`` and ``tree_disc``.

    ``radius_m`` (n,) is the horizontal radius of each tree. ``low`` (2,) is the corner of the first cell, and ``cell`` the side of
    a cell, metres.
    """
    top = np.full((rows, cols), -np.inf)
    first = np.zeros(rows * cols + 1, np.int64)
    tree, disc = np.empty(0, np.int32), np.empty((0, 3), np.float32)
    for fill in range(2):
        for n in range(len(base)):
            c0, c1 = int((base[n, 0] - radius_m[n] - low[0]) / cell), int((base[n, 0] + radius_m[n] - low[0]) / cell)
            r0, r1 = int((base[n, 1] - radius_m[n] - low[1]) / cell), int((base[n, 1] + radius_m[n] - low[1]) / cell)
            for r in range(max(r0, 0), min(r1, rows - 1) + 1):
                for c in range(max(c0, 0), min(c1, cols - 1) + 1):
                    if fill == 0:
                        top[r, c] = max(top[r, c], base[n, 2] + quad_sizes[n, 2])
                        first[r * cols + c + 1] += 1
                    else:
                        entry = first[r * cols + c]
                        tree[entry] = n
                        disc[entry, 0], disc[entry, 1], disc[entry, 2] = base[n, 0] - low[0], base[n, 1] - low[1], radius_m[n]
                        first[r * cols + c] += 1
        if fill == 0:
            for k in range(rows * cols):
                first[k + 1] += first[k]
            tree, disc = np.empty(first[-1], np.int32), np.empty((first[-1], 3), np.float32)
    first[1:] = first[:-1].copy()
    first[0] = 0
    return top, first, tree, disc


@cached("process", 64 * MIB)
def leaf_masks() -> np.ndarray:
    """Return the leaf mask of each texture of a tree, shape (2 * variants, side, side), bool."""
    return foliage().mip_levels[0][..., 3] >= ALPHA_THRESHOLD * 255


def is_blocked_by_leaves(trees: TreeInstances, rays: ProbeRays) -> np.ndarray:
    """Return whether each ray (1 + k, n) hits a leaf before it reaches the light, bool."""
    start, direction = (np.ascontiguousarray(v).reshape(-1, 3) for v in (rays.start_frame_m, rays.direction_frame))
    met, _ = first_leaf_hits(trees, start, direction, np.ravel(rays.length_m))
    return np.isfinite(met).reshape(rays.length_m.shape)


def first_leaf_hits(
    trees: TreeInstances, start: np.ndarray, direction: np.ndarray, length_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance along each ray to the first leaf (n,), metres, and the unit normal of the hit (n, 3).

    Rays have starts (n, 3), unit directions (n, 3) and lengths (n,). The distance is infinite if no leaf lies within the length.
    """
    if not len(trees):
        return np.full(len(start), np.inf), np.zeros((len(start), 3))
    pictures = TreeArrays(trees.base_frame_m, trees.quad_sizes_m, trees.yaw_cos_sin, trees.variant, leaf_masks())
    return _trace_first_hits(tree_grid_of(trees), pictures, start, direction, length_m, MIN_LEAF_DISTANCE_M)


@compiled
def _trace_first_hits(grid, pictures, start, direction, length, min_distance):
    """Return the distance (n,) along each ray to the first leaf, infinite without one, and the unit normal (n, 3) of the hit.

    ``grid`` is a ``TreeGrid``, ``pictures`` a ``TreeArrays``. Hits nearer than ``min_distance`` metres do not count. The other
    parameters are those of ``first_leaf_hits``.
    """
    low, cell, top, first, tree, disc = grid
    base, shape, yaw_cos_sin, variant, leaf_mask = pictures
    rows, cols = top.shape
    side = leaf_mask.shape[1]
    distance, normal = np.full(len(start), np.inf), np.zeros((len(start), 3))
    for n in range(len(start)):
        dx, dy, dz = direction[n, 0], direction[n, 1], direction[n, 2]
        # Clip the ray to the grid, in units of cells.
        from_x, from_y = start[n, 0] - low[0], start[n, 1] - low[1]
        x, y = from_x / cell, from_y / cell
        vx, vy = dx / cell, dy / cell
        entry_distance, end = min_distance, length[n]
        for k in range(2):
            at, v, size = (x, vx, cols) if k == 0 else (y, vy, rows)
            if abs(v) < 1e-15:
                if not 0.0 <= at < size:
                    end = -1.0
            else:
                a, b = -at / v, (size - at) / v
                entry_distance, end = max(entry_distance, min(a, b)), min(end, max(a, b))
        if not entry_distance < end:
            continue
        c, r = min(max(int(x + entry_distance * vx), 0), cols - 1), min(max(int(y + entry_distance * vy), 0), rows - 1)
        flat = np.hypot(dx, dy)
        t = entry_distance
        while True:
            next_x = ((c + (vx > 0.0)) - x) / vx if abs(vx) > 1e-15 else np.inf
            next_y = ((r + (vy > 0.0)) - y) / vy if abs(vy) > 1e-15 else np.inf
            exit_distance = min(next_x, next_y, end)
            if min(start[n, 2] + t * dz, start[n, 2] + exit_distance * dz) <= top[r, c]:
                for i in range(first[r * cols + c], first[r * cols + c + 1]):
                    px, py, radius_m = from_x - disc[i, 0], from_y - disc[i, 1], disc[i, 2] + 0.01
                    if abs(px * dy - py * dx) > radius_m * flat or (flat < 1e-9 and px * px + py * py > radius_m * radius_m):
                        continue
                    m = tree[i]
                    px, py, pz = start[n, 0] - base[m, 0], start[n, 1] - base[m, 1], start[n, 2] - base[m, 2]
                    cosine, sine = np.float64(yaw_cos_sin[m, 0]), np.float64(yaw_cos_sin[m, 1])
                    for quad in range(3):
                        if quad == 2:
                            nx, ny, nz, plane_distance = 0.0, 0.0, 1.0, pz - shape[m, 3]
                        elif quad == 0:
                            nx, ny, nz, plane_distance = -sine, cosine, 0.0, cosine * py - sine * px
                        else:
                            nx, ny, nz, plane_distance = cosine, sine, 0.0, cosine * px + sine * py
                        towards = nx * dx + ny * dy + nz * dz
                        if towards == 0.0:
                            continue
                        s = -plane_distance / towards
                        if not (min_distance < s < min(distance[n], length[n])):
                            continue
                        qx, qy, qz = px + s * dx, py + s * dy, pz + s * dz
                        local_x, local_y = cosine * qx + sine * qy, cosine * qy - sine * qx
                        if quad == 2:
                            u, v = 0.5 * (local_x / shape[m, 1] + 1.0), 0.5 * (1.0 - local_y / shape[m, 1])
                        else:
                            u, v = 0.5 * ((local_x if quad == 0 else local_y) / shape[m, 0] + 1.0), 1.0 - qz / shape[m, 2]
                        if 0.0 <= u < 1.0 and 0.0 <= v < 1.0:
                            if leaf_mask[2 * variant[m] + (1 if quad == 2 else 0), int(v * side), int(u * side)]:
                                distance[n] = s
                                normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz
            if distance[n] <= exit_distance or exit_distance >= end:
                break
            t = exit_distance
            if next_x <= next_y:
                c += 1 if vx > 0.0 else -1
            else:
                r += 1 if vy > 0.0 else -1
            if not (0 <= c < cols and 0 <= r < rows):
                break
    return distance, normal
