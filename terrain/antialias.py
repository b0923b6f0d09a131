"""Anti-aliased pictures of perspective views: more samples in every pixel where something ends, one elsewhere.

The samples are rows of pixels below the picture's own in one buffer, so that algorithms fill them like any others.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from terrain.camera import PerspectiveView
from terrain.compiled import compiled
from terrain.facets import face_normals
from terrain.geometry import GeometryBuffer
from terrain.picture import Visible, buffer_of
from terrain.scene import Scene
from terrain.visible import NEAR_M

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


@dataclass(frozen=True, eq=False)
class Sampled:
    """A picture's buffer with samples below it: its own rows, the pixels (n,) that the samples are of (``each`` of them, in
    order; the last row may be filled up with repetitions).
    """

    buffer: GeometryBuffer
    rows: int
    pixels: tuple[np.ndarray, np.ndarray] = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    each: int = len(EVERY)

    @property
    def own(self) -> GeometryBuffer:
        """The picture's own pixels alone."""
        if not len(self.pixels[0]):
            return self.buffer
        shape, changes = self.buffer.there.shape, {}
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
        row, col = self.pixels
        if len(row):
            samples = linear[self.rows :].reshape(-1, linear.shape[-1])[: len(row) * self.each]
            out[row, col] = (out[row, col] + samples.reshape(len(row), self.each, -1).sum(axis=1)) / (1 + self.each)
        return out


def finer_view(view: PerspectiveView) -> PerspectiveView:
    """The view of the same camera whose pixels the samples of a view are."""
    return view.finer(SIDE)


def sampled(scene: Scene, view: PerspectiveView) -> Sampled:
    """A view's buffer with samples wherever something ends in it."""
    frame = view.frame(scene.world)
    visible = Visible(scene, view, frame)
    solids = scene.population.solids
    normals = np.zeros((0, 3), np.float32) if solids is None else face_normals(solids.vertices_earth_m, solids.triangles)
    row, col = np.nonzero(
        _edges(visible.seen.number, visible.seen.depth, len(visible.ground.triangles), normals, NEAR_M, BEND, JUMP)
    )
    if not len(row):
        return Sampled(buffer_of(scene, view, visible), view.rows)
    places = np.array(DIAGONAL if len(row) > DENSE * view.rows * view.cols else EVERY)
    spare = -len(row) * len(places) % view.cols
    fine_row, fine_col = (
        np.pad((of[:, None] * SIDE + inside).ravel(), (0, spare), mode="edge").reshape(-1, view.cols)
        for of, inside in ((row, places // SIDE), (col, places % SIDE))
    )
    finer = finer_view(view)
    below = (finer, Visible(scene, finer, frame), (fine_row, fine_col))
    return Sampled(buffer_of(scene, view, visible, below), view.rows, (row, col), len(places))


@compiled
def _edges(number, depth, ground, normals, near, bend, jump):  # type: ignore[no-untyped-def]
    """Where something ends: bool (rows, cols), both pixels beside an edge."""
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
                if own == other:
                    continue
                ends = _kind(own, ground, len(normals)) != _kind(other, ground, len(normals))
                if not ends:
                    here, there = near / depth[i, j], near / depth[a, b]
                    ends = abs(here - there) > jump * min(here, there)
                if not ends and ground <= own < ground + len(normals):
                    n, m = normals[own - ground], normals[other - ground]
                    ends = n[0] * m[0] + n[1] * m[1] + n[2] * m[2] < bend
                if ends:
                    out[i, j] = True
                    out[a, b] = True
    return out


@compiled
def _kind(triangle, ground, solids):  # type: ignore[no-untyped-def]
    if triangle < 0:
        return 0
    return 1 if triangle < ground else 2 if triangle < ground + solids else 3
