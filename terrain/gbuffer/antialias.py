"""Anti-aliasing: several samples in each pixel on an edge, one sample elsewhere (adaptive multisampling).

The samples are stored as more rows of pixels below the picture's own rows, in one buffer. So shadow algorithms treat them like any
other pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import NEAR_PLANE_M
from skugga.terrain.gbuffer.map_block import EDGE_SAMPLES_PER_SIDE, has_map_block, map_block
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.view_geometry import RasterisedView, geometry_buffer, ground_imagery, resolve_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.facets import face_normals
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

ALL_SAMPLE_INDICES, DIAGONAL_SAMPLE_INDICES = (0, 1, 2, 3), (0, 3)
"""Indices of the samples in use: all four, or two diagonal ones in pictures with many edges (``MIN_DENSE_EDGE_SHARE``)."""

MIN_DENSE_EDGE_SHARE = 0.12
"""Share of pixels on edges above which only the diagonal samples are used. Pictures of woods exceed it."""

MIN_FACE_COSINE = 0.9
"""Cosine between the normals of neighbouring mesh faces below which an edge lies between them."""

MAX_DEPTH_STEP_SHARE = 0.02
"""Maximum difference between the distances of two neighbours without an edge between them, as a share of the smaller distance."""

NEIGHBOUR_OFFSETS = ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
"""Row and column offsets of a pixel and its four neighbours, which decide whether the pixel lies on an edge."""


@dataclass(frozen=True, eq=False)
class MultisampledBuffer:
    """A picture's geometry buffer, with rows of extra anti-aliasing samples below its own rows.

    Attributes
    ----------
    buffer
        The buffer: the picture's own rows, then rows of samples. Samples follow one another in the order of ``sampled_pixels``, and
        the last row is padded with copies of the last sample.
    picture_rows
        The number of the picture's own rows.
    sampled_pixels
        Rows (n,) and columns (n,) of the pixels that have samples.
    sample_count
        The number of samples of each of these pixels, without the pixel's own point.
    """

    buffer: GeometryBuffer
    picture_rows: int
    sampled_pixels: tuple[np.ndarray, np.ndarray] = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    sample_count: int = len(ALL_SAMPLE_INDICES)

    @property
    def has_samples(self) -> bool:
        """Whether any pixel has samples."""
        return len(self.sampled_pixels[0]) > 0

    @cached_property
    def pixel_buffer(self) -> GeometryBuffer:
        """The buffer of the picture's own pixels, without samples."""
        if not self.has_samples:
            return self.buffer
        shape = self.buffer.valid.shape
        changes: dict[str, Any] = {}
        for item in fields(GeometryBuffer):
            value = getattr(self.buffer, item.name)
            if isinstance(value, np.ndarray) and value.shape[:2] == shape:
                changes[item.name] = value[: self.picture_rows]
        return replace(self.buffer, **changes)

    def pixels_of_points(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows (n,) and columns (n,) of the picture's pixels that show the buffer's points at ``row`` and ``col`` (n,).

        A point in a row of samples belongs to the pixel that it is a sample of.
        """
        sample = np.flatnonzero(row >= self.picture_rows)
        row, col = row.copy(), col.copy()
        if len(sample):
            pixel_index = ((row[sample] - self.picture_rows) * self.buffer.valid.shape[1] + col[sample]) // self.sample_count
            pixel_index = np.minimum(pixel_index, len(self.sampled_pixels[0]) - 1)
            row[sample], col[sample] = self.sampled_pixels[0][pixel_index], self.sampled_pixels[1][pixel_index]
        return row, col

    def average_samples(self, linear: np.ndarray) -> np.ndarray:
        """Average linear values (m, cols, k) of all the buffer's points to the picture's pixels (rows, cols, k).

        A pixel's mean includes its own point and its samples.
        """
        out = linear[: self.picture_rows].copy()
        samples = linear[self.picture_rows :].reshape(-1, linear.shape[-1])
        run_in_chunks(len(self.sampled_pixels[0]), _average_samples, *self.sampled_pixels, samples, self.sample_count, out)
        return out


def finer_view(view: PerspectiveView) -> PerspectiveView:
    """Return the view of the same camera with a pixel for each possible sample: ``EDGE_SAMPLES_PER_SIDE`` along a pixel's side."""
    return view.finer(EDGE_SAMPLES_PER_SIDE)


def samples_per_pixel(edge_share: float) -> float:
    """Return the mean number of extra samples per pixel of a perspective view in which the share ``edge_share`` lies on edges."""
    return edge_share * len(DIAGONAL_SAMPLE_INDICES if edge_share > MIN_DENSE_EDGE_SHARE else ALL_SAMPLE_INDICES)


def picture_buffer(scene: Scene, view: MapView | PerspectiveView) -> MultisampledBuffer:
    """Return the buffer that a perspective view, or a block of a map, is drawn from.

    That of a map has no samples: ``skugga.shadows.map_edges`` finds the edges of its shadows after these are computed.
    """
    if not isinstance(view, MapView):
        return multisampled(scene, view)
    buffer = map_block(scene, view).buffer(scene) if has_map_block(scene) else geometry_buffer(scene, view)
    return MultisampledBuffer(buffer, view.rows)


def _cache_key(scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    """Return the cache key of ``multisampled``. It leaves out the sun and the lamps, which do not change the buffer."""
    return scene.world, scene.elevation, scene.map_crs, scene.objects, ground_imagery(scene), view.cache_key


@cached("scene", 512 * MIB, key=_cache_key, max_entries=1)
def multisampled(scene: Scene, view: PerspectiveView) -> MultisampledBuffer:
    """Return the buffer of a perspective view, with samples in the pixels on edges.

    The buffer is the same under any sun. The cache holds that of the last view.
    """
    multisampled.cache.clear()  # free the last one's memory before the next one is allocated
    frame = view.frame(scene.world)
    visible = RasterisedView(scene, view, frame)
    normals = mesh_normals(scene.objects)
    row, col = np.nonzero(
        edge_mask(visible.id_buffer.triangle_number, visible.id_buffer.depth, len(visible.ground.triangles), normals, NEAR_PLANE_M)
    )
    if not len(row):
        return MultisampledBuffer(resolve_buffer(scene, view, visible), view.rows)
    sample_positions = np.array(
        DIAGONAL_SAMPLE_INDICES if len(row) > MIN_DENSE_EDGE_SHARE * view.rows * view.cols else ALL_SAMPLE_INDICES
    )
    padding = -len(row) * len(sample_positions) % view.cols
    fine_row, fine_col = (
        np.pad((pixel_index[:, None] * EDGE_SAMPLES_PER_SIDE + offset).ravel(), (0, padding), mode="edge").reshape(-1, view.cols)
        for pixel_index, offset in (
            (row, sample_positions // EDGE_SAMPLES_PER_SIDE),
            (col, sample_positions % EDGE_SAMPLES_PER_SIDE),
        )
    )
    finer = finer_view(view)
    pixel_mask = np.zeros((finer.rows, finer.cols), np.bool_)
    pixel_mask[fine_row, fine_col] = True
    samples = (finer, RasterisedView(scene, finer, frame, pixel_mask=pixel_mask), (fine_row, fine_col))
    return MultisampledBuffer(resolve_buffer(scene, view, visible, samples), view.rows, (row, col), len(sample_positions))


@cached("scene", 128 * MIB)
def mesh_normals(objects: SceneObjects) -> np.ndarray:
    """Return the unit normals (m, 3) float32 of the faces of the meshes."""
    solids = objects.solids
    return np.zeros((0, 3), np.float32) if solids is None else face_normals(solids.vertices_earth_m, solids.triangles)


def edge_mask(
    triangle_number: np.ndarray, depth: np.ndarray, ground_triangle_count: int, normals: np.ndarray, near_m: float
) -> np.ndarray:
    """Return the mask (rows, cols) of pixels on edges, on both sides of each edge.

    Parameters
    ----------
    triangle_number
        (rows, cols), the number of the triangle in each pixel, from 1; 0 without one. The ground's triangles come first, then those
        of the meshes, then those of the trees.
    depth
        (rows, cols), ``near_m`` over the distance along the view's axis.
    ground_triangle_count
        The number of the ground's triangles.
    normals
        (m, 3), unit normals of the meshes' triangles.
    near_m
        Distance of the near plane, metres.
    """
    is_edge = np.zeros(triangle_number.shape, np.bool_)
    run_in_chunks(
        len(is_edge), _mark_edge_pixels, triangle_number, depth, ground_triangle_count, normals, near_m, MIN_FACE_COSINE,
        MAX_DEPTH_STEP_SHARE, is_edge,
    )  # fmt: skip
    return is_edge


def edge_mask_of_neighbours(
    triangle_number: np.ndarray, distance_m: np.ndarray, ground_triangle_count: int, normals: np.ndarray
) -> np.ndarray:
    """Return which of n single pixels lie on edges, bool (n,), from each pixel and its four neighbours.

    ``triangle_number`` and the distances ``distance_m`` along the view's axis, metres, have the shape (n, 5). The last axis follows
    ``NEIGHBOUR_OFFSETS``: the pixel itself comes first. The other parameters are those of ``edge_mask``.
    """
    return _edges_of_neighbours(triangle_number, distance_m, ground_triangle_count, normals, MIN_FACE_COSINE, MAX_DEPTH_STEP_SHARE)


@compiled
def _average_samples(first, last, row, col, samples, sample_count, out):
    """Write the mean of each pixel and its samples to the picture ``out`` (rows, cols, k).

    The pixels are at ``row`` and ``col`` (n,). Their samples are consecutive rows of ``samples`` (n * sample_count, k).
    """
    for n in range(first, last):
        for k in range(out.shape[2]):
            total = samples[n * sample_count, k]
            for m in range(1, sample_count):
                total += samples[n * sample_count + m, k]
            out[row[n], col[n], k] = (out[row[n], col[n], k] + total) / (1 + sample_count)


@compiled
def _mark_edge_pixels(first, last, triangle_number, depth, ground_triangle_count, normals, near, min_cosine, max_depth_step, out):
    """Set ``out`` (rows, cols) where a pixel differs from a neighbour by an edge, on both sides of each edge.

    The pairs of neighbours are those with their upper or left pixel in the rows from ``first`` to ``last`` (exclusive). The other
    pixel may lie in row ``last``: threads only ever set values to True there. ``near`` is the distance of the near plane, metres.
    ``min_cosine`` and ``max_depth_step`` are the limits ``MIN_FACE_COSINE`` and ``MAX_DEPTH_STEP_SHARE``. The other parameters are
    those of ``edge_mask``.
    """
    rows, cols = triangle_number.shape
    for i in range(first, last):
        for j in range(cols):
            triangle = np.int64(triangle_number[i, j]) - 1
            for step in range(2):
                a, b = i + step, j + 1 - step
                if a >= rows or b >= cols:
                    continue
                neighbour = np.int64(triangle_number[a, b]) - 1
                if _is_edge(
                    triangle,
                    neighbour,
                    near / depth[i, j],
                    near / depth[a, b],
                    ground_triangle_count,
                    normals,
                    min_cosine,
                    max_depth_step,
                ):
                    out[i, j] = True
                    out[a, b] = True


@compiled
def _edges_of_neighbours(triangle_number, distance, ground_triangle_count, normals, min_cosine, max_depth_step):
    """Return the result of ``edge_mask_of_neighbours``, bool (n,).

    ``distance`` (n, 5) is its ``distance_m``. ``min_cosine`` and ``max_depth_step`` are those of ``_mark_edge_pixels``.
    """
    out = np.zeros(len(triangle_number), np.bool_)
    for n in range(len(triangle_number)):
        triangle = np.int64(triangle_number[n, 0]) - 1
        for k in range(1, triangle_number.shape[1]):
            neighbour = np.int64(triangle_number[n, k]) - 1
            if _is_edge(
                triangle, neighbour, distance[n, 0], distance[n, k], ground_triangle_count, normals, min_cosine, max_depth_step
            ):
                out[n] = True
    return out


@internal
def _is_edge(triangle, neighbour, distance, neighbour_distance, ground_triangle_count, normals, min_cosine, max_depth_step):
    """Return whether an edge lies between a pixel and its neighbour.

    ``triangle`` and ``neighbour`` are the numbers of their triangles, from 0; negative without one. ``distance`` and
    ``neighbour_distance`` are their distances along the view's axis, metres. ``min_cosine`` and ``max_depth_step`` are those of
    ``_mark_edge_pixels``.
    """
    if triangle == neighbour:
        return False
    if _surface_kind(triangle, ground_triangle_count, len(normals)) != _surface_kind(
        neighbour, ground_triangle_count, len(normals)
    ):
        return True
    if abs(distance - neighbour_distance) > max_depth_step * min(distance, neighbour_distance):
        return True
    if not ground_triangle_count <= triangle < ground_triangle_count + len(normals):
        return False
    n, m = normals[triangle - ground_triangle_count], normals[neighbour - ground_triangle_count]
    return n[0] * m[0] + n[1] * m[1] + n[2] * m[2] < min_cosine


@internal
def _surface_kind(triangle, ground_triangle_count, solids):
    """Return the kind of surface of the triangle number ``triangle``, which counts from 0 and is negative without a triangle.

    ``solids`` is the number of the meshes' triangles.
    """
    if triangle < 0:
        return NO_SURFACE
    return RELIEF if triangle < ground_triangle_count else MESHES if triangle < ground_triangle_count + solids else FOREST
