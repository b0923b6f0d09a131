"""Anti-aliasing: several samples in each pixel on an edge, one sample elsewhere (adaptive multisampling).

The samples are rows of pixels below the picture's own rows in one buffer, so that algorithms fill them like any other pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import NEAR_M
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.view_geometry import RasterisedView, geometry_buffer, ground_imagery, resolve_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.facets import face_normals
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

SAMPLES_PER_SIDE = 2
"""Side of the sample grid of a pixel on an edge. The pixel's own point is one more sample."""

ALL_SAMPLES, DIAGONAL_SAMPLES = (0, 1, 2, 3), (0, 3)
"""The positions of the sample grid in use: all, or two diagonal ones in pictures with many edges (``DENSE_EDGE_SHARE``)."""

DENSE_EDGE_SHARE = 0.12
"""Share of pixels on edges above which the diagonal samples are used, as in woods."""

MIN_FACE_COSINE = 0.9
"""Cosine between the normals of neighbouring mesh faces below which an edge lies between them."""

MAX_DEPTH_STEP = 0.02
"""Maximum difference between the distances of two neighbours without an edge between them, as a share of the smaller distance."""

CROSS_OFFSETS = ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
"""Row and column offsets of a pixel and its four neighbours, which decide whether the pixel lies on an edge."""


