"""The compiled loops that march rays over a heightfield: the horizon of every node towards one azimuth.

**Space.** ``skugga.shadows.sweep.orientation`` turns the grid: rays run towards row 0, and move by 0 to 1 columns to the right per
row. So the ray of each node crosses row after row at the same position within a cell. A *run* is ``RUN`` nodes side by side. Their
rays are processed at once with vector instructions, without gathers and branches, and each on its own line: nothing is interpolated
between lines.

**Samples.** Between two crossings of edges the ground is straight along a ray, so the horizon is the steepest of the slopes from
the node to the crossings. Crossings of rows always count. Those of columns and of both diagonals of each quad (the lower one lies
below the surface, ``skugga.terrain.ground.sheet``) count where the ground is so rough, or so near, that leaving them out could
change the angle by more than ``MAX_CHORD_ERROR``.

**Skipped ground.** The grid is divided into blocks of ``BLOCK_ROWS`` rows and ``BLOCK_COLS`` columns, and eight of them into a tall
block. A block is skipped where its highest node is below the horizons that the run's nodes have so far. So distance is nearly free,
and the result is that of all ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal

RUN = 64
"""Nodes side by side that are processed at once."""

BLOCK_BITS, TALL_BLOCK_BITS = 3, 6
"""Binary logarithms of the rows of a block and of a tall block."""

BLOCK_COLS = 32
"""Columns of a block."""

BLOCK_ROWS, TALL_BLOCK_ROWS = 1 << BLOCK_BITS, 1 << TALL_BLOCK_BITS
"""Rows of a block and of a tall block."""

TESTED_ROWS = 4
"""Rows before a node that are never skipped."""

NO_GROUND_M = np.float32(-1e30)
"""Height of nodes without ground."""

NO_EYE_M = np.float32(3e38)
"""Height of an eye that does not exist: no ground rises above it, so it keeps no ground from being skipped."""

NO_HORIZON = np.float32(-1e30)
"""Tangent of a horizon without any ground."""

NO_GROUND_TANGENT = np.float32(-1e15)
"""Tangents below this one are of horizons without ground, also where a ray passes beside the last node."""

RUN_U, ONE_U = np.uint64(RUN), np.uint64(1)


class Ground(NamedTuple):
    """The ground that rays cross, turned for an orientation.

    Attributes
    ----------
    height_m
        float32 (n, width), metres above a common level, ``NO_GROUND_M`` without ground. Two runs of columns
        beyond those of the nodes are without ground: rays end there, and eyes may stand there.
    flat_height_m
        The same values (n * width,).
    highest_m, highest_tall_m
        float32, the highest node of each block and of each tall block, and of one more row towards the nodes that look at it.
    roughness_m
        float32, for each block: how far its ground may rise above a ray between two crossings of rows, if the ray keeps to its
        column (``write_blocks``).
    """

    height_m: np.ndarray
    flat_height_m: np.ndarray
    highest_m: np.ndarray
    highest_tall_m: np.ndarray
    roughness_m: np.ndarray


class Rays(NamedTuple):
    """The rays of one azimuth: where they cross rows, and the edges between two rows. Index k counts rows from the node.

    Attributes
    ----------
    column
        int64 (k,), the column before the crossing of each row, relative to the node.
    row_terms
        float32 (k, 4): the factors of the heights at that column and at the next one, the fall of the level by curvature over the
        distance, and 1 over the distance. The slope is their sum of products (``_row_slopes``).
    fall_m, distance_m
        float32 (k,), metres: the fall of the level by curvature, and the distance.
    columns_per_row
        Columns by which the rays move to the right in each row, 0 to 1.
    edge_start
        int64 (k + 1,): where the crossings of edges between row k - 1 and row k begin in ``edge_columns``.
    edge_row
        int64 (edges,): k, the row behind each crossing of an edge.
    edge_columns
        int64 (edges, 2): the columns of the edge's ends in row k - 1 and in row k.
    edge_terms
        float32 (edges, 4), as ``row_terms`` for these two ends.
    """

    column: np.ndarray
    row_terms: np.ndarray
    fall_m: np.ndarray
    distance_m: np.ndarray
    columns_per_row: np.float32
    edge_start: np.ndarray
    edge_row: np.ndarray
    edge_columns: np.ndarray
    edge_terms: np.ndarray


@internal
def _four_row_slopes(height, at_0, at_1, at_2, at_3, terms, k, state):
    """Raise the horizons of a run by the crossings of four rows.

    ``height`` (flat) has the first node's values of each row at ``at_0`` to ``at_3``. ``state`` holds the run's tangents, then its
    heights.
    """
    a_0, b_0, fall_0, near_0 = terms[k, 0], terms[k, 1], terms[k, 2], terms[k, 3]
    a_1, b_1, fall_1, near_1 = terms[k + 1, 0], terms[k + 1, 1], terms[k + 1, 2], terms[k + 1, 3]
    a_2, b_2, fall_2, near_2 = terms[k + 2, 0], terms[k + 2, 1], terms[k + 2, 2], terms[k + 2, 3]
    a_3, b_3, fall_3, near_3 = terms[k + 3, 0], terms[k + 3, 1], terms[k + 3, 2], terms[k + 3, 3]
    for number in range(RUN):
        c = np.uint64(number)
        own = state[RUN_U + c]
        slope_0 = height[at_0 + c] * a_0 + height[at_0 + c + ONE_U] * b_0 - (own * near_0 + fall_0)
        slope_1 = height[at_1 + c] * a_1 + height[at_1 + c + ONE_U] * b_1 - (own * near_1 + fall_1)
        slope_2 = height[at_2 + c] * a_2 + height[at_2 + c + ONE_U] * b_2 - (own * near_2 + fall_2)
        slope_3 = height[at_3 + c] * a_3 + height[at_3 + c + ONE_U] * b_3 - (own * near_3 + fall_3)
        slope_0 = slope_0 if slope_0 > slope_1 else slope_1
        slope_2 = slope_2 if slope_2 > slope_3 else slope_3
        slope_0 = slope_0 if slope_0 > slope_2 else slope_2
        tangent = state[c]
        state[c] = slope_0 if slope_0 > tangent else tangent


@internal
def _four_edge_slopes(height, a_0, b_0, a_1, b_1, a_2, b_2, a_3, b_3, terms, k, state):
    """Raise the horizons of a run by four crossings of edges, between the heights at ``a_0`` and at ``b_0``, and so on."""
    near_a_0, near_b_0, fall_0, near_0 = terms[k, 0], terms[k, 1], terms[k, 2], terms[k, 3]
    near_a_1, near_b_1, fall_1, near_1 = terms[k + 1, 0], terms[k + 1, 1], terms[k + 1, 2], terms[k + 1, 3]
    near_a_2, near_b_2, fall_2, near_2 = terms[k + 2, 0], terms[k + 2, 1], terms[k + 2, 2], terms[k + 2, 3]
    near_a_3, near_b_3, fall_3, near_3 = terms[k + 3, 0], terms[k + 3, 1], terms[k + 3, 2], terms[k + 3, 3]
    for number in range(RUN):
        c = np.uint64(number)
        own = state[RUN_U + c]
        slope_0 = height[a_0 + c] * near_a_0 + height[b_0 + c] * near_b_0 - (own * near_0 + fall_0)
        slope_1 = height[a_1 + c] * near_a_1 + height[b_1 + c] * near_b_1 - (own * near_1 + fall_1)
        slope_2 = height[a_2 + c] * near_a_2 + height[b_2 + c] * near_b_2 - (own * near_2 + fall_2)
        slope_3 = height[a_3 + c] * near_a_3 + height[b_3 + c] * near_b_3 - (own * near_3 + fall_3)
        slope_0 = slope_0 if slope_0 > slope_1 else slope_1
        slope_2 = slope_2 if slope_2 > slope_3 else slope_3
        slope_0 = slope_0 if slope_0 > slope_2 else slope_2
        tangent = state[c]
        state[c] = slope_0 if slope_0 > tangent else tangent


@internal
def _edge_slopes(height, at_a, at_b, a, b, fall, near, state):
    """Raise the horizons of a run by one crossing, between the heights at ``at_a`` and at ``at_b``, with the terms of ``Rays``."""
    for number in range(RUN):
        c = np.uint64(number)
        slope = height[at_a + c] * a + height[at_b + c] * b - (state[RUN_U + c] * near + fall)
        tangent = state[c]
        state[c] = slope if slope > tangent else tangent


@internal
def _may_rise(top_m, nearest_m, farthest_m, state):
    """Return whether ground no higher than ``top_m`` between two distances can raise the horizon of any node of a run."""
    found = np.int32(0)
    for number in range(RUN):
        c = np.uint64(number)
        rise, tangent = top_m - state[RUN_U + c], state[c]
        found |= np.int32(max(rise - tangent * nearest_m, rise - tangent * farthest_m) > 0)
    return found != 0


@internal
def _largest(values, row, first_column, last_column):
    """Return the largest value of a row of blocks between two columns, of those that the grid has."""
    first_block = max(first_column, 0) // BLOCK_COLS
    out = values[row, first_block]
    for block in range(first_block + 1, min(last_column // BLOCK_COLS + 1, values.shape[1])):
        out = max(out, values[row, block])
    return out


@compiled
def march(first, last, ground, rays, eye_height_m, eye_row, eye_col, max_chord_error, out):
    """Raise the tangents of the horizons of eyes in rows [first, last) of ``out``, float32 (n, runs * ``RUN``).

    ``ground`` and ``rays`` are a ``Ground`` and ``Rays``. ``eye_height_m`` has the heights of the eyes, as ``out``; their first
    node is node (``eye_row``, ``eye_col``) of the ground. ``max_chord_error`` is the largest tangent of an angle that may be lost
    between two crossings of rows.
    """
    state = np.empty(2 * RUN, np.float32)
    for out_col in range(0, out.shape[1], RUN):
        for out_row in range(first, last):
            state[:RUN] = out[out_row, out_col : out_col + RUN]
            state[RUN:] = eye_height_m[out_row, out_col : out_col + RUN]
            march_run(ground, rays, eye_row + out_row, eye_col + out_col, max_chord_error, state)
            out[out_row, out_col : out_col + RUN] = state[:RUN]


@internal
def march_run(ground, rays, row, col, max_chord_error, state):
    """Raise the tangents of the horizons of a run of eyes, whose first node is node (``row``, ``col``) of the ground.

    ``state`` float32 (2 * ``RUN``) holds the run's tangents, then the heights of its eyes. The other parameters are those of
    ``march``.
    """
    width = ground.height_m.shape[1]
    last_column = width - 2 * RUN - 1
    flat, highest_m, highest_tall_m, roughness_m = ground.flat_height_m, ground.highest_m, ground.highest_tall_m, ground.roughness_m
    max_error = max_chord_error / (np.float32(1.0) + rays.columns_per_row)
    terms, column, fall_m, distance_m = rays.row_terms, rays.column, rays.fall_m, rays.distance_m
    k = tall_begin = 1
    while k <= row and col + column[k] <= last_column:
        first_column, nearest_m = col + column[k] - 1, distance_m[k - 1]
        if k == tall_begin:
            end = k + ((row - k) & (TALL_BLOCK_ROWS - 1))
            tall_begin = end + 1
            top_m = _largest(highest_tall_m, (row - k) >> TALL_BLOCK_BITS, first_column, col + column[end] + 1 + RUN)
            if k > TESTED_ROWS and not _may_rise(top_m - fall_m[k], nearest_m, distance_m[end], state):
                k = tall_begin
                continue
        block_row, end = (row - k) >> BLOCK_BITS, k + ((row - k) & (BLOCK_ROWS - 1))
        begin, is_near, next_column = k, k <= TESTED_ROWS, col + column[end] + 1 + RUN
        top_m = _largest(highest_m, block_row, first_column, next_column) - fall_m[k]
        if not is_near and not _may_rise(top_m, nearest_m, distance_m[end], state):
            k = end + 1
            continue
        while k + 3 <= end:
            at = (row - k) * width + col
            at_1, at_2, at_3 = at - width + column[k + 1], at - 2 * width + column[k + 2], at - 3 * width + column[k + 3]
            _four_row_slopes(flat, np.uint64(at + column[k]), np.uint64(at_1), np.uint64(at_2), np.uint64(at_3), terms, k, state)
            k += 4
        while k <= end:
            at_row = np.uint64((row - k) * width + col + column[k])
            _edge_slopes(flat, at_row, at_row + ONE_U, terms[k, 0], terms[k, 1], terms[k, 2], terms[k, 3], state)
            k += 1
        is_rough = _largest(roughness_m, block_row, first_column, next_column) > max_error * nearest_m
        if is_near or (is_rough and _may_rise(top_m, nearest_m, distance_m[end], state)):
            _all_edge_slopes(flat, width, row, col, begin, end, rays, state)


@internal
def _all_edge_slopes(flat, width, row, col, begin, end, rays, state):
    """Raise the horizons of a run by all crossings of edges between row ``begin - 1`` and row ``end`` before it."""
    ends, terms = rays.edge_columns, rays.edge_terms
    edge, last = rays.edge_start[begin], rays.edge_start[end + 1]
    while edge + 3 < last:
        at_0, at_1 = (row - rays.edge_row[edge]) * width + col, (row - rays.edge_row[edge + 1]) * width + col
        at_2, at_3 = (row - rays.edge_row[edge + 2]) * width + col, (row - rays.edge_row[edge + 3]) * width + col
        _four_edge_slopes(
            flat, np.uint64(at_0 + width + ends[edge, 0]), np.uint64(at_0 + ends[edge, 1]),
            np.uint64(at_1 + width + ends[edge + 1, 0]), np.uint64(at_1 + ends[edge + 1, 1]),
            np.uint64(at_2 + width + ends[edge + 2, 0]), np.uint64(at_2 + ends[edge + 2, 1]),
            np.uint64(at_3 + width + ends[edge + 3, 0]), np.uint64(at_3 + ends[edge + 3, 1]), terms, edge, state,
        )  # fmt: skip
        edge += 4
    while edge < last:
        at = (row - rays.edge_row[edge]) * width + col
        _edge_slopes(
            flat, np.uint64(at + width + ends[edge, 0]), np.uint64(at + ends[edge, 1]), terms[edge, 0], terms[edge, 1],
            terms[edge, 2], terms[edge, 3], state,
        )  # fmt: skip
        edge += 1


@compiled
def write_turned(first, last, values, level_m, missing, out):
    """Write rows [first, last) of heights (n, m) above ``level_m`` to ``out``, and ``missing`` for heights that are not finite.

    It goes by squares of 64 nodes, so that both arrays stay in the processor's cache where one is stored by columns.
    """
    for row_begin in range(first, last, 64):
        for col_begin in range(0, values.shape[1], 64):
            for row in range(row_begin, min(row_begin + 64, last)):
                for col in range(col_begin, min(col_begin + 64, values.shape[1])):
                    height = values[row, col] - level_m
                    out[row, col] = height if abs(height) < np.float32(1e30) else missing


@compiled
def write_blocks(first, last, height_m, highest_m, roughness_m):
    """Write the highest node and the roughness of blocks, rows [first, last) of blocks (``Ground``).

    A ray that moves by t columns from row to row is at most (1 + t) / 4 of a quad's twist below the ground between the two, and
    t / 4 of the bend of a row where it crosses a column. The roughness is a bound of both for t = 0; ``march`` multiplies by 1 + t.
    """
    n, width = height_m.shape
    for block_row in range(first, last):
        begin, end = block_row * BLOCK_ROWS, min((block_row + 1) * BLOCK_ROWS, n - 1)
        highest_m[block_row] = NO_GROUND_M
        roughness_m[block_row] = 0.0
        for row in range(begin, min(end + 1, n)):
            for col in range(width):
                block = col // BLOCK_COLS
                highest_m[block_row, block] = max(highest_m[block_row, block], height_m[row, col])
                if row < end and 0 < col < width - 1:
                    near, far = height_m[row, col], height_m[row + 1, col]
                    right, far_right, left = height_m[row, col + 1], height_m[row + 1, col + 1], height_m[row, col - 1]
                    if min(min(near, far), min(right, min(far_right, left))) > NO_GROUND_M:
                        twist, bend = abs(near + far_right - right - far), abs(left - 2.0 * near + right)
                        rough = np.float32(0.25 * twist + 0.125 * bend)
                        roughness_m[block_row, block] = max(roughness_m[block_row, block], rough)
