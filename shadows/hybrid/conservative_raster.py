"""Rasterise triangles and edges conservatively: each texel that they touch stores their depths as runs.

A run is a union of depth intervals that overlap or touch. A texel stores disjoint runs in the order of depth. If it has more than
`MAX_DEPTH_RUNS`, the two farthest merge. A merged run is as correct as two separate ones, only less precise.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

MAX_DEPTH_RUNS = 3
"""Maximum number of runs of a texel."""

TEXEL_MARGIN = 1.0 / 64.0
"""Margin of a texel's square for triangles, in texels. It covers all rounding of coordinates."""

EDGE_MARGIN = 2.0 * TEXEL_MARGIN
"""Margin for edges: a triangle that touches its widened square reaches well into the wider square of its edges."""

EDGE_RUN_LAYERS = 1e9
"""Lower bound of the layers of a run with an edge: its number of layers varies over the texel."""

MAX_THIN_TEXELS = 2.0**-14
"""Largest thickness, in texels, of triangles drawn as their three edges: rounding decides whether they cover a point."""

MAX_THIN_AREA_SHARE = 2.0**-30
"""Largest area of such triangles as a share of the magnitudes of the products whose difference it is."""

LAYER_PROBE = (0.437, 0.613)
"""Point of a texel where layers are counted: inside, off the lattices and diagonals where meshes tend to have edges."""

PROBE_MARGIN = 2.0**-20
"""Distance to the probe, in texels, within which a triangle covers it."""

DEPTH_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
"""Bound of the rounding error of a depth on a triangle's plane, relative to its terms' magnitudes: 16 operations."""


@compiled
def certain_depths(cols, rows, corners, edges):
    """Rasterise triangles and edges, and return the depths at which each texel decides with certainty.

    Parameters
    ----------
    cols, rows
        Size of the map, texels.
    corners
        Triangles (t, 3, 3) float64 in (u, v, depth): u, v in texels, depth linear in them.
    edges
        Edges (e, 2, 3) float64 likewise.

    Returns
    -------
    nearest, nearest_other_depth, shadow_depth
        Depths float64 (rows, cols), infinite if a texel has no such run:

        - the near bound of the first run,
        - the near bound of the second run if the first is whole (without an edge) and of one layer, otherwise of the first,
        - the far bound of the first run that is whole and of one layer or more.
    """
    nearest = np.full((rows, cols), np.inf)
    nearest_other_depth = np.full((rows, cols), np.inf)
    shadow_depth = np.full((rows, cols), np.inf)
    runs = np.empty((rows, cols, MAX_DEPTH_RUNS + 1, 3))  # near bound, far bound, layers
    counts = np.zeros((rows, cols), np.int64)
    for t in range(len(corners)):
        _draw_triangle(runs, counts, corners[t])
    for e in range(len(edges)):
        _draw_edge(runs, counts, edges[e, 0], edges[e, 1])
    for row in range(rows):
        for col in range(cols):
            count, run = counts[row, col], runs[row, col]
            if count > 0:
                nearest[row, col] = nearest_other_depth[row, col] = run[0, 0]
                if run[0, 2] == 1.0:
                    nearest_other_depth[row, col] = run[1, 0] if count > 1 else np.inf
            for k in range(count):
                if 1.0 <= run[k, 2] < EDGE_RUN_LAYERS:
                    shadow_depth[row, col] = run[k, 1]
                    break
    return nearest, nearest_other_depth, shadow_depth


@internal
def _draw_triangle(runs, counts, corners):
    """Add the depth interval of a triangle, ``corners`` (3, 3) in (u, v, depth), to each texel that it touches.

    The interval holds the extremes of the triangle's plane over the texel's square, limited to the extremes of its corners. It
    counts as a layer if the triangle covers the point ``LAYER_PROBE`` of the texel. ``runs`` (rows, cols, ``MAX_DEPTH_RUNS`` + 1,
    3) holds the runs of each texel as near bound, far bound and layers, and ``counts`` (rows, cols) their number. Both are changed
    in place.
    """
    rows, cols = counts.shape
    a, b, c = corners[0], corners[1], corners[2]
    u_min, u_max = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
    v_min, v_max = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
    if u_max < -EDGE_MARGIN or u_min > cols + EDGE_MARGIN or v_max < -EDGE_MARGIN or v_min > rows + EDGE_MARGIN:
        return
    bu, bv, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    cu, cv, cz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    area, terms = bu * cv - bv * cu, abs(bu * cv) + abs(bv * cu)
    longest = np.sqrt(max(bu * bu + bv * bv, cu * cu + cv * cv, (cu - bu) ** 2 + (cv - bv) ** 2))
    if abs(area) <= max(MAX_THIN_TEXELS * longest, MAX_THIN_AREA_SHARE * terms):
        for k in range(3):
            _draw_edge(runs, counts, corners[k], corners[(k + 1) % 3])
        return
    slope_u, slope_v = (bz * cv - cz * bv) / area, (cz * bu - bz * cu) / area
    z_min, z_max = min(a[2], b[2], c[2]), max(a[2], b[2], c[2])
    in_u = (abs(bz * cv) + abs(cz * bv) + abs(slope_u) * terms) / abs(area) * (u_max - u_min + 1.0)
    in_v = (abs(cz * bu) + abs(bz * cu) + abs(slope_v) * terms) / abs(area) * (v_max - v_min + 1.0)
    reach = (abs(slope_u) + abs(slope_v)) * (0.5 + TEXEL_MARGIN)
    error = DEPTH_ROUNDING * (in_u + in_v + max(abs(z_min), abs(z_max)))
    for row in range(*_texel_range(v_min - TEXEL_MARGIN, v_max + TEXEL_MARGIN, rows)):
        low, high = _u_range_of_triangle(corners, row - TEXEL_MARGIN, row + 1.0 + TEXEL_MARGIN)
        if low > high:
            continue
        probe_low, probe_high = _u_range_of_triangle(
            corners, row + LAYER_PROBE[1] - PROBE_MARGIN, row + LAYER_PROBE[1] + PROBE_MARGIN
        )
        for col in range(*_texel_range(low - TEXEL_MARGIN, high + TEXEL_MARGIN, cols)):
            middle = a[2] + slope_u * (col + 0.5 - a[0]) + slope_v * (row + 0.5 - a[1])
            near = max(z_min, middle - reach) - error
            far = max(near, min(z_max, middle + reach) + error)
            covers = probe_low - PROBE_MARGIN <= col + LAYER_PROBE[0] <= probe_high + PROBE_MARGIN
            counts[row, col] = _insert_depth_run(runs[row, col], counts[row, col], near, far, 1.0 if covers else 0.0)


