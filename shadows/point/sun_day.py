"""A day's sun at a point: sunrise and sunset, the intervals of direct sun, and the occluders at their ends.

The sun is the centre of its disc, with refraction. It is up while it is above the horizontal plane through the point. It is sampled
every ``STEP_S`` seconds. Changes between two samples are located with an accuracy of ``FINE_STEP_S`` seconds. Intervals of sun or
shade that are shorter than ``STEP_S`` may be missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, tzinfo

import numpy as np

from skugga.shadows.point.horizon import SunCaster, Surroundings, sees_sun, sun_occluders
from skugga.shadows.point.sun_angles import sun_angles_at, sun_samples
from skugga.terrain.geo.clock import day_bounds

STEP_S = 60.0
"""Seconds between two samples of a day's sun."""

FINE_STEP_S = 2.0
"""Seconds between two samples around a change between sun and shade."""

SUN_HOURS_STEP_S = 300.0
"""Seconds between two samples of ``sampled_sun_hours``."""


@dataclass(frozen=True)
class SunlitInterval:
    """An interval of direct sun.

    Attributes
    ----------
    begin, end
        Start and end of the interval.
    occluder_before
        The caster that hides the sun before ``begin``; ``None`` at sunrise over a flat horizon, or if the day begins there.
    occluder_after
        The caster that hides the sun after ``end``; ``None`` at sunset over a flat horizon, or if the day ends there.
    """

    begin: datetime
    end: datetime
    occluder_before: SunCaster | None
    occluder_after: SunCaster | None

    @property
    def hours(self) -> float:
        """Duration in hours."""
        return (self.end - self.begin).total_seconds() / 3600.0


@dataclass(frozen=True)
class SunDay:
    """A day's sun at a point, from midnight to midnight by a clock.

    Attributes
    ----------
    day
        The date.
    sunrise, sunset
        Times of sunrise and sunset over a flat horizon; ``None`` on a day without.
    noon
        The time of the sun's highest altitude.
    noon_altitude_deg
        The sun's highest altitude, degrees.
    first_sun, last_sun
        Start of the first and end of the last interval of direct sun; ``None`` without any.
    daylight_h
        Hours with the sun up.
    direct_sun_h
        Hours of direct sun.
    hidden_sun_h
        Hours with the sun up, but hidden.
    sunlit_intervals
        The intervals of direct sun.
    remark
        Explanation of values of ``None``, such as polar night; ``None`` if there is nothing to explain.
    """

    day: date
    sunrise: datetime | None
    sunset: datetime | None
    noon: datetime
    noon_altitude_deg: float
    first_sun: datetime | None
    last_sun: datetime | None
    daylight_h: float
    direct_sun_h: float
    hidden_sun_h: float
    sunlit_intervals: tuple[SunlitInterval, ...]
    remark: str | None


def sun_day(surroundings: Surroundings, day: date, clock: tzinfo) -> SunDay:
    """Compute the sun of a day at a place, from midnight to midnight by ``clock``.

    Raises ``InputError`` in a flat world, for years outside of the sun's ephemeris, and for a day that the clock's calendar skips.
    """
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_bounds(day, clock))
    times_s, to_sun = sun_samples(surroundings.scene.world, begin, end, STEP_S)
    azimuth, altitude = sun_angles_at(surroundings.place, to_sun)
    lit = sees_sun(surroundings, azimuth, altitude)

    def moment_of(second: float) -> datetime:
        return datetime.fromtimestamp(round(second), UTC).astimezone(clock)

    up = altitude > 0.0
    rises, sets = (_horizon_crossings_s(times_s, altitude, rising) for rising in (True, False))
    changes = np.flatnonzero(lit[1:] != lit[:-1])
    at = _change_times_s(surroundings, times_s, azimuth, altitude, lit, changes)
    bounds = np.concatenate([[begin] if lit[0] else [], at, [end] if lit[-1] else []])
    occluders = _occluders_at(surroundings, times_s, azimuth, altitude, lit, changes)
    occluders = [*([None] if lit[0] else []), *occluders, *([None] if lit[-1] else [])]
    sunlit = tuple(
        SunlitInterval(moment_of(bounds[n]), moment_of(bounds[n + 1]), occluders[n], occluders[n + 1])
        for n in range(0, len(bounds), 2)
    )
    daylight = _daylight_s(times_s, altitude, up, rises, sets)
    direct = float(sum(bounds[1::2] - bounds[::2]))
    highest = int(np.argmax(altitude))
    return SunDay(
        day=day,
        sunrise=moment_of(rises[0]) if len(rises) else None,
        sunset=moment_of(sets[-1]) if len(sets) else None,
        noon=moment_of(_culmination_s(times_s, altitude, highest)),
        noon_altitude_deg=float(altitude[highest]),
        first_sun=sunlit[0].begin if sunlit else None,
        last_sun=sunlit[-1].end if sunlit else None,
        daylight_h=daylight / 3600.0,
        direct_sun_h=direct / 3600.0,
        hidden_sun_h=max(daylight - direct, 0.0) / 3600.0,
        sunlit_intervals=sunlit,
        remark=_remark(up, bool(sunlit), len(rises), len(sets)),
    )


def _remark(is_up: np.ndarray, has_direct_sun: bool, sunrise_count: int, sunset_count: int) -> str | None:
    """Return a sentence that explains missing times of sunrise, sunset or direct sun; ``None`` if none is missing.

    ``is_up`` (n,) tells whether the sun is up at each sample. ``sunrise_count`` and ``sunset_count`` are the numbers of times at
    which the sun crosses a flat horizon upwards and downwards. ``has_direct_sun`` tells whether the point has direct sun at any
    sample.
    """
    if not is_up.any():
        return "polar night: the sun stays below the level horizon all day"
    if is_up.all():
        ending = "" if has_direct_sun else ", but terrain or objects hide it all day"
        return f"polar day: the sun does not set{ending}"
    if not has_direct_sun:
        return "the sun rises, but terrain or objects hide it all day"
    if not (sunrise_count and sunset_count):
        return f"the sun does not {'set' if sunrise_count else 'rise'} on this day"
    return None


