"""Erode valleys by rivers: uplift and stream-power incision, until the ground drains everywhere.

The equation is dz/dt = U - K A^0.5 S (A drained area, S slope), solved implicitly along the drainage tree: J. Braun and S. D.
Willett (2013), "A very efficient O(n), implicit and parallel method to solve the stream power equation", Geomorphology
180-181:170-179. A priority flood from the rim builds the tree, so no path ends in a pit: R. Barnes et al. (2014), "Priority-flood",
Computers & Geosciences 62:117-127. A constant, ``CHANNEL_HEAD_AREA_SHARE``, is added to A. Where A is smaller, slopes are those of
hillsides.

Main valleys form on a coarse grid, their tributaries on finer ones. Each refinement displaces the ground sideways by noise, so
rivers meander instead of following eight directions.
"""

from __future__ import annotations

import heapq

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.ground.noise import fractal_at
from skugga.terrain.interpolation_loops import cell_interval, lerp_corners

STEPS_BY_GRID = (40, 20, 12, 8, 6)
"""Time steps on the coarsest grid and on each finer one; the last number holds for all further grids."""

TIME_STEP = 0.25
"""Length of a step, in units of the time in which an uplift of 1 raises the ground by its longest side (K is 1)."""

CHANNEL_HEAD_AREA_SHARE = 1e-3
"""Area that drains through a channel's head, as a share of the square of the ground's longest side."""

CREEP_FRACTION = 0.1
"""Soil creep, which rounds crests: the fraction of the way to its neighbours' mean that a cell moves in a step."""

FINAL_CREEP_STEPS = 6
"""Final steps of creep alone: they soften the straight edges of channels cut along eight directions."""

DISPLACEMENT_CELLS, DISPLACEMENT_WAVELENGTH_CELLS = 1.8, 3.1
"""Displacement of the ground at a refinement, and the wavelength of its noise, in cells of the coarser grid."""


def erode(start_height: np.ndarray, uplift_rate: np.ndarray, halvings: int, seed: int) -> np.ndarray:
    """Return ground (rows, cols) float64 that rivers have eroded, in units of its longest side.

    Starts from the heights ``start_height`` and lifts them at the rate ``uplift_rate``, in heights per unit of time. Both are (m,
    n) on the coarsest grid, with at least two nodes a side. Refines the grid ``halvings`` times: n nodes a side become 2 n - 1. The
    rim keeps its height: rivers leave the ground there.
    """
    height, side = start_height.copy(), max(start_height.shape) - 1.0
    for refinement in range(halvings + 1):
        if refinement:
            height, uplift_rate = _refine(height, DISPLACEMENT_CELLS, seed + 2 * refinement), _refine(uplift_rate, 0.0, 0)
            side *= 2.0
        for _ in range(STEPS_BY_GRID[min(refinement, len(STEPS_BY_GRID) - 1)]):
            order, receiver = drainage(height)
            _incise(height, uplift_rate, order, receiver, 1.0 / side)
            _creep(height)
    for _ in range(FINAL_CREEP_STEPS):
        _creep(height)
    return height


@compiled
def drainage(height):
    """Return all cells (n,) in an order that puts each cell after its receiver, and the receiver (n,) of each cell.

    Both are flat indices. The receiver is the neighbour that a cell drains into. Cells of the rim drain into themselves.
    """
    rows, cols = height.shape
    order = np.empty(rows * cols, np.int64)
    receiver = np.full(rows * cols, -1, np.int64)
    is_visited = np.zeros((rows, cols), np.bool_)
    heap = [(height[0, 0], 0)]
    receiver[0] = 0
    for i in range(rows):
        for j in range(cols):
            if (i == 0 or j == 0 or i == rows - 1 or j == cols - 1) and i + j > 0:
                heapq.heappush(heap, (height[i, j], i * cols + j))
                receiver[i * cols + j] = i * cols + j
    count = 0
    while len(heap) > 0:
        spill_height, cell = heapq.heappop(heap)
        i, j = cell // cols, cell % cols
        is_visited[i, j] = True
        order[count] = cell
        count += 1
        steepest = 0.0
        for a in range(max(i - 1, 0), min(i + 2, rows)):
            for b in range(max(j - 1, 0), min(j + 2, cols)):
                neighbour = a * cols + b
                if receiver[neighbour] < 0:
                    receiver[neighbour] = cell
                    heapq.heappush(heap, (max(height[a, b], spill_height), neighbour))
                elif is_visited[a, b] and neighbour != cell and receiver[cell] != cell:
                    drop = (height[i, j] - height[a, b]) / np.sqrt(float((a - i) ** 2 + (b - j) ** 2))
                    if drop > steepest:
                        steepest, receiver[cell] = drop, neighbour
    return order, receiver


@compiled
def _incise(height, uplift, order, receiver, cell):
    """Apply one time step of uplift and incision to ``height`` in place.

    ``order`` and ``receiver`` are those of ``drainage``. ``cell`` is a cell's side as a share of the ground's longest side.
    """
    flat, lift, cols = height.ravel(), uplift.ravel(), height.shape[1]
    area = np.full(flat.shape[0], cell * cell)
    for k in range(order.shape[0] - 1, -1, -1):
        if receiver[order[k]] != order[k]:
            area[receiver[order[k]]] += area[order[k]]
    for k in range(order.shape[0]):
        c, r = order[k], receiver[order[k]]
        if r != c:
            distance = cell * np.sqrt(float((c // cols - r // cols) ** 2 + (c % cols - r % cols) ** 2))
            incision = TIME_STEP * np.sqrt(area[c] + CHANNEL_HEAD_AREA_SHARE) / distance
            flat[c] = (flat[c] + TIME_STEP * lift[c] + incision * flat[r]) / (1.0 + incision)


@compiled
def _creep(height):
    """Move each inner cell of ``height`` (rows, cols) by ``CREEP_FRACTION`` towards its four neighbours' mean, in place."""
    rows, cols = height.shape
    before = height.copy()
    for i in range(1, rows - 1):
        for j in range(1, cols - 1):
            mean = 0.25 * (before[i - 1, j] + before[i + 1, j] + before[i, j - 1] + before[i, j + 1])
            height[i, j] += CREEP_FRACTION * (mean - before[i, j])


@compiled
def _refine(coarse_grid, displacement_cells, seed):
    """Return a grid of (2 m - 1, 2 n - 1) nodes, interpolated bilinearly in (m, n) nodes at positions displaced by noise.

    The rim is not displaced.
    """
    rows, cols = coarse_grid.shape
    fine_grid = np.empty((2 * rows - 1, 2 * cols - 1))
    for i in range(2 * rows - 1):
        for j in range(2 * cols - 1):
            y, x = 0.5 * i, 0.5 * j
            if displacement_cells > 0.0:
                u, v = x / DISPLACEMENT_WAVELENGTH_CELLS, y / DISPLACEMENT_WAVELENGTH_CELLS
                displacement = displacement_cells * min(1.0, 0.25 * min(min(x, y), min(cols - 1 - x, rows - 1 - y)))
                x += displacement * fractal_at(u, v, 2, seed)
                y += displacement * fractal_at(u + 31.7, v + 47.1, 2, seed + 1)
            x, y = min(max(x, 0.0), cols - 1.0), min(max(y, 0.0), rows - 1.0)
            a, b, row_fraction = cell_interval(y, rows)
            c, d, col_fraction = cell_interval(x, cols)
            fine_grid[i, j] = lerp_corners(
                coarse_grid[a, c], coarse_grid[a, d], coarse_grid[b, c], coarse_grid[b, d], row_fraction, col_fraction
            )
    return fine_grid
