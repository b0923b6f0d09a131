"""The sun of weather records: the light outside of the atmosphere, and the shift of times that fits the light to the sun."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas

MIN_BEAM_W_M2 = 50.0
"""Power of sunlight from which a record tells the sun's altitude."""

MIN_BEAM_RECORDS = 50
"""Number of such records from which times can be fitted."""

FIT_RADIUS = (0.9, 1.1)
"""Range of the fitted cosine's amplitude: 1 for the light of a place, others for another latitude or for unrelated parts."""


def extraterrestrial_w_m2(moments: np.ndarray) -> np.ndarray:
    """Return the sunlight outside of the atmosphere at moments (n,), datetime64 in UTC, on planes that face the sun, W/m2."""
    from pvlib import irradiance  # imported here: pvlib and pandas take 0.8 s

    with without_pvlib_warnings():
        return np.asarray(irradiance.get_extra_radiation(as_index(moments)))


def time_shift_min(
    moments: np.ndarray, ghi: np.ndarray, dni: np.ndarray, dhi: np.ndarray, lon_deg: float, lat_deg: float
) -> float | None:
    """Return the minutes by which moments (n,), datetime64 in UTC, must be later for their light to fit the sun of a place.

    The cosine of the sun's zenith angle is sin(lat) sin(dec) + cos(lat) cos(dec) cos(hour angle), and (GHI - DHI) / DNI by the
    light. A shift of the hour angle is linear in its own cosine and sine, which least squares yield. The result is within half a
    day; ``None`` if too few records have sunlight, or if no shift fits.
    """
    from pvlib import solarposition

    is_sunny = dni >= MIN_BEAM_W_M2
    if np.count_nonzero(is_sunny) < MIN_BEAM_RECORDS:
        return None
    moments, beam = moments[is_sunny], dni[is_sunny]
    with without_pvlib_warnings():
        day = as_index(moments).dayofyear.to_numpy()
        declination = solarposition.declination_spencer71(day)
        equation_of_time_min = solarposition.equation_of_time_spencer71(day)
    since_midnight = moments.astype("datetime64[us]") - moments.astype("datetime64[D]").astype("datetime64[us]")
    minutes = since_midnight / np.timedelta64(1, "m") + equation_of_time_min
    hour_angle = np.radians(minutes / 4.0 - 180.0 + lon_deg)
    lat = np.radians(lat_deg)
    level_beam = ghi[is_sunny] - dhi[is_sunny] - beam * np.sin(lat) * np.sin(declination)
    amplitude = beam * np.cos(lat) * np.cos(declination)
    terms = np.stack([amplitude * np.cos(hour_angle), -amplitude * np.sin(hour_angle)], axis=1)
    cosine, sine = np.linalg.lstsq(terms, level_beam, rcond=None)[0]
    if not FIT_RADIUS[0] <= np.hypot(cosine, sine) <= FIT_RADIUS[1]:
        return None
    return float(np.degrees(np.arctan2(sine, cosine)) * 4.0)


def as_index(moments: np.ndarray) -> pandas.DatetimeIndex:
    """Return moments, datetime64 in UTC, as pvlib takes them."""
    import pandas

    return pandas.DatetimeIndex(moments.astype("datetime64[ns]"), tz="UTC")


@contextmanager
def without_pvlib_warnings() -> Iterator[None]:
    """Ignore warnings of pvlib's use of names that pandas will drop."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning)
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        yield
