"""Find the trees that a map of the sun has to hold: those that may shade one of its receivers.

Along the sun's rays, the visible points of a camera are sparse: far woods hide most of the ground between their trees. A coarse
mask of the map stores where receivers lie, and the depth of the farthest of them from the sun (J. Bittner, O. Mattausch, A.
Silvennoinen and M. Wimmer 2011, "Shadow Caster Culling for Efficient Shadow Mapping"). A tree beside or behind all receivers
changes no look-up. The ground between a pixel's point and that of the pixel below counts as a receiver, too, since samples of
edges lie on it (``skugga.shadows.view_edges``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.shadows.maps.sun_disc import MAX_HALF_DISC_TEXELS
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS, DepthMap
from skugga.terrain.compiled import CORES, compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import tree_radius

RECEIVER_MASK_CELLS = 512
"""Cells of the mask along each side of a map."""

MAX_LINE_CELLS = 64
"""Number of cells from which on two pixels, one above the other, count as parts of different surfaces."""


def with_relevant_trees(depth_map: DepthMap, buffer: GeometryBuffer, samples_sun_disc: bool) -> DepthMap:
    """Return a map with the indices of the trees that may shade one of its receivers.

    ``samples_sun_disc`` is true if the map is looked up for the sun's disc.
    """
    if depth_map.trees is None or depth_map.tree_bounds is None:
        return depth_map
    return replace(depth_map, relevant_trees=relevant_trees(depth_map, buffer, samples_sun_disc))


def relevant_trees(depth_map: DepthMap, buffer: GeometryBuffer, samples_sun_disc: bool) -> np.ndarray:
    """Return the indices of the trees that a map of the sun has to hold, the nearest to the sun first.

    ``samples_sun_disc`` is true if the map is looked up for the sun's disc.
    """
    assert depth_map.trees is not None and depth_map.tree_bounds is not None
    rotation, translation, low, high = depth_map.tree_bounds
    trees = depth_map.trees
    tree_numbers = trees.in_box(rotation, translation, np.array([low[0], low[1], -np.inf]), high)
    if depth_map.point_indices is not None and depth_map.is_uniform and len(tree_numbers):
        texel_m = np.array(depth_map.uniforms["texel_m"])
        cells = np.maximum((high - low)[:2] / RECEIVER_MASK_CELLS, texel_m)
        farthest = np.full((CORES, RECEIVER_MASK_CELLS + 1, RECEIVER_MASK_CELLS + 1), -np.inf, np.float32)
        parts = np.linspace(0, len(depth_map.point_indices), CORES + 1).astype(np.int64)
        pixel_rows = buffer.valid.shape[0] if buffer.first_sample_row is None else buffer.first_sample_row
        run_in_chunks(
            CORES, _write_farthest_receivers, parts, buffer.position_frame_m.reshape(-1, 3), buffer.valid.reshape(-1),
            buffer.valid.shape[1], pixel_rows, depth_map.point_indices, rotation, translation, cells, farthest,
        )  # fmt: skip
        margin_m = (MAP_BORDER_TEXELS + (MAX_HALF_DISC_TEXELS if samples_sun_disc else 0)) * texel_m
        is_relevant = np.empty(len(tree_numbers), np.bool_)
        run_in_chunks(
            len(tree_numbers), _select_relevant_trees, trees.base_frame_m, trees.quad_sizes_m, tree_numbers, rotation, translation,
            cells, farthest.max(axis=0), margin_m, is_relevant,
        )  # fmt: skip
        tree_numbers = tree_numbers[is_relevant]
    return trees.front_to_back(tree_numbers, rotation[2])


@compiled
def _write_farthest_receivers(
    first,
    last,
    share_starts,
    position,
    valid,
    cols,
    pixel_rows,
    point_indices,
    rotation,
    translation,
    cell_size_m,
    farthest_depth_m,
):
    """Store in each cell of a mask the largest depth of its receivers, as seen from the sun, metres.

    The receivers are the points ``position[point_indices]``, metres in the frame, and lines from these to the points of the pixels
    below them. The first ``pixel_rows`` rows of ``cols`` points each belong to pixels, of which ``valid`` ones show a surface.
    ``rotation`` (3, 3) and ``translation`` (3,) transform points to right, up and depth in the map. A cell has the sides
    ``cell_size_m`` (2,). The receivers are divided into shares, which threads process in parallel: share k holds those from
    ``share_starts[k]`` to before ``share_starts[k + 1]`` and has the mask ``farthest_depth_m[k]`` (rows, cols). This call processes
    the shares [``first``, ``last``).
    """
    rows_of_cells, cols_of_cells = farthest_depth_m.shape[1:]
    last_with_neighbour = (pixel_rows - 1) * cols
    for share in range(first, last):
        share_cells = farthest_depth_m[share]
        for n in range(share_starts[share], share_starts[share + 1]):
            index = point_indices[n]
            right, up, depth = _cells_and_depth(position, index, rotation, translation, cell_size_m)
            r, c = min(max(int(up), 0), rows_of_cells - 1), min(max(int(right), 0), cols_of_cells - 1)
            share_cells[r, c] = max(share_cells[r, c], np.float32(depth))
            if index >= last_with_neighbour or not valid[index + cols]:
                continue
            right_below, up_below, depth_below = _cells_and_depth(position, index + cols, rotation, translation, cell_size_m)
            steps = int(max(abs(right_below - right), abs(up_below - up))) + 1
            if steps == 1 and int(right_below) == c and int(up_below) == r:
                continue
            if steps > MAX_LINE_CELLS:  # from one surface to another
                continue
            farther = np.float32(max(depth, depth_below))
            for k in range(1, 2 * steps + 1):
                along = k / (2 * steps)
                r = min(max(int(up + along * (up_below - up)), 0), rows_of_cells - 1)
                c = min(max(int(right + along * (right_below - right)), 0), cols_of_cells - 1)
                share_cells[r, c] = max(share_cells[r, c], farther)


@internal
def _cells_and_depth(position, index, rotation, translation, cell_size_m):
    """Return a point's place right and up in a map, in cells, and its depth, metres (``_write_farthest_receivers``)."""
    x, y, z = position[index, 0], position[index, 1], position[index, 2]
    right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
    up = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
    depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    return right / cell_size_m[0], up / cell_size_m[1], depth


