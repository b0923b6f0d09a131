"""Lights besides the sun: spot lights and omni lights. ``skugga.terrain.effects.lamps`` computes their irradiance at a point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from skugga.terrain.errors import LevelError, Problem
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.ground.ground_path import GroundPath, GroundPosition, path_over_ground
from skugga.terrain.level.parts import LightSpec

CONE_EDGE_FADE_SHARE = 0.1
"""Share of a spot's half angle over which its light fades out at the rim."""

MIN_TARGET_DISTANCE_M = 1e-6
"""Minimum distance between a static spot and its static target."""

MIN_MOVING_TARGET_DISTANCE_M = 0.1
"""Minimum distance between a spot and its target where either moves.

If they came nearer, the spot's direction could reverse from one frame to the next.
"""


class LightPosition(NamedTuple):
    """A light's homogeneous position in a local frame: a lamp's position with w = 1, or a unit direction to the sun with w = 0."""

    x: float
    y: float
    z: float
    w: float


def light_position(vector: np.ndarray, w: float) -> LightPosition:
    """Return a homogeneous position from a vector (3,): a lamp's position with w = 1, or a direction with w = 0."""
    x, y, z = (float(v) for v in vector)
    return LightPosition(x, y, z, w)


class LampInFrame(NamedTuple):
    """A lamp in the coordinates of a local frame.

    Attributes
    ----------
    position_frame_m
        (3,), the position in metres.
    cone_axis_frame
        (3,), the unit axis of the cone.
    lamp_from_frame
        (3, 3), the rotation from the frame to the lamp's axes.
    """

    position_frame_m: np.ndarray
    cone_axis_frame: np.ndarray
    lamp_from_frame: np.ndarray


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light at a position.

    Attributes
    ----------
    position_earth_m
        float64 (3,), the earth-fixed position in metres.
    earth_from_lamp
        float64 (3, 3), columns right, down and forward (towards the target; straight down for an omni light).
    cutoff_deg
        Half angle of the cone; 180 for an omni light.
    color
        Linear RGB colour.
    intensity
        Irradiance at normal incidence at the distance ``reference_distance_m``, in units of the sun's.
    reference_distance_m
        The distance in metres that ``intensity`` refers to.
    radius_m
        Radius of the luminous ball in metres; 0 for a point light.
    """

    name: str
    kind: Literal["spot", "omni"]
    position_earth_m: np.ndarray
    earth_from_lamp: np.ndarray
    cutoff_deg: float
    color: tuple[float, float, float]
    intensity: float
    reference_distance_m: float
    radius_m: float = 0.0

    def in_frame(self, frame: LocalFrame) -> LampInFrame:
        """Return the lamp's position and orientation in a local frame."""
        return LampInFrame(
            frame.points_from_earth(self.position_earth_m),
            frame.directions_from_earth(self.earth_from_lamp[:, 2]),
            self.earth_from_lamp.T @ frame.frame_from_earth.T,
        )


@dataclass(frozen=True, eq=False)
class AnimatedLamp:
    """A level's lamp at all times of the level's clock.

    Attributes
    ----------
    position
        The lamp's position: a ``GroundPath`` if it moves, a ``GroundPosition`` if it is static.
    target
        A spot's target, of the same types; ``None`` for an omni light.
    reference_distance_m
        Distance in metres at which the light has the level's intensity. A moving lamp keeps the strength of its first keyframe.
    """

    name: str
    spec: LightSpec
    position: GroundPosition | GroundPath
    target: GroundPosition | GroundPath | None
    reference_distance_m: float

    def at_second(self, seconds: float) -> Lamp:
        """Return the lamp at a second of the level's clock. A static lamp returns the same object each time."""
        return self._lamp_at(seconds) if self.spec.moves else self._static_lamp

    @cached_property
    def _static_lamp(self) -> Lamp:
        """The lamp at second 0 of the level's clock, computed once."""
        return self._lamp_at(0.0)

    def _lamp_at(self, seconds: float) -> Lamp:
        """Return the lamp at a second of the level's clock, always as a new object."""
        spec, (position, up, _) = self.spec, _ground_position_at(self.position, seconds)
        forward, cutoff = -up, 180.0
        if self.target is not None:
            to_target, cutoff = _ground_position_at(self.target, seconds).point_earth_m - position, spec.cutoff
            distance_m = float(np.linalg.norm(to_target))
            forward = to_target / distance_m if distance_m > MIN_TARGET_DISTANCE_M else forward
        axes = axes_along(forward, up)
        return Lamp(
            self.name, spec.kind, position, axes, cutoff, spec.color, spec.intensity, self.reference_distance_m, spec.radius
        )


