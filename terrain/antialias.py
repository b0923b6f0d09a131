"""Anti-aliased pictures of perspective views: four samples in every pixel where something ends, one elsewhere.

The samples are rows of pixels below the picture's own in one buffer, so that algorithms fill them like any others.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from terrain.camera import PerspectiveView
from terrain.compiled import compiled
from terrain.geometry import GeometryBuffer
from terrain.picture import Visible, buffer_of
from terrain.scene import Scene

SIDE = 2
"""Samples a side in a pixel where something ends."""

BEND = 0.9
"""Cosine between the normals of neighbouring pixels below which an edge lies between them."""

JUMP = 0.02
"""Share of the distance by which a neighbour may lie farther away without an edge between them."""


NO_PIXELS = (np.zeros(0, np.int64), np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class Sampled:
    """A picture's buffer with samples below it: its own rows, and the pixels (n,) that the samples are of (four each, in
    order; the last row may be filled up with repetitions).
    """

    buffer: GeometryBuffer
    rows: int
    pixels: tuple[np.ndarray, np.ndarray]

    def averaged(self, linear: np.ndarray) -> np.ndarray:
        """The picture (rows, cols, k) of what was computed for all points: means of the samples where there are any."""
        out = linear[: self.rows].copy()
        row, col = self.pixels
        if len(row):
            samples = linear[self.rows :].reshape(-1, linear.shape[-1])[: len(row) * SIDE**2]
            out[row, col] = samples.reshape(len(row), SIDE**2, -1).mean(axis=1)
        return out


def sampled(scene: Scene, view: PerspectiveView, buffer: GeometryBuffer) -> Sampled:
    """A view's buffer with samples wherever something ends in it."""
    eye, _ = view.in_frame(buffer.frame)
    row, col = np.nonzero(edges(buffer.kind, buffer.position_frame_m, buffer.shading_normal_frame, eye, BEND, JUMP))
    if not len(row):
        return Sampled(buffer, view.rows, (row, col))
    fine = view.finer(SIDE)
    inside = np.arange(SIDE**2)
    fine_row = (row[:, None] * SIDE + inside // SIDE).ravel()
    fine_col = (col[:, None] * SIDE + inside % SIDE).ravel()
    spare = -len(fine_row) % view.cols
    shape = (-1, view.cols)
    at = tuple(np.pad(v, (0, spare), mode="edge").reshape(shape) for v in (fine_row, fine_col))
    below = buffer_of(scene, fine, Visible(scene, fine, buffer.frame), at)  # type: ignore[arg-type]
    joined = {}
    for item in fields(GeometryBuffer):
        above = getattr(buffer, item.name)
        if isinstance(above, np.ndarray) and above.shape[:2] == buffer.there.shape:
            joined[item.name] = np.concatenate([above, getattr(below, item.name)])
    return Sampled(replace(buffer, **joined), view.rows, (row, col))


@compiled
def edges(kind, point, normal, eye, bend, jump):  # type: ignore[no-untyped-def]
    """Where something ends: bool (rows, cols), both pixels beside an edge, and all of foliage."""
    rows, cols = kind.shape
    out = np.zeros((rows, cols), np.bool_)
    for i in range(rows):
        for j in range(cols):
            if kind[i, j] == 3:
                out[i, j] = True
            for step in range(2):
                a, b = i + step, j + 1 - step
                if a >= rows or b >= cols:
                    continue
                ends = kind[i, j] != kind[a, b]
                if not ends and kind[i, j] != 0:
                    facing = 0.0
                    near, far = 0.0, 0.0
                    for k in range(3):
                        facing += normal[i, j, k] * normal[a, b, k]
                        near += (point[i, j, k] - eye[k]) ** 2
                        far += (point[a, b, k] - eye[k]) ** 2
                    near, far = np.sqrt(near), np.sqrt(far)
                    ends = facing < bend or abs(far - near) > jump * min(near, far)
                if ends:
                    out[i, j] = True
                    out[a, b] = True
    return out
