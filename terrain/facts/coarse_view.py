"""Coarse software rasteriser of a perspective view: the visible triangle in every few pixels, without OpenGL.

There are few pixels and many triangles, and most triangles are smaller than the spacing of the pixels. The rasteriser therefore
tests rays on the CPU and saves the time of sending all triangles to OpenGL. A pixel's ray r hits a triangle a, b, c (all in camera
axes) if r . (b x c), r . (c x a) and r . (a x b) have the same sign. No corner needs to be in front of the eye (M. Olano, T. Greer
1997, "Triangle scan conversion using 2D homogeneous coordinates").

The same pass also samples the neighbours of each pixel in the full picture. Whether a pixel contains an edge depends on these
neighbours and not on those of the coarse picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.antialias import NEIGHBOUR_OFFSETS, edge_mask, edge_mask_of_neighbours, mesh_normals
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_mesh
from skugga.terrain.gbuffer.id_buffer import NEAR_PLANE_M, IdBuffer
from skugga.terrain.gbuffer.view_geometry import resolve_buffer, solid_vertices
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene import Scene

COARSE_STEP_PX = 8
"""Spacing of the sampled pixels, in pixels of the view."""


@dataclass(frozen=True, eq=False)
class NeighbourSamples:
    """Samples of some pixels of a perspective view and of their four neighbours: the input of edge detection, without trees.

    Attributes
    ----------
    view
        The perspective view at its full resolution.
    row, col
        The pixels (n,).
    triangle_number
        Visible triangle in each pixel and its neighbours (n, 5), uint32, in the order of ``NEIGHBOUR_OFFSETS``. Triangles are
        numbered from 1, first those of the ground, then those of the meshes. 0 is no triangle.
    distance_m
        Distance along the view axis (n, 5), float64, metres; infinite where no triangle is visible.
    ground_triangle_count
        Number of triangles of the ground.
    face_normals
        Normals of the mesh faces (m, 3), float32.
    """

    view: PerspectiveView
    row: np.ndarray
    col: np.ndarray
    triangle_number: np.ndarray
    distance_m: np.ndarray
    ground_triangle_count: int
    face_normals: np.ndarray


@dataclass(frozen=True, eq=False)
class CoarseView:
    """Coarse samples of a perspective view: the visible surface in every few pixels, without trees.

    Attributes
    ----------
    buffer
        Geometry buffer at the coarse resolution.
    eye_frame_m
        Position of the eye (3,), metres.
    points_frame_m
        Visible points (n, 3), float64, metres.
    distance_m
        Distances of the points from the eye (n,), metres.
    height_m
        Heights of the points (n,), metres.
    spacing_tangent
        Angle between neighbouring samples, as a tangent.
    edge_share
        Share of the pixels of the full view that contain an edge.
    edge_samples
        Sampled pixels of the full view with their neighbours.
    """

    buffer: GeometryBuffer
    eye_frame_m: np.ndarray
    points_frame_m: np.ndarray
    distance_m: np.ndarray
    height_m: np.ndarray
    spacing_tangent: float
    edge_share: float
    edge_samples: NeighbourSamples


@dataclass(frozen=True, eq=False)
class _CoarseRaster:
    """Input from which ``skugga.terrain.gbuffer.view_geometry`` resolves points: like its ``RasterisedView``, without trees."""

    frame: LocalFrame
    ground: GroundMesh
    solids: np.ndarray | None
    id_buffer: IdBuffer
    tree_instances: None = None


def _cache_key(scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    """Return the cache key of a coarse view: the objects of the scene and the camera. Light does not matter."""
    camera = (view.focal_px, view.row0, view.col0, view.step_px, view.rows, view.cols)
    return scene.objects, view.eye_earth_m.tobytes(), view.earth_from_camera.tobytes(), camera


@cached("scene", 1024 * MIB, key=_cache_key)
def coarse_view_of(scene: Scene, view: PerspectiveView) -> CoarseView:
    """Return the coarse view of a scene without trees, sampled every ``COARSE_STEP_PX`` pixels.

    If these samples show only sky, every pixel is sampled.
    """
    coarse_view = _sample_at_step(scene, view, COARSE_STEP_PX)
    return coarse_view if len(coarse_view.points_frame_m) else _sample_at_step(scene, view, 1, coarse_view.edge_samples)


def _sample_at_step(scene: Scene, view: PerspectiveView, step_px: int, edge_samples: NeighbourSamples | None = None) -> CoarseView:
    """Return the view sampled every ``step_px`` pixels.

    The result holds ``edge_samples`` if they are given, else samples of its own. A view of every pixel gets those of the coarse
    view, since its own would need too much memory in the cache.
    """
    coarse_camera = replace(view, step_px=view.step_px * step_px, rows=-(-view.rows // step_px), cols=-(-view.cols // step_px))
    frame = view.frame(scene.world)
    ground, solids = ground_mesh(scene, coarse_camera), solid_vertices(scene.objects, frame)
    meshes = [(ground.position_frame_m, ground.triangles)]
    if solids is not None and scene.objects.solids is not None:
        meshes.append((solids, scene.objects.solids.triangles))
    number, depth_m = rasterize_triangles(
        coarse_camera, frame, meshes, np.array(NEIGHBOUR_OFFSETS if edge_samples is None else NEIGHBOUR_OFFSETS[:1]) / step_px
    )
    id_buffer = IdBuffer(np.ascontiguousarray(number[..., 0]), np.zeros((0, 0, 4), np.uint8), np.zeros((0, 0), np.float32))
    if edge_samples is None:
        row, col = (step_px * index.ravel() for index in np.indices(id_buffer.triangle_number.shape))
        shape, normals = (len(row), len(NEIGHBOUR_OFFSETS)), mesh_normals(scene.objects)
        edge_samples = NeighbourSamples(
            view, row, col, number.reshape(shape), depth_m.reshape(shape), len(ground.triangles), normals
        )
        has_edge = edge_mask_of_neighbours(
            edge_samples.triangle_number, edge_samples.distance_m, edge_samples.ground_triangle_count, edge_samples.face_normals
        )
    else:
        depth = (NEAR_PLANE_M / depth_m[..., 0]).astype(np.float32)
        has_edge = edge_mask(
            id_buffer.triangle_number, depth, edge_samples.ground_triangle_count, edge_samples.face_normals, NEAR_PLANE_M
        )
    geometry = resolve_buffer(scene, coarse_camera, _CoarseRaster(frame, ground, solids, id_buffer))
    points = geometry.position_frame_m[geometry.valid]
    eye, _ = view.in_frame(frame)
    distance_m = np.linalg.norm(points - eye, axis=-1)
    return CoarseView(
        geometry,
        eye,
        points,
        distance_m,
        geometry.height_m[geometry.valid],
        coarse_camera.pixel_tangent,
        float(has_edge.mean()),
        edge_samples,
    )


def rasterize_triangles(
    view: PerspectiveView, frame: LocalFrame, meshes: list[tuple[np.ndarray, np.ndarray]], sample_offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest triangle at k sample positions of each pixel, and its distance along the view axis.

    The numbers have shape (rows, cols, k) and dtype uint32. The distances are float64 metres, infinite where no triangle is hit.
    ``sample_offsets`` (k, 2) holds the sample offsets from the pixel's centre, down and to the right, in pixels. Each mesh is a
    pair of vertices (n, 3) in ``frame`` and triangles (m, 3). Triangles are numbered from 1 through all meshes.
    """
    eye, camera_from_frame = view.in_frame(frame)
    number = np.zeros((view.rows, view.cols, len(sample_offsets)), np.uint32)
    depth = np.full(number.shape, np.inf)
    tangents = np.array([view.col0, view.row0, view.step_px]) / view.focal_px
    first = 1
    for vertices, triangles in meshes:
        in_camera, pixel = _project_vertices(vertices, eye, np.ascontiguousarray(camera_from_frame), tangents)
        _rasterize(in_camera, pixel, triangles, tangents, sample_offsets, NEAR_PLANE_M, first, number, depth)
        first += len(triangles)
    return number, depth


