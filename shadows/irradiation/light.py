"""The light of each sun: that of the clear sky or of weather, and its parts by the model of Perez and Driesse, by pvlib.

The model divides the light of the sky into an isotropic part, a circumsolar part, which comes from the sun's direction, and that of
a band at the horizon (A. Driesse, A. Jensen and R. Perez 2024, "A continuous form of the Perez diffuse sky model for forward and
reverse transposition", Solar Energy 267). On a plane under an open sky each part is a number for the sun times a number for the
plane. These numbers for the suns are read from pvlib's own results for level, vertical and sun-facing planes.

The light of a clear sky depends on the height of the ground, since the air above is thinner. It is computed for several heights.
That of weather does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from skugga.shadows.irradiation.planes import TiltedPlane
from skugga.shadows.irradiation.suns import SunIntervals, suns_at, time_up
from skugga.shadows.irradiation.weather_records import RecordIntervals, Weather, as_timedelta, records_in_windows
from skugga.shadows.irradiation.weather_sun import as_index, extraterrestrial_w_m2, without_pvlib_warnings
from skugga.terrain.geo.daily_windows import DailyWindow

Part = Literal["total", "beam", "circumsolar", "sky", "horizon_band", "reflected"]
"""The parts of irradiation, and their total."""

MIN_BEAM_ALTITUDE_DEG = 2.0
"""Altitude of the sun below which sunlight is not told from GHI and DHI: their difference is divided by next to nothing."""

MAX_LOW_SUN_DEG = 10.0
"""Altitude of the sun below which sunlight that follows from GHI is limited to that of a clear sky."""

CLEAR_SKY_TOLERANCE = 1.1
"""Sunlight of a low sun as a multiple of that of a clear sky, as in pvlib's ``irradiance.dni``."""


MIN_SINE = 1e-9
"""Sine of the tilt of planes without light from the band at the horizon: level ones."""


@dataclass(frozen=True, eq=False)
class SkyLight:
    """The light of n suns at some heights, W/m2, (heights, n) each.

    Attributes
    ----------
    beam
        Sunlight on a plane that faces the sun (DNI).
    circumsolar
        Circumsolar skylight on a plane that faces the sun.
    isotropic
        Isotropic skylight on a level plane.
    horizon_band
        Light of the horizon's band on a vertical plane. It is negative where the horizon is darker than the sky.
    level
        All light on a level plane (GHI).
    """

    beam: np.ndarray
    circumsolar: np.ndarray
    isotropic: np.ndarray
    horizon_band: np.ndarray
    level: np.ndarray


def clear_sky_light(
    suns: SunIntervals, lon_deg: float, lat_deg: float, height_m: np.ndarray, linke_turbidity: float | None
) -> SkyLight:
    """Return the light of suns under a clear sky at heights (k,), by pvlib's model of P. Ineichen and R. Perez (2002).

    ``linke_turbidity`` is the turbidity of the air; ``None``: pvlib's monthly climate at the position.
    """
    if not len(suns):
        return SkyLight(*(np.zeros((len(height_m), 0)) for _ in range(5)))
    with without_pvlib_warnings():
        extraterrestrial, turbidity = extraterrestrial_w_m2(suns.moments), _turbidity(suns, lon_deg, lat_deg, linke_turbidity)
        out = [
            _parts(suns, *_clear_sky(suns, turbidity, extraterrestrial, height), extraterrestrial) for height in height_m.tolist()
        ]  # fmt: skip
    return SkyLight(*(np.stack(values) for values in zip(*out, strict=True)))


