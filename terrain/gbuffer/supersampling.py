"""Supersample the pixels of a coarse map: compute shadows on finer nodes and average them in each pixel (a box filter).

Heights that are averaged over a pixel lose the ridges that cast shadows. So where a map's pixels are larger than the raster's cells
(or than the level's ``resolution``, if that is coarser), shadows are computed on finer nodes. Pixels are divided into 2 x 2, 4 x 4,
8 x 8 ... sub-pixels. The division whose sub-pixels are nearest to the data's resolution is chosen, unless it gives a block more
nodes than the maximum.

The nodes are the centres of the sub-pixels. For a tile they are the centres of the pixels of tiles one, two or three zooms deeper.
In maps that are not tiles, the sides of pixels cut through the squares round nodes. A square's weight in a pixel is the share of
the square that lies in the pixel.

The positions of the nodes depend on the level's raster, its anchor and the pixels' size only, so that all tiles share them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

PixelSampling = Literal["means", "points"]
"""How a map's pixels are computed: as means of the nodes that they cover, or at their centres only. The latter serves measurements
of accuracy.
"""

MAX_TERRAIN_ONLY_NODES = 16 * BLOCK_PX**2
"""Maximum number of nodes in a block of tiles whose only casters are smooth ground and whose only light is the sun.

These are 4 x 4 nodes per pixel of a block that is full of ground, and more where ground fills only a part of the block.
"""

MAX_BLOCK_NODES = 4 * BLOCK_PX**2
"""Maximum number of nodes in any other block: with objects on the ground, with lamps, or where a block of sub-pixels is wider than
``MAX_PARALLEL_RAYS_M``.
"""

MAX_PARALLEL_RAYS_M = 150e3
"""Width of a block, metres, above which shadow maps are used. Relative to the curved ground, the sun's rays are not parallel across
wider blocks.
"""

SIDE_TOLERANCE_NODES = 1e-6
"""Tolerance, in nodes, within which a pixel's side coincides with the side of a node's square."""


def is_terrain_only(scene: Scene) -> bool:
    """Return whether a level has only smooth ground, and no light but the sun."""
    smooth = scene.elevation.surface == "smooth"
    return smooth and set(scene.light_names) <= {SUN} and set(scene.objects.caster_kinds) <= {"relief"}


def max_ground_pixels(scene: Scene, view: MapView) -> float:
    """Return an upper bound of the pixels of a map's block that show ground."""
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    return min(BLOCK_PX**2, scene.elevation.rows * scene.elevation.cols * (cell_m / map_pixel_m(scene.world, view)) ** 2)


def subdivision_level(scene: Scene, view: MapView) -> int:
    """Return how many times the sides of a map's pixels are halved, so that they come nearest to the data's resolution.

    The result is 0 if pixels are not divided. It is smaller where a block would have too many nodes.
    """
    pixel_m, cell_m = map_pixel_m(scene.world, view), scene.elevation.cell_size_m(scene.world.metres_per_unit)
    block = max_ground_pixels(scene, view)
    count = max(int(np.rint(np.log2(pixel_m / max(cell_m, scene.elevation.resolution_m or 0.0)))), 0)
    while count > 0:
        is_narrow = scene.world.is_flat or BLOCK_PX * pixel_m / 2**count <= MAX_PARALLEL_RAYS_M
        if 4.0**count * block <= (MAX_TERRAIN_ONLY_NODES if is_narrow and is_terrain_only(scene) else MAX_BLOCK_NODES):
            break
        count -= 1
    return count


def subpixel_grid(view: MapView, halvings: int) -> Grid:
    """Return the grid whose nodes are the centres of a map's sub-pixels, after the pixels' sides are halved ``halvings`` times."""
    view_halvings = np.log2(np.sqrt(view.row_step * view.col_step))  # a view's pixels may be larger than its grid's step
    return view.grid.subdivided(max(int(np.rint(halvings - view_halvings)), 0))


def covered_nodes(view: MapView, grid: Grid) -> MapView:
    """Return the view whose pixels are the nodes of a finer grid that a map's pixels cover."""
    ends = []
    for sides in _pixel_sides(view, grid):
        first, last = int(np.floor(sides[0] + SIDE_TOLERANCE_NODES)), int(np.ceil(sides[-1] - SIDE_TOLERANCE_NODES))
        ends.append((first, last - first))
    (row0, rows), (col0, cols) = ends
    return MapView(grid, float(row0), float(col0), 1.0, 1.0, rows, cols)