def animated_lamp(name: str, spec: LightSpec, geolocator: Geolocator, key_path: str) -> AnimatedLamp:
    """Return a level's lamp at all times of the level's clock (``AnimatedLamp``).

    ``key_path`` is the path of the lamp's key in the level file, for messages. Raises ``LevelError`` for a position outside of the
    ground's data. Raises it also for a path that leaves the terrain or goes under the ground, and for a spot that meets its target.
    """
    first_s = 0.0 if spec.motion is None else spec.motion.path[0].seconds
    position = _ground_position_or_path(spec, "position", geolocator, key_path)
    start_position = _ground_position_at(position, first_s)
    if spec.kind == "omni":
        return AnimatedLamp(name, spec, position, None, max(start_position.above_ground_m, 1.0))
    target = _ground_position_or_path(spec, "target", geolocator, key_path)
    reference_m = float(np.linalg.norm(_ground_position_at(target, first_s).point_earth_m - start_position.point_earth_m))
    if spec.motion is None and not reference_m > MIN_TARGET_DISTANCE_M:
        raise LevelError(f"{key_path}.target", spec.target, "a point other than the position")
    _check_distance(position, target, f"{key_path}.motion.path")
    return AnimatedLamp(name, spec, position, target, reference_m)


def _ground_position_or_path(
    spec: LightSpec, key: Literal["position", "target"], geolocator: Geolocator, key_path: str
) -> GroundPosition | GroundPath:
    """Return a light's position or target: a ``GroundPosition`` if it is static, a ``GroundPath`` if it moves."""
    position: tuple[float, float, float] | None = getattr(spec, key)
    if position is not None:
        return GroundPosition(*geolocator.point_above_ground(position, f"{key_path}.{key}"), position[2])
    motion, name = spec.motion, f"{key_path}.motion.path"
    assert motion is not None
    keys = [(keyframe.seconds, getattr(keyframe, key)) for keyframe in motion.path]
    path = path_over_ground(keys, motion.loop, motion.above, geolocator, name, key)
    path.check(name, may_be_under_ground=key == "target")
    return path


def _check_distance(position: GroundPosition | GroundPath, target: GroundPosition | GroundPath, name: str) -> None:
    """Raise ``LevelError`` where a spot comes so near to its target that its direction is undefined."""
    path = position if isinstance(position, GroundPath) else target
    if not isinstance(path, GroundPath):
        return
    seconds = path.sample_times_s()
    points = [end.points_earth_m(seconds) if isinstance(end, GroundPath) else end.point_earth_m for end in (position, target)]
    is_too_near = np.linalg.norm(points[1] - points[0], axis=-1) < MIN_MOVING_TARGET_DISTANCE_M
    if is_too_near.any():
        problem = Problem(f"the light meets its target at second {seconds[is_too_near][0]:.6g}")
        raise LevelError(name, problem, f"Keep the light at least {MIN_MOVING_TARGET_DISTANCE_M} m from its target")


def _ground_position_at(position: GroundPosition | GroundPath, seconds: float) -> GroundPosition:
    """Return a static position as it is, and the point of a path at a second of the level's clock."""
    return position.at_second(seconds) if isinstance(position, GroundPath) else position


def axes_along(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the axes right, down and forward (3, 3, as columns) of a light that points ``forward``.

    The right axis is horizontal for the vertical ``up`` (3,). If ``forward`` is vertical, the right axis is arbitrary.
    """
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(np.abs(up), 1) + np.array([0.3, 0.2, 0.1]))
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])