def weather_light(
    weather: Weather, windows: Sequence[DailyWindow], lon_deg: float, lat_deg: float
) -> tuple[SunIntervals, SkyLight]:
    """Return the suns and the light of weather's records in windows, at a place.

    A record has one sun, in the middle of the time that the sun is up in it. Its energy falls in that time: the power is the
    record's mean, times the record's length over that time. Light of records in which the sun is not up, as at dawn, comes from the
    sky with the nearest sun of its window. In a window without sun it is left out.

    Parameters
    ----------
    weather
        The records.
    windows
        The windows. Records are cut at their ends.
    lon_deg, lat_deg
        The place, degrees.

    Returns
    -------
    suns : SunIntervals
        The n suns, in the order of the windows.
    light : SkyLight
        Their light, (2, n): the same at two heights, between which callers interpolate.

    Raises
    ------
    InputError
        For a date with daylight of which the weather has no record.
    """
    records = records_in_windows(weather, windows, lon_deg, lat_deg)
    up_min, moments = time_up(records.start, records.length_min, lon_deg, lat_deg)
    whole_up_min = up_min.copy()  # a record's light is shared by the time that the sun is up, also outside of the window
    is_cut = records.length_min < weather.length_min[records.record] - 1e-6
    cut = records.record_start[is_cut], weather.length_min[records.record[is_cut]]
    whole_up_min[is_cut], _ = time_up(*cut, lon_deg, lat_deg)
    suns, is_up = suns_at(moments, up_min, lon_deg, lat_deg)
    if not len(suns):
        return suns, SkyLight(*(np.zeros((2, 0)) for _ in range(5)))
    with without_pvlib_warnings():
        extraterrestrial = extraterrestrial_w_m2(suns.moments)
        scale = weather.length_min[records.record[is_up]] / whole_up_min[is_up]
        ghi, dni, dhi = _complete(weather, records.record[is_up], suns, scale, extraterrestrial)
        dawn = _dawn_wh(weather, records, up_min, whole_up_min, is_up) / (scale * suns.hours)
        ghi, dhi = ghi + dawn, dhi + dawn
        limit = extraterrestrial
        if weather.dni is None:
            turbidity = _turbidity(suns, lon_deg, lat_deg, None)
            clear_dni, _, _ = _clear_sky(suns, turbidity, extraterrestrial, weather.height_m or 0.0)
            limit = np.where(suns.altitude_deg < MAX_LOW_SUN_DEG, CLEAR_SKY_TOLERANCE * clear_dni, extraterrestrial)
        limit = limit / scale  # as all powers here: the model of the sky's parts does not know those of an hour within minutes
        dhi = dhi + np.maximum(dni - limit, 0.0) * np.sin(np.radians(suns.altitude_deg))
        parts = _parts(suns, np.minimum(dni, limit), dhi, ghi, extraterrestrial)
    return suns, SkyLight(*(np.tile(scale * values, (2, 1)) for values in parts))


