"""The moments at which a day's sun is sampled over a block: in even steps, and where it rises above a floor and sets.

The sun's position is computed for each minute at the level's anchor, with refraction. Between two minutes its direction is
interpolated, which is accurate to 2e-6 of a radian.
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

BLOCK_SAMPLES = 5
"""Rows and columns of positions that represent a block."""

MIN_REFRACTED_DEG = -0.8333
"""Altitude below which the formula has no refraction: no part of the sun's disc is visible."""

HORIZON_OFFSET_MIN = 0.02
"""Minutes after a rise, and before a set, of the sun that is used there."""

MIN_SPACING_MIN = 0.25
"""Minimum minutes between two samples."""


@dataclass(frozen=True, eq=False)
class WindowSun:
    """The sun during a window of a date, at n times.

    Attributes
    ----------
    window
        The window.
    times_min
        (n,): minutes after the window's start.
    towards_earth
        (n, 3): earth-fixed unit vectors towards the apparent sun.
    unrefracted_earth
        (n, 3): the same without refraction.
    azimuth_deg, altitude_deg
        (n,): apparent azimuths and altitudes at the level's anchor.
    lift_deg
        (n,): refraction.
    """

    window: DailyWindow
    times_min: np.ndarray
    towards_earth: np.ndarray
    unrefracted_earth: np.ndarray
    azimuth_deg: np.ndarray
    altitude_deg: np.ndarray
    lift_deg: np.ndarray

    def direction(self, minutes: np.ndarray) -> np.ndarray:
        """Return unit vectors (k, 3) towards the sun, at minutes (k,) after the window's start."""
        towards = np.stack([np.interp(minutes, self.times_min, axis) for axis in self.towards_earth.T], axis=1)
        return towards / np.linalg.norm(towards, axis=1, keepdims=True)

    def sun(self, minutes: float, world: World) -> Sun:
        """Return the sun at so many minutes after the window's start."""
        towards = self.direction(np.array([minutes]))[0]
        east, north, up = world.earth_from_anchor.T @ towards
        azimuth = float(np.degrees(np.arctan2(east, north))) % 360.0
        altitude = float(np.degrees(np.arcsin(np.clip(up, -1.0, 1.0))))
        return Sun(azimuth, altitude, towards, None, float(np.interp(minutes, self.times_min, self.lift_deg)))


@dataclass(frozen=True, eq=False)
class SunSpan:
    """A span of time with the sun up: from a rise in a block, or the window's start, to a set or the window's end.

    Attributes
    ----------
    samples_min
        (k,): sampled moments, minutes after the window's start.
    above
        (k, BLOCK_PLACES, BLOCK_PLACES): the sine of the altitude less that of the floor, at positions of the block.
    """

    samples_min: np.ndarray
    above: np.ndarray

    def sample_min(self, number: int) -> float:
        """Return the moment whose sun is used at a knot, minutes: it lies inside of the span."""
        first, last = self.samples_min[0] + HORIZON_OFFSET_MIN, self.samples_min[-1] - HORIZON_OFFSET_MIN
        return float(np.clip(self.samples_min[number], first, max(first, last)))


def window_suns(world: World, windows: Sequence[DailyWindow]) -> list[WindowSun]:
    """Return the sun during daily windows.

    Raises ``UnsupportedError`` off the earth, and ``InputError`` for years outside of the sun's ephemeris.
    """
    if world.off_earth_reason is not None:
        raise UnsupportedError("date", str(windows[0].date), f"{world.off_earth_reason}, so a date does not define the sun")
    days = []
    for window in windows:
        times = np.append(np.arange(0.0, window.minutes, 1.0), window.minutes)
        start = np.datetime64(window.start.astimezone(UTC).replace(tzinfo=None), "us")
        path = sun_path(start + np.rint(times * 60e6).astype("timedelta64[us]"), world.anchor_lon_deg, world.anchor_lat_deg)
        towards, unrefracted = (
            np.stack([direction_enu(*angles) for angles in zip(path.azimuth_deg, altitude, strict=True)])
            @ world.earth_from_anchor.T
            for altitude in (path.altitude_deg, path.altitude_deg - path.lift_deg)
        )
        days.append(WindowSun(window, times, towards, unrefracted, path.azimuth_deg, path.altitude_deg, path.lift_deg))
    return days


def refracted_sine(sine: np.ndarray) -> np.ndarray:
    """Return the sine of the sun's apparent altitude, from the sine of its altitude without refraction.

    The formula is that of ``sun_path`` (Reda & Andreas 2004, eq. 42). So each position in a wide block has its own sunrise.
    """
    altitude = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))
    air = PRESSURE_PA / 101000.0 * 283.0 / (273.0 + TEMPERATURE_C)
    clamped_deg = np.maximum(altitude, MIN_REFRACTED_DEG)
    lift = air * 1.02 / (60.0 * np.tan(np.radians(clamped_deg + 10.3 / (clamped_deg + 5.11))))
    return np.asarray(np.sin(np.radians(altitude + np.where(altitude >= MIN_REFRACTED_DEG, lift, 0.0))))


def lattice_of(view: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (BLOCK_PLACES, BLOCK_PLACES) of the positions that represent a block, in pixels from its first."""
    row, col = (np.linspace(0.0, count - 1.0, BLOCK_SAMPLES) for count in (view.rows, view.cols))
    rows, cols = np.meshgrid(row, col, indexing="ij")
    return rows, cols


def sun_spans(day: WindowSun, view: MapView, world: World, floor_deg: float, step_min: float) -> list[SunSpan]:
    """Return the spans with the sun above a floor (degrees, apparent) anywhere in a block, with their sampled moments."""
    row, col = lattice_of(view)
    x, y = view.grid.x(view.col0 + col * view.col_step), view.grid.y(view.row0 + row * view.row_step)
    _, up = world.ground(view.grid.crs, x, y)
    up, floor = up.reshape(-1, 3), np.sin(np.radians(floor_deg))
    heights = refracted_sine(day.unrefracted_earth @ up.T) - floor
    spells = []
    for first, last in _above_zero(day.times_min, heights.max(axis=1)):
        steps = np.arange(np.ceil(first / step_min), np.floor(last / step_min) + 1.0) * step_min
        floor_crossings = [t for spell in _above_zero(day.times_min, heights.min(axis=1)) for t in spell if first < t < last]
        knots = [first]
        for moment in sorted([*steps, *floor_crossings]):
            if moment - knots[-1] >= MIN_SPACING_MIN and last - moment >= MIN_SPACING_MIN:
                knots.append(float(moment))
        moments = np.array([*knots, last])
        above = np.stack([np.interp(moments, day.times_min, heights_at_point) for heights_at_point in heights.T], axis=1)
        above = above.reshape(-1, BLOCK_SAMPLES, BLOCK_SAMPLES)
        spells.append(SunSpan(moments, above))
    return spells


def _above_zero(times: np.ndarray, values: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals of time during which values, linear between times, are over 0."""
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
