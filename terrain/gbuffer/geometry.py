"""Geometry buffers: for each pixel the visible point, its normals and the triangle it lies on.

The buffer of a map block is made by arithmetic, without rasterising: pixel centre -> quad and triangle of the grid ->
float64 point. Per quad of corners NW, NE, SW, SE the cut runs from SW to NE; a pixel on a node belongs to the triangle
that the node is the north-west corner of (to a neighbour where that one is missing, at the data's borders).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.compiled import compiled
from terrain.gbuffer.ground_mesh import GroundMesh
from terrain.gbuffer.resolve import NO_SURFACE, RELIEF
from terrain.gbuffer.tree_instances import TreeInstances
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView
from terrain.geo.world import LocalFrame
from terrain.ground.surface import Surface, SurfaceWindow

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
        float32, the triangle's geometric unit normal: shadows and attached shadow go by this one.
    shading_normal_frame
        float32, a smooth unit normal: shading goes by this one.
    crease
        float32, the largest distance between the triangle's unit normal and those of the triangles round the nearest
        node: 0 on a plane. An algorithm that looks beside the point needs it for its bias.
    kind
        uint8, what is seen: ``terrain.gbuffer.resolve``'s NOTHING, RELIEF, MESHES or FOREST.
    triangle
        int32 (rows, cols, 3) of a map's ground: row and column of the quad in ``surface``, and 0 for its NW, 1 for its SE triangle.
    surface
        Of a map: the nodes that the buffer was made from; they cast what they show. ``None`` in perspective.
    ground
        In perspective: the ground's triangles, which cast what they show. ``None`` in a map.
    corners_frame_m
        float32 (rows, cols, 9), the triangle's three corners: for everything but a map's ground, where it is 0. ``None`` where
        there is nothing else.
    albedo
        float32, linear; NaN where the ground's tint is to be taken. ``None``: everywhere.
    samples_from, sample_pixels
        Rows from here on are further samples of pixels (``terrain.gbuffer.antialias``), which are averaged; rows and columns (n,
        cols) of the pixels that they are in the finer view of the same camera.
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
    corners_frame_m: np.ndarray | None = None
    albedo: np.ndarray | None = None
    tree_instances: TreeInstances | None = None
    solids_frame_m: np.ndarray | None = None
    samples_from: int | None = None
    sample_pixels: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def shown(self) -> Shown:
        """What a loop that shades needs of it."""
        return Shown(self.there, self.kind, self.position_frame_m, self.height_m, self.shading_normal_frame)


def map_geometry(surface: Surface, view: MapView, frame: LocalFrame) -> GeometryBuffer:
    """The geometry buffer of a map view's bare ground (a block) in a frame."""
    reach = int(np.clip(np.rint(1.0 / surface.cells_per_step), 1, SMOOTH_NODES))
    row = view.row0 + np.arange(view.rows) * view.row_step
    col = view.col0 + np.arange(view.cols) * view.col_step
    halo = reach + 1
    row0, col0 = int(np.floor(row[0])) - halo, int(np.floor(col[0])) - halo
    rows, cols = int(np.floor(row[-1])) + 2 + halo - row0, int(np.floor(col[-1])) + 2 + halo - col0
    window = surface.window(row0, col0, rows, cols, frame)
    faces = quad_normals(window.position_frame_m)
    smooth = _smooth_normals(window.position_frame_m, reach)
    there, position, height, normal, shading, crease, triangle = _pixels(
        window.position_frame_m, window.height_m, window.there, faces, smooth, row - row0, col - col0
    )
    kind = np.where(there, np.uint8(RELIEF), np.uint8(NO_SURFACE))
    return GeometryBuffer(view, frame, there, position, height, normal, shading, crease, kind, triangle, window)


@compiled
def quad_normals(position):
    """Unit normals (rows - 1, cols - 1, 2, 3) of each quad's NW (0) and SE (1) triangle; NaN where a corner is missing."""
    rows, cols, _ = position.shape
    out = np.empty((rows - 1, cols - 1, 2, 3), np.float32)
    for r in range(rows - 1):
        for c in range(cols - 1):
            for half in range(2):
                if half == 0:
                    o, a, b = position[r, c], position[r + 1, c], position[r, c + 1]
                else:
                    o, a, b = position[r + 1, c + 1], position[r, c + 1], position[r + 1, c]
                ax, ay, az = a[0] - o[0], a[1] - o[1], a[2] - o[2]
                bx, by, bz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
                x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                length = np.sqrt(x * x + y * y + z * z)
                out[r, c, half, 0], out[r, c, half, 1], out[r, c, half, 2] = x / length, y / length, z / length
    return out


