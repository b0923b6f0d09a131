"""Measure how much the rows of a grid differ in width across the sun's rays.

Lines that cross the rows of a grid follow the sun's rays well if neighbouring rows have nearly the same width. In a CRS in degrees,
the rows near a pole become ever narrower.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.overview_cells import overview_on_grid
from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView
from skugga.terrain.scene import Scene

MAX_ROW_WIDTH_RATIO = 1e9
"""Value of ``row_width_ratio`` for rows that fold or have no width. It is finite because descriptors cannot hold infinity."""

NodeSpan = tuple[float, float]
"""First and last node along an axis of a grid."""

WINDOW_SAMPLES_PER_SIDE = 17
"""Samples along each side of a window."""


def row_width_ratio(scene: Scene, grid: Grid, view: MapView | None = None) -> float:
    """Return the largest ratio of the widths, across the sun's rays, of two rows in a window of a grid that is drawn at once.

    The windows are the outermost blocks and the middle block of a map ``view`` over the level, extended by the level's longest
    shadow. Without a view, the only window is the level. Rows are columns if the sun's rays run more along rows. The result is 1
    without a sun and in a flat world.
    """
    if scene.light_space is None or scene.world.is_flat:
        return 1.0
    row, col, _ = overview_on_grid(scene.world, scene.elevation, grid)
    valid = np.isfinite(row) & np.isfinite(col)
    if not valid.any():
        return 1.0
    level_rows, level_cols = ((float(nodes[valid].min()), float(nodes[valid].max())) for nodes in (row, col))
    windows = [
        (rows, cols)
        for rows in _outer_and_middle_block_spans(level_rows, view)
        for cols in _outer_and_middle_block_spans(level_cols, view)
    ]
    return max(_width_ratio(scene, grid, window, (level_rows, level_cols)) for window in windows)


def _outer_and_middle_block_spans(level_span: NodeSpan, view: MapView | None) -> list[NodeSpan]:
    """Return the spans of the outermost blocks and of the middle block over a level, along one axis."""
    low, high = level_span
    if view is None or (not view.is_on_nodes and high - low < BLOCK_PX):
        return [level_span]
    if not view.is_on_nodes:  # blocks start anywhere
        return [(low, low + BLOCK_PX), (high - BLOCK_PX, high)]
    blocks = {np.floor(node / BLOCK_PX) for node in (low, (low + high) / 2.0, high)}
    return [(block * BLOCK_PX, (block + 1.0) * BLOCK_PX - 1.0) for block in sorted(blocks)]


def _width_ratio(scene: Scene, grid: Grid, window: tuple[NodeSpan, NodeSpan], level: tuple[NodeSpan, NodeSpan]) -> float:
    """Return the ratio of the widest to the narrowest row of a window (rows, columns), across the sun's rays."""
    assert scene.light_space is not None
    middle = [(low + high) / 2.0 for low, high in window]
    point_m = _earth_points(scene, grid, (middle[0], middle[0] + 1.0), (middle[1], middle[1] + 1.0), 2)
    across_m = scene.light_space.points_from_earth(point_m)[..., 0]
    ray_axis = 0 if abs(across_m[0, 1] - across_m[0, 0]) >= abs(across_m[1, 0] - across_m[0, 0]) else 1
    node_m = float(np.linalg.norm((point_m[1, 0] if ray_axis == 0 else point_m[0, 1]) - point_m[0, 0]))
    tallest_m = float(np.ptp(scene.height_range_m)) + scene.objects.tallest_object_m
    shadow_nodes = longest_shadow_m(tallest_m, scene.light_space.altitude_deg) / max(node_m, 1e-6)
    spans, (low, high) = list(window), level[ray_axis]
    first, last = window[ray_axis]
    spans[ray_axis] = min(first, max(first - shadow_nodes, low)), max(last, min(last + shadow_nodes, high))
    steps = np.diff(
        scene.light_space.points_from_earth(_earth_points(scene, grid, spans[0], spans[1], WINDOW_SAMPLES_PER_SIDE))[..., 0],
        axis=1 - ray_axis,
    )
    if not ((steps > 0.0).all() or (steps < 0.0).all()):
        return MAX_ROW_WIDTH_RATIO
    widths = np.abs(steps.sum(axis=1 - ray_axis))
    return min(float(widths.max() / widths.min()), MAX_ROW_WIDTH_RATIO)


def _earth_points(scene: Scene, grid: Grid, rows: NodeSpan, cols: NodeSpan, samples: int) -> np.ndarray:
    """Return points (samples, samples, 3) of the earth's surface on evenly spaced rows and columns of a grid."""
    row, col = np.meshgrid(np.linspace(*rows, samples), np.linspace(*cols, samples), indexing="ij")
    return scene.world.points_at_zero_height(grid.crs, grid.x(col), grid.y(row))[0]