@compiled
def _select_relevant_trees(
    first, last, base, shape, tree_numbers, rotation, translation, cell_size_m, farthest_depth_m, margin_m, out
):
    """Write to ``out`` (n,) which trees may shade a receiver: those in front of the farthest one in any cell that they cover.

    ``tree_numbers`` (n,) are the trees' indices in ``base`` and ``shape`` (``base_frame_m`` and ``quad_sizes_m`` of
    ``TreeInstances``). Entries of ``out`` in [``first``, ``last``) are written. ``farthest_depth_m`` (rows, cols) holds the largest
    depths of receivers by cell, metres. ``rotation``, ``translation`` and ``cell_size_m`` are those of
    ``_write_farthest_receivers``. ``margin_m`` (2,), right and up, widens each tree by the reach of a look-up.
    """
    rows, cols = farthest_depth_m.shape
    middle = np.empty(3)
    for m in range(first, last):
        n = tree_numbers[m]
        radius = tree_radius(shape[n])
        for k in range(3):
            middle[k] = (
                rotation[k, 0] * base[n, 0] + rotation[k, 1] * base[n, 1] + rotation[k, 2] * (base[n, 2] + 0.5 * shape[n, 2])
                + translation[k]
            )  # fmt: skip
        left = max(int(np.floor((middle[0] - radius - margin_m[0]) / cell_size_m[0])), 0)
        right = min(int(np.floor((middle[0] + radius + margin_m[0]) / cell_size_m[0])), cols - 1)
        low = max(int(np.floor((middle[1] - radius - margin_m[1]) / cell_size_m[1])), 0)
        high = min(int(np.floor((middle[1] + radius + margin_m[1]) / cell_size_m[1])), rows - 1)
        # Points may have been moved a few texels along the rays before their look-up.
        nearest = middle[2] - radius - margin_m[0] - margin_m[1]
        is_relevant = False
        for r in range(low, high + 1):
            for c in range(left, right + 1):
                if farthest_depth_m[r, c] >= nearest:
                    is_relevant = True
                    break
            if is_relevant:
                break
        out[m] = is_relevant