@compiled
def _project_vertices(vertices, eye, rotation, tangents):
    """Return vertices (n, 3) in camera axes, and their columns and rows (n, 2) in the picture.

    Columns and rows are valid for vertices in front of the eye only. ``tangents`` are the tangents of the first column and row, and
    the step of a pixel.
    """
    camera_position, pixel = np.empty((len(vertices), 3)), np.empty((len(vertices), 2))
    for n in range(len(vertices)):
        x, y, z = vertices[n, 0] - eye[0], vertices[n, 1] - eye[1], vertices[n, 2] - eye[2]
        for k in range(3):
            camera_position[n, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
        for k in range(2):
            pixel[n, k] = (camera_position[n, k] / camera_position[n, 2] - tangents[k]) / tangents[2]
    return camera_position, pixel


@internal
def _is_outside_frustum(a, b, c, tangents, max_offset_px, rows, cols):
    """Return whether a triangle lies entirely beyond one side of the view frustum widened by ``max_offset_px`` pixels.

    ``a``, ``b`` and ``c`` (3,) are its corners in camera axes. ``tangents`` (3,) is that of ``_project_vertices``, and the picture
    has ``rows`` x ``cols`` pixels.
    """
    for k in range(2):
        low = tangents[k] - max_offset_px * tangents[2]
        high = low + ((cols if k == 0 else rows) - 1 + 2.0 * max_offset_px) * tangents[2]
        if a[k] < low * a[2] and b[k] < low * b[2] and c[k] < low * c[2]:
            return True
        if a[k] > high * a[2] and b[k] > high * b[2] and c[k] > high * c[2]:
            return True
    return False


@compiled
def _rasterize(camera_vertices, pixel, triangles, tangents, offsets, near, first, number, depth):
    """Write the nearest triangle of one mesh at each sample to ``number`` and ``depth`` (rows, cols, k), where it is nearer.

    ``camera_vertices`` (n, 3) and ``pixel`` (n, 2) are the results of ``_project_vertices``, and ``tangents`` (3,) its parameter.
    ``offsets`` (k, 2) are the samples' offsets from the pixel's centre, down and to the right, in pixels. ``near`` is the distance
    of the near plane, metres, and ``first`` the number of the mesh's first triangle. ``depth`` is the distance along the view's
    axis, metres.
    """
    rows, cols, samples = number.shape
    max_offset_px = np.abs(offsets).max()
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        behind_near = (camera_vertices[i, 2] < near) + (camera_vertices[j, 2] < near) + (camera_vertices[k, 2] < near)
        if behind_near == 3:
            continue
        if behind_near == 0:
            low_col, high_col = min(pixel[i, 0], pixel[j, 0], pixel[k, 0]), max(pixel[i, 0], pixel[j, 0], pixel[k, 0])
            low_row, high_row = min(pixel[i, 1], pixel[j, 1], pixel[k, 1]), max(pixel[i, 1], pixel[j, 1], pixel[k, 1])
            if not (
                high_col >= -max_offset_px
                and low_col <= cols - 1 + max_offset_px
                and high_row >= -max_offset_px
                and low_row <= rows - 1 + max_offset_px
            ):
                continue
            # Samples lie in the row or the column of a pixel's centre. A box without such a row or column contains no sample.
            if np.ceil(low_col) > high_col and np.ceil(low_row) > high_row:
                continue
            c0, c1 = int(np.ceil(max(low_col - max_offset_px, 0.0))), int(min(high_col + max_offset_px, cols - 1.0))
            r0, r1 = int(np.ceil(max(low_row - max_offset_px, 0.0))), int(min(high_row + max_offset_px, rows - 1.0))
        elif _is_outside_frustum(camera_vertices[i], camera_vertices[j], camera_vertices[k], tangents, max_offset_px, rows, cols):
            continue
        else:
            r0, r1, c0, c1 = 0, rows - 1, 0, cols - 1
        if c0 > c1 or r0 > r1:
            continue
        a0, a1, a2 = camera_vertices[i, 0], camera_vertices[i, 1], camera_vertices[i, 2]
        b0, b1, b2 = camera_vertices[j, 0], camera_vertices[j, 1], camera_vertices[j, 2]
        d0, d1, d2 = camera_vertices[k, 0], camera_vertices[k, 1], camera_vertices[k, 2]
        u0, u1, u2 = b1 * d2 - b2 * d1, b2 * d0 - b0 * d2, b0 * d1 - b1 * d0
        v0, v1, v2 = d1 * a2 - d2 * a1, d2 * a0 - d0 * a2, d0 * a1 - d1 * a0
        w0, w1, w2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        volume = a0 * u0 + a1 * u1 + a2 * u2
        side = 1.0 if volume > 0.0 else -1.0
        # Upper bounds of the decrease of each edge function from a pixel's centre to a sample.
        wide = max_offset_px * tangents[2]
        less_u, less_v, less_w = wide * (abs(u0) + abs(u1)), wide * (abs(v0) + abs(v1)), wide * (abs(w0) + abs(w1))
        for r in range(r0, r1 + 1):
            y = tangents[1] + r * tangents[2]
            for c in range(c0, c1 + 1):
                x = tangents[0] + c * tangents[2]
                u, v, w = side * (x * u0 + y * u1 + u2), side * (x * v0 + y * v1 + v2), side * (x * w0 + y * w1 + w2)
                if u < -less_u or v < -less_v or w < -less_w:
                    continue
                for p in range(samples):
                    y_p, x_p = y + offsets[p, 0] * tangents[2], x + offsets[p, 1] * tangents[2]
                    u, v = side * (x_p * u0 + y_p * u1 + u2), side * (x_p * v0 + y_p * v1 + v2)
                    w = side * (x_p * w0 + y_p * w1 + w2)
                    if u < 0.0 or v < 0.0 or w < 0.0 or u + v + w <= 0.0:
                        continue
                    z = side * volume / (u + v + w)
                    if near <= z < depth[r, c, p]:
                        depth[r, c, p] = z
                        number[r, c, p] = first + t
