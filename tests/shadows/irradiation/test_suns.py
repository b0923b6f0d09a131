"""Suns whose intervals begin later each day: the same time of sun, and less error of narrow shadows over a month."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest
from pyproj import CRS

from skugga.shadows.irradiation.suns import SunIntervals, default_step_min, sun_intervals
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import DailyWindow, windows_between
from skugga.terrain.geo.world import World

LON, LAT = 10.0, 47.0


@pytest.fixture
def month() -> list[DailyWindow]:
    """The days of June 2023."""
    world = World(CRS.from_epsg(4326), False, LON, LAT, LON, LAT, 1.0)
    return windows_between(world, date(2023, 6, 1), date(2023, 6, 30), 1, (0.0, 1440.0), SOLAR)


def energy(suns: SunIntervals) -> np.ndarray:
    """Return a light of each sun that grows with its altitude."""
    return suns.hours * np.sin(np.radians(suns.altitude_deg))


def test_the_time_of_sun_stays(month):
    even, later = (sun_intervals(month, 60.0, LON, LAT, later) for later in (False, True))
    assert later.hours.sum() == pytest.approx(even.hours.sum(), rel=1e-4)
    assert energy(later).sum() == pytest.approx(energy(even).sum(), rel=1e-3)
    assert (np.diff(later.moments.astype("int64")) > 0).all() and later.hours.max() <= 1.001
    for window in month[:3]:
        (alone,) = (sun_intervals([window], 60.0, LON, LAT, begin_later_each_day=True),)
        assert np.isin(alone.moments, later.moments).all(), "a date has the same suns alone"


def test_a_mast_takes_the_light_that_short_steps_say(month):
    """Masts of 4 degrees: hourly suns of the same hours hit or miss each for weeks."""
    exact = sun_intervals(month, 2.0, LON, LAT)
    errors = {}
    for later in (False, True):
        suns = sun_intervals(month, 60.0, LON, LAT, later)
        lost = np.array([
            [energy(each)[np.abs(each.azimuth_deg - azimuth) < 2.0].sum() for azimuth in range(90, 271, 5)]
            for each in (suns, exact)
        ])  # fmt: skip
        errors[later] = np.abs(lost[0] - lost[1]).mean() / lost[1].mean()
    assert errors[True] < 0.4 * errors[False] and errors[False] > 0.5


def test_short_periods_have_short_steps():
    assert (default_step_min(27), default_step_min(28)) == (10.0, 60.0)
