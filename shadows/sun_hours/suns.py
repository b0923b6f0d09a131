"""The moments at which a day's sun is sampled over a block of cells.

They are even time steps, and the times at which the sun rises above a minimum altitude (the floor) and falls below it. The sun's
position is computed for each minute at the level's anchor, with refraction. Between two minutes its direction is interpolated,
which is accurate to 2e-6 of a radian.
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

BLOCK_SAMPLES_PER_SIDE = 5
"""Number of rows, and of columns, of a lattice of positions that represent a block of cells."""

MIN_REFRACTED_DEG = -0.8333
"""Altitude below which refraction is set to 0, because no part of the sun's disc is visible."""

HORIZON_OFFSET_MINUTES = 0.02
"""Minutes by which the first moment of a span is moved forward, and the last one back, so that the sun is above the horizon."""

MIN_SPACING_MINUTES = 0.25
"""Minimum minutes between two samples."""


@dataclass(frozen=True, eq=False)
class WindowSun:
    """The sun during a window of time of one date, at n times.

    Attributes
    ----------
    window
        The window.
    times_minutes
        (n,): minutes after the window's start.
    to_sun_earth
        (n, 3): earth-fixed unit vectors towards the apparent sun.
    to_sun_unrefracted_earth
        (n, 3): earth-fixed unit vectors towards the sun without refraction.
    azimuth_deg, altitude_deg
        (n,), degrees: apparent azimuths and altitudes at the level's anchor.
    refraction_deg
        (n,), degrees: refraction, by which the apparent sun is higher than the true one.
    """

    window: DailyWindow
    times_minutes: np.ndarray
    to_sun_earth: np.ndarray
    to_sun_unrefracted_earth: np.ndarray
    azimuth_deg: np.ndarray
    altitude_deg: np.ndarray
    refraction_deg: np.ndarray

    def directions_at(self, minutes: np.ndarray) -> np.ndarray:
        """Return unit vectors (k, 3) towards the sun, at minutes (k,) after the window's start."""
        towards = np.stack([np.interp(minutes, self.times_minutes, axis) for axis in self.to_sun_earth.T], axis=1)
        return towards / np.linalg.norm(towards, axis=1, keepdims=True)

    def sun_at(self, minutes: float, world: World) -> Sun:
        """Return the sun at ``minutes`` after the window's start."""
        towards = self.directions_at(np.array([minutes]))[0]
        east, north, up = world.earth_from_anchor.T @ towards
        azimuth = float(np.degrees(np.arctan2(east, north))) % 360.0
        altitude = float(np.degrees(np.arcsin(np.clip(up, -1.0, 1.0))))
        return Sun(azimuth, altitude, towards, None, float(np.interp(minutes, self.times_minutes, self.refraction_deg)))


@dataclass(frozen=True, eq=False)
class SunSpan:
    """An interval of time during which the sun is above the floor (a minimum altitude) somewhere in a block.

    It begins when the sun rises above the floor or at the window's start, and ends when the sun sets or at the window's end.

    Attributes
    ----------
    samples_minutes
        (k,): sampled moments, minutes after the window's start.
    above_floor_sine
        (k, BLOCK_SAMPLES_PER_SIDE, BLOCK_SAMPLES_PER_SIDE): the sine of the sun's altitude less that of the floor, at positions of
        the block.
    """

    samples_minutes: np.ndarray
    above_floor_sine: np.ndarray

    def sample_minutes(self, number: int) -> float:
        """Return the moment, in minutes, for which the sun of sample ``number`` is computed.

        At the ends of the span it is moved inwards by ``HORIZON_OFFSET_MINUTES``.
        """
        first, last = self.samples_minutes[0] + HORIZON_OFFSET_MINUTES, self.samples_minutes[-1] - HORIZON_OFFSET_MINUTES
        return float(np.clip(self.samples_minutes[number], first, max(first, last)))


def window_suns(world: World, windows: Sequence[DailyWindow]) -> list[WindowSun]:
    """Return the sun during windows of time, one for each date.

    Raises ``UnsupportedError`` off the earth, and ``InputError`` for years outside of the sun's ephemeris.
    """
    if world.off_earth_reason is not None:
        raise UnsupportedError("date", str(windows[0].date), f"{world.off_earth_reason}, so a date does not define the sun")
    days = []
    for window in windows:
        times = np.append(np.arange(0.0, window.length_min, 1.0), window.length_min)
        start = np.datetime64(window.start.astimezone(UTC).replace(tzinfo=None), "us")
        path = sun_path(start + np.rint(times * 60e6).astype("timedelta64[us]"), world.anchor_lon_deg, world.anchor_lat_deg)
        towards, unrefracted = (
            np.stack([direction_enu(*angles) for angles in zip(path.azimuth_deg, altitude, strict=True)])
            @ world.earth_from_anchor.T
            for altitude in (path.altitude_deg, path.altitude_deg - path.refraction_deg)
        )
        days.append(WindowSun(window, times, towards, unrefracted, path.azimuth_deg, path.altitude_deg, path.refraction_deg))
    return days


