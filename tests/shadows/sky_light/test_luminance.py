"""Skies: symmetries of their luminance, and the light above horizons against integrals by another method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad

from skugga.shadows.sky_light.luminance import CLEAR, HORIZON_CODES, OVERCAST, light_tables, relative_luminance

AZIMUTHS = 16


def test_level_open_ground_has_irradiance_1():
    for cover, altitude in ((0.0, 10.0), (0.0, 60.0), (0.4, 35.0), (1.0, 20.0)):
        vector = light_tables(AZIMUTHS, cover, altitude, 130.0)[:, 0].sum(axis=0)
        assert vector[2] == pytest.approx(1.0, abs=1e-5)


def test_no_light_comes_from_below_a_horizon_at_the_zenith():
    assert not light_tables(AZIMUTHS, 0.3, 20.0, 75.0)[:, HORIZON_CODES - 1].any()


def test_overcast_sky_is_even_in_azimuth():
    tables = light_tables(AZIMUTHS, 1.0, 10.0, 222.0)
    np.testing.assert_allclose(tables[:, 0].sum(axis=0)[:2], 0.0, atol=1e-6)
    np.testing.assert_allclose(tables[..., 2], np.broadcast_to(tables[:1, :, 2], tables.shape[:2]), rtol=1e-4, atol=1e-7)


def test_overcast_zenith_is_about_three_times_as_bright_as_the_horizon():
    """The gradation of type 1 stands for the CIE's older overcast sky, (1 + 2 sin a) / 3."""
    altitude = np.radians(np.array([0.01, 30.0, 90.0]))
    luminance = relative_luminance(OVERCAST, altitude, np.zeros(3), 1.0, 0.0)
    np.testing.assert_allclose(luminance / luminance[2], (1.0 + 2.0 * np.sin(altitude)) / 3.0, atol=0.05)


def test_clear_sky_is_mirrored_with_the_sun():
    east, west = light_tables(AZIMUTHS, 0.0, 25.0, 90.0), light_tables(AZIMUTHS, 0.0, 25.0, 270.0)
    mirrored = west[(-np.arange(AZIMUTHS)) % AZIMUTHS] * np.array([-1.0, 1.0, 1.0], np.float32)
    np.testing.assert_allclose(east, mirrored, atol=1e-6)
    assert east[:, 0].sum(axis=0)[0] > 0.2, "the side of the sun is brighter"


@pytest.mark.parametrize("sky_name", ["clear", "overcast"])
def test_light_on_a_slope_equals_an_integral(sky_name: str):
    """A slope of 30 degrees to the south-east, before horizons of 20 degrees all around, by adaptive quadrature."""
    sky, sun = {"clear": CLEAR, "overcast": OVERCAST}[sky_name], (np.radians(40.0), np.radians(200.0))
    normal = np.array([np.sin(np.radians(30.0)) * np.sqrt(0.5), -np.sin(np.radians(30.0)) * np.sqrt(0.5), np.cos(np.radians(30.0))])

    def light(normal_enu: np.ndarray, low: float) -> float:
        def integrand(altitude: float, azimuth: float) -> float:
            direction = np.array([np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude)])
            luminance = relative_luminance(sky, np.array(altitude), np.array(azimuth), *sun)
            return float(luminance * np.cos(altitude) * (direction @ normal_enu))

        return float(dblquad(integrand, 0.0, 2.0 * np.pi, low, 0.5 * np.pi, epsabs=1e-4, epsrel=1e-4)[0])

    expected = light(normal, np.radians(20.0)) / light(np.array([0.0, 0.0, 1.0]), 0.0)
    code = round(np.sin(np.radians(20.0)) * (HORIZON_CODES - 1))
    vector = light_tables(AZIMUTHS, float(sky_name == "overcast"), 40.0, 200.0)[:, code].sum(axis=0)
    assert float(vector @ normal) == pytest.approx(expected, rel=0.005)