def supersampled_view(
    scene: Scene, view: MapView | PerspectiveView, pixel_sampling: PixelSampling = "means"
) -> MapView | PerspectiveView:
    """Return the view at whose pixels the lights' visibility is computed for a view.

    For a coarse map its pixels are the finer nodes that the map covers. Otherwise it is ``view`` itself, also if ``pixel_sampling``
    is ``points``.
    """
    count = subdivision_level(scene, view) if isinstance(view, MapView) and pixel_sampling == "means" else 0
    return covered_nodes(view, subpixel_grid(view, count)) if isinstance(view, MapView) and count else view


def _pixel_sides(view: MapView, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the sides of a map's pixels on a finer grid: rows (rows + 1,) and columns (cols + 1,).

    They count squares round nodes: the square of node n extends from n to n + 1. Nodes of the map's own grid are nodes of the finer
    grid, or lie half-way between two of them.
    """
    steps = float(np.rint(view.grid.step / grid.step))
    offsets = (view.grid.y0 - grid.y0) / (grid.step * grid.y_to_x_step_ratio), (grid.x0 - view.grid.x0) / grid.step
    axes = (view.row0, view.row_step, view.rows), (view.col0, view.col_step, view.cols)
    row, col = (
        (first + (np.arange(count + 1) - 0.5) * step) * steps - np.rint(2.0 * offset) / 2.0 + 0.5
        for (first, step, count), offset in zip(axes, offsets, strict=True)
    )
    return row, col


def means_in_pixels(view: MapView, nodes: MapView, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the mean of the values at the valid nodes that each pixel covers, float32 (rows, cols); NaN without valid nodes.

    ``nodes`` is the view of the nodes (``covered_nodes``). ``values`` and ``valid`` have its shape.
    """
    row, col = _sides_in(view, nodes)
    if values.dtype == np.bool_ and (row_weights := _uniform_weights(row)) and (col_weights := _uniform_weights(col)):
        return _means_of_bool(values, valid, *row_weights, *col_weights, view.rows, view.cols)
    return _means(values, valid, row, col)


def _uniform_weights(sides: np.ndarray) -> tuple[int, np.ndarray] | None:
    """Return the weights of the node squares in a pixel along one axis, if they are the same for all pixels; else ``None``.

    The first value is the number of squares from one pixel to the next. The second one (n,) int64 is twice the share of each square
    that the first pixel covers, from square 0 on. ``sides`` are those of ``_sides_in``.
    """
    step = int(np.rint(sides[1] - sides[0]))
    if (
        np.abs(np.diff(sides) - step).max() > SIDE_TOLERANCE_NODES
        or abs(sides[0] * 2.0 - np.rint(sides[0] * 2.0)) > SIDE_TOLERANCE_NODES
    ):
        return None
    first, halves = int(np.rint(sides[0] * 2.0)), np.arange(int(np.rint(sides[1] * 2.0)))
    return step, np.bincount(halves[first:] // 2).astype(np.int64)


def max_in_pixels(view: MapView, nodes: MapView, values: np.ndarray) -> np.ndarray:
    """Return the maximum of the values at the nodes that each pixel covers, (rows, cols). Values must be 0 or more."""
    return _max_values(values, *_sides_in(view, nodes))


def _sides_in(view: MapView, nodes: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (rows + 1,) and the columns (cols + 1,) of the sides of a map's pixels on the nodes of the view ``nodes``.

    They are those of ``_pixel_sides``, counted from the first row and column of ``nodes``.
    """
    row, col = _pixel_sides(view, nodes.grid)
    return row - nodes.row0, col - nodes.col0


@internal
def _square_range(sides, i):
    """Return the first square that pixel ``i`` covers along an axis, and the exclusive end. ``sides`` bound the pixels."""
    return int(np.floor(sides[i] + SIDE_TOLERANCE_NODES)), int(np.ceil(sides[i + 1] - SIDE_TOLERANCE_NODES))


@internal
def _overlap(sides, i, n):
    """Return the share of square ``n`` that pixel ``i`` covers along an axis; exactly 1 if it covers all of it up to rounding."""
    share = min(sides[i + 1], n + 1.0) - max(sides[i], np.float64(n))
    return 1.0 if share > 1.0 - SIDE_TOLERANCE_NODES else share


@compiled
def _means(values, valid, row, col):
    """Return the result of ``means_in_pixels``. ``row`` and ``col`` are the positions of the pixels' sides (``_sides_in``).

    The mean weights each node by the area of its square that the pixel covers.
    """
    rows, cols = row.size - 1, col.size - 1
    out = np.full((rows, cols), np.nan, np.float32)
    for i in range(rows):
        first_r, end_r = _square_range(row, i)
        for j in range(cols):
            first_c, end_c = _square_range(col, j)
            total_weight, total = 0.0, 0.0
            for r in range(first_r, end_r):
                down = _overlap(row, i, r)
                for c in range(first_c, end_c):
                    if valid[r, c]:
                        weight = down * _overlap(col, j, c)
                        total_weight += weight
                        total += weight * values[r, c]
            if total_weight > 0.0:
                out[i, j] = total / total_weight
    return out


@compiled
def _means_of_bool(values, valid, row_step, row_weights, col_step, col_weights, rows, cols):
    """Return the result of ``_means`` for bool values, in integer arithmetic.

    All pixels have the same weights. ``row_step`` and ``row_weights``, ``col_step`` and ``col_weights`` are those of
    ``_uniform_weights``.
    """
    out = np.empty((rows, cols), np.float32)
    node_cols = valid.shape[1]
    down_weight, right_weight = 0, 0
    for k in range(row_weights.size):
        down_weight += row_weights[k]
    for k in range(col_weights.size):
        right_weight += col_weights[k]
    full_weight = down_weight * right_weight
    quotients = np.empty(full_weight + 1, np.float32)  # the means of pixels whose nodes are all valid
    for n in range(full_weight + 1):
        quotients[n] = np.float64(n) / np.float64(full_weight)
    valid_weight, total = np.empty(node_cols, np.int32), np.empty(node_cols, np.int32)  # sums down a row of pixels
    pixel_valid_weight, pixel_total = (
        np.empty(node_cols, np.int32),
        np.empty(node_cols, np.int32),
    )  # sums of the pixel that begins at each square
    for i in range(rows):
        total[:] = 0
        row_is_valid = True
        for k in range(row_weights.size):
            if row_weights[k] > 0:
                row_is_valid = _is_all_valid(valid[i * row_step + k]) and row_is_valid
        if row_is_valid:
            for k in range(row_weights.size):
                if row_weights[k] > 0:
                    _add_weighted(values[i * row_step + k], np.int32(row_weights[k]), total)
            _sum_along(total, col_weights, pixel_total)
            for j in range(cols):
                out[i, j] = quotients[pixel_total[j * col_step]]
            continue
        valid_weight[:] = 0
        for k in range(row_weights.size):
            if row_weights[k] > 0:
                _add_weighted(valid[i * row_step + k], np.int32(row_weights[k]), valid_weight)
                _add_weighted(valid[i * row_step + k] & values[i * row_step + k], np.int32(row_weights[k]), total)
        _sum_along(valid_weight, col_weights, pixel_valid_weight)
        _sum_along(total, col_weights, pixel_total)
        for j in range(cols):
            pixel_weight = pixel_valid_weight[j * col_step]
            out[i, j] = np.float64(pixel_total[j * col_step]) / np.float64(pixel_weight) if pixel_weight > 0 else np.nan
    return out


@internal
def _is_all_valid(valid):
    """Return whether all elements of a row (n,) of a mask are ``True``. The loop has no early exit, so that it is vectorised."""
    missing = 0
    for n in range(valid.size):
        missing += 0 if valid[n] else 1
    return missing == 0


@internal
def _add_weighted(values, weight, out):
    """Add the product of the integer ``weight`` and the bool ``values`` (n,) to ``out`` (n,), in place."""
    for n in range(out.size):
        out[n] += weight * np.int32(values[n])


@internal
def _sum_along(values, weights, out):
    """Write the weighted sum of each value and the ``weights.size`` - 1 values after it to ``out``.

    The last elements of ``out``, where too few values follow for a sum, do not change.
    """
    count = values.size - weights.size + 1
    for k in range(weights.size):
        weight, window, sums = np.int32(weights[k]), values[k : k + count], out[:count]
        if k == 0:
            for n in range(count):
                sums[n] = weight * window[n]
        elif weight > 0:
            for n in range(count):
                sums[n] += weight * window[n]


@compiled
def _max_values(values, row, col):
    """Return the result of ``max_in_pixels``. ``row`` and ``col`` are the positions of the pixels' sides (``_sides_in``)."""
    rows, cols = row.size - 1, col.size - 1
    out = np.zeros((rows, cols), values.dtype)
    for i in range(rows):
        first_r, end_r = _square_range(row, i)
        for j in range(cols):
            first_c, end_c = _square_range(col, j)
            for r in range(first_r, end_r):
                for c in range(first_c, end_c):
                    out[i, j] = max(out[i, j], values[r, c])
    return out
