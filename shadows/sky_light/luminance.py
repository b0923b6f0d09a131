"""Luminance of the sky: two of the CIE's standard skies, and tables of their light above a horizon.

Source: CIE S 011/E:2003 (ISO 15469:2004), *Spatial distribution of daylight: CIE standard general sky*. The luminance is a product
of a gradation, which depends on the altitude, and an indicatrix, which depends on the angle to the sun.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

HORIZON_CODES = 256
"""Number of horizons that tables have entries for: their sines are even steps from 0 to 1."""

_ALTITUDE_STEPS, _AZIMUTH_STEPS = 512, 8
"""Steps of the integrals over altitudes from 0 to 90 degrees, and over the azimuths of a sector."""

MIN_SKY_SUN_ALTITUDE_DEG = 3.0
"""Lowest altitude of the sun for which the clear sky is computed. Below it, the brightest part of the sky stays there."""


class StandardSky(NamedTuple):
    """Parameters of a standard sky: ``gradation_scale`` a, ``gradation_rate`` b and the indicatrix' c, d and e."""

    gradation_scale: float
    gradation_rate: float
    indicatrix_scale: float
    indicatrix_rate: float
    indicatrix_back: float


OVERCAST = StandardSky(4.0, -0.7, 0.0, -1.0, 0.0)
"""Type 1: overcast, three times as bright in the zenith as at the horizon."""

CLEAR = StandardSky(-1.0, -0.32, 10.0, -3.0, 0.45)
"""Type 12: clear, with low turbidity."""


def relative_luminance(
    sky: StandardSky, altitude: np.ndarray, azimuth: np.ndarray, sun_altitude: float, sun_azimuth: float
) -> np.ndarray:
    """Return the luminance of a sky in directions, in arbitrary units. All angles are radians."""
    gradation = 1.0 + sky.gradation_scale * np.exp(sky.gradation_rate / np.maximum(np.sin(altitude), 1e-6))
    cosine = np.sin(altitude) * np.sin(sun_altitude) + np.cos(altitude) * np.cos(sun_altitude) * np.cos(azimuth - sun_azimuth)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    indicatrix = (
        1.0
        + sky.indicatrix_scale * (np.exp(sky.indicatrix_rate * angle) - np.exp(0.5 * np.pi * sky.indicatrix_rate))
        + sky.indicatrix_back * np.cos(angle) ** 2
    )
    return gradation * indicatrix


def light_tables(azimuths: int, cloud_cover: float, sun_altitude_deg: float, sun_azimuth_deg: float) -> np.ndarray:
    """Return the light of each sector of the sky above a horizon, as a vector: float32 (``azimuths``, ``HORIZON_CODES``, 3).

    The vector's product with a surface's normal is the irradiance on it. Its axes are east, north and up. Level ground that sees
    the whole sky has the irradiance 1.

    Parameters
    ----------
    azimuths
        Number of evenly spaced sectors; the middle of the first one is north.
    cloud_cover
        Share of the overcast sky, 0 to 1. The rest is the clear sky.
    sun_altitude_deg, sun_azimuth_deg
        The sun's position, degrees. The overcast sky does not depend on it.
    """
    altitude = (np.arange(_ALTITUDE_STEPS) + 0.5) * (0.5 * np.pi / _ALTITUDE_STEPS)
    sector = (np.arange(_AZIMUTH_STEPS) + 0.5) / _AZIMUTH_STEPS - 0.5
    azimuth = 2.0 * np.pi / azimuths * (np.arange(azimuths)[:, None, None] + sector[:, None])
    sun = np.radians(max(sun_altitude_deg, MIN_SKY_SUN_ALTITUDE_DEG)), np.radians(sun_azimuth_deg)
    total = np.zeros((azimuths, HORIZON_CODES, 3))
    for sky, share in ((CLEAR, 1.0 - cloud_cover), (OVERCAST, cloud_cover)):
        if share == 0.0:
            continue
        light = relative_luminance(sky, altitude, azimuth, *sun) * np.cos(altitude)
        directions = np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude) + 0.0 * azimuth
        by_altitude = np.stack([(light * axis).mean(axis=1) for axis in directions], axis=-1)
        above = np.cumsum(by_altitude[:, ::-1], axis=1)[:, ::-1]
        above = np.concatenate([above, np.zeros((azimuths, 1, 3))], axis=1)
        horizon = np.arcsin(np.linspace(0.0, 1.0, HORIZON_CODES)) * (_ALTITUDE_STEPS / (0.5 * np.pi))
        step = np.minimum(horizon.astype(np.int64), _ALTITUDE_STEPS - 1)
        fraction = (horizon - step)[:, None]
        table = above[:, step] + fraction * (above[:, step + 1] - above[:, step])
        total += share * table / table[:, 0, 2].sum()
    return total.astype(np.float32)
