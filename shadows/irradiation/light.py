"""The light of each sun, by pvlib: the clear sky, and the parts of its light by the model of Perez and Driesse.

The model divides the light of the sky into an isotropic part, a circumsolar part, which comes from the sun's direction, and that of
a band at the horizon (A. Driesse, A. Jensen and R. Perez 2024, "A continuous form of the Perez diffuse sky model for forward and
reverse transposition", Solar Energy 267). On a plane under an open sky each part is a number for the sun times a number for the
plane. These numbers for the suns are read from pvlib's own results for level, vertical and sun-facing planes.

Light depends on the height of the ground, since the air above is thinner. It is computed for several heights.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from skugga.shadows.irradiation.suns import SunIntervals


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
    with warnings.catch_warnings():  # pvlib uses names that pandas will drop
        warnings.filterwarnings("ignore", category=FutureWarning)
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        return _clear_sky_light(suns, lon_deg, lat_deg, height_m, linke_turbidity)


def _clear_sky_light(
    suns: SunIntervals, lon_deg: float, lat_deg: float, height_m: np.ndarray, linke_turbidity: float | None
) -> SkyLight:
    """Return the light of at least one sun, as ``clear_sky_light`` does."""
    import pandas  # imported here: pvlib and pandas take 0.8 s
    from pvlib import atmosphere, clearsky, irradiance

    times = pandas.DatetimeIndex(suns.moments.astype("datetime64[ns]"), tz="UTC")
    turbidity = (
        clearsky.lookup_linke_turbidity(times, lat_deg, lon_deg).to_numpy()
        if linke_turbidity is None
        else np.full(len(suns), linke_turbidity)
    )
    zenith = 90.0 - suns.altitude_deg
    extraterrestrial = irradiance.get_extra_radiation(times).to_numpy()
    relative_airmass = atmosphere.get_relative_airmass(zenith)
    out = []
    for height in height_m:
        airmass = atmosphere.get_absolute_airmass(relative_airmass, atmosphere.alt2pres(height))
        sky = clearsky.ineichen(zenith, airmass, turbidity, altitude=height, dni_extra=extraterrestrial)
        dni, dhi, ghi = (np.asarray(sky[name]) for name in ("dni", "dhi", "ghi"))
        out.append(_parts(suns, dni, dhi, ghi, extraterrestrial))
    return SkyLight(*(np.stack(values) for values in zip(*out, strict=True)))


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


def reflected_light(light: SkyLight, albedo: float) -> np.ndarray:
    """Return the light (heights, n) that level ground of an albedo sends up, W/m2."""
    from pvlib import irradiance

    return np.asarray(irradiance.get_ground_diffuse(180.0, light.level, albedo))
