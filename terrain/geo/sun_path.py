"""The sun's positions at many times for one observer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta

import numpy as np

from skugga.terrain.errors import InputError

SUPPORTED_YEARS = (1678, 2261)
"""First and last year for which the sun's position is computed (the range of pandas' time stamps)."""

PRESSURE_PA, TEMPERATURE_C = 101325.0, 12.0
"""The air's pressure and temperature for refraction."""


@dataclass(frozen=True, eq=False)
class SunPath:
    """The sun's positions at n times for one observer.

    Attributes
    ----------
    times
        (n,), datetime64[us] in UTC.
    azimuth_deg
        (n,), azimuths clockwise from north, in degrees.
    altitude_deg
        (n,), apparent altitudes in degrees.
    refraction_deg
        (n,), refraction in degrees, which is included in ``altitude_deg``; 0 well below the horizon.
    """

    times: np.ndarray
    azimuth_deg: np.ndarray
    altitude_deg: np.ndarray
    refraction_deg: np.ndarray

    def __len__(self) -> int:
        """Return the number of times."""
        return len(self.times)


def sun_path(times: Sequence[datetime] | np.ndarray, lon_deg: float, lat_deg: float) -> SunPath:
    """Return the sun's positions at times for an observer at sea level, by NREL's solar position algorithm (Reda & Andreas 2004).

    Times are aware datetimes, or datetime64 in UTC. Refraction is the algorithm's own, for 1013.25 hPa and 12 degrees Celsius.
    Raises ``InputError`` for years beyond ``SUPPORTED_YEARS``.
    """
    moments = as_utc(times)
    check_times(moments)
    import pandas  # imported here: takes 0.8 s with pvlib, and only times need it
    from pvlib.solarposition import spa_python

    position = spa_python(
        pandas.DatetimeIndex(moments.astype("datetime64[ns]"), tz="UTC"), lat_deg, lon_deg,
        altitude=0, pressure=PRESSURE_PA, temperature=TEMPERATURE_C,
    )  # fmt: skip
    apparent, geometric = (position[name].to_numpy() for name in ("apparent_elevation", "elevation"))
    return SunPath(moments, position["azimuth"].to_numpy() % 360.0, apparent, apparent - geometric)


def check_times(moments: np.ndarray) -> None:
    """Raise ``InputError`` for times (datetime64 in UTC) outside of ``SUPPORTED_YEARS``."""
    first, last = (np.datetime64(f"{year}-01-01") for year in (SUPPORTED_YEARS[0], SUPPORTED_YEARS[1] + 1))
    tolerance = np.timedelta64(1, "D")  # tolerance: each zone begins and ends a year at its own time
    for moment in moments[(moments < first - tolerance) | (moments >= last + tolerance)][:1]:
        raise InputError("time", str(moment.astype("datetime64[s]")), f"years {SUPPORTED_YEARS[0]} to {SUPPORTED_YEARS[1]}")


def check_date(day: date, name: str = "date") -> None:
    """Raise ``InputError`` unless the year of a date lies between the two ``SUPPORTED_YEARS``, both excluded.

    The sun's position is then computed for the whole date in every time zone.
    """
    if not SUPPORTED_YEARS[0] < day.year < SUPPORTED_YEARS[1]:
        raise InputError(name, day.isoformat(), f"years {SUPPORTED_YEARS[0] + 1} to {SUPPORTED_YEARS[1] - 1}")


def as_utc(times: Sequence[datetime] | np.ndarray) -> np.ndarray:
    """Return times as datetime64[us] in UTC (n,)."""
    if isinstance(times, np.ndarray):
        return times.astype("datetime64[us]")
    local = np.array([time.replace(tzinfo=None) for time in times], "datetime64[us]")
    offsets = np.array([time.utcoffset() or timedelta(0) for time in times], "timedelta64[us]")
    return local - offsets  # ``astimezone`` would leave the years 1 to 9999 and fail
