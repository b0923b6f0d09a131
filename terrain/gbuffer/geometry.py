"""Geometry buffers: for each pixel the visible point, its normals and the triangle it lies on.

The buffer of a map block is made by arithmetic, without rasterising (``skugga.terrain.gbuffer.map_points``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.ground_mesh import GroundMesh
from skugga.terrain.gbuffer.map_points import map_lifts, map_points
from skugga.terrain.gbuffer.resolve import NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.columns import PlacedOnColumns
from skugga.terrain.ground.surface import Surface, SurfaceWindow

SMOOTH_NODES = 16
"""Widest central difference of the shading normal, in nodes: beyond 16-fold magnification facets show."""


class Shown(NamedTuple):
    """What pixels show, as loops that shade them take it: arrays of a ``GeometryBuffer``."""

    there: np.ndarray
    kind: np.ndarray
    position_frame_m: np.ndarray
    height_m: np.ndarray
    shading_normal_frame: np.ndarray


@dataclass(frozen=True, eq=False)
class GeometryBuffer:
    """What is visible, per pixel. Shapes (rows, cols) or (rows, cols, 3); NaN (or 0) where there is no surface.

    Attributes
    ----------
    there
        bool, whether the pixel shows a surface.
    position_frame_m
        float64, the visible point in the frame.
    height_m
        float32, its height.
    normal_frame
        float32, the triangle's geometric unit normal; the mean of all where several triangles of a map's ground share the point.
        Shadows go by ``skugga.terrain.gbuffer.shared_points``, which knows those.
    shading_normal_frame
        float32, a smooth unit normal: shading goes by this one.
    crease
        float32, the largest distance between the triangle's unit normal and those of the triangles round the nearest
        node: 0 on a plane. An algorithm that looks beside the point needs it for its bias.
    kind
        uint8, what is seen: ``skugga.terrain.gbuffer.resolve``'s NOTHING, RELIEF, MESHES or FOREST.
    triangle
        int32 (rows, cols, 3) of a map's ground: row and column of the quad in ``surface``, and 0 for the triangle on its north
        side, 1 for the other; the first of those that share the point.
    surface
        Of a map: the nodes that the buffer was made from; they cast what they show. ``None`` in perspective, and over columns.
    columns
        Of a map whose ground is upright columns: those, and where its pixels lie on them; they cast what they show. Their tops are
        what is seen, so normals are up and nothing is creased.
    ground
        In perspective: the ground's triangles, which cast what they show. ``None`` in a map.
    corners_frame_m
        float32 (rows, cols, 9), the triangle's three corners: for everything but a map's ground, where it is 0. ``None`` where
        there is nothing else.
    albedo
        float32, linear; NaN where the ground's tint is to be taken. ``None``: everywhere.
    samples_from, sample_pixels
        Rows from here on are further samples of pixels (``skugga.terrain.gbuffer.antialias``), which are averaged; rows and columns
        (n, cols) of the pixels that they are in the finer view of the same camera.
    lift_m
        float32 (rows, cols), how far the smooth ground lies from the triangle's point along the line of sight, in a map upwards
        (``skugga.terrain.gbuffer.lift``); NaN on nodes of the raster, and beside creases. ``None`` where all points are such.
    lifted
        bool (rows, cols), where the point has been put there, for one light. ``None``: nowhere.
    stand, solids_frame_m
        The trees of the view, and the vertices (n, 3) float64 of its meshes in the frame; ``None`` without any.
    """

    view: MapView | PerspectiveView
    frame: LocalFrame
    there: np.ndarray
    position_frame_m: np.ndarray
    height_m: np.ndarray
    normal_frame: np.ndarray
    shading_normal_frame: np.ndarray
    crease: np.ndarray
    kind: np.ndarray
    triangle: np.ndarray | None = None
    surface: SurfaceWindow | None = None
    ground: GroundMesh | None = None
    columns: PlacedOnColumns | None = None
    corners_frame_m: np.ndarray | None = None
    albedo: np.ndarray | None = None
    tree_instances: TreeInstances | None = None
    solids_frame_m: np.ndarray | None = None
    samples_from: int | None = None
    sample_pixels: tuple[np.ndarray, np.ndarray] | None = None
    lift_m: np.ndarray | None = None
    lifted: np.ndarray | None = None

    @property
    def shown(self) -> Shown:
        """What a loop that shades needs of it."""
        return Shown(self.there, self.kind, self.position_frame_m, self.height_m, self.shading_normal_frame)


@dataclass(frozen=True, eq=False)
class MapNodes:
    """The nodes that points of a map's bare ground go by, and their smooth normals (rows, cols, 3)."""

    window: SurfaceWindow
    smooth: np.ndarray


