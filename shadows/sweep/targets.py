"""The nodes and points of a picture that a sweep evaluates, with their positions on the sun-aligned grid.

``skugga.shadows.sweep.sweep`` sweeps the ground and evaluates them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.sweep.ground_windows import GroundWindow
from skugga.shadows.sweep.rays import SunRays
from skugga.terrain.casters.caster_types import Receivers
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.bare_nodes import BareNodes
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.light_space import light_bounds


@dataclass(frozen=True, eq=False)
class SweepTargets:
    """The nodes and points that a sweep evaluates for a buffer's pixels (rows, cols).

    Attributes
    ----------
    t_range
        Minimum and maximum t (the position across the sweep lines, in cells) of all nodes and points.
    on_node_mask
        bool (rows, cols): pixels that show a node of the grid.
    row_range, col_range
        First row of the nodes on the sun-aligned grid, and the one after the last; columns likewise.
    grid_window
        The same window on the grid before turning, as slices of rows and of columns.
    off_node_mask
        bool (rows, cols): pixels that show a point between nodes or above the ground.
    row, col, t
        (n,): positions of the points of ``off_node_mask`` on the sun-aligned grid, and across the lines.
    ray_height_m
        (n,), metres: ray heights of the points of ``off_node_mask``; NaN for points of the ground.
    """

    t_range: tuple[float, float]
    on_node_mask: np.ndarray
    row_range: tuple[int, int]
    col_range: tuple[int, int]
    grid_window: tuple[slice, slice]
    off_node_mask: np.ndarray
    row: np.ndarray
    col: np.ndarray
    t: np.ndarray
    ray_height_m: np.ndarray


def _t_range(rays: SunRays, receivers: Receivers) -> tuple[float, float]:
    """Return the minimum and maximum t (the position across the sweep lines, in cells) of receivers, extended by one cell."""
    low, high = light_bounds(receivers.position_frame_m, receivers.valid, *rays.light.transform_from_frame(receivers.frame))
    ends = sorted((float(right) - rays.right_origin_m) / rays.right_m_per_cell for right in (low[0], high[0]))
    return ends[0] - 1.0, ends[1] + 1.0


def _node_windows(
    rays: SunRays, ground: GroundWindow, view: MapView
) -> tuple[tuple[int, int], tuple[int, int], tuple[slice, slice]]:
    """Return where a view's nodes lie on the sun-aligned grid, and their window of the ground's grid as slices.

    On the sun-aligned grid these are the first row and the one after the last, and the same of columns.
    """
    top, left = int(view.row0) - ground.row0, int(view.col0) - ground.col0
    return *rays.sun_aligned_window(top, left, (view.rows, view.cols), *ground.shape), (
        slice(top, top + view.rows),
        slice(left, left + view.cols),
    )


def targets_of_nodes(rays: SunRays, ground: GroundWindow, nodes: BareNodes) -> SweepTargets:
    """Return the nodes of bare ground in a map as targets."""
    none, shape = np.zeros(0), (nodes.view.rows, nodes.view.cols)
    all_nodes, no_pixels = (np.broadcast_to(np.bool_(value), shape) for value in (True, False))
    return SweepTargets(
        _t_range(rays, nodes), all_nodes, *_node_windows(rays, ground, nodes.view), no_pixels, none, none, none, none
    )


def targets_of_buffer(rays: SunRays, ground: GroundWindow, buffer: GeometryBuffer) -> SweepTargets:
    """Return the nodes and points at which a buffer's pixels show a surface."""
    view = buffer.view
    on_nodes = isinstance(view, MapView) and view.is_on_nodes
    on_triangles = (
        buffer.surface_kind == RELIEF if buffer.is_lifted is None else (buffer.surface_kind == RELIEF) & ~buffer.is_lifted
    )
    nodes = buffer.valid & on_triangles & on_nodes
    off_nodes = buffer.valid & ~nodes
    rows, cols, window = (0, 0), (0, 0), (slice(0), slice(0))
    pixels = np.flatnonzero(off_nodes)
    t, ray_height_m = rays.ray_coordinates(buffer.position_frame_m, buffer.frame, pixels)
    if isinstance(view, MapView):
        if nodes.any():
            rows, cols, window = _node_windows(rays, ground, view)
        pixel_row_col = np.divmod(pixels, view.cols)
        row, col = view.row0 + pixel_row_col[0] * view.row_step, view.col0 + pixel_row_col[1] * view.col_step
    else:
        row, col = rays.rows_and_columns(buffer.position_frame_m, buffer.frame, pixels)
    row -= ground.row0
    col -= ground.col0
    sun_aligned_row, sun_aligned_col = rays.orientation.to_sun_aligned_in_place(row, col, *ground.shape)
    run_in_chunks(len(pixels), _set_nan, ray_height_m, on_triangles.reshape(-1), pixels)
    return SweepTargets(
        _t_range(rays, buffer), nodes, rows, cols, window, off_nodes, sun_aligned_row, sun_aligned_col, t, ray_height_m
    )


def max_abs_ray_height_m(ray_height: np.ndarray, targets: SweepTargets) -> float:
    """Return the largest absolute ray height of the ground around the points, metres; 0 without points.

    ``ray_height`` (n, m) is that of the sun-aligned grid with its borders. The result determines the rounding of comparisons.
    """
    if not targets.row.size:
        return 0.0
    (i, end_i), (j, end_j) = (
        (max(int(np.floor(index.min())) - 1, 0), max(int(np.ceil(index.max())) + 2, 1))
        for index in (targets.row, targets.col + 1.0)
    )
    return float(np.fmax.reduce(np.abs(ray_height[i:end_i, j:end_j]), axis=None, initial=0.0))


@compiled
def _set_nan(first, last, values, mask, indices):
    """Set ``values[n]`` to NaN for n in [``first``, ``last``) where a mask is true at the flat index ``indices[n]``."""
    for n in range(first, last):
        if mask[indices[n]]:
            values[n] = np.nan
