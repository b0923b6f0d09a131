"""Lights besides the sun: spots and omni lights at places. How bright they are at a point: ``skugga.terrain.effects.lamps``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from skugga.terrain.errors import Problem, LevelError
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.ground.ground_path import GroundPath, Standpoint, path_over_ground
from skugga.terrain.level.parts import LightSpec

CONE_EDGE = 0.1
"""Share of a spot's half angle over which its light fades out at the rim."""

LEAST_AIM_M = 1e-6
"""Distance of a target that stays from a spot that does."""

LEAST_WAY_M = 0.1
"""Distance of a spot from its target, where either moves: nearer, it is turned about in no time."""


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


@dataclass(frozen=True, eq=False)
class LampRig:
    """A light of a level, wherever the clock puts it: a path moves, a standpoint stays. ``target`` is a spot's.

    ``reference_m`` is the distance at which its light has the level's intensity: a lamp that moves is as strong all the way as it
    is at its first key.
    """

    name: str
    spec: LightSpec
    position: Standpoint | GroundPath
    target: Standpoint | GroundPath | None
    reference_m: float

    def at_second(self, seconds: float) -> Lamp:
        """The lamp at a second of the level's clock; one and the same where it does not move."""
        return self._lamp_at(seconds) if self.spec.moves else self._still

    @cached_property
    def _still(self) -> Lamp:
        return self._lamp_at(0.0)

    def _lamp_at(self, seconds: float) -> Lamp:
        spec, (position, up, _) = self.spec, _at(self.position, seconds)
        forward, cutoff = -up, 180.0
        if self.target is not None:
            to_target, cutoff = _at(self.target, seconds).point_earth_m - position, spec.cutoff
            away_m = float(np.linalg.norm(to_target))
            forward = to_target / away_m if away_m > LEAST_AIM_M else forward
        axes = axes_along(forward, up)
        return Lamp(self.name, spec.kind, position, axes, cutoff, spec.color, spec.intensity, self.reference_m, spec.radius)


def lamp_rig(name: str, spec: LightSpec, place: Geolocator, where: str) -> LampRig:
    """The rig of a level's light. Raises ``LevelError`` for a position off the ground's data, and for a path that leaves the
    terrain, goes under the ground, or on which a spot and its target meet.
    """
    first_s = 0.0 if spec.motion is None else spec.motion.path[0].seconds
    position = _placed(spec, "position", place, where)
    standing = _at(position, first_s)
    if spec.kind == "omni":
        return LampRig(name, spec, position, None, max(standing.above_ground_m, 1.0))
    target = _placed(spec, "target", place, where)
    reference_m = float(np.linalg.norm(_at(target, first_s).point_earth_m - standing.point_earth_m))
    if spec.motion is None and not reference_m > LEAST_AIM_M:
        raise LevelError(f"{where}.target", spec.target, "a point other than the position")
    _refuse_meeting(position, target, f"{where}.motion.path")
    return LampRig(name, spec, position, target, reference_m)


def _placed(spec: LightSpec, key: Literal["position", "target"], place: Geolocator, where: str) -> Standpoint | GroundPath:
    """Where the position or the target of a light is."""
    stays: tuple[float, float, float] | None = getattr(spec, key)
    if stays is not None:
        return Standpoint(*place.above_ground(stays, f"{where}.{key}"), stays[2])
    motion, name = spec.motion, f"{where}.motion.path"
    assert motion is not None
    keys = [(each.seconds, getattr(each, key)) for each in motion.path]
    path = path_over_ground(keys, motion.loop, motion.above, place, name, key)
    path.check(name, may_be_under_ground=key == "target")
    return path


def _refuse_meeting(position: Standpoint | GroundPath, target: Standpoint | GroundPath, name: str) -> None:
    """Raise ``LevelError`` where a spot comes so near to its target that it is turned nowhere."""
    path = position if isinstance(position, GroundPath) else target
    if not isinstance(path, GroundPath):
        return
    seconds = path.seconds_along()
    points = [end.points_earth_m(seconds) if isinstance(end, GroundPath) else end.point_earth_m for end in (position, target)]
    meet = np.linalg.norm(points[1] - points[0], axis=-1) < LEAST_WAY_M
    if meet.any():
        fault = Problem(f"the light is where its target is at second {seconds[meet][0]:.6g}")
        raise LevelError(name, fault, f"positions {LEAST_WAY_M} m from the target at least")


def _at(where: Standpoint | GroundPath, seconds: float) -> Standpoint:
    return where.at_second(seconds) if isinstance(where, GroundPath) else where


def axes_along(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Right, down and forward (3, 3, as columns) for a direction; upright unless it is the vertical itself."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(np.abs(up), 1) + np.array([0.3, 0.2, 0.1]))
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])
