"""Which time zone is kept where."""

import pytest

from terrain.geo.clock import time_zone_at


@pytest.mark.parametrize(
    ("lon_deg", "lat_deg", "zone"),
    [
        (8.4, 47.5, "Europe/Zurich"),
        (-3.7, 40.4, "Europe/Madrid"),
        (-84.2, 36.3, "America/New_York"),
        (-104.0, 39.7, "America/Denver"),
        (85.3, 27.7, "Asia/Kathmandu"),
        (360.0 + 8.4, 47.5, "Europe/Zurich"),
        (-180.5, -16.6, "Pacific/Fiji"),
    ],
)
def test_time_zone_is_that_of_the_place(lon_deg: float, lat_deg: float, zone: str):
    """Not that of the meridian: Madrid keeps the clock of Berlin. Longitudes go round the earth."""
    assert time_zone_at(lon_deg, lat_deg) == zone
