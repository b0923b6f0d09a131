"""Forward shadow mapping, after Zhang 1998, "Forward shadow mapping": the light's depth samples are projected into the eye's view.

A shadow map is usually looked up: each visible point finds its texel, and compares depths there. Forward mapping goes the other
way. Each texel of the light's map is a point that the light reaches. Projected into the picture, it lights the pixel on which it
falls, if the pixel shows the same surface. All other pixels stay dark. Samples can be splatted in two ways:

- as *points*: a sample lights the one pixel in which it falls,
- as *quads*: four neighbouring samples span two triangles, which light all pixels whose centres they cover.

A sample shows the same surface if its distance from the plane of the pixel's triangle is within a tolerance: a step of the map's
depth, the rounding of positions, and ``tolerance_texels`` times the shift of that distance by a texel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.maps.windows import POSITION_ERROR
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView


class EyePicture(NamedTuple):
    """The eye's picture, as the loops read it.

    Attributes
    ----------
    eye_m
        (3,): the eye in the frame, metres.
    camera_from_frame
        (3, 3): rotation from the frame to right, down and forward.
    lens
        (4,): focal length in pixels, row and column of the first pixel, and side of a pixel (``PerspectiveView``).
    can_be_lit
        bool (rows, cols): the pixel shows a surface that faces the light.
    position_frame_m
        (rows, cols, 3): the visible points, metres.
    normal_frame
        (rows, cols, 3): unit normals of their triangles.
    """

    eye_m: np.ndarray
    camera_from_frame: np.ndarray
    lens: np.ndarray
    can_be_lit: np.ndarray
    position_frame_m: np.ndarray
    normal_frame: np.ndarray


@dataclass(frozen=True, eq=False)
class ForwardMask:
    """The result of forward mapping.

    Attributes
    ----------
    counts
        int32 (rows, cols): number of samples, or of triangles between samples, that lit each pixel.
    samples
        Number of the map's texels that hold a sample.
    """

    counts: np.ndarray
    samples: int

    @property
    def is_lit(self) -> np.ndarray:
        """The mask of lit pixels (rows, cols)."""
        return self.counts > 0


def eye_picture(buffer: GeometryBuffer, can_be_lit: np.ndarray) -> EyePicture:
    """Return the picture of a perspective view's buffer, in which the pixels ``can_be_lit`` (rows, cols) may be lit."""
    view = buffer.view
    assert isinstance(view, PerspectiveView)
    eye, axes = view.in_frame(buffer.frame)
    lens = np.array([view.focal_px, view.row0, view.col0, view.step_px])
    return EyePicture(eye, np.ascontiguousarray(axes), lens, can_be_lit, buffer.position_frame_m, buffer.normal_frame)


def splat_samples(
    depths: np.ndarray,
    texels_from_frame: np.ndarray,
    picture: EyePicture,
    as_quads: bool,
    tolerance_texels: float,
    depth_step: float,
) -> ForwardMask:
    """Project the samples of a depth map into the eye's picture, and return which pixels they light.

    Parameters
    ----------
    depths
        (n, m), the map's depths in [0, 1]. 1 is empty, and 0 may be a caster in front of the map.
    texels_from_frame
        (4, 4), the matrix from the frame to texels (x, y), whose centres lie at halves, and to the depth in [0, 1].
    picture
        The eye's picture.
    as_quads
        Whether four neighbours span two triangles; otherwise each sample is a point.
    tolerance_texels
        Texels by whose shift a sample may lie off the pixel's plane.
    depth_step
        Step of the map's depths.
    """
    frame_from_texels = np.linalg.inv(texels_from_frame)
    counts = np.zeros(picture.can_be_lit.shape, np.int32)
    loop = _splat_quads if as_quads else _splat_points
    tolerance = np.array([tolerance_texels, depth_step, POSITION_ERROR])
    loop(depths, frame_from_texels, tolerance, *picture, counts)
    return ForwardMask(counts, int(((depths > 0.0) & (depths < 1.0)).sum()))


@internal
def _texel_point(frame_from_texels, x, y, depth):
    """Return the point (3,) of the frame, metres, at a place ``x``, ``y`` of the map, in texels, and at a depth in [0, 1]."""
    m = frame_from_texels
    w = m[3, 0] * x + m[3, 1] * y + m[3, 2] * depth + m[3, 3]
    return (
        (m[0, 0] * x + m[0, 1] * y + m[0, 2] * depth + m[0, 3]) / w,
        (m[1, 0] * x + m[1, 1] * y + m[1, 2] * depth + m[1, 3]) / w,
        (m[2, 0] * x + m[2, 1] * y + m[2, 2] * depth + m[2, 3]) / w,
    )


@internal
def _plane_tolerance_m(frame_from_texels, tolerance, x, y, depth, p, normal):
    """Return the tolerance of the distance, metres, of a sample ``p`` (3,) from a plane with a unit normal (3,).

    The sample lies at the texel ``x``, ``y`` and a depth in [0, 1]. ``tolerance`` holds texels, a step of depths, and the rounding
    of positions as a share of their coordinates.
    """
    right = _texel_point(frame_from_texels, x + 1.0, y, depth)
    up = _texel_point(frame_from_texels, x, y + 1.0, depth)
    deep = _texel_point(frame_from_texels, x, y, depth + tolerance[1])
    shift_m = depth_m = size_m = 0.0
    for k in range(3):
        depth_m += normal[k] * (deep[k] - p[k])
        size_m = max(size_m, abs(p[k]))
    across_m = along_m = 0.0
    for k in range(3):
        across_m += normal[k] * (right[k] - p[k])
        along_m += normal[k] * (up[k] - p[k])
    shift_m = abs(across_m) + abs(along_m)
    return tolerance[0] * shift_m + abs(depth_m) + tolerance[2] * size_m


