"""The ground between the sun and a view, as windows of a sun-aligned grid: one for each level of detail."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from skugga.shadows.sweep.grid import HIGHER_DIAGONALS, allocate_bordered_grid, close_border
from skugga.shadows.sweep.lines import SunAlignedGrid
from skugga.shadows.sweep.rays import SunRays, rays_at
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_nodes
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import HeightWindow, NodeHeights
from skugga.terrain.scene import Scene

RAY_DIRECTION_TOLERANCE = 0.05
"""Tolerance in columns per row for the direction of rays.

On the round earth, rays that shift to the right at one position of a grid may shift to the left at another one, by at most this.
"""


@dataclass(frozen=True, eq=False)
class GroundWindow:
    """A window (rows, cols) of a grid at one level of detail, turned for the sweep.

    Attributes
    ----------
    lod
        Level of detail: every 2**lod-th node of the finest grid.
    row0, col0
        Row and column of the window's first node, on the grid at this level of detail.
    shape
        Rows and columns of the window before turning.
    sun_aligned_grid
        The ray heights on the sun-aligned grid, and the positions of its lines.
    first_ground_row
        First sun-aligned row that may hold ground.
    """

    lod: int
    row0: int
    col0: int
    shape: tuple[int, int]
    sun_aligned_grid: SunAlignedGrid
    first_ground_row: int = 0


def grounds_of_block(
    rays: SunRays, block: NodeHeights, patches: Iterable[Patch], culled: Collection[Patch] = ()
) -> list[GroundWindow]:
    """Return the ground that casts shadows on a map's block, by level of detail: the coarsest first, the block's own last.

    The heights of ``culled`` patches are not read, since they cast no shadow on the block.
    """
    patches = [patch for patch in patches if not (patch.lod and lies_behind(rays, patch, block))]
    grounds: list[GroundWindow] = []
    for lod in sorted({0, *(patch.lod for patch in patches)}, reverse=True):
        surface = rays.scene.surface(rays.grid.coarser(lod))
        patches_of_lod = [patch for patch in patches if patch.lod == lod]
        casting = [patch for patch in patches_of_lod if patch not in culled and not lies_behind(rays, patch, block)]
        windows = [surface.height_window(*window, includes_rim=True) for window in patch_windows(casting)]
        if lod and not windows and not grounds:
            continue  # no ray heights to pass on
        grounds.append(_ground_window(rays, lod, windows if lod else [block, *windows], patches_of_lod))
    return grounds


def patch_windows(patches: list[Patch]) -> list[tuple[int, int, int, int]]:
    """Return windows of nodes that cover exactly some patches, each as first row, first column, number of rows and of columns.

    Adjacent patches that form a rectangle are merged into one window.
    """
    runs: dict[tuple[int, int], list[int]] = {}  # first and last column of adjacent patches -> first and last row with them
    windows = []
    rows: dict[int, list[int]] = {}
    for row, col in sorted((patch.row, patch.col) for patch in patches):
        rows.setdefault(row, []).append(col)
    end_row = max(rows, default=0) + 1
    for row, cols in [*rows.items(), (end_row, [])]:
        breaks = np.flatnonzero(np.diff(cols) > 1) + 1
        row_runs = {(int(run[0]), int(run[-1])) for run in np.split(np.array(cols), breaks) if len(run)}
        for run in [run for run, (_, last) in runs.items() if run not in row_runs or last + 1 != row]:
            first, last = runs.pop(run)
            windows.append((first, run[0], last - first + 1, run[1] - run[0] + 1))
        for run in row_runs:
            runs[run] = [runs[run][0] if run in runs else row, row]
    return [
        (row * PATCH_QUADS, col * PATCH_QUADS, down * PATCH_QUADS + 1, right * PATCH_QUADS + 1)
        for row, col, down, right in sorted(windows)
    ]


def lies_behind(rays: SunRays, patch: Patch, block: NodeHeights) -> bool:
    """Return whether a patch lies behind a block, as seen from the sun, and casts no shadow on it.

    On the sun-aligned grid the rays lead down and to the right. If they lead almost straight down, some may lead to the left. This
    is considered for patches at full detail only: a coarser patch takes part only if it lies towards the sun.
    """
    side = PATCH_QUADS * 2**patch.lod
    rows, cols = block.shape
    i, j = rays.orientation.to_sun_aligned(np.array([0, side]) + patch.row * side, np.array([0, side]) + patch.col * side, 0, 0)
    block_i, block_j = rays.orientation.to_sun_aligned(
        np.array([0, rows - 1]) + block.row0, np.array([0, cols - 1]) + block.col0, 0, 0
    )
    lean = patch.lod == 0 and rays.columns_per_row < RAY_DIRECTION_TOLERANCE
    return bool(i.min() >= block_i.max() or (j.min() >= block_j.max() and not lean))


@cached("light", 1024 * MIB)
def ground_of_view(scene: Scene, ground_mesh: GroundMesh, frame: LocalFrame) -> tuple[SunRays, GroundWindow]:
    """Return the sun's rays over the ground of a perspective view, and this ground as a sun-aligned grid.

    The last result is cached.

    If the drawn ground is decimated (drawn with fewer nodes), all other nodes get values on the drawn triangles. Quads are then cut
    along the sides of these triangles. ``needs_sunward`` tells whether to compute ``GroundWindow.sunward_m``.
    """
    nodes = ground_nodes(scene)
    rows, cols = nodes.height_m.shape
    rays = rays_at(scene, nodes.grid, nodes.row0 + (rows - 1) / 2, nodes.col0 + (cols - 1) / 2)
    if nodes.decimation_errors is None:
        return rays, _ground_window(rays, 0, [HeightWindow(nodes.row0, nodes.col0, nodes.height_m, np.isfinite(nodes.height_m))])
    row, col = (
        np.rint((ground_mesh.grid.y0 - ground_mesh.y) / ground_mesh.grid.step),
        np.rint((ground_mesh.x - ground_mesh.grid.x0) / ground_mesh.grid.step),
    )
    corner = np.stack([row - nodes.row0, col - nodes.col0], axis=1).astype(np.int32)
    _, ray_height_m = rays.ray_coordinates(ground_mesh.position_frame_m, frame, np.arange(len(ground_mesh.position_frame_m)))
    ray_heights = rays.bordered_sun_aligned_copy(_interpolate_on_triangles(corner, ray_height_m, ground_mesh.triangles, rows, cols))
    is_cut_nw_se = np.pad(
        rays.orientation.sun_aligned_cuts(_falling_quads(corner, ground_mesh.triangles, rows, cols)), ((0, 0), (1, 1))
    )
    sun_aligned_grid = SunAlignedGrid(ray_heights, *rays.window_cubics(0, nodes.row0, nodes.col0, rows, cols), is_cut_nw_se)
    return rays, GroundWindow(0, nodes.row0, nodes.col0, (rows, cols), sun_aligned_grid)


def _ground_window(rays: SunRays, lod: int, windows: list[NodeHeights], patches: Iterable[Patch] = ()) -> GroundWindow:
    """Return the ground of windows of heights as one sun-aligned grid.

    The grid also covers ``patches`` without heights, because the fitted positions of its lines depend on its size. Outside of the
    windows it holds no ground.
    """
    starts = [(w.row0, w.col0) for w in windows] + [(p.row * PATCH_QUADS, p.col * PATCH_QUADS) for p in patches]
    ends = [(w.row0 + w.shape[0], w.col0 + w.shape[1]) for w in windows]
    ends += [((p.row + 1) * PATCH_QUADS + 1, (p.col + 1) * PATCH_QUADS + 1) for p in patches]
    row0, col0 = (min(axis) for axis in zip(*starts, strict=True))
    rows, cols = max(row for row, _ in ends) - row0, max(col for _, col in ends) - col0

    spans = [rays.sun_aligned_window(w.row0 - row0, w.col0 - col0, w.shape, rows, cols) for w in windows]
    first_ground_row = max(min((first for (first, _), _ in spans), default=rows) - 1, 0)
    # no row beside ``filled_rows`` is read
    filled_rows = (0, None) if lod else (first_ground_row, max(end for (_, end), _ in spans))

    with_border, inside = allocate_bordered_grid(
        *((cols, rows) if rays.orientation.axes_swapped else (rows, cols)), slice(*filled_rows), *spans[:1]
    )
    grid_view = rays.orientation.grid_order_view(inside)
    if windows:
        views = [grid_view[w.row0 - row0 :, w.col0 - col0 :][: w.shape[0], : w.shape[1]] for w in windows]
        rays.write_ray_heights(lod, windows, views)
    sun_aligned_grid = SunAlignedGrid(
        close_border(with_border, slice(*filled_rows)), *rays.window_cubics(lod, row0, col0, rows, cols), HIGHER_DIAGONALS
    )
    return GroundWindow(lod, row0, col0, (rows, cols), sun_aligned_grid, first_ground_row)


@compiled
def _interpolate_on_triangles(corner, value, triangles, rows, cols):
    """Interpolate values linearly on triangles, at all nodes of a grid: float32 (``rows``, ``cols``), NaN outside of the triangles.

    ``corner`` int (n, 2) holds the grid row and column of each corner, which is a node, and ``value`` (n,) its value. ``triangles``
    int (m, 3) holds indices into ``corner``.
    """
    out = np.full((rows, cols), np.nan, np.float32)
    for n in range(len(triangles)):
        a, b, c = corner[triangles[n, 0]], corner[triangles[n, 1]], corner[triangles[n, 2]]
        v0, v1, v2 = value[triangles[n, 0]], value[triangles[n, 1]], value[triangles[n, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        for row in range(min(a[0], b[0], c[0]), max(a[0], b[0], c[0]) + 1):
            for col in range(min(a[1], b[1], c[1]), max(a[1], b[1], c[1]) + 1):
                v = ((row - a[0]) * (c[1] - a[1]) - (col - a[1]) * (c[0] - a[0])) / area
                w = ((b[0] - a[0]) * (col - a[1]) - (b[1] - a[1]) * (row - a[0])) / area
                if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
                    out[row, col] = v0 + v * (v1 - v0) + w * (v2 - v0)
    return out


@compiled
def _falling_quads(corner, triangles, rows, cols):
    """Return which quads of a grid of nodes are cut along their falling diagonals by triangles: bool (``rows`` - 1, ``cols`` - 1).

    The falling diagonal leads from a quad's upper left (north-west) node to its lower right (south-east) node. A quad is True if a
    side of a triangle runs along this diagonal. All other quads are cut along their rising diagonals, or are not cut by a side and
    so are planar. ``corner`` int (n, 2) holds the grid row and column of each corner, ``triangles`` int (m, 3) indices into
    ``corner``. The grid has ``rows`` x ``cols`` nodes.
    """
    is_falling = np.zeros((rows - 1, cols - 1), np.bool_)
    for n in range(len(triangles)):
        for k in range(3):
            start, end = corner[triangles[n, k]], corner[triangles[n, (k + 1) % 3]]
            if end[0] - start[0] == end[1] - start[1]:
                for step in range(abs(end[0] - start[0])):
                    is_falling[min(start[0], end[0]) + step, min(start[1], end[1]) + step] = True
    return is_falling
