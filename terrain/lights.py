"""Lights besides the sun: spots and omni lights at places. How bright they are at a point: ``terrain.effects.lamps``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from terrain.errors import LevelError
from terrain.geo.world import LocalFrame
from terrain.ground.geolocate import Geolocator
from terrain.level.parts import LightSpec

CONE_EDGE = 0.1
"""Share of a spot's half angle over which its light fades out at the rim."""


class LightPosition(NamedTuple):
    """A light in a frame, homogeneous: a lamp's place and 1, or a unit direction to the sun and 0."""

    x: float
    y: float
    z: float
    w: float


def light_position(place_or_direction: np.ndarray, w: float) -> LightPosition:
    """The position of a light of a place (3,) and 1, or of a direction (3,) and 0."""
    x, y, z = (float(v) for v in place_or_direction)
    return LightPosition(x, y, z, w)


class LampInFrame(NamedTuple):
    """A lamp in a frame: its place (3,), metres, its unit axis (3,), and the rotation (3, 3) from the frame to the lamp."""

    position_frame_m: np.ndarray
    axis_frame: np.ndarray
    lamp_from_frame: np.ndarray


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light at a place.

    Attributes
    ----------
    position_earth_m
        float64 (3,).
    earth_from_lamp
        float64 (3, 3), columns right, down and forward (to the target; straight down for an omni light).
    cutoff_deg
        Half angle of the cone; 180 for an omni light.
    radius_m
        Of the ball that shines; 0: a point.
    color, intensity
        Linear colour, and irradiance at normal incidence in units of the sun's at the distance ``reference_m``.
    """

    name: str
    kind: Literal["spot", "omni"]
    position_earth_m: np.ndarray
    earth_from_lamp: np.ndarray
    cutoff_deg: float
    color: tuple[float, float, float]
    intensity: float
    reference_m: float
    radius_m: float = 0.0

    def in_frame(self, frame: LocalFrame) -> LampInFrame:
        """Where it stands in a frame, and how it is turned there."""
        return LampInFrame(
            frame.points_from_earth(self.position_earth_m),
            frame.directions_from_earth(self.earth_from_lamp[:, 2]),
            self.earth_from_lamp.T @ frame.frame_from_earth.T,
        )


def lamp_of(name: str, spec: LightSpec, place: Geolocator, where: str) -> Lamp:
    """The lamp of a level's light. Raises ``LevelError`` for a position off the ground's data."""
    position, up = place.above_ground(spec.position, f"{where}.position")
    if spec.target is None:
        forward, reference_m, cutoff = -up, max(spec.position[2], 1.0), 180.0
    else:
        target, _ = place.above_ground(spec.target, f"{where}.target")
        to_target = target - position
        reference_m = float(np.linalg.norm(to_target))
        if not reference_m > 1e-6:
            raise LevelError(f"{where}.target", spec.target, "a point other than the position")
        forward, cutoff = to_target / reference_m, spec.cutoff
    return Lamp(name, spec.kind, position, axes_along(forward, up), cutoff, spec.color, spec.intensity, reference_m, spec.radius)


def axes_along(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Right, down and forward (3, 3, as columns) for a direction; upright unless it is the vertical itself."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(np.abs(up), 1) + np.array([0.3, 0.2, 0.1]))
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])
