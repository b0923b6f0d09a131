"""Paths over a level's ground: where what moves is at a second of the clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.terrain.errors import Problem, LevelError
from skugga.terrain.geo.keyed_curve import KeyedCurve
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.level.motion import Above

LEAST_PLACES = 16
"""Places between two keys at which a path is looked at, at least."""

MOST_PLACES = 20_000
"""Places of a path that are looked at, about, at most."""

UNDER_GROUND_M = 0.01
"""How far below the ground is not told from on it: heights are float32."""

TimedPosition = tuple[float, tuple[float, float, float]]
"""A second of the clock, and where something is then."""


class Standpoint(NamedTuple):
    """Where what does not move is: an earth-fixed point (3,), the vertical there, and how high above the ground, metres."""

    point_earth_m: np.ndarray
    up_earth: np.ndarray
    above_ground_m: float


@dataclass(frozen=True, eq=False)
class GroundPath:
    """A smooth way through places with times (``skugga.terrain.geo.keyed_curve``). Height has a curve of its own, so that it never
    leaves the heights of the keys before and after: what drives from key to key on the ground stays on it.

    ``plan`` are earth-fixed points of height 0 at the keys, between which a curve runs in space; what counts of it is where it
    stands above the earth. ``heights`` are metres ``above`` the ground there, holes filled, or above the sea.
    """

    place: Geolocator
    plan: KeyedCurve
    heights: KeyedCurve
    above: Above

    def at_second(self, seconds: float) -> Standpoint:
        """Where it is at a second of the clock."""
        point, up, height_m, ground_m = (values[0] for values in self._at(np.array([seconds])))
        return Standpoint(point + height_m * up, up, float(height_m - ground_m))

    def points_earth_m(self, seconds: np.ndarray) -> np.ndarray:
        """Earth-fixed points (n, 3) at seconds (n,) of the clock."""
        point, up, height_m, _ = self._at(seconds)
        return point + height_m[:, None] * up

    def azimuth_deg(self, seconds: float) -> float:
        """The way that it goes, seen from above: degrees clockwise from north (from the grid's in a flat world)."""
        point, up, _, _ = self._at(np.array([seconds]))
        east, north, _ = self.plan.direction_at(seconds) @ self.place.world.earth_from_enu(point[0], up[0])
        return float(np.degrees(np.arctan2(east, north)))

    def check(self, name: str, may_be_under_ground: bool = False) -> None:
        """Raise ``LevelError``, naming ``name``, where it leaves the ground's data or goes under the ground."""
        seconds = self.seconds_along()
        _, _, height_m, ground_m = self._at(seconds)
        if not np.isfinite(ground_m).all():
            off = seconds[~np.isfinite(ground_m)][0]
            raise LevelError(name, Problem(f"leaves the terrain at second {off:.6g}"), "a path over the terrain all the way")
        under = height_m < ground_m - UNDER_GROUND_M
        if under.any() and not may_be_under_ground:
            first = int(np.argmax(under))
            fault = (
                f"at {height_m[first]:.2f} m at second {seconds[first]:.6g}, under the ground, which is at {ground_m[first]:.2f} m"
            )
            raise LevelError(name, Problem(fault), "a path above the ground all the way")

    def seconds_along(self) -> np.ndarray:
        """Seconds (n,) of places half a cell apart, about, from key to key; farther where they would be too many."""
        elevation, times_s = self.place.elevation, self.plan.times_s
        step_m = 0.5 * elevation.cell_size_m(self.place.world.metres_per_unit)
        wanted = np.linalg.norm(np.diff(self.plan.values, axis=0), axis=1) / step_m
        wanted = np.maximum(wanted * min(1.0, MOST_PLACES / max(float(wanted.sum()), 1.0)), LEAST_PLACES)
        knots = np.concatenate([[0.0], np.cumsum(np.ceil(wanted))])
        return np.interp(np.arange(knots[-1] + 1.0), knots, times_s)

    def _at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Earth-fixed points (n, 3) of height 0, the verticals there, heights (n,) as drawn, and those of the ground, metres."""
        world, elevation = self.place.world, self.place.elevation
        x, y, _ = world.map_position(elevation.crs, self.plan.at(seconds))
        point, up = world.ground(elevation.crs, x, y)
        ground_m = elevation.filled_ground_m(x, y)
        own_m = self.heights.at(seconds)[:, 0]
        return point, up, own_m + ground_m if self.above == "ground" else own_m, ground_m


def path_over_ground(keys: Sequence[TimedPosition], loop: bool, above: Above, place: Geolocator, name: str, key: str) -> GroundPath:
    """The path through keys. Raises ``LevelError`` for one off the terrain: ``NAME.NUMBER.KEY``."""
    world, elevation = place.world, place.elevation
    points = []
    for number, (_, position) in enumerate(keys):
        x, y = place.xy(position[:2])
        if not (np.isfinite([x, y]).all() and np.isfinite(elevation.filled_ground_m(x, y))):
            raise LevelError(f"{name}.{number}.{key}", position, f"a position on the terrain: within {place.extent}")
        points.append(world.ground(elevation.crs, np.float64(x), np.float64(y))[0])
    times_s = np.array([seconds for seconds, _ in keys], np.float64)
    heights = np.array([[position[2]] for _, position in keys], np.float64)
    return GroundPath(place, KeyedCurve(times_s, np.array(points), loop), KeyedCurve(times_s, heights, loop), above)