def refracted_sine(sine: np.ndarray) -> np.ndarray:
    """Return the sine of the sun's apparent altitude, from the sine of its altitude without refraction.

    The formula for refraction is that of ``sun_path`` (Reda & Andreas 2004, eq. 42). It is applied to each position, so that each
    part of a wide block has its own sunrise.
    """
    altitude = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))
    air = PRESSURE_PA / 101000.0 * 283.0 / (273.0 + TEMPERATURE_C)
    clamped_deg = np.maximum(altitude, MIN_REFRACTED_DEG)
    lift = air * 1.02 / (60.0 * np.tan(np.radians(clamped_deg + 10.3 / (clamped_deg + 5.11))))
    return np.asarray(np.sin(np.radians(altitude + np.where(altitude >= MIN_REFRACTED_DEG, lift, 0.0))))


def block_sample_positions(view: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and the columns of a lattice of positions that represent a block.

    Each array is (BLOCK_SAMPLES_PER_SIDE, BLOCK_SAMPLES_PER_SIDE). Rows and columns are counted in pixels from the block's first
    pixel.
    """
    row, col = (np.linspace(0.0, count - 1.0, BLOCK_SAMPLES_PER_SIDE) for count in (view.rows, view.cols))
    rows, cols = np.meshgrid(row, col, indexing="ij")
    return rows, cols


def sun_spans(day: WindowSun, view: MapView, world: World, floor_deg: float, step_minutes: float) -> list[SunSpan]:
    """Return the spans during which the sun is above a minimum altitude somewhere in a block, with their sampled moments.

    ``floor_deg`` is the minimum apparent altitude. ``step_minutes`` is the time between two samples, minutes.
    """
    row, col = block_sample_positions(view)
    x, y = view.grid.x(view.col0 + col * view.col_step), view.grid.y(view.row0 + row * view.row_step)
    _, up = world.points_at_zero_height(view.grid.crs, x, y)
    up, floor = up.reshape(-1, 3), np.sin(np.radians(floor_deg))
    heights = refracted_sine(day.to_sun_unrefracted_earth @ up.T) - floor
    spells = []
    for first, last in _above_zero(day.times_minutes, heights.max(axis=1)):
        steps = np.arange(np.ceil(first / step_minutes), np.floor(last / step_minutes) + 1.0) * step_minutes
        floor_crossings = [t for spell in _above_zero(day.times_minutes, heights.min(axis=1)) for t in spell if first < t < last]
        knots = [first]
        for moment in sorted([*steps, *floor_crossings]):
            if moment - knots[-1] >= MIN_SPACING_MINUTES and last - moment >= MIN_SPACING_MINUTES:
                knots.append(float(moment))
        moments = np.array([*knots, last])
        above_floor_sine = np.stack(
            [np.interp(moments, day.times_minutes, heights_at_point) for heights_at_point in heights.T], axis=1
        )
        above_floor_sine = above_floor_sine.reshape(-1, BLOCK_SAMPLES_PER_SIDE, BLOCK_SAMPLES_PER_SIDE)
        spells.append(SunSpan(moments, above_floor_sine))
    return spells


def _above_zero(times: np.ndarray, values: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals (start, end) during which a function of time is over 0.

    The function is linear between ``times`` (n,), where it has ``values`` (n,).
    """
    over = np.concatenate([[False], values > 0.0, [False]])
    starts, ends = np.flatnonzero(over[1:] & ~over[:-1]), np.flatnonzero(over[:-1] & ~over[1:]) - 1

    def zero_crossing(a: int, b: int) -> float:
        return float(times[a] + (times[b] - times[a]) * values[a] / (values[a] - values[b]))

    spells = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        first = float(times[0]) if start == 0 else zero_crossing(start - 1, start)
        last = float(times[-1]) if end == len(times) - 1 else zero_crossing(end, end + 1)
        if last > first:
            spells.append((first, last))
    return spells
