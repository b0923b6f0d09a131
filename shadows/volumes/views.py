"""Make the views in which shadow volumes are drawn: clip coordinates, and the depths of the visible points.

Depths of points on meshes come from drawing the meshes. Meshes, near caps and sides use one shader program, so that a near cap has
exactly the depth of its surface.

Depths of points on ground and trees are computed from the points, since no near cap lies on a lit one. There are two exceptions,
where the ground is drawn as well. The first is the ground of a map that bends: a point that is off by a share of a pixel may lie on
the wrong side of a volume that grazes it. The second is ground with gaps, all of whose triangles cast. A rasteriser leaves out some
pixels whose centres lie exactly on the ground's rim. They keep the depths computed from their points.

In perspective, depth is n over the distance along the view's axis, where n is the distance of the near plane. Points at infinity
have depth 0, and nothing is clipped there. The near plane lies half-way to the nearest visible point, which keeps float32 steps
fine. A map is seen from above everything. Volumes below all visible points are clipped, since nothing is counted there.

**Samples** of a perspective view's pixels are pixels of a finer view of the same camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.volumes.volumes import ground_has_gaps
from skugga.terrain.casters.clip_space import affine_parts, camera_clip, map_clip
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.antialias import finer_view
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import NEAR_PLANE_M, set_uniforms, shader_source
from skugga.terrain.gbuffer.resolve import MESHES, RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.light_space import light_bounds
from skugga.terrain.gl.device import Device
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from moderngl import Framebuffer, Program


NOTHING_DRAWN = np.zeros((0, 0), np.float32)
"""The drawn depth where no point needs one."""


@dataclass(frozen=True, eq=False)
class VisiblePoints:
    """Some of a buffer's points, in the view in which they are drawn.

    Attributes
    ----------
    size
        Rows and columns of the view.
    row, col
        int (n,): the points' pixels in the view.
    buffer_indices
        int (n,): the points' flat indices in the buffer.
    depth
        float64 (n,): the points' depths.
    uses_drawn_depth
        bool (n,): whether the depth comes from drawing the surface, if this covers the pixel: on meshes, on ground that bends in a
        map, and on ground with gaps.
    lift_depth
        float64 (n,): the depth of a point less that of the drawn ground below it; 0 for points on the ground. In a map that bends,
        points on the smooth ground lie above the drawn ground (``skugga.terrain.gbuffer.smooth_ground``).
    ground
        The ground to draw in a map that bends or has gaps; ``None`` otherwise.
    clip_from_frame, origin_frame_m
        Matrix (4, 4) to clip coordinates, from homogeneous frame points in metres from an origin (3,).
    near_plane_frame_m
        The near plane's rectangle (4, 3); ``None`` in a map, which has none.
    """

    size: tuple[int, int]
    row: np.ndarray
    col: np.ndarray
    buffer_indices: np.ndarray
    depth: np.ndarray
    uses_drawn_depth: np.ndarray
    lift_depth: np.ndarray
    ground: Sheet | None
    clip_from_frame: np.ndarray
    origin_frame_m: np.ndarray
    near_plane_frame_m: np.ndarray | None

    def to_clip(self, points: np.ndarray) -> np.ndarray:
        """Return the clip coordinates (n, 4) float64 of homogeneous frame points (n, 4)."""
        return np.column_stack([points[:, :3] - points[:, 3:] * self.origin_frame_m, points[:, 3]]) @ self.clip_from_frame.T


def points_of_view(buffer: GeometryBuffer, scene: Scene, mask: np.ndarray, near_m: float) -> Iterator[VisiblePoints]:
    """Yield the view's own points in ``mask``, without samples, part by part.

    ``near_m`` is the distance of the near plane. Ground of columns (raster cells with flat tops) is drawn in a view with one pixel
    for each cell. A point on a column lies at the middle of its top.
    """
    if buffer.columns is not None:
        yield from _column_top_points(buffer, scene, mask & (buffer.surface_kind == RELIEF), near_m)
        mask = mask & (buffer.surface_kind != RELIEF)
    yield from pixel_points(buffer, scene, mask, near_m)


def pixel_points(buffer: GeometryBuffer, scene: Scene, mask: np.ndarray, near_m: float) -> Iterator[VisiblePoints]:
    """Yield the points in ``mask`` that lie at their pixels, part by part, each part in a view of its own.

    ``near_m`` is the distance of the near plane.
    """
    view = buffer.view
    for part, top, left in affine_parts(scene.world, view):
        row, col = np.nonzero(mask[top : top + part.rows, left : left + part.cols])
        if len(row):
            yield _visible_points(buffer, scene, part, near_m, row, col, (row + top) * view.cols + col + left)


def _column_top_points(buffer: GeometryBuffer, scene: Scene, mask: np.ndarray, near_m: float) -> Iterator[VisiblePoints]:
    """Yield the points on tops of columns in ``mask``, part by part, in a view with one pixel for each cell.

    ``near_m`` is the distance of the near plane.
    """
    assert buffer.columns is not None
    window, pixels = buffer.columns.window, np.flatnonzero(mask)
    row, col = buffer.columns.row.ravel()[pixels], buffer.columns.col.ravel()[pixels]
    cells = MapView(window.columns.grid, window.row0, window.col0, 1.0, 1.0, *window.height_m.shape)
    for part, top, left in affine_parts(scene.world, cells):
        inside = (row >= top) & (row < top + part.rows) & (col >= left) & (col < left + part.cols)
        if inside.any():
            yield _visible_points(buffer, scene, part, near_m, row[inside] - top, col[inside] - left, pixels[inside])


def sample_points(buffer: GeometryBuffer, scene: Scene, mask: np.ndarray, near_m: float) -> Iterator[VisiblePoints]:
    """Yield the points in ``mask`` of a view's samples, if it has any.

    ``near_m`` is the distance of the near plane.
    """
    view = buffer.view
    if buffer.sample_pixels is None or not isinstance(view, PerspectiveView):
        return
    sample_indices = np.nonzero(mask[view.rows :])
    if len(sample_indices[0]):
        row, col = (index[sample_indices] for index in buffer.sample_pixels)
        indices = (sample_indices[0] + view.rows) * view.cols + sample_indices[1]
        yield _visible_points(buffer, scene, finer_view(view), near_m, row, col, indices)


@contextmanager
def receiver_stencil(
    gl: Device, buffer: GeometryBuffer, scene: Scene, points: VisiblePoints, part_rectangles: np.ndarray, marks_pixels: bool
) -> Iterator[tuple[Framebuffer, Program]]:
    """Provide a framebuffer with a stencil and the depths of some points, and the program that draws volumes into it.

    The depths are set in the rectangles ``part_rectangles`` (k, 4) of the view. If ``marks_pixels`` is true, the points' pixels are
    marked.
    """
    rows, cols = points.size
    target = gl.stencil.target(cols, rows)
    program = gl.program(shader_source("shadows/volumes/volume.vert"), shader_source("shadows/maps/depth.frag"))
    set_uniforms(program, {
        "clip_from_frame": tuple(points.clip_from_frame.T.ravel()), "origin_frame_m": tuple(points.origin_frame_m),
    })  # fmt: skip
    drawn_depth = NOTHING_DRAWN
    if points.uses_drawn_depth.any():
        with gl.stencil.depth_pass(target):
            if buffer.solids_frame_m is not None and scene.objects.solids is not None:
                gl.draw_triangles(program, _homogeneous(buffer.solids_frame_m), scene.objects.solids.triangles)
            if points.ground is not None:
                gl.draw_grid_mesh(program, _homogeneous(points.ground.position_frame_m), points.ground.triangles)
            elif buffer.ground is not None and ground_has_gaps(buffer, scene):
                gl.draw_triangles(program, _homogeneous(buffer.ground.position_frame_m), buffer.ground.triangles)
        drawn_depth = _drawn_depth(target)
    texture = gl.texture(
        _depth_image(
            points.row,
            points.col,
            points.uses_drawn_depth,
            points.depth,
            points.lift_depth,
            drawn_depth,
            part_rectangles,
            rows,
            cols,
        )
    )
    texture.use(0)
    for marking in (False, True) if marks_pixels else (False,):
        depth_program = gl.program(
            shader_source("shadows/pixels.vert"), shader_source("shadows/volumes/seen_depth.frag"), {"marking": marking}
        )
        depth_program["seen"] = 0
        with gl.stencil.mark_pass(target) if marking else gl.stencil.depth_pass(target, overwrite=True):
            for part in part_rectangles.tolist():
                target.scissor = tuple(part)
                gl.draw_quad(depth_program)
            target.scissor = None  # type: ignore[assignment]  # the stubs do not allow None, which ends clipping
    texture.release()
    yield target, program


def _drawn_depth(target: Framebuffer) -> np.ndarray:
    """Return the depth of what was drawn into a framebuffer, float32 (rows, cols); 0 where there is nothing."""
    cols, rows = target.size
    return np.frombuffer(target.read(components=1, attachment=-1, dtype="f4"), np.float32).reshape(rows, cols)


def _homogeneous(points: np.ndarray) -> np.ndarray:
    """Return points (..., 3) as homogeneous float32 (..., 4), with 1 as the last coordinate."""
    out = np.ones((*points.shape[:-1], 4), np.float32)
    out[..., :3] = points
    return out


def _visible_points(
    buffer: GeometryBuffer,
    scene: Scene,
    view: MapView | PerspectiveView,
    near_m: float,
    row: np.ndarray,
    col: np.ndarray,
    indices: np.ndarray,
) -> VisiblePoints:
    """Return the points at flat ``indices`` of a buffer, in a view where they lie at the pixels ``row``, ``col`` (n,).

    ``near_m`` is the distance of the near plane.
    """
    points, frame = buffer.position_frame_m.reshape(-1, 3), buffer.frame
    if isinstance(view, PerspectiveView):
        origin, camera_from_frame = view.in_frame(frame)
        clip = camera_clip(view, frame, origin, near_m)
        (left, right), (top, bottom) = (
            [(first + (size * k - 0.5) * view.step_px) / view.focal_px for k in (0, 1)]
            for first, size in ((view.col0, view.cols), (view.row0, view.rows))
        )
        corners = np.array([[left, top, 1.0], [right, top, 1.0], [right, bottom, 1.0], [left, bottom, 1.0]])
        near = origin + near_m * corners @ camera_from_frame
    else:
        low, high = points[indices].min(axis=0), points[indices].max(axis=0)
        top_m = max(float(high[2]), scene.height_range_m[1] + scene.objects.tallest_object_m)  # above all casters
        margin_m = 1.0 + 0.01 * (top_m - low[2])
        origin, near = (low + high) / 2.0, None
        clip = map_clip(scene.world, frame, view, origin, (low[2] - margin_m, top_m + margin_m))
    bends = not (
        scene.world.is_flat or isinstance(view, PerspectiveView) or buffer.columns is not None
    )  # columns have no cap on top
    draws_ground = ground_has_gaps(buffer, scene) or bends
    ground = _ground_of(buffer, view) if draws_ground and isinstance(view, MapView) else None
    depth = _depths(points, indices, clip[2:], origin)
    is_drawn = buffer.surface_kind.ravel()[indices] == MESHES
    if draws_ground:
        is_drawn |= buffer.surface_kind.ravel()[indices] == RELIEF
    lift_depth = np.zeros(len(indices))
    if buffer.is_lifted is not None:
        is_lifted = buffer.is_lifted.ravel()[indices]
        if bends and buffer.lift_m is not None:
            lifted = np.flatnonzero(is_lifted)
            lift_depth[lifted] = buffer.lift_m.ravel()[indices[lifted]] * clip[2, 2]
        else:
            is_drawn &= ~is_lifted
    return VisiblePoints((view.rows, view.cols), row, col, indices, depth, is_drawn, lift_depth, ground, clip, origin, near)


@compiled
def _depths(points, buffer_indices, clip_rows, origin):
    """Return the depths (n,) of the points (m, 3) with the indices ``buffer_indices`` (n,).

    ``clip_rows`` (2, 4) are the last two rows of the matrix to clip coordinates, for points in metres from ``origin`` (3,).
    """
    out = np.empty(len(buffer_indices))
    for n in range(len(buffer_indices)):
        x, y, z = (
            points[buffer_indices[n], 0] - origin[0],
            points[buffer_indices[n], 1] - origin[1],
            points[buffer_indices[n], 2] - origin[2],
        )
        out[n] = (clip_rows[0, 0] * x + clip_rows[0, 1] * y + clip_rows[0, 2] * z + clip_rows[0, 3]) / (
            clip_rows[1, 0] * x + clip_rows[1, 1] * y + clip_rows[1, 2] * z + clip_rows[1, 3]
        )
    return out


@compiled
def _depth_image(row, col, uses_drawn_depth, depth, lift_depth, drawn_depth, part_rectangles, rows, cols):
    """Return the points' depths at their pixels, float32 (``rows``, ``cols``).

    ``row``, ``col``, ``uses_drawn_depth`` and ``depth`` (n,) are those of ``VisiblePoints``. The value is -1 where drawing the
    surface gives the depth, and ``lift_depth`` more than ``drawn_depth`` (rows, cols) at points above it. It is NaN at other pixels
    of the rectangles ``part_rectangles`` (k, 4), and undefined outside of them.
    """
    out = np.empty((rows, cols), np.float32)
    for k in range(len(part_rectangles)):
        left, top = part_rectangles[k, 0], part_rectangles[k, 1]
        out[top : top + part_rectangles[k, 3], left : left + part_rectangles[k, 2]] = np.nan
    for n in range(len(row)):
        i, j = row[n], col[n]
        if uses_drawn_depth[n] and drawn_depth[i, j] > 0.0:
            out[i, j] = drawn_depth[i, j] + lift_depth[n] if lift_depth[n] > 0.0 else -1.0
        else:
            out[i, j] = depth[n]
    return out


def _ground_of(buffer: GeometryBuffer, part: MapView) -> Sheet:
    """Return the ground in a part of a map. For columns, return the ground of the whole map."""
    if buffer.columns is not None:
        return buffer.columns.window.sheet
    surface = buffer.surface
    assert surface is not None
    rows, cols = (
        slice(max(int(np.floor(first)) - 1 - origin, 0), int(np.ceil(first + (count - 1) * step)) + 3 - origin)
        for first, step, count, origin in (
            (part.row0, part.row_step, part.rows, surface.row0),
            (part.col0, part.col_step, part.cols, surface.col0),
        )
    )
    quads = slice(rows.start, rows.stop - 1), slice(cols.start, cols.stop - 1)
    return Sheet(surface.position_frame_m[rows, cols], surface.sheet.is_cut_nw_se[quads])


def near_plane_distance_m(buffer: GeometryBuffer) -> float:
    """Return a distance along the view's axis in front of all visible points, metres; 0 in a map."""
    if isinstance(buffer.view, MapView):
        return 0.0
    eye, camera_from_frame = buffer.view.in_frame(buffer.frame)
    low, _ = light_bounds(buffer.position_frame_m, buffer.valid, camera_from_frame, -camera_from_frame @ eye)
    return max(0.5 * float(low[2]), NEAR_PLANE_M) if np.isfinite(low[2]) else NEAR_PLANE_M