@dataclass(frozen=True, eq=False)
class MultisampledBuffer:
    """A picture's geometry buffer, with rows of extra anti-aliasing samples below its own rows.

    Attributes
    ----------
    buffer
        The picture's own rows, then rows of samples.
    rows
        The number of the picture's own rows.
    pixels
        Rows and columns (n,) of the pixels that have samples.
    sample_count
        Samples of each of these pixels. Samples follow one another in the order of ``pixels``; padding repeats the last one.
    """

    buffer: GeometryBuffer
    rows: int
    pixels: tuple[np.ndarray, np.ndarray] = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    sample_count: int = len(ALL_SAMPLES)

    @property
    def has_samples(self) -> bool:
        """Whether any pixel has samples."""
        return len(self.pixels[0]) > 0

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
                changes[item.name] = value[: self.rows]
        return replace(self.buffer, **changes)

    def pixels_of(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of the picture's pixels that rows and columns of the buffer belong to."""
        sample = np.flatnonzero(row >= self.rows)
        row, col = row.copy(), col.copy()
        if len(sample):
            pixel_index = ((row[sample] - self.rows) * self.buffer.valid.shape[1] + col[sample]) // self.sample_count
            pixel_index = np.minimum(pixel_index, len(self.pixels[0]) - 1)
            row[sample], col[sample] = self.pixels[0][pixel_index], self.pixels[1][pixel_index]
        return row, col

    def averaged(self, linear: np.ndarray) -> np.ndarray:
        """Return the picture (rows, cols, k) of linear values of all points: the mean over each pixel's samples."""
        out = linear[: self.rows].copy()
        samples = linear[self.rows :].reshape(-1, linear.shape[-1])
        run_in_chunks(len(self.pixels[0]), _average_samples, *self.pixels, samples, self.sample_count, out)
        return out


def finer_view(view: PerspectiveView) -> PerspectiveView:
    """Return the view of the same camera that has a pixel for each possible sample."""
    return view.finer(SAMPLES_PER_SIDE)


def samples_per_pixel(edge_share: float) -> float:
    """Return the mean number of extra samples of a perspective view's pixel, from the share of pixels on edges."""
    return edge_share * len(DIAGONAL_SAMPLES if edge_share > DENSE_EDGE_SHARE else ALL_SAMPLES)


def picture_buffer(scene: Scene, view: MapView | PerspectiveView) -> MultisampledBuffer:
    """Return the buffer that a view (a block, if it is a map) is drawn from.

    A map has no samples yet: its edges are known once its shadows are (``skugga.shadows.map_edges``).
    """
    return MultisampledBuffer(geometry_buffer(scene, view), view.rows) if isinstance(view, MapView) else multisampled(scene, view)


def _cache_key(scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    return scene.world, scene.elevation, scene.map_crs, scene.objects, ground_imagery(scene), view.cache_key


@cached("scene", 512 * MIB, key=_cache_key, max_entries=1)
def multisampled(scene: Scene, view: PerspectiveView) -> MultisampledBuffer:
    """Return a perspective view's buffer with samples in the pixels on edges.

    The cache holds the last one: it is the same under any sun.
    """
    multisampled.cache.clear()  # free the last one's memory before the next one is allocated
    frame = view.frame(scene.world)
    visible = RasterisedView(scene, view, frame)
    normals = mesh_normals(scene.objects)
    row, col = np.nonzero(
        edge_mask(visible.id_buffer.number, visible.id_buffer.depth, len(visible.ground.triangles), normals, NEAR_M)
    )
    if not len(row):
        return MultisampledBuffer(resolve_buffer(scene, view, visible), view.rows)
    sample_positions = np.array(DIAGONAL_SAMPLES if len(row) > DENSE_EDGE_SHARE * view.rows * view.cols else ALL_SAMPLES)
    padding = -len(row) * len(sample_positions) % view.cols
    fine_row, fine_col = (
        np.pad((pixel_index[:, None] * SAMPLES_PER_SIDE + offset).ravel(), (0, padding), mode="edge").reshape(-1, view.cols)
        for pixel_index, offset in ((row, sample_positions // SAMPLES_PER_SIDE), (col, sample_positions % SAMPLES_PER_SIDE))
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


def edge_mask(number: np.ndarray, depth: np.ndarray, ground: int, normals: np.ndarray, near_m: float) -> np.ndarray:
    """Return the mask (rows, cols) of pixels on edges, on both sides of each edge.

    ``number`` counts triangles from 1: the first ``ground`` are the ground's, then come those of the meshes, with normals (m, 3).
    ``depth`` is ``near_m`` over the distance along the view's axis.
    """
    return _edges(number, depth, ground, normals, near_m, MIN_FACE_COSINE, MAX_DEPTH_STEP)


def edge_mask_of_crosses(number: np.ndarray, distance_m: np.ndarray, ground: int, normals: np.ndarray) -> np.ndarray:
    """Return which single pixels (n,) lie on edges.

    The last axis of ``number`` and of the distances ``distance_m`` (n, 5) follows ``CROSS_OFFSETS``: the pixel itself first.
    """
    return _edges_of_crosses(number, distance_m, ground, normals, MIN_FACE_COSINE, MAX_DEPTH_STEP)


@compiled
def _average_samples(first, last, row, col, samples, sample_count, out):
    """Write the mean of each pixel and its samples, which are consecutive rows of ``samples`` (n * each, k), to the picture."""
    for n in range(first, last):
        for k in range(out.shape[2]):
            total = samples[n * sample_count, k]
            for m in range(1, sample_count):
                total += samples[n * sample_count + m, k]
            out[row[n], col[n], k] = (out[row[n], col[n], k] + total) / (1 + sample_count)


@compiled
def _edges(number, depth, ground, normals, near, min_cosine, max_depth_step):
    rows, cols = number.shape
    out = np.zeros((rows, cols), np.bool_)
    for i in range(rows):
        for j in range(cols):
            triangle = np.int64(number[i, j]) - 1
            for step in range(2):
                a, b = i + step, j + 1 - step
                if a >= rows or b >= cols:
                    continue
                neighbour = np.int64(number[a, b]) - 1
                if _is_edge(
                    triangle, neighbour, near / depth[i, j], near / depth[a, b], ground, normals, min_cosine, max_depth_step
                ):
                    out[i, j] = True
                    out[a, b] = True
    return out


@compiled
def _edges_of_crosses(number, distance, ground, normals, min_cosine, max_depth_step):
    out = np.zeros(len(number), np.bool_)
    for n in range(len(number)):
        triangle = np.int64(number[n, 0]) - 1
        for k in range(1, number.shape[1]):
            neighbour = np.int64(number[n, k]) - 1
            if _is_edge(triangle, neighbour, distance[n, 0], distance[n, k], ground, normals, min_cosine, max_depth_step):
                out[n] = True
    return out


@internal
def _is_edge(triangle, neighbour, distance, neighbour_distance, ground, normals, min_cosine, max_depth_step):
    """Return whether an edge lies between two neighbours.

    Triangles count from 0 (negative: none). ``distance`` and ``neighbour_distance`` are distances along the view's axis.
    """
    if triangle == neighbour:
        return False
    if _kind(triangle, ground, len(normals)) != _kind(neighbour, ground, len(normals)):
        return True
    if abs(distance - neighbour_distance) > max_depth_step * min(distance, neighbour_distance):
        return True
    if not ground <= triangle < ground + len(normals):
        return False
    n, m = normals[triangle - ground], normals[neighbour - ground]
    return n[0] * m[0] + n[1] * m[1] + n[2] * m[2] < min_cosine


@internal
def _kind(triangle, ground, solids):
    if triangle < 0:
        return NO_SURFACE
    return RELIEF if triangle < ground else MESHES if triangle < ground + solids else FOREST
