"""The camera and the light of a perspective map, in a local frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera in a frame.

    Attributes
    ----------
    eye_m
        (3,): position of the eye, metres.
    camera_from_frame
        (3, 3): rotation from the local frame to right, down and forward.
    """

    eye_m: np.ndarray
    camera_from_frame: np.ndarray

    @property
    def forward_axis(self) -> np.ndarray:
        """The unit vector (3,) along which the camera looks, in the frame."""
        return self.camera_from_frame[2]

    def to_camera(self, points_m: np.ndarray) -> np.ndarray:
        """Return points (..., 3) of the frame in camera coordinates: metres right, down and forward of the eye."""
        return (points_m - self.eye_m) @ self.camera_from_frame.T


@dataclass(frozen=True, eq=False)
class Light:
    """A light in a frame.

    Attributes
    ----------
    homogeneous_position
        (4,): the light as a homogeneous point.
    lit_point_m
        (3,): a point that the light certainly shines at: ahead of a spot, anywhere under the sun.
    """

    homogeneous_position: np.ndarray
    lit_point_m: np.ndarray
