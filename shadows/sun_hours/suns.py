"""Under which suns a day's sun is looked for over a block: at even steps, and where it rises above the horizon or a floor and sets.

Where the sun stands is known each minute from one path for the level's anchor, refraction included; between two minutes its
direction is interpolated (right to 2e-6 of a radian).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC

import numpy as np

from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.daily_windows import DailyWindow
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import Sun, direction_enu
from skugga.terrain.geo.sun_path import PRESSURE_PA, TEMPERATURE_C, sun_path
from skugga.terrain.geo.world import World

BLOCK_PLACES = 5
"""Rows and columns of places that stand for a block's."""

LOWEST_LIFTED_DEG = -0.8333
"""Altitude below which the formula knows no refraction: none of the sun's disc is seen."""

UP_MIN = 0.02
"""By how many minutes after a rise, and before a set, the sun stands that is looked for there."""

APART_MIN = 0.25
"""Suns that are nearer to one another are one."""


@dataclass(frozen=True, eq=False)
class WindowSun:
    """The sun through a window of a date: unit vectors ``towards_earth`` (n, 3), and ``bare_earth`` without refraction,
    ``lift_deg`` and angles (n,) at minutes ``times_min`` (n,) after its start.
    """

    window: DailyWindow
    times_min: np.ndarray
    towards_earth: np.ndarray
    bare_earth: np.ndarray
    azimuth_deg: np.ndarray
    altitude_deg: np.ndarray
    lift_deg: np.ndarray

    def direction(self, minutes: np.ndarray) -> np.ndarray:
        """Unit vectors (k, 3) towards the sun so many minutes after the window's start."""
        found = np.stack([np.interp(minutes, self.times_min, axis) for axis in self.towards_earth.T], axis=1)
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def sun(self, minutes: float, world: World) -> Sun:
        """The sun so many minutes after the window's start."""
        towards = self.direction(np.array([minutes]))[0]
        east, north, up = world.earth_from_anchor.T @ towards
        azimuth = float(np.degrees(np.arctan2(east, north))) % 360.0
        altitude = float(np.degrees(np.arcsin(np.clip(up, -1.0, 1.0))))
        return Sun(azimuth, altitude, towards, None, float(np.interp(minutes, self.times_min, self.lift_deg)))


@dataclass(frozen=True, eq=False)
class SunSpan:
    """A time, from a rise of the sun in a block or the window's start on to a set or its end: moments ``knots_min`` (k,) at which
    the sun is looked for, minutes after the window's start. ``above`` (k, BLOCK_PLACES, BLOCK_PLACES) is by how much the sine of
    its altitude exceeds the floor's at places of the block.
    """

    knots_min: np.ndarray
    above: np.ndarray

    def looked_for_min(self, number: int) -> float:
        """When the sun stands that is looked for at a knot: a moment inside of the span."""
        first, last = self.knots_min[0] + UP_MIN, self.knots_min[-1] - UP_MIN
        return float(np.clip(self.knots_min[number], first, max(first, last)))


def window_suns(world: World, windows: Sequence[DailyWindow]) -> list[WindowSun]:
    """The sun through daily windows. Raises ``UnsupportedError`` off the earth, ``InputError`` for years that are not known."""
    if world.off_earth is not None:
        raise UnsupportedError("date", str(windows[0].date), f"{world.off_earth}: it has no sun of a date")
    days = []
    for window in windows:
        times = np.append(np.arange(0.0, window.minutes, 1.0), window.minutes)
        start = np.datetime64(window.start.astimezone(UTC).replace(tzinfo=None), "us")
        path = sun_path(start + np.rint(times * 60e6).astype("timedelta64[us]"), world.anchor_lon_deg, world.anchor_lat_deg)
        towards, bare = (
            np.stack([direction_enu(*angles) for angles in zip(path.azimuth_deg, altitude, strict=True)])
            @ world.earth_from_anchor.T
            for altitude in (path.altitude_deg, path.altitude_deg - path.lift_deg)
        )
        days.append(WindowSun(window, times, towards, bare, path.azimuth_deg, path.altitude_deg, path.lift_deg))
    return days


def lifted_sine(sine: np.ndarray) -> np.ndarray:
    """The sine of the sun's apparent altitude for that of its altitude without refraction, by the formula of ``sun_path`` (Reda &
    Andreas 2004, eq. 42): so a wide block's places have each their own sunrise.
    """
    altitude = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))
    air = PRESSURE_PA / 101000.0 * 283.0 / (273.0 + TEMPERATURE_C)
    over = np.maximum(altitude, LOWEST_LIFTED_DEG)
    lift = air * 1.02 / (60.0 * np.tan(np.radians(over + 10.3 / (over + 5.11))))
    return np.asarray(np.sin(np.radians(altitude + np.where(altitude >= LOWEST_LIFTED_DEG, lift, 0.0))))


def lattice_of(view: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (BLOCK_PLACES, BLOCK_PLACES) of the places that stand for a block's pixels, counted from its first."""
    row, col = (np.linspace(0.0, count - 1.0, BLOCK_PLACES) for count in (view.rows, view.cols))
    rows, cols = np.meshgrid(row, col, indexing="ij")
    return rows, cols


def sun_spans(day: WindowSun, view: MapView, world: World, floor_deg: float, step_min: float) -> list[SunSpan]:
    """When the sun stands above a floor (degrees, apparent) anywhere in a block, and the moments at which to look for it."""
    row, col = lattice_of(view)
    x, y = view.grid.x(view.col0 + col * view.col_step), view.grid.y(view.row0 + row * view.row_step)
    _, up = world.ground(view.grid.crs, x, y)
    up, floor = up.reshape(-1, 3), np.sin(np.radians(floor_deg))
    heights = lifted_sine(day.bare_earth @ up.T) - floor
    spells = []
    for first, last in _above_zero(day.times_min, heights.max(axis=1)):
        steps = np.arange(np.ceil(first / step_min), np.floor(last / step_min) + 1.0) * step_min
        whole = [t for spell in _above_zero(day.times_min, heights.min(axis=1)) for t in spell if first < t < last]
        knots = [first]
        for moment in sorted([*steps, *whole]):
            if moment - knots[-1] >= APART_MIN and last - moment >= APART_MIN:
                knots.append(float(moment))
        moments = np.array([*knots, last])
        above = np.stack([np.interp(moments, day.times_min, place) for place in heights.T], axis=1)
        above = above.reshape(-1, BLOCK_PLACES, BLOCK_PLACES)
        spells.append(SunSpan(moments, above))
    return spells


def _above_zero(times: np.ndarray, values: np.ndarray) -> list[tuple[float, float]]:
    """The spells of time in which values, linear between times, are over 0."""
    over = np.concatenate([[False], values > 0.0, [False]])
    starts, ends = np.flatnonzero(over[1:] & ~over[:-1]), np.flatnonzero(over[:-1] & ~over[1:]) - 1

    def zero(a: int, b: int) -> float:
        return float(times[a] + (times[b] - times[a]) * values[a] / (values[a] - values[b]))

    spells = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        first = float(times[0]) if start == 0 else zero(start - 1, start)
        last = float(times[-1]) if end == len(times) - 1 else zero(end, end + 1)
        if last > first:
            spells.append((first, last))
    return spells
