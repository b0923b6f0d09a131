"""Paths over a level's ground: the position of a moving object at a time of the level's clock.

The level's clock runs in seconds and drives all motion. A path goes through keys: positions at given times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.errors import LevelError, Problem
from skugga.terrain.geo.keyed_curve import KeyedCurve
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.level.motion import HeightReference

MIN_SAMPLES_PER_SEGMENT = 16
"""Minimum number of points at which a path is checked between two neighbouring keys."""

MAX_PATH_SAMPLES = 20_000
"""Approximate maximum number of points at which a whole path is checked."""

UNDERGROUND_TOLERANCE_M = 0.01
"""Tolerance below the ground, metres: heights are float32."""

TimedPosition = tuple[float, tuple[float, float, float]]
"""A key of a path: a time of the level's clock in seconds, and the position at that time.

A position is horizontal coordinates as in ``Geolocator``, and a height in metres.
"""


class GroundPosition(NamedTuple):
    """Position over the ground, with the local up vector.

    Attributes
    ----------
    point_earth_m
        Earth-fixed point (3,), metres.
    up_earth
        Unit up vector there, earth-fixed (3,).
    above_ground_m
        Height above the ground, metres.
    """

    point_earth_m: np.ndarray
    up_earth: np.ndarray
    above_ground_m: float


@dataclass(frozen=True, eq=False)
class GroundPath:
    """A smooth curve through keys, which are timed positions (``skugga.terrain.geo.keyed_curve``).

    The height has a curve of its own, which stays between the heights of the two neighbouring keys. So an object that drives from
    key to key on the ground stays on it.

    Attributes
    ----------
    geolocator
        Locates positions on the level's ground.
    horizontal_curve
        Curve in space through earth-fixed points of height 0 at the keys. Only its projection onto the earth counts.
    height_curve
        Curve of heights, metres, above the reference ``height_reference``.
    height_reference
        Reference of the heights: the ground with holes filled, or sea level.
    """

    geolocator: Geolocator
    horizontal_curve: KeyedCurve
    height_curve: KeyedCurve
    height_reference: HeightReference

    def at_second(self, seconds: float) -> GroundPosition:
        """Return the position at a time of the clock, in seconds."""
        point, up, height_m, ground_m = (values[0] for values in self._evaluate(np.array([seconds])))
        return GroundPosition(point + height_m * up, up, float(height_m - ground_m))

    def points_earth_m(self, seconds: np.ndarray) -> np.ndarray:
        """Return earth-fixed points (n, 3), metres, at times (n,) of the clock, in seconds."""
        point, up, height_m, _ = self._evaluate(seconds)
        return point + height_m[:, None] * up

    def azimuth_deg(self, seconds: float) -> float:
        """Return the direction of travel seen from above, degrees clockwise from north (from grid north in a flat world)."""
        point, up, _, _ = self._evaluate(np.array([seconds]))
        east, north, _ = self.horizontal_curve.direction_at(seconds) @ self.geolocator.world.earth_from_enu(point[0], up[0])
        return float(np.degrees(np.arctan2(east, north)))

    def check(self, name: str, may_be_under_ground: bool = False) -> None:
        """Raise ``LevelError`` with the name ``name`` if the path leaves the ground's data or goes under the ground."""
        seconds = self.sample_times_s()
        _, _, height_m, ground_m = self._evaluate(seconds)
        if not np.isfinite(ground_m).all():
            off_terrain_s = seconds[~np.isfinite(ground_m)][0]
            raise LevelError(
                name, Problem(f"leaves the terrain at second {off_terrain_s:.6g}"), "Keep all of the path over the terrain"
            )
        is_under_ground = height_m < ground_m - UNDERGROUND_TOLERANCE_M
        if is_under_ground.any() and not may_be_under_ground:
            first = int(np.argmax(is_under_ground))
            fault = (
                f"at {height_m[first]:.2f} m at second {seconds[first]:.6g}, under the ground, which is at {ground_m[first]:.2f} m"
            )
            raise LevelError(name, Problem(fault), "Keep all of the path above the ground")

    def sample_times_s(self) -> np.ndarray:
        """Return the times (n,) in seconds at which the path is checked: about every half cell of the raster.

        The keys' times are among them. Times are farther apart if more than about ``MAX_PATH_SAMPLES`` would result.
        """
        elevation, times_s = self.geolocator.elevation, self.horizontal_curve.times_s
        step_m = 0.5 * elevation.cell_size_m(self.geolocator.world.metres_per_unit)
        samples = np.linalg.norm(np.diff(self.horizontal_curve.values, axis=0), axis=1) / step_m
        samples = np.maximum(samples * min(1.0, MAX_PATH_SAMPLES / max(float(samples.sum()), 1.0)), MIN_SAMPLES_PER_SEGMENT)
        knots = np.concatenate([[0.0], np.cumsum(np.ceil(samples))])
        return np.interp(np.arange(knots[-1] + 1.0), knots, times_s)

    def _evaluate(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return earth-fixed points (n, 3) of height 0, up vectors (n, 3), and heights (n,) of path and ground, metres."""
        world, elevation = self.geolocator.world, self.geolocator.elevation
        x, y, _ = world.map_position(elevation.crs, self.horizontal_curve.at(seconds))
        point, up = world.points_at_zero_height(elevation.crs, x, y)
        ground_m = elevation.filled_ground_m(x, y)
        curve_height_m = self.height_curve.at(seconds)[:, 0]
        return point, up, curve_height_m + ground_m if self.height_reference == "ground" else curve_height_m, ground_m


def path_over_ground(
    keys: Sequence[TimedPosition], loop: bool, height_reference: HeightReference, geolocator: Geolocator, name: str, key: str
) -> GroundPath:
    """Return the path through keys.

    Raises ``LevelError`` for a key off the terrain. The message names it by ``name``, the key's number and the parameter ``key``,
    as in NAME.NUMBER.KEY.
    """
    world, elevation = geolocator.world, geolocator.elevation
    points = []
    for number, (_, position) in enumerate(keys):
        x, y = geolocator.xy(position[:2])
        if not (np.isfinite([x, y]).all() and np.isfinite(elevation.filled_ground_m(x, y))):
            raise LevelError(f"{name}.{number}.{key}", position, f"a position on the terrain: within {geolocator.extent_text}")
        points.append(world.points_at_zero_height(elevation.crs, np.float64(x), np.float64(y))[0])
    times_s = np.array([seconds for seconds, _ in keys], np.float64)
    heights_m = np.array([[position[2]] for _, position in keys], np.float64)
    return GroundPath(
        geolocator, KeyedCurve(times_s, np.array(points), loop), KeyedCurve(times_s, heights_m, loop), height_reference
    )
