"""The path of a camera through keyframes.

The path is smooth and does not overshoot the keyframes. Between two keyframes at the same position the camera stands still.
Positions, heights and fields of view follow ``skugga.terrain.geo.keyed_curve``, as a level's moving objects do:

- The path does not depend on the orientation of the axes.
- A camera whose keyframes are high stays high.
- Heights are interpolated above the datum, not above the ground. A camera that followed every bump of the ground would shake.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

import numpy as np

from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.keyed_curve import KeyedCurve
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.level.camera_file import CameraPathSpec


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A camera's path over a level's ground.

    Attributes
    ----------
    geolocator
        Locates positions on the level's ground.
    times_s
        (n,), the times of the keyframes in seconds.
    eye_positions, target_positions
        float64 (n, 3), positions in the coordinates of ``Geolocator`` (longitudes without jumps), and heights above the datum in
        metres.
    fov_deg
        (n,), the vertical fields of view.
    """

    geolocator: Geolocator
    times_s: np.ndarray
    eye_positions: np.ndarray
    target_positions: np.ndarray
    fov_deg: np.ndarray

    def view_at(self, time_s: float, rows: int, cols: int) -> PerspectiveView:
        """Return the view at a time in seconds, with ``rows`` x ``cols`` pixels.

        The camera stands still before the first keyframe and after the last one. Raises ``InputError`` where the eye is outside of
        the ground's data or not above it, or where it coincides with the target.
        """
        eye, target = (
            np.concatenate([position_curve.at(time_s), height_curve.at(time_s)])
            for position_curve, height_curve in self._eye_and_target_curves
        )
        point, up = self.geolocator.point_at_height((eye[0], eye[1]), eye[2])
        ground_m = self.geolocator.ground_m((eye[0], eye[1]))
        if not np.isfinite(ground_m):
            problem = Problem(f"{eye[0]:.6g}, {eye[1]:.6g} lies outside of the terrain's data")
            raise InputError("eye", problem, "Keep the camera over the terrain's data")
        if not eye[2] > ground_m:
            problem = Problem(f"the camera is {ground_m - eye[2]:.3g} m below the ground")
            raise InputError("eye", problem, "Keep the camera above the ground")
        target_point, _ = self.geolocator.point_at_height((target[0], target[1]), target[2])
        return look_at(point, target_point, up, float(self._fov_curve.at(time_s)[0]), rows, cols)

    @cached_property
    def _eye_and_target_curves(self) -> tuple[tuple[KeyedCurve, KeyedCurve], ...]:
        """The curves of position and height: of the eye, and of the target."""
        return tuple(
            (KeyedCurve(self.times_s, points[:, :2]), KeyedCurve(self.times_s, points[:, 2:]))
            for points in (self.eye_positions, self.target_positions)
        )

    @cached_property
    def _fov_curve(self) -> KeyedCurve:
        """The curve of the vertical field of view, degrees."""
        return KeyedCurve(self.times_s, self.fov_deg[:, None])


def camera_path(spec: CameraPathSpec, geolocator: Geolocator, start: datetime | None) -> CameraPath:
    """Return a camera's path over the ground of a level.

    ``start`` is the date and time of the film's first frame, or ``None`` for a film without a date. Raises ``InputError`` that
    names a keyframe outside of the ground's data. Raises it also for keyframes with dates if ``start`` is ``None``.
    """
    try:
        times_s = spec.times_s(start)
    except ValueError:
        problem = Problem(f"'{spec.keys[0].at}' is a date, but the film has no date")
        raise InputError("keys", problem, "Give times since the first frame, such as 0s") from None
    eyes, targets = np.empty((len(times_s), 3)), np.empty((len(times_s), 3))
    for number, key in enumerate(spec.keys):
        for name, out, position in (("eye", eyes, key.eye), ("target", targets, key.target)):
            ground_m = geolocator.ground_m(position[:2])
            if not np.isfinite(ground_m):
                raise InputError(f"keys.{number}.{name}", position, "a position on the terrain's data")
            out[number] = *position[:2], ground_m + position[2]
    if not geolocator.world.is_flat:  # take the shorter way round the earth between keyframes
        eyes[:, 0] = np.unwrap(eyes[:, 0], period=360.0)
        targets[:, 0] = np.unwrap(targets[:, 0], period=360.0)
    return CameraPath(geolocator, np.array(times_s), eyes, targets, np.array([key.fov for key in spec.keys]))