@internal
def _draw_edge(runs, counts, a, b):
    """Add the depth interval of the edge from ``a`` to ``b`` (3,), in (u, v, depth), to each texel that it touches.

    Its run gets ``EDGE_RUN_LAYERS`` layers or more, which tells that the run has an edge. ``runs`` and ``counts`` are those of
    ``_draw_triangle``.
    """
    rows, cols = counts.shape
    v_min, v_max = min(a[1], b[1]), max(a[1], b[1])
    if v_max < -EDGE_MARGIN or v_min > rows + EDGE_MARGIN:
        return
    error = DEPTH_ROUNDING * max(abs(a[2]), abs(b[2]))
    for row in range(*_texel_range(v_min - EDGE_MARGIN, v_max + EDGE_MARGIN, rows)):
        start, stop = _clip_interval(a[1], b[1], row - EDGE_MARGIN, row + 1.0 + EDGE_MARGIN, 0.0, 1.0)
        if start > stop:
            continue
        u_start, u_stop = a[0] + start * (b[0] - a[0]), a[0] + stop * (b[0] - a[0])
        low, high = min(u_start, u_stop), max(u_start, u_stop)
        for col in range(*_texel_range(low - EDGE_MARGIN, high + EDGE_MARGIN, cols)):
            first, last = _clip_interval(a[0], b[0], col - EDGE_MARGIN, col + 1.0 + EDGE_MARGIN, start, stop)
            if first <= last:
                z_first, z_last = a[2] + first * (b[2] - a[2]), a[2] + last * (b[2] - a[2])
                near, far = min(z_first, z_last) - error, max(z_first, z_last) + error
                counts[row, col] = _insert_depth_run(runs[row, col], counts[row, col], near, far, EDGE_RUN_LAYERS)


@internal
def _insert_depth_run(runs, count, near, far, layers):
    """Insert the interval of depths from ``near`` to ``far`` into a texel's runs, and return the new number of runs.

    ``runs`` (``MAX_DEPTH_RUNS`` + 1, 3) holds near bound, far bound and layers of the texel's first ``count`` runs. The interval
    adds ``layers`` layers. It merges with the runs that it overlaps or touches, and their layers add up.
    """
    first = 0
    while first < count and runs[first, 1] < near:
        first += 1
    stop = first
    while stop < count and runs[stop, 0] <= far:
        near, far, layers = min(near, runs[stop, 0]), max(far, runs[stop, 1]), layers + runs[stop, 2]
        stop += 1
    if stop == first:
        for k in range(count, first, -1):
            for i in range(3):
                runs[k, i] = runs[k - 1, i]
    elif stop > first + 1:
        for k in range(stop, count):
            for i in range(3):
                runs[k + first + 1 - stop, i] = runs[k, i]
    count += first + 1 - stop
    runs[first, 0], runs[first, 1], runs[first, 2] = near, far, layers
    if count > MAX_DEPTH_RUNS:
        count = MAX_DEPTH_RUNS
        runs[count - 1, 1] = runs[count, 1]
        runs[count - 1, 2] += runs[count, 2]
    return count


@internal
def _u_range_of_triangle(corners, low, high):
    """Return the minimum and maximum u of the part of a triangle with v in [low, high]; inf and -inf if it is empty.

    The part is convex, so it meets exactly the texels between these bounds in a row of texels from ``low`` to ``high``. ``corners``
    (3, 3) are in (u, v, depth).
    """
    u_min, u_max = np.inf, -np.inf
    for k in range(3):
        n = (k + 1) % 3
        start, stop = _clip_interval(corners[k, 1], corners[n, 1], low, high, 0.0, 1.0)
        if start <= stop:
            edge_u = corners[n, 0] - corners[k, 0]
            u_start, u_stop = corners[k, 0] + start * edge_u, corners[k, 0] + stop * edge_u
            u_min, u_max = min(u_min, u_start, u_stop), max(u_max, u_start, u_stop)
    return u_min, u_max


@internal
def _clip_interval(a, b, low, high, start, stop):
    """Clip the parameter interval [start, stop] of the segment from ``a`` to ``b``, one coordinate each, to low <= value <= high.

    Of the result, start > stop if it is empty.
    """
    if a == b:
        return (start, stop) if low <= a <= high else (1.0, 0.0)
    at_low, at_high = (low - a) / (b - a), (high - a) / (b - a)
    return max(start, min(at_low, at_high)), min(stop, max(at_low, at_high))


@internal
def _texel_range(low, high, size):
    """Return the range (first, last + 1) of the texels, among ``size``, that [low, high] meets."""
    return int(np.floor(max(0.0, min(float(size), low)))), int(np.floor(max(-1.0, min(size - 1.0, high)))) + 1
