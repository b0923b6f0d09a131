"""Geometry buffers: for each pixel the visible point, its normals and the triangle it lies on.

``map_geometry`` computes the buffer of a map block by arithmetic, without rasterising (``skugga.terrain.gbuffer.map_points``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.ground_mesh import GroundMesh
from skugga.terrain.gbuffer.map_points import MapPoints, map_lifts, map_points
from skugga.terrain.gbuffer.resolve import NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.columns import ColumnIndices
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.ground.surface import Surface, SurfaceWindow

MAX_STENCIL_RADIUS = 16
"""Maximum half width, in nodes, of the central difference that gives the shading normal.

On grids with more nodes per raster cell than this, the facets of the bilinear ground become visible.
"""


class ShadingInputs(NamedTuple):
    """The arrays of a ``GeometryBuffer`` that shading loops read."""

    valid: np.ndarray
    surface_kind: np.ndarray
    position_frame_m: np.ndarray
    height_m: np.ndarray
    shading_normal_frame: np.ndarray


@dataclass(frozen=True, eq=False)
class GeometryBuffer:
    """The visible surface in each pixel of a view.

    Arrays have the shape (rows, cols) or (rows, cols, 3). Pixels without a surface hold NaN (or 0). "The triangle" is the one that
    the pixel shows.

    Attributes
    ----------
    view, frame
        The view, and the local frame of all points and directions.
    valid
        bool, valid mask: the pixel shows a surface.
    position_frame_m
        float64, the visible point in the frame, metres.
    height_m
        float32, the point's height, metres.
    normal_frame
        float32, the triangle's geometric unit normal. Where several triangles of a map's ground share the point, it is the mean of
        their normals. Shadows use the single normals there (``skugga.terrain.gbuffer.light_facing``).
    shading_normal_frame
        float32, a smooth unit normal, for shading.
    crease
        float32, the bend of the surface: the largest distance between the triangle's unit normal and the unit normals of the
        triangles round the nearest node; 0 on a plane. Algorithms that sample beside the point derive their bias from it.
    surface_kind
        uint8, the kind of surface: NO_SURFACE, RELIEF, MESHES or FOREST of ``skugga.terrain.gbuffer.resolve``.
    triangle
        int32 (rows, cols, 3), for a map's ground only: row and column of the triangle's quad in ``surface``, then 0 for the
        triangle on the quad's north side or 1 for the other one. Where several triangles share the point, it is the first of them.
    surface
        In maps of smooth ground: the nodes that the buffer was computed from. Its ``with_rim`` is the ground that casts shadows,
        which includes the rim (ground for one node beyond the raster). ``None`` in perspective and for columns.
    columns
        In maps of ground as upright columns: the columns, and the column in each pixel. The visible columns also cast the shadows.
        Pixels show the columns' tops, so normals point up and creases are 0. ``None`` for other ground.
    ground
        In perspective: the ground's triangles. The visible triangles also cast the shadows. ``None`` in a map.
    corners_frame_m
        float32 (rows, cols, 9), the triangle's three corners, metres; 0 for a map's ground. A point that ``is_lifted`` in
        perspective lies on no triangle: its corners are those of the triangle from which it was moved. ``None`` in maps of ground
        without objects.
    mesh_triangle
        int32 (rows, cols), in perspective: number of the meshes' triangle, from 0; negative where the pixel shows no mesh. ``None``
        in maps, and without buildings and models with a ``Surface``.
    albedo
        float32, linear; NaN where the ground has its tint. ``None`` if the ground has its tint everywhere.
    first_sample_row
        The first row of extra anti-aliasing samples (``skugga.terrain.gbuffer.antialias``). ``None`` without samples.
    sample_pixels
        Rows and columns (n, cols) of these samples in the finer view of the same camera. ``None`` without samples.
    lift_m
        float32 (rows, cols), the distance from the point on the triangle to the smooth ground above it, metres. It is measured
        along the line of sight, in a map upwards (``skugga.terrain.gbuffer.lift``). NaN on nodes of the raster and beside creases.
        ``None`` if it is NaN everywhere.
    is_lifted
        bool (rows, cols), whether the point was moved to the smooth ground, for one light. ``None`` if no point was moved.
    tree_instances
        The trees of the view; ``None`` without any.
    solids_frame_m
        float64 (n, 3), the vertices of the view's meshes in the frame; ``None`` without any.
    """

    view: MapView | PerspectiveView
    frame: LocalFrame
    valid: np.ndarray
    position_frame_m: np.ndarray
    height_m: np.ndarray
    normal_frame: np.ndarray
    shading_normal_frame: np.ndarray
    crease: np.ndarray
    surface_kind: np.ndarray
    triangle: np.ndarray | None = None
    surface: SurfaceWindow | None = None
    ground: GroundMesh | None = None
    columns: ColumnIndices | None = None
    corners_frame_m: np.ndarray | None = None
    albedo: np.ndarray | None = None
    tree_instances: TreeInstances | None = None
    solids_frame_m: np.ndarray | None = None
    first_sample_row: int | None = None
    sample_pixels: tuple[np.ndarray, np.ndarray] | None = None
    lift_m: np.ndarray | None = None
    is_lifted: np.ndarray | None = None
    mesh_triangle: np.ndarray | None = None

    @property
    def shading_inputs(self) -> ShadingInputs:
        """The arrays that shading loops read."""
        return ShadingInputs(self.valid, self.surface_kind, self.position_frame_m, self.height_m, self.shading_normal_frame)


@dataclass(frozen=True, eq=False)
class MapNodes:
    """The nodes that a map's bare ground is interpolated from.

    Attributes
    ----------
    window
        The nodes.
    smooth_normals
        float32 (rows, cols, 3), their smooth unit normals.
    """

    window: SurfaceWindow
    smooth_normals: np.ndarray

    def around(self, surface: Surface, view: MapView) -> MapNodes:
        """Return a copy of the nodes that the pixels of a view need: those that ``map_nodes`` returns for it alone."""
        row0, col0, row1, col1 = _node_bounds([view], normal_stencil_radius(surface))
        first_row, first_col = row0 - self.window.row0, col0 - self.window.col0
        part = slice(first_row, first_row + row1 - row0), slice(first_col, first_col + col1 - col0)
        return MapNodes(self.window.part(*part), np.ascontiguousarray(self.smooth_normals[part]))


def map_nodes(surface: Surface, views: Sequence[MapView], frame: LocalFrame) -> MapNodes:
    """Return the nodes that the pixels of several views of one grid are interpolated from, with their positions in ``frame``."""
    stencil_radius = normal_stencil_radius(surface)
    row0, col0, row1, col1 = _node_bounds(views, stencil_radius)
    window = surface.window(row0, col0, row1 - row0, col1 - col0, frame)
    return MapNodes(window, _smooth_normals(window.position_frame_m, stencil_radius))


def _node_bounds(views: Sequence[MapView], stencil_radius: int) -> tuple[int, int, int, int]:
    """Return first row, first column, end row and end column of the nodes that the pixels of some views are interpolated from.

    The ends are exclusive. ``stencil_radius`` is the half width of the shading normal's difference, in nodes.
    """
    halo = stencil_radius + (stencil_radius + 1) // 2 + 1
    firsts = [(view.row0, view.col0) for view in views]
    lasts = [(view.row0 + (view.rows - 1) * view.row_step, view.col0 + (view.cols - 1) * view.col_step) for view in views]
    row0, col0 = np.floor(np.min(firsts, axis=0)).astype(int) - halo
    row1, col1 = np.floor(np.max(lasts, axis=0)).astype(int) + 2 + halo
    return int(row0), int(col0), int(row1), int(col1)


def map_geometry(
    surface: Surface, view: MapView, frame: LocalFrame, pixel_mask: np.ndarray | None = None, nodes: MapNodes | None = None
) -> GeometryBuffer:
    """Return the geometry buffer of the bare ground of a map view, such as a block.

    ``pixel_mask`` (rows, cols) selects pixels; the others show nothing. ``nodes`` are nodes that ``map_nodes`` computed for several
    views, this one among them; by default they are computed here, with the same result. Raises ``ValueError`` if ``nodes`` do not
    cover the view.
    """
    pixel_mask = np.ones((view.rows, view.cols), np.bool_) if pixel_mask is None else pixel_mask
    stencil_radius = normal_stencil_radius(surface)
    nodes = nodes or map_nodes(surface, [view], frame)
    window, smooth_normals, sheet = nodes.window, nodes.smooth_normals, nodes.window.sheet
    row0, col0, row1, col1 = _node_bounds([view], stencil_radius)
    ends = window.row0, window.col0, window.row0 + window.shape[0], window.col0 + window.shape[1]
    if row0 < ends[0] or col0 < ends[1] or row1 > ends[2] or col1 > ends[3]:
        raise ValueError(f"nodes: they span {ends}, but the view needs {(row0, col0, row1, col1)}. Use map_nodes of this view.")
    row = view.row0 + np.arange(view.rows) * view.row_step - window.row0
    col = view.col0 + np.arange(view.cols) * view.col_step - window.col0
    on_nodes = view.is_on_nodes and stencil_radius == 1
    points = map_points(
        window.position_frame_m,
        window.height_m,
        window.valid,
        sheet.is_cut_nw_se,
        sheet.normals_frame,
        smooth_normals,
        row,
        col,
        pixel_mask,
    )
    if view.is_on_nodes:
        _add_isolated_nodes(window, row, col, pixel_mask, points)
    valid, position, height, normal, shading_normal, crease, triangle = points
    kind = np.where(valid, np.uint8(RELIEF), np.uint8(NO_SURFACE))
    # A pixel on a node has no triangle of its own, unless the grid is finer than the raster.
    lift = None
    if not on_nodes:
        lift = map_lifts(
            window.position_frame_m, sheet.is_cut_nw_se, sheet.normals_frame, smooth_normals, window.up_origin_frame_m, row, col,
            points, stencil_radius,
        )  # fmt: skip
    return GeometryBuffer(view, frame, valid, position, height, normal, shading_normal, crease, kind, triangle, window, lift_m=lift)


def _add_isolated_nodes(window: SurfaceWindow, row: np.ndarray, col: np.ndarray, pixel_mask: np.ndarray, points: MapPoints) -> None:
    """Write the points of pixels on isolated nodes into ``points``.

    An isolated node lies on the raster, but is not a corner of a visible triangle: the raster is one node wide there. Its triangles
    are those that it forms with the rim beside it. Rim nodes beyond the end of a line of nodes have one neighbour on the raster.
    They count only for a single node, as they would flatten the line's end. ``row`` and ``col`` are the nodes in the window.
    """
    rim = window.rim
    if rim is None:
        return
    node_valid = window.valid[np.ix_(row.astype(np.int64), col.astype(np.int64))]
    for min_neighbours in (2, 1):
        isolated = pixel_mask & node_valid & ~points.valid
        if not isolated.any():
            return
        casting = window.with_rim
        position = casting.position_frame_m.copy()
        is_end = _neighbour_count(np.isfinite(window.height_m))[rim.row, rim.col] < min_neighbours
        position[rim.row[is_end], rim.col[is_end]] = np.nan
        sheet, smooth_normals = Sheet(position, casting.sheet.is_cut_nw_se), _smooth_normals(position, 1)  # the rim is a node wide
        isolated_points = map_points(
            position, casting.height_m, window.valid, sheet.is_cut_nw_se, sheet.normals_frame, smooth_normals, row, col, isolated
        )
        for values, isolated_values in zip(points, isolated_points, strict=True):
            values[isolated] = isolated_values[isolated]


def _neighbour_count(mask: np.ndarray) -> np.ndarray:
    """Return how many of the eight neighbours of each element of a mask (rows, cols) are True; an element itself counts, too."""
    rows, cols = mask.shape
    padded = np.pad(mask, 1).astype(np.uint8)
    down = padded[:rows] + padded[1 : rows + 1] + padded[2:]
    return down[:, :cols] + down[:, 1 : cols + 1] + down[:, 2:]


def normal_stencil_radius(surface: Surface) -> int:
    """Return the half width, in nodes, of the central difference that gives the shading normal.

    It is the width of one raster cell, limited to 1 to ``MAX_STENCIL_RADIUS`` nodes.
    """
    return int(np.clip(np.rint(1.0 / surface.cells_per_step), 1, MAX_STENCIL_RADIUS))


@compiled
def _smooth_normals(position, stencil_radius):
    """Return smooth unit normals (rows, cols, 3) float32 at the nodes, from differences over ``stencil_radius`` nodes in each
    direction.

    The differences are one-sided at the borders of the data. If ``stencil_radius`` is as wide as a raster cell, the slope of a
    bilinear surface becomes continuous, and its facets are not visible.
    """
    rows, cols, _ = position.shape
    out = np.empty((rows, cols, 3), np.float32)
    out[:] = np.nan
    for r in range(stencil_radius, rows - stencil_radius):
        for c in range(stencil_radius, cols - stencil_radius):
            p = position[r, c]
            if not np.isfinite(p[2]):
                continue
            west, east = position[r, c - stencil_radius], position[r, c + stencil_radius]
            north, south = position[r - stencil_radius, c], position[r + stencil_radius, c]
            if not np.isfinite(west[2]):
                west = p
            if not np.isfinite(east[2]):
                east = p
            if not np.isfinite(north[2]):
                north = p
            if not np.isfinite(south[2]):
                south = p
            ax, ay, az = east[0] - west[0], east[1] - west[1], east[2] - west[2]
            bx, by, bz = north[0] - south[0], north[1] - south[1], north[2] - south[2]
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                out[r, c, 0], out[r, c, 1], out[r, c, 2] = x / length, y / length, z / length
    return out
