"""Hours of sun of each day of a year at a point.

The sun is sampled every ``YEAR_STEP_S`` seconds, and each sample counts for one step. So the start and the end of an interval of
direct sun are off by at most half a step. Over a day these errors mostly cancel. The sun is compared with the horizon by ground,
which is computed every ``HORIZON_STEP_DEG`` degrees of azimuth and interpolated linearly. Buildings and trees are tested by rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, timedelta, tzinfo

import numpy as np

from skugga.shadows.point.horizon import Surroundings, is_clear_of_objects
from skugga.shadows.point.horizon_walk import relief_horizon
from skugga.shadows.point.sun_angles import sun_angles_at, sun_directions
from skugga.terrain.geo.clock import day_bounds, has_day

YEAR_STEP_S = 300.0
"""Seconds between two samples of a year's sun."""

HORIZON_STEP_DEG = 0.1
"""Degrees of azimuth between two exact positions of the horizon by ground."""


@dataclass(frozen=True, eq=False)
class SunYear:
    """Hours of sun of each day of a year.

    Attributes
    ----------
    days
        The n dates.
    daylight_h
        (n,): hours with the sun up.
    direct_sun_h
        (n,): hours of direct sun on the point.
    """

    days: tuple[date, ...]
    daylight_h: np.ndarray
    direct_sun_h: np.ndarray


def sun_year(surroundings: Surroundings, year: int, clock: tzinfo) -> SunYear:
    """Return the hours of sun of every day of a year by a clock. Days that the clock's calendar skips are left out.

    Raises the errors of ``sun_directions``.
    """
    dates = (date(year, 1, 1) + timedelta(days=n) for n in range((date(year + 1, 1, 1) - date(year, 1, 1)).days))
    days = tuple(day for day in dates if has_day(day, clock))
    midnight = np.array([day_bounds(day, clock)[0].astimezone(UTC).timestamp() for day in days])
    end = day_bounds(days[-1], clock)[1].astimezone(UTC).timestamp()
    times_s = np.arange(midnight[0] + YEAR_STEP_S / 2, end, YEAR_STEP_S)
    azimuth, altitude = sun_angles_at(surroundings.place, sun_directions(surroundings.scene.world, times_s))
    up = altitude > 0.0
    lit = up & (altitude > _interpolated_relief_deg(surroundings, azimuth))
    above = np.flatnonzero(lit)
    lit[above] = is_clear_of_objects(surroundings, azimuth[above], altitude[above])
    which = np.searchsorted(midnight, times_s, side="right") - 1
    hours = [np.bincount(which, weights=is_sun * (YEAR_STEP_S / 3600.0), minlength=len(days)) for is_sun in (up, lit)]
    return SunYear(days, *hours)


def _interpolated_relief_deg(surroundings: Surroundings, azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the elevation angle of the ground's horizon, (n,) degrees, towards azimuths (n,) in degrees."""
    grid = np.arange(0.0, 360.0 + HORIZON_STEP_DEG / 2, HORIZON_STEP_DEG)
    tangent = relief_horizon(surroundings.scene, surroundings.place, grid).tangent
    return np.interp(azimuth_deg, grid, np.degrees(np.arctan(tangent)))