def _horizon_crossings_s(times_s: np.ndarray, altitude_deg: np.ndarray, is_rising: bool) -> np.ndarray:
    """Return the times, in seconds, at which the sun's altitude crosses 0 upwards (``is_rising``) or downwards.

    The altitude is interpolated linearly between samples. ``times_s`` (n,) are the times of the samples, and ``altitude_deg`` (n,)
    the altitudes then.
    """
    up = altitude_deg > 0.0
    n = np.flatnonzero(up[1:] & ~up[:-1] if is_rising else ~up[1:] & up[:-1])
    share = altitude_deg[n] / (altitude_deg[n] - altitude_deg[n + 1])
    return times_s[n] + share * (times_s[n + 1] - times_s[n])


def _daylight_s(
    times_s: np.ndarray, altitude_deg: np.ndarray, is_up: np.ndarray, sunrises_s: np.ndarray, sunsets_s: np.ndarray
) -> float:
    """Return the total time in seconds during which the sun is up.

    The times of the samples are ``times_s`` (n,), ``is_up`` (n,) tells whether the sun is up then, and ``sunrises_s`` and
    ``sunsets_s`` are the times at which it crosses a flat horizon.
    """
    begins = np.concatenate([[times_s[0]] if is_up[0] else [], sunrises_s])
    ends = np.concatenate([sunsets_s, [times_s[-1]] if is_up[-1] else []])
    return float(np.sum(ends - begins))


def _culmination_s(times_s: np.ndarray, altitude_deg: np.ndarray, highest_index: int) -> float:
    """Return the time in seconds of the sun's highest altitude, near sample ``highest_index``, which is the highest one.

    It is the vertex of the parabola through this sample and its two neighbours. ``times_s`` and ``altitude_deg`` (n,) are those of
    the samples.
    """
    if not 0 < highest_index < len(times_s) - 1:
        return float(times_s[highest_index])
    before, at, after = altitude_deg[highest_index - 1 : highest_index + 2]
    bend = before - 2.0 * at + after
    return float(times_s[highest_index] + (0.5 * (before - after) / bend if bend else 0.0) * STEP_S)


def _change_times_s(
    surroundings: Surroundings,
    times_s: np.ndarray,
    azimuth_deg: np.ndarray,
    altitude_deg: np.ndarray,
    is_lit: np.ndarray,
    change_indices: np.ndarray,
) -> np.ndarray:
    """Return the times, in seconds, at which direct sun begins or ends.

    ``change_indices`` holds the indices of the samples with a change before the next sample. The sun is assumed to move evenly
    between two samples. The sun at the times ``times_s`` (n,) of the samples has the azimuths and altitudes ``azimuth_deg`` and
    ``altitude_deg`` (n,), and ``is_lit`` (n,) tells whether the point has direct sun then.
    """
    if not len(change_indices):
        return np.zeros(0)
    count = int(STEP_S / FINE_STEP_S)
    share = np.arange(1, count) / count
    turned = (azimuth_deg[change_indices + 1] - azimuth_deg[change_indices] + 180.0) % 360.0 - 180.0
    azimuth = azimuth_deg[change_indices, None] + share * turned[:, None]
    altitude = (
        altitude_deg[change_indices, None] + share * (altitude_deg[change_indices + 1] - altitude_deg[change_indices])[:, None]
    )
    is_sunlit = sees_sun(surroundings, azimuth.ravel(), altitude.ravel()).reshape(azimuth.shape)
    is_sunlit = np.concatenate([is_sunlit, is_lit[change_indices + 1, None]], axis=1)
    first = np.argmax(is_sunlit != is_lit[change_indices, None], axis=1)  # the first of several changes
    return times_s[change_indices] + (first + 0.5) / count * (times_s[change_indices + 1] - times_s[change_indices])


def _occluders_at(
    surroundings: Surroundings,
    times_s: np.ndarray,
    azimuth_deg: np.ndarray,
    altitude_deg: np.ndarray,
    is_lit: np.ndarray,
    change_indices: np.ndarray,
) -> list[SunCaster | None]:
    """Return the caster that hides the sun just before or after each change between sun and shade.

    ``change_indices`` holds the indices of the samples with a change before the next sample. The caster is that at the sample in
    shade. The other parameters are those of ``_change_times_s``.
    """
    dark = np.where(is_lit[change_indices], change_indices + 1, change_indices)
    return sun_occluders(surroundings, azimuth_deg[dark], altitude_deg[dark]) if len(dark) else []


def sampled_sun_hours(surroundings: Surroundings, day: date, clock: tzinfo) -> float:
    """Return the approximate hours of direct sun of a day, from samples every ``SUN_HOURS_STEP_S`` seconds.

    It is faster than ``sun_day`` and meant for many points. The start and the end of each interval of sun are off by at most 2.5
    minutes.
    """
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_bounds(day, clock))
    _, to_sun = sun_samples(surroundings.scene.world, begin + SUN_HOURS_STEP_S / 2, end, SUN_HOURS_STEP_S)
    azimuth, altitude = sun_angles_at(surroundings.place, to_sun[:-1])
    return float(sees_sun(surroundings, azimuth, altitude).sum() * SUN_HOURS_STEP_S / 3600.0)
