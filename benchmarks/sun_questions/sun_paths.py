"""Solar positions on 21 March by the other tools' own formulas, so that errors of their shadows can be measured alone."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

SUNCALC_DATE, SUNCALC_MIN_ALTITUDE_DEG = datetime(2020, 3, 21, tzinfo=UTC), -0.5
"""Date of Whitebox's almanac, in the leap year 2020, and the altitude of its sunrise and sunset, without refraction."""

SUNCALC_DAY_NUMBER, R_SUN_DAY_NUMBER = 81, 80
"""Day of the year of 21 March, in a leap year and in other years."""

DAY_S = 86400.0


def suncalc_path(lon_deg: float, lat_deg: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths from north and altitudes (n,) without refraction, degrees, through a day centred on local noon.

    The formulas are those of the library suncalc (after the Astronomy Answers of the University of Utrecht), which Whitebox's
    `time_in_daylight` uses.
    """
    noon_s = SUNCALC_DATE.timestamp() + DAY_S / 2 - lon_deg * DAY_S / 360.0
    days = (noon_s + np.arange(-DAY_S / 2 + step_s / 2, DAY_S / 2, step_s)) / DAY_S + 2440587.5 - 2451545.0
    anomaly = np.radians(357.5291 + 0.98560028 * days)
    centre = np.radians(1.9148 * np.sin(anomaly) + 0.02 * np.sin(2 * anomaly) + 0.0003 * np.sin(3 * anomaly))
    longitude, tilt = anomaly + centre + np.radians(102.9372) + np.pi, np.radians(23.4397)
    declination = np.arcsin(np.sin(tilt) * np.sin(longitude))
    ascension = np.arctan2(np.sin(longitude) * np.cos(tilt), np.cos(longitude))
    hour = np.radians(280.16 + 360.9856235 * days + lon_deg) - ascension
    return _azimuth_and_altitude(hour, declination, np.radians(lat_deg))


def r_sun_path(lat_deg: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths from north and altitudes (n,) without refraction, degrees, through a day of true solar time.

    The declination is that of GRASS r.sun (Gruter 1984) for the day's number, constant through the day.
    """
    year_angle = 2.0 * np.pi * R_SUN_DAY_NUMBER / 365.25
    declination = np.arcsin(0.3978 * np.sin(year_angle - 1.4 + 0.0355 * np.sin(year_angle - 0.0489)))
    hour = np.arange(step_s / 2, DAY_S, step_s) * (2.0 * np.pi / DAY_S) - np.pi
    return _azimuth_and_altitude(hour, np.full(len(hour), declination), np.radians(lat_deg))


def _azimuth_and_altitude(hour: np.ndarray, declination: np.ndarray, lat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and altitudes, degrees, from hour angles (0 at noon), declinations and a latitude, all in radians."""
    azimuth = np.arctan2(np.sin(hour), np.cos(hour) * np.sin(lat) - np.tan(declination) * np.cos(lat))
    sine = np.sin(lat) * np.sin(declination) + np.cos(lat) * np.cos(declination) * np.cos(hour)
    return (np.degrees(azimuth) + 180.0) % 360.0, np.degrees(np.arcsin(sine))


def hours_before_cliff(
    azimuth_deg: np.ndarray, altitude_deg: np.ndarray, step_s: float, height_m: float, distance_m: np.ndarray
) -> np.ndarray:
    """Return hours of sun (n,) on a level floor to the west of an endless cliff that runs north and south.

    ``distance_m`` (n,) are the distances from the cliff. Towards an azimuth A east of the meridian, the tangent of the angle of the
    cliff's edge is height sin A / distance.
    """
    eastward = np.maximum(np.sin(np.radians(azimuth_deg)), 0.0)
    edge_deg = np.degrees(np.arctan(height_m * eastward / distance_m[:, None]))
    lit = (altitude_deg > edge_deg) & (altitude_deg > 0.0)
    return np.asarray(lit.sum(axis=1) * step_s / 3600.0)
