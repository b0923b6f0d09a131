"""Anti-aliased pictures: more samples in every pixel where something ends, one elsewhere.

The samples are rows of pixels below the picture's own in one buffer, so that algorithms fill them like any others.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, in_shares, internal
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import NEAR_M
from skugga.terrain.gbuffer.picture import RasterisedView, buffer_of, geometry_of, imagery_of
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, NO_SURFACE, RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.facets import face_normals
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

SIDE = 2
"""The samples of a pixel where something ends lie on a grid of so many a side; its own point counts as one more."""

EVERY, DIAGONAL = (0, 1, 2, 3), (0, 3)
"""Which of the grid's places are taken: all, or two where edges are ..."""

DENSE = 0.12
"""... in more than this share of the pixels, as in woods."""

BEND = 0.9
"""Cosine between the normals of neighbouring faces of meshes below which an edge lies between them."""

JUMP = 0.02
"""Share of the distance by which a neighbour may lie farther away without an edge between them."""

CROSS = ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
"""A pixel and those beside it, which decide whether something ends in it: rows and columns from it."""


@dataclass(frozen=True, eq=False)
class MultisampledBuffer:
    """A picture's buffer with samples below it: its own rows, the pixels (n,) that the samples are of (``each`` of them, in
    order; the last row may be filled up with repetitions).
    """

    buffer: GeometryBuffer
    rows: int
    pixels: tuple[np.ndarray, np.ndarray] = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    each: int = len(EVERY)

    @property
    def sampled(self) -> bool:
        """Whether any pixels have samples."""
        return len(self.pixels[0]) > 0

    @cached_property
    def own(self) -> GeometryBuffer:
        """The picture's own pixels alone."""
        if not self.sampled:
            return self.buffer
        shape = self.buffer.there.shape
        changes: dict[str, Any] = {}
        for item in fields(GeometryBuffer):
            value = getattr(self.buffer, item.name)
            if isinstance(value, np.ndarray) and value.shape[:2] == shape:
                changes[item.name] = value[: self.rows]
        return replace(self.buffer, **changes)

    def pixels_of(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The picture's pixels (rows and columns) that rows and columns of the buffer belong to."""
        sample = np.flatnonzero(row >= self.rows)
        row, col = row.copy(), col.copy()
        if len(sample):
            own = ((row[sample] - self.rows) * self.buffer.there.shape[1] + col[sample]) // self.each
            own = np.minimum(own, len(self.pixels[0]) - 1)
            row[sample], col[sample] = self.pixels[0][own], self.pixels[1][own]
        return row, col

    def averaged(self, linear: np.ndarray) -> np.ndarray:
        """The picture (rows, cols, k) of what was computed for all points: means of the samples where there are any."""
        out = linear[: self.rows].copy()
        samples = linear[self.rows :].reshape(-1, linear.shape[-1])
        in_shares(len(self.pixels[0]), _mix_in, *self.pixels, samples, self.each, out)
        return out


def finer_view(view: PerspectiveView) -> PerspectiveView:
    """The view of the same camera whose pixels the samples of a view are."""
    return view.finer(SIDE)


def samples_per_pixel(edge_share: float) -> float:
    """How many further samples a perspective view's pixels get in the mean, where something ends in such a share of them."""
    return edge_share * len(DIAGONAL if edge_share > DENSE else EVERY)


def picture_buffer(scene: Scene, view: MapView | PerspectiveView) -> MultisampledBuffer:
    """The buffer that a view (a block, if it is a map) is drawn from. Where edges run in a map only its shadows tell: samples come
    later (``skugga.shadows.map_edges``).
    """
    return MultisampledBuffer(geometry_of(scene, view), view.rows) if isinstance(view, MapView) else multisampled(scene, view)


def _made_from(scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    return scene.world, scene.elevation, scene.map_crs, scene.objects, imagery_of(scene), view.numbers


@cached("scene", 512 * MIB, key=_made_from, most=1)
def multisampled(scene: Scene, view: PerspectiveView) -> MultisampledBuffer:
    """A view's buffer with samples wherever something ends in it. The last one is kept: it is the same under any sun."""
    multisampled.cache.clear()  # the last one goes before the next one takes its room
    frame = view.frame(scene.world)
    visible = RasterisedView(scene, view, frame)
    normals = mesh_normals(scene.objects)
    row, col = np.nonzero(edges_between(visible.seen.number, visible.seen.depth, len(visible.ground.triangles), normals, NEAR_M))
    if not len(row):
        return MultisampledBuffer(buffer_of(scene, view, visible), view.rows)
    places = np.array(DIAGONAL if len(row) > DENSE * view.rows * view.cols else EVERY)
    spare = -len(row) * len(places) % view.cols
    fine_row, fine_col = (
        np.pad((pixel_index[:, None] * SIDE + inside).ravel(), (0, spare), mode="edge").reshape(-1, view.cols)
        for pixel_index, inside in ((row, places // SIDE), (col, places % SIDE))
    )
    finer = finer_view(view)
    wanted = np.zeros((finer.rows, finer.cols), np.bool_)
    wanted[fine_row, fine_col] = True
    below = (finer, RasterisedView(scene, finer, frame, wanted=wanted), (fine_row, fine_col))
    return MultisampledBuffer(buffer_of(scene, view, visible, below), view.rows, (row, col), len(places))


@cached("scene", 128 * MIB)
def mesh_normals(objects: SceneObjects) -> np.ndarray:
    """Unit normals (m, 3) float32 of the faces of a population's meshes."""
    solids = objects.solids
    return np.zeros((0, 3), np.float32) if solids is None else face_normals(solids.vertices_earth_m, solids.triangles)


def edges_between(number: np.ndarray, depth: np.ndarray, ground: int, normals: np.ndarray, near_m: float) -> np.ndarray:
    """Where something ends: bool (rows, cols), both pixels beside an edge. Of each pixel, the number of its triangle (the first
    ``ground`` are the ground's, then come the meshes', which have normals (m, 3)), and ``near_m`` over its distance along the axis.
    """
    return _edges(number, depth, ground, normals, near_m, BEND, JUMP)


def edges_in_neighbours(number: np.ndarray, away_m: np.ndarray, ground: int, normals: np.ndarray) -> np.ndarray:
    """The same (n,) of single pixels, the first of ``CROSS`` along the last axis of numbers and distances (n, 5)."""
    return _crossed(number, away_m, ground, normals, BEND, JUMP)


@compiled
def _mix_in(first, last, row, col, samples, each, out):
    """Put the mean of a pixel and its samples, which follow one another (n * each, k), into the picture."""
    for n in range(first, last):
        for k in range(out.shape[2]):
            total = samples[n * each, k]
            for m in range(1, each):
                total += samples[n * each + m, k]
            out[row[n], col[n], k] = (out[row[n], col[n], k] + total) / (1 + each)


@compiled
def _edges(number, depth, ground, normals, near, bend, jump):
    rows, cols = number.shape
    out = np.zeros((rows, cols), np.bool_)
    for i in range(rows):
        for j in range(cols):
            own = np.int64(number[i, j]) - 1
            for step in range(2):
                a, b = i + step, j + 1 - step
                if a >= rows or b >= cols:
                    continue
                other = np.int64(number[a, b]) - 1
                if _ends(own, other, near / depth[i, j], near / depth[a, b], ground, normals, bend, jump):
                    out[i, j] = True
                    out[a, b] = True
    return out


@compiled
def _crossed(number, away, ground, normals, bend, jump):
    out = np.zeros(len(number), np.bool_)
    for n in range(len(number)):
        own = np.int64(number[n, 0]) - 1
        for k in range(1, number.shape[1]):
            other = np.int64(number[n, k]) - 1
            if _ends(own, other, away[n, 0], away[n, k], ground, normals, bend, jump):
                out[n] = True
    return out


@internal
def _ends(own, other, here, there, ground, normals, bend, jump):
    """Whether something ends between two neighbours: triangles counted from 0 (below: none) at distances along the view's axis."""
    if own == other:
        return False
    if _kind(own, ground, len(normals)) != _kind(other, ground, len(normals)):
        return True
    if abs(here - there) > jump * min(here, there):
        return True
    if not ground <= own < ground + len(normals):
        return False
    n, m = normals[own - ground], normals[other - ground]
    return n[0] * m[0] + n[1] * m[1] + n[2] * m[2] < bend


@internal
def _kind(triangle, ground, solids):
    if triangle < 0:
        return NO_SURFACE
    return RELIEF if triangle < ground else MESHES if triangle < ground + solids else FOREST
