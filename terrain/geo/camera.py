"""Perspective views: a pinhole camera on the earth, the rays of its pixels, and parts and refinements of views.

Camera axes are right, down and forward. The ray of pixel (i, j) has the direction ``((col0 + j * step) / focal_px,
(row0 + i * step) / focal_px, 1)``. A part of a picture, a picture shifted by pixels and a finer picture are therefore the same
camera with other offsets, steps and sizes. A ray that two such pictures share is identical in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.world import LocalFrame, World

PERSPECTIVE_FRAME_SPACING_SHARE = 1 / 16
"""Spacing of the local frames of perspective views, as a share of the spacing for maps (``skugga.terrain.geo.world``).

A frame is thus near the eye, where steps of float32 stay below 0.1 mm.
"""


@dataclass(frozen=True, eq=False)
class PerspectiveView:
    """A perspective view in pixels.

    Attributes
    ----------
    eye_earth_m
        float64 (3,), the earth-fixed eye in metres.
    earth_from_camera
        float64 (3, 3), rotation whose columns are the camera's right, down and forward axes.
    focal_px
        Focal length: pixels per unit of tangent (of the angle to the forward axis), for a step of one.
    row0, col0
        Offset of the first pixel's centre from the principal point, in pixels.
    step_px
        Distance of neighbouring pixel centres. It is 1 except in finer views and in views of every n-th pixel.
    rows, cols
        Size in pixels.
    pixel_share
        A pixel's side as a share of ``step_px``. It is 1 except in views of every n-th pixel.
    """

    eye_earth_m: np.ndarray
    earth_from_camera: np.ndarray
    focal_px: float
    row0: float
    col0: float
    step_px: float
    rows: int
    cols: int
    pixel_share: float = 1.0

    @property
    def cache_key(self) -> tuple[object, ...]:
        """All parameters as a hashable tuple: equal views have equal tuples."""
        eye, axes = self.eye_earth_m.tobytes(), self.earth_from_camera.tobytes()
        return eye, axes, self.focal_px, self.row0, self.col0, self.step_px, self.rows, self.cols, self.pixel_share

    @property
    def pixel_tangent(self) -> float:
        """The tangent of the angle that a pixel's side spans at the centre of the picture."""
        return self.pixel_share * self.step_px / self.focal_px

    def part(self, row: int, col: int, rows: int, cols: int) -> PerspectiveView:
        """Return the view of ``rows`` x ``cols`` pixels, the first of which is pixel (``row``, ``col``) of this view.

        ``row`` and ``col`` may be negative.
        """
        return replace(self, row0=self.row0 + row * self.step_px, col0=self.col0 + col * self.step_px, rows=rows, cols=cols)

    def shifted(self, rows: float, cols: float) -> PerspectiveView:
        """Return the view with all pixel centres moved down and to the right by fractions of a pixel."""
        side = self.pixel_share * self.step_px
        return replace(self, row0=self.row0 + rows * side, col0=self.col0 + cols * side)

    def finer(self, subpixels_per_side: int) -> PerspectiveView:
        """Return the view that divides each pixel into ``subpixels_per_side`` x ``subpixels_per_side`` pixels."""
        first = (1.0 / subpixels_per_side - 1.0) / 2.0
        shifted_view = self.shifted(first, first)
        return replace(
            shifted_view,
            step_px=self.step_px / subpixels_per_side,
            rows=self.rows * subpixels_per_side,
            cols=self.cols * subpixels_per_side,
        )

    def in_frame(self, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return the eye (3,) in a frame, in metres, and the rotation (3, 3) from the frame to the camera."""
        return (
            frame.points_from_earth(self.eye_earth_m),
            self.earth_from_camera.T @ frame.frame_from_earth.T,
        )

    def frame(self, world: World) -> LocalFrame:
        """Return the local frame whose origin, on a world-fixed lattice of origins, is nearest to the eye."""
        return world.frame_near_earth(self.eye_earth_m, PERSPECTIVE_FRAME_SPACING_SHARE)


def look_at(
    eye_earth_m: np.ndarray, target_earth_m: np.ndarray, up_earth: np.ndarray, fov_deg: float, rows: int, cols: int
) -> PerspectiveView:
    """Return the upright camera at an eye that looks at a target.

    Eye and target (3,) are earth-fixed points in metres, and ``up_earth`` (3,) is the unit up vector at the eye. ``fov_deg`` is the
    vertical field of view of a picture of ``rows`` x ``cols`` pixels. If the view is straight up or down, the picture's top points
    to earth-fixed north (the y axis of a flat world). Raises ``InputError`` if eye and target are one point.
    """
    forward = target_earth_m - eye_earth_m
    distance = float(np.linalg.norm(forward))
    if not distance > 1e-6:
        raise InputError("target", Problem("coincides with the eye"), "Give a point other than the eye")
    forward = forward / distance
    right = np.cross(forward, up_earth)
    if np.linalg.norm(right) < 1e-9:
        pole = np.array([0.0, 1.0, 0.0]) if abs(up_earth[2]) > 0.999999 else np.array([0.0, 0.0, 1.0])
        right = np.cross(forward, pole)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    focal_px = rows / 2.0 / np.tan(np.radians(fov_deg) / 2.0)
    return PerspectiveView(
        eye_earth_m, np.column_stack([right, down, forward]), float(focal_px), -(rows - 1) / 2.0, -(cols - 1) / 2.0, 1.0, rows, cols
    )