@internal
def _project(eye, axes, lens, p):
    """Return the column and the row in the picture, and the depth in metres, of a point ``p`` (3,) of the frame.

    ``eye``, ``axes`` and ``lens`` are those of ``EyePicture``.
    """
    a, b, c = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
    depth = axes[2, 0] * a + axes[2, 1] * b + axes[2, 2] * c
    if depth <= 0.0:
        return 0.0, 0.0, depth
    x = lens[0] * (axes[0, 0] * a + axes[0, 1] * b + axes[0, 2] * c) / depth
    y = lens[0] * (axes[1, 0] * a + axes[1, 1] * b + axes[1, 2] * c) / depth
    return (x - lens[2]) / lens[3], (y - lens[1]) / lens[3], depth


@internal
def _row_span(row, x0, y0, x1, y1, x2, y2):
    """Return the first and the last x at which a triangle with three corners, in pixels, covers the row ``row``."""
    left, right = np.inf, -np.inf
    for n in range(3):
        xa, ya, xb, yb = x0, y0, x1, y1
        if n == 1:
            xa, ya, xb, yb = x1, y1, x2, y2
        elif n == 2:
            xa, ya, xb, yb = x2, y2, x0, y0
        if ya != yb and min(ya, yb) <= row <= max(ya, yb):
            x = xa + (row - ya) / (yb - ya) * (xb - xa)
            left, right = min(left, x), max(right, x)
    return (left, right) if left <= right else (0.0, -1.0)


@compiled
def _splat_points(depths, frame_from_texels, tolerance, eye, axes, lens, can_be_lit, position, normal, counts):
    """Count in ``counts`` (rows, cols) the samples of a map that fall on each pixel and on its surface.

    The other arguments are those of ``splat_samples`` and ``EyePicture``.
    """
    rows, cols = counts.shape
    for i in range(depths.shape[0]):
        for j in range(depths.shape[1]):
            depth = float(depths[i, j])
            if depth <= 0.0 or depth >= 1.0:
                continue
            p = _texel_point(frame_from_texels, j + 0.5, i + 0.5, depth)
            x, y, distance = _project(eye, axes, lens, p)
            if distance <= 0.0:
                continue
            col, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
            if row < 0 or col < 0 or row >= rows or col >= cols or not can_be_lit[row, col]:
                continue
            off_m = 0.0
            for k in range(3):
                off_m += normal[row, col, k] * (p[k] - position[row, col, k])
            if abs(off_m) <= _plane_tolerance_m(frame_from_texels, tolerance, j + 0.5, i + 0.5, depth, p, normal[row, col]):
                counts[row, col] += 1


@compiled
def _splat_quads(depths, frame_from_texels, tolerance, eye, axes, lens, can_be_lit, position, normal, counts):
    """Count in ``counts`` (rows, cols) the triangles between samples that cover each pixel's centre and lie on its surface.

    The other arguments are those of ``splat_samples`` and ``EyePicture``.
    """
    rows, cols = counts.shape
    corner_x, corner_y, corner_share = np.empty(4), np.empty(4), np.empty(4)
    for i in range(depths.shape[0] - 1):
        for j in range(depths.shape[1] - 1):
            is_complete = True
            for n in range(4):
                depth = float(depths[i + n // 2, j + n % 2])
                if depth <= 0.0 or depth >= 1.0:
                    is_complete = False
                    break
                p = _texel_point(frame_from_texels, j + n % 2 + 0.5, i + n // 2 + 0.5, depth)
                x, y, distance = _project(eye, axes, lens, p)
                if distance <= 0.0:
                    is_complete = False
                    break
                corner_x[n], corner_y[n], corner_share[n] = x, y, 1.0 / distance
            if not is_complete:
                continue
            depth = float(depths[i, j])
            for half in range(2):
                a, b, c = (0, 1, 3) if half == 0 else (0, 3, 2)
                x0, x1, x2 = corner_x[a], corner_x[b], corner_x[c]
                y0, y1, y2 = corner_y[a], corner_y[b], corner_y[c]
                first_row = max(int(np.ceil(min(y0, y1, y2))), 0)
                last_row = min(int(np.floor(max(y0, y1, y2))), rows - 1)
                area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
                if area == 0.0:
                    continue
                for row in range(first_row, last_row + 1):
                    left, right = _row_span(row, x0, y0, x1, y1, x2, y2)
                    for col in range(max(int(np.ceil(left)), 0), min(int(np.floor(right)), cols - 1) + 1):
                        if not can_be_lit[row, col]:
                            continue
                        u = ((x1 - col) * (y2 - row) - (x2 - col) * (y1 - row)) / area
                        v = ((x2 - col) * (y0 - row) - (x0 - col) * (y2 - row)) / area
                        share = u * corner_share[a] + v * corner_share[b] + (1.0 - u - v) * corner_share[c]
                        distance = off_m = 0.0
                        for k in range(3):
                            to_point = position[row, col, k] - eye[k]
                            distance += axes[2, k] * to_point
                            off_m += normal[row, col, k] * to_point
                        off_m *= 1.0 / (share * distance) - 1.0
                        q = position[row, col]
                        point = _texel_point(frame_from_texels, j + 0.5, i + 0.5, depth)
                        limit_m = _plane_tolerance_m(frame_from_texels, tolerance, j + 0.5, i + 0.5, depth, point, normal[row, col])
                        if abs(off_m) <= limit_m + tolerance[2] * max(abs(q[0]), abs(q[1]), abs(q[2])):
                            counts[row, col] += 1