def map_nodes(surface: Surface, views: Sequence[MapView], frame: LocalFrame) -> MapNodes:
    """The nodes that the points of views of one grid go by, in a frame."""
    reach = normal_reach(surface)
    row0, col0, row1, col1 = _nodes_of(views, reach)
    window = surface.window(row0, col0, row1 - row0, col1 - col0, frame)
    return MapNodes(window, _smooth_normals(window.position_frame_m, reach))


def _nodes_of(views: Sequence[MapView], reach: int) -> tuple[int, int, int, int]:
    """First row and column of the nodes that points of some views go by, and those after the last ones."""
    halo = reach + (reach + 1) // 2 + 1
    firsts = [(view.row0, view.col0) for view in views]
    lasts = [(view.row0 + (view.rows - 1) * view.row_step, view.col0 + (view.cols - 1) * view.col_step) for view in views]
    row0, col0 = np.floor(np.min(firsts, axis=0)).astype(int) - halo
    row1, col1 = np.floor(np.max(lasts, axis=0)).astype(int) + 2 + halo
    return int(row0), int(col0), int(row1), int(col1)


def map_geometry(
    surface: Surface, view: MapView, frame: LocalFrame, wanted: np.ndarray | None = None, nodes: MapNodes | None = None
) -> GeometryBuffer:
    """The geometry buffer of a map view's bare ground (a block) in a frame: of all pixels, or of those ``wanted`` (rows, cols).
    ``nodes`` are those that its points go by, where they were made before (``map_nodes``): a node is the same in every window.
    Raises ``ValueError`` where they do not reach so far.
    """
    wanted = np.ones((view.rows, view.cols), np.bool_) if wanted is None else wanted
    reach = normal_reach(surface)
    nodes = nodes or map_nodes(surface, [view], frame)
    window, smooth, sheet = nodes.window, nodes.smooth, nodes.window.sheet
    row0, col0, row1, col1 = _nodes_of([view], reach)
    ends = window.row0, window.col0, window.row0 + window.shape[0], window.col0 + window.shape[1]
    if row0 < ends[0] or col0 < ends[1] or row1 > ends[2] or col1 > ends[3]:
        raise ValueError(f"nodes: {ends}; the view needs {(row0, col0, row1, col1)}")
    row = view.row0 + np.arange(view.rows) * view.row_step - window.row0
    col = view.col0 + np.arange(view.cols) * view.col_step - window.col0
    on_nodes = view.on_nodes and reach == 1
    there, position, height, normal, shading, crease, triangle = map_points(
        window.position_frame_m, window.height_m, window.there, sheet.falls, sheet.normals_frame, smooth, row, col, wanted
    )
    kind = np.where(there, np.uint8(RELIEF), np.uint8(NO_SURFACE))
    # Where the grid's nodes are about the raster's, or wider apart, a pixel on one has no triangle of its own.
    lift = None
    if not on_nodes:
        lift = map_lifts(
            window.position_frame_m, sheet.falls, sheet.normals_frame, smooth, window.centre_frame_m, row, col, position, triangle,
            reach,
        )  # fmt: skip
    return GeometryBuffer(view, frame, there, position, height, normal, shading, crease, kind, triangle, window, lift_m=lift)


def normal_reach(surface: Surface) -> int:
    """Nodes that the shading normal's differences reach each way: a raster's cell, as far as that is allowed."""
    return int(np.clip(np.rint(1.0 / surface.cells_per_step), 1, SMOOTH_NODES))


@compiled
def _smooth_normals(position, reach):
    """Unit normals at the nodes from differences over ``reach`` nodes each way, one-sided at the data's borders.

    With ``reach`` one raster cell, the slope of a bilinear surface varies without a jump: facets do not show.
    """
    rows, cols, _ = position.shape
    out = np.empty((rows, cols, 3), np.float32)
    out[:] = np.nan
    for r in range(reach, rows - reach):
        for c in range(reach, cols - reach):
            p = position[r, c]
            if not np.isfinite(p[2]):
                continue
            west, east = position[r, c - reach], position[r, c + reach]
            north, south = position[r - reach, c], position[r + reach, c]
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
