"""Bits of hourly shade: those of the masks of the same suns, by day and by the hours of the clock."""

from __future__ import annotations

from datetime import date, datetime, timedelta, timezone

import numpy as np
import pytest

import skugga
from skugga.terrain.geo.sun_path import sun_path
from tests.rasters import write_geotiff

LON, LAT = 9.0, 46.9


@pytest.fixture
def hill(tmp_path):
    """File of a hill with a hole beside it."""
    row, col = np.mgrid[:30, :30]
    heights = (400.0 * np.exp(-((row - 15.0) ** 2 + (col - 15.0) ** 2) / 40.0)).astype(np.float32)
    heights[0, 0] = np.nan
    return write_geotiff(tmp_path / "hill.tif", heights, "EPSG:32632", 500e3, 5.2e6, 30.0)


def test_bits_are_masks_of_the_hours_suns(hill):
    with skugga.open_level(hill) as level:
        bits = level.compute("hourly_shade", month="2023-11", clock="+01:00")
        assert bits.shape == (30, 30, 24) and bits.dtype == np.int32 and (bits[0, 0] == -9999).all()
        for day, hour in ((1, 10), (9, 14), (30, 15)):
            middle = datetime(2023, 11, day, hour, 30, tzinfo=timezone(timedelta(hours=1)))
            mask = level.shade("mask", time=middle)
            lit = (bits[..., hour] >> (day - 1)) & 1
            wrong = (lit != (mask > 0))[1:, 1:]
            assert wrong.mean() < 0.01 and 0.02 < (mask[1:, 1:] == 0).mean() < 0.6
        assert not (bits[1:, 1:, :6] | bits[1:, 1:, 18:]).any(), "night"
        assert not (bits[1:, 1:, 12] >> 30).any(), "November has 30 days"


def test_every_daylight_hour_of_open_ground_is_seen(tmp_path):
    plain = write_geotiff(tmp_path / "plain.tif", np.zeros((5, 5), np.float32), "EPSG:32632", 500e3, 5.2e6, 30.0)
    with skugga.open_level(plain) as level:
        bits = level.compute("hourly_shade", month="2024-02", clock="utc")
    hours = np.arange("2024-02-01T00:30", "2024-03-01", np.timedelta64(60, "m"), "datetime64[us]")
    up = sun_path(hours, LON, LAT).altitude_deg.reshape(29, 24) > 1.0
    seen = (bits[2, 2][None, :] >> np.arange(29)[:, None]) & 1
    assert (seen[up] == 1).all() and abs(int(seen.sum()) - int(up.sum())) < 70
    assert len(up) == (date(2024, 3, 1) - date(2024, 2, 1)).days