@compiled
def _smooth_normals(position, reach):
    """Unit normals at the nodes from differences over ``reach`` nodes each way, one-sided at the data's borders.

    With ``reach`` one raster cell, the slope of a bilinear surface varies without a jump: facets do not show.
    """
    rows, cols, _ = position.shape
    out = np.full((rows, cols, 3), np.nan, np.float32)
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


@compiled
def _pixels(position, height, shown, faces, smooth, row, col):
    """Fill the buffer for pixel centres at the (fractional) window rows and columns given."""
    rows, cols = row.size, col.size
    there = np.zeros((rows, cols), np.bool_)
    point = np.full((rows, cols, 3), np.nan)
    level = np.full((rows, cols), np.nan, np.float32)
    normal = np.full((rows, cols, 3), np.nan, np.float32)
    shading = np.full((rows, cols, 3), np.nan, np.float32)
    crease = np.zeros((rows, cols), np.float32)
    triangle = np.full((rows, cols, 3), -1, np.int32)
    for i in range(rows):
        r0 = int(np.floor(row[i]))
        fr0 = row[i] - r0
        for j in range(cols):
            c0 = int(np.floor(col[j]))
            fc0 = col[j] - c0
            near_r, near_c = int(np.floor(row[i] + 0.5)), int(np.floor(col[j] + 0.5))
            if not shown[near_r, near_c]:
                continue
            # The quad south-east of the point; on a node or a grid line also those beside it, should that one be missing.
            found = False
            r, c, fr, fc, half = r0, c0, fr0, fc0, 0
            for k in range(4):
                up, left = k // 2, k % 2
                if (up == 1 and fr0 > 0.0) or (left == 1 and fc0 > 0.0):
                    continue
                r, c, fr, fc = r0 - up, c0 - left, fr0 + up, fc0 + left
                half = 0 if fr + fc <= 1.0 else 1
                found = np.isfinite(faces[r, c, half, 2])
                if not found and fr + fc == 1.0:
                    half = 1
                    found = np.isfinite(faces[r, c, half, 2])
                if found:
                    break
            if not found:
                continue
            there[i, j] = True
            triangle[i, j, 0], triangle[i, j, 1], triangle[i, j, 2] = r, c, half
            for k in range(3):
                if half == 0:
                    o = position[r, c, k]
                    point[i, j, k] = o + fr * (position[r + 1, c, k] - o) + fc * (position[r, c + 1, k] - o)
                else:
                    o = position[r + 1, c + 1, k]
                    point[i, j, k] = o + (1.0 - fr) * (position[r, c + 1, k] - o) + (1.0 - fc) * (position[r + 1, c, k] - o)
                normal[i, j, k] = faces[r, c, half, k]
            if half == 0:
                o = np.float64(height[r, c])
                level[i, j] = o + fr * (height[r + 1, c] - o) + fc * (height[r, c + 1] - o)
            else:
                o = np.float64(height[r + 1, c + 1])
                level[i, j] = o + (1.0 - fr) * (height[r, c + 1] - o) + (1.0 - fc) * (height[r + 1, c] - o)
            widest = 0.0
            for k in range(6):  # the triangles round the nearest node
                if k == 0:
                    face = faces[near_r - 1, near_c - 1, 1]
                elif k == 1:
                    face = faces[near_r - 1, near_c, 0]
                elif k == 2:
                    face = faces[near_r - 1, near_c, 1]
                elif k == 3:
                    face = faces[near_r, near_c - 1, 0]
                elif k == 4:
                    face = faces[near_r, near_c - 1, 1]
                else:
                    face = faces[near_r, near_c, 0]
                apart = 0.0
                for m in range(3):
                    apart += (face[m] - normal[i, j, m]) ** 2
                if apart > widest:  # False for a missing face, whose normal is NaN
                    widest = apart
            crease[i, j] = np.sqrt(widest)
            # Smooth normal: bilinear between the nodes' ones, where all of them exist.
            sx, sy, sz, weight = 0.0, 0.0, 0.0, 0.0
            for m in range(4):
                w = (fr0 if m // 2 else 1.0 - fr0) * (fc0 if m % 2 else 1.0 - fc0)
                if w > 0.0:
                    s = smooth[r0 + m // 2, c0 + m % 2]
                    if np.isfinite(s[2]):
                        sx, sy, sz, weight = sx + w * s[0], sy + w * s[1], sz + w * s[2], weight + w
            length = np.sqrt(sx * sx + sy * sy + sz * sz)
            if length > 0.0:
                shading[i, j, 0], shading[i, j, 1], shading[i, j, 2] = sx / length, sy / length, sz / length
            else:
                for m in range(3):
                    shading[i, j, m] = normal[i, j, m]
    return there, point, level, normal, shading, crease, triangle
