"""Irradiation of Gaussian hills against quadrature: analytic normals, and shadows and horizons by root finding."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest

from benchmarks.irradiation.hill_raster import HillRaster, open_hills
from benchmarks.irradiation.hills import GaussianHills, four_hills, hills_irradiation, hills_sky
from skugga.shadows.irradiation.irradiation import IrradiationRules
from skugga.shadows.irradiation.light import Part
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import windows_between

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop

SAMPLES = 200
"""Cells that are compared."""

MAX_MEAN_ERROR = 0.001
"""Maximum mean error, as a share of the mean. Published tools have 0.0055 to 0.0166 on such hills."""

MAX_PART_ERROR: dict[Part, float] = {
    "total": 0.001, "beam": 0.001, "circumsolar": 0.001, "sky": 0.001, "horizon_band": 0.01, "reflected": 0.01,
}  # fmt: skip
"""The same by part. The last two parts are less than a hundredth of the total."""


@pytest.fixture(scope="module")
def raster(tmp_path_factory: pytest.TempPathFactory):
    with open_hills(tmp_path_factory.mktemp("hills")) as raster:
        yield raster


def test_hills_receive_what_quadrature_says(raster: HillRaster):
    windows = windows_between(raster.scene.world, date(2023, 3, 21), date(2023, 12, 21), 55, (0.0, 1440.0), SOLAR)
    row, col = np.random.default_rng(1).integers(1, raster.view.rows - 1, (2, SAMPLES))
    truth = hills_irradiation(
        raster.hills, *raster.positions_m(row, col), *raster.suns_and_light(windows, IrradiationRules()), 0.2, 72
    )
    for part, limit in MAX_PART_ERROR.items():
        values = raster.irradiation(windows, IrradiationRules((part,)))[row, col]
        assert np.abs(values - truth[part]).mean() <= limit * abs(truth[part].mean()), part
    assert truth["total"].min() < 0.8 * truth["total"].max(), "hills and their shadows matter"


def test_shadows_of_the_hills_matter(raster: HillRaster):
    """Truth without cast shadows differs by more than is allowed, so shadows are tested."""
    windows = windows_between(raster.scene.world, date(2023, 12, 21), date(2023, 12, 21), 1, (0.0, 1440.0), SOLAR)
    row, col = np.random.default_rng(2).integers(1, raster.view.rows - 1, (2, SAMPLES))
    light = raster.suns_and_light(windows, IrradiationRules())
    position = raster.positions_m(row, col)
    truth = hills_irradiation(raster.hills, *position, *light, 0.2, 36)["beam"]
    values = raster.irradiation(windows, IrradiationRules(("beam",)))[row, col]
    assert np.abs(values - truth).mean() <= MAX_MEAN_ERROR * truth.mean()
    suns, heights_m, sky_light = light
    slope = raster.hills.slopes(*position)
    unshaded = np.zeros(SAMPLES)
    for azimuth, altitude, hours, power in zip(
        np.radians(suns.azimuth_deg), np.radians(suns.altitude_deg), suns.hours, sky_light.beam.T, strict=True
    ):
        cosine = np.sin(altitude) - np.cos(altitude) * (slope[0] * np.sin(azimuth) + slope[1] * np.cos(azimuth))
        beam = np.interp(raster.hills.heights_m(*position), heights_m, power)
        unshaded += np.maximum(cosine, 0.0) * beam * hours / 1000.0
    unshaded /= np.hypot(1.0, np.hypot(*slope))
    assert (unshaded - truth).mean() > 20.0 * MAX_MEAN_ERROR * truth.mean()


def test_horizon_of_one_hill_has_a_closed_form():
    """From a point far below, on its axis, the horizon of a hill is the tangent from that point, found here by bisection."""
    hill = GaussianHills(*(np.array([value]) for value in (0.0, 0.0, 100.0, 50.0)), half_side_m=1000.0)
    distance_m = np.array([200.0, 300.0, 500.0])
    low, high = np.zeros(3), distance_m - 1.0
    start_m = hill.heights_m(-distance_m, np.zeros(3))
    for _ in range(80):  # at the point of contact x from the start, the slope of the hill is that of the line
        x = (low + high) / 2.0
        height_m = hill.heights_m(x - distance_m, np.zeros(3))
        slope = height_m * (distance_m - x) / 50.0**2
        is_before = slope > (height_m - start_m) / x
        low, high = np.where(is_before, x, low), np.where(is_before, high, x)
    tangent = (hill.heights_m(low - distance_m, np.zeros(3)) - start_m) / low
    found = hill.horizon_tangents(-distance_m, np.zeros(3), 90.0)
    np.testing.assert_allclose(found, tangent, rtol=1e-5)


def test_open_ground_sees_all_the_sky():
    hills = four_hills(400.0)
    far = np.array([2199.0]), np.array([2199.0])
    sky, band = hills_sky(hills, *far, 72)
    assert 0.97 < sky[0] < 1.0 and band[0] < 0.01


def test_no_ground_is_higher_than_the_bound():
    hills = four_hills(400.0)
    axis_m = np.linspace(-2000.0, 2000.0, 401)
    assert 0.9 * hills.top_m < hills.heights_m(axis_m[None, :], axis_m[:, None]).max() <= hills.top_m
