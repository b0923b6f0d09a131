"""Positions of the sun at many times at once."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest

from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun import apparent_sun_position
from skugga.terrain.geo.sun_path import as_utc, sun_path

START = datetime(2024, 3, 21, 4, tzinfo=UTC)


def test_sun_path_agrees_with_single_positions():
    times = [START + timedelta(hours=n) for n in range(16)]
    path = sun_path(times, 10.0, 60.0)
    single_positions = np.array([apparent_sun_position(time, 10.0, 60.0) for time in times])
    np.testing.assert_allclose(
        np.stack([path.azimuth_deg, path.altitude_deg, path.refraction_deg], axis=1), single_positions, atol=1e-9
    )
    assert len(path) == 16


def test_sun_path_culminates_at_90_less_latitude_at_equinox():
    """The sun culminates in the south, at 90 degrees less the latitude; refraction adds a minute of arc."""
    path = sun_path(np.arange("2024-03-20T00:00", "2024-03-21T00:00", 60, dtype="datetime64[s]"), 15.0, 50.0)
    noon = int(path.altitude_deg.argmax())
    assert path.altitude_deg[noon] == pytest.approx(40.0, abs=0.2)
    assert path.azimuth_deg[noon] == pytest.approx(180.0, abs=0.3)


def test_as_utc_converts_times_of_any_zone():
    east = datetime(1, 1, 1, tzinfo=timezone(timedelta(hours=14)))
    assert as_utc([START.astimezone(timezone(timedelta(hours=-5)))]) == np.datetime64("2024-03-21T04:00")
    assert as_utc([east]) == np.datetime64("0000-12-31T10:00")


def test_sun_path_refuses_years_out_of_range():
    with pytest.raises(InputError, match="years 1678 to 2261"):
        sun_path([START, START.replace(year=2300)], 10.0, 60.0)