def _complete(
    weather: Weather, record: np.ndarray, suns: SunIntervals, scale: np.ndarray, extraterrestrial: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return GHI, DNI and DHI of the records of n suns, (n,) each, W/m2 as means of the records' intervals.

    Parts that weather does not have follow from GHI = DHI + DNI sin(altitude), or from GHI by the model of D. Erbs and A. Driesse.
    ``scale`` (n,) leads from means to the power while the sun is up.
    """
    from pvlib import irradiance

    ghi, dni, dhi = (None if values is None else values[record] for values in (weather.ghi, weather.dni, weather.dhi))
    sine = np.sin(np.radians(suns.altitude_deg))
    if ghi is None:
        assert dni is not None and dhi is not None
        return dhi + dni * sine, dni, dhi
    if dni is None and dhi is None:
        zenith = 90.0 - suns.altitude_deg
        parts = irradiance.erbs_driesse(ghi * scale, zenith, dni_extra=extraterrestrial)
        return ghi, parts["dni"] / scale, parts["dhi"] / scale
    if dni is None:
        assert dhi is not None
        has_beam = (suns.altitude_deg >= MIN_BEAM_ALTITUDE_DEG) & (ghi > dhi)
        return ghi, np.where(has_beam, (ghi - dhi) / sine, 0.0), np.where(has_beam, dhi, ghi)
    if dhi is None:
        dni = np.minimum(dni, ghi / sine)
        return ghi, dni, ghi - dni * sine
    return ghi, dni, dhi


def _dawn_wh(
    weather: Weather, records: RecordIntervals, up_min: np.ndarray, whole_up_min: np.ndarray, is_up: np.ndarray
) -> np.ndarray:
    """Return the energy of records without sun that counts with each of the n suns, Wh/m2: with the nearest of the same window."""
    power = weather.dhi if weather.ghi is None else weather.ghi
    assert power is not None
    whole_min = weather.length_min[records.record]
    share = np.where(whole_up_min > 0.0, up_min * whole_min / np.maximum(whole_up_min, 1e-9), records.length_min)
    energy = np.where(is_up, 0.0, power[records.record] * share / 60.0)
    lit, dark = np.flatnonzero(is_up), np.flatnonzero(energy > 0.0)
    after = np.searchsorted(lit, dark)
    middle = records.start + as_timedelta(records.length_min / 2.0)
    out, nearest_us = np.zeros(len(lit)), np.full(len(dark), np.inf)
    chosen = np.full(len(dark), -1)
    for candidate in (after - 1, after):
        sun = np.clip(candidate, 0, len(lit) - 1)
        distance_us = np.abs((middle[lit[sun]] - middle[dark]).astype(float))
        is_better = (records.window[lit[sun]] == records.window[dark]) & (distance_us < nearest_us)
        chosen[is_better], nearest_us[is_better] = sun[is_better], distance_us[is_better]
    np.add.at(out, chosen[chosen >= 0], energy[dark][chosen >= 0])
    return out


def _turbidity(suns: SunIntervals, lon_deg: float, lat_deg: float, linke_turbidity: float | None) -> np.ndarray:
    """Return Linke's turbidity of the air for each sun, (n,)."""
    from pvlib import clearsky  # imported here: pvlib and pandas take 0.8 s

    if linke_turbidity is not None:
        return np.full(len(suns), linke_turbidity)
    return clearsky.lookup_linke_turbidity(as_index(suns.moments), lat_deg, lon_deg).to_numpy()


def _clear_sky(
    suns: SunIntervals, turbidity: np.ndarray, extraterrestrial: np.ndarray, height_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return direct, diffuse and global light under a clear sky at one height, (n,) each, W/m2."""
    from pvlib import atmosphere, clearsky

    zenith = 90.0 - suns.altitude_deg
    airmass = atmosphere.get_absolute_airmass(atmosphere.get_relative_airmass(zenith), atmosphere.alt2pres(height_m))
    sky = clearsky.ineichen(zenith, airmass, turbidity, altitude=height_m, dni_extra=extraterrestrial)
    dni, dhi, ghi = (np.asarray(sky[name]) for name in ("dni", "dhi", "ghi"))
    return dni, dhi, ghi


def _parts(
    suns: SunIntervals, dni: np.ndarray, dhi: np.ndarray, ghi: np.ndarray, extraterrestrial: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return the fields of ``SkyLight`` at one height, (n,) each, from direct, diffuse, global and extraterrestrial light."""
    from pvlib import irradiance

    zenith, azimuth = 90.0 - suns.altitude_deg, suns.azimuth_deg

    def on_plane(tilt: float | np.ndarray, part: str) -> np.ndarray:
        parts = irradiance.perez_driesse(tilt, azimuth, dhi, dni, extraterrestrial, zenith, azimuth, return_components=True)
        return np.asarray(parts[part])

    return dni, on_plane(zenith, "poa_circumsolar"), on_plane(0.0, "poa_isotropic"), on_plane(90.0, "poa_horizon"), ghi


def limit_horizon_band(light: SkyLight, suns: SunIntervals, plane: TiltedPlane) -> SkyLight:
    """Return the light whose band at the horizon takes no more than the sky gives a plane in the open, as in pvlib.

    Only planes that lean over by more than 150 degrees need it, in years of clear skies and in pvlib's two TMY3 files: they see
    little more of the sky than the band, which weather may leave darker. Without it 0.6 % of the light is missing at 175 degrees.
    Rasters apply it to planes of one tilt as if under an open sky.
    """
    tilt = np.radians(plane.tilt_deg)
    sky = light.isotropic * (1.0 + np.cos(tilt)) / 2.0 + light.circumsolar * plane.cosine_towards(
        suns.azimuth_deg, suns.altitude_deg
    )
    least = -sky / max(float(np.sin(tilt)), MIN_SINE)
    return replace(light, horizon_band=np.maximum(light.horizon_band, least))


def reflected_light(light: SkyLight, albedo: float) -> np.ndarray:
    """Return the light (heights, n) that level ground of an albedo sends up, W/m2."""
    from pvlib import irradiance

    return np.asarray(irradiance.get_ground_diffuse(180.0, light.level, albedo))
