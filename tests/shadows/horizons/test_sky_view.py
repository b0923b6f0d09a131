"""Sky view factors against closed forms, each in the definitions that it tells apart."""

import numpy as np
import pytest

from skugga.shadows.horizons import turned
from skugga.shadows.horizons.azimuths import SKY_VIEW_KINDS
from skugga.shadows.horizons.grid import HorizonGrid, north_up_cell
from skugga.shadows.horizons.sky_view import arctan, ground_slopes, sky_view_factor
from skugga.terrain.compiled import compiled

ANGLES_DEG = (20.0, 45.0, 60.0)


SQUARE_METRES = north_up_cell(1.0, 1.0)


def factor_of(height_m, kind, cell=SQUARE_METRES, azimuths=72):
    """Return the sky view factor at the middle node."""
    eyes = tuple(slice(count // 2, count // 2 + 1) for count in height_m.shape)
    (factor,) = sky_view_factor(HorizonGrid(np.asarray(height_m, np.float32), cell, eyes=eyes), kind, azimuths).ravel()
    return float(factor)


@pytest.mark.parametrize("direction_deg", [0.0, 20.0, 45.0])
@pytest.mark.parametrize("slope_deg", ANGLES_DEG)
def test_infinite_ramp(slope_deg, direction_deg):
    slope, direction = np.radians(slope_deg), np.radians(direction_deg)
    row, col = np.mgrid[-40:41, -40:41]
    ramp = np.tan(slope) * (col * np.cos(direction) + row * np.sin(direction))
    assert factor_of(ramp, "solid_angle") == pytest.approx(1.0 - slope / np.pi, abs=0.002)
    assert factor_of(ramp, "tilted") == pytest.approx((1.0 + np.cos(slope)) / 2.0, abs=0.001)
    assert factor_of(ramp, "openness") == pytest.approx(90.0, abs=0.01)
    assert factor_of(ramp, "negative_openness") == pytest.approx(90.0, abs=0.01)


@pytest.mark.parametrize("slope_deg", ANGLES_DEG)
def test_v_shaped_valley_tells_the_level_plane_from_the_tilted_one(slope_deg):
    slope = np.radians(slope_deg)
    across = np.abs(np.arange(-2500, 2501.0))
    floor = np.tile(np.tan(slope) * across, (11, 1))
    wall = np.tile(np.tan(slope) * np.abs(np.arange(-2501, 2500.0)), (11, 1))  # one metre beside the lowest line
    long = north_up_cell(20000.0, 1.0)  # 200 km to either end
    assert factor_of(floor, "cosine", long) == pytest.approx(np.cos(slope), abs=0.001)
    assert factor_of(wall, "tilted", long) == pytest.approx(np.cos(slope) ** 2, abs=0.001)


@pytest.mark.parametrize("slope_deg", ANGLES_DEG)
def test_pit(slope_deg):
    """From the middle of a round floor, a conical wall stands equally high in all directions."""
    slope = np.radians(slope_deg)
    distance = np.hypot(*np.mgrid[-300:301, -300:301])
    pit = np.where(distance < 150.0, 0.0, np.tan(slope) * distance)
    assert factor_of(pit, "solid_angle") == pytest.approx(1.0 - np.sin(slope), abs=0.002)
    assert factor_of(pit, "cosine") == pytest.approx(np.cos(slope) ** 2, abs=0.001)
    assert factor_of(pit, "openness") == pytest.approx(90.0 - slope_deg, abs=0.1)


@pytest.mark.parametrize("height_per_width", [0.3, 1.0, 2.0])
def test_floor_of_a_canyon(height_per_width):
    across = np.arange(-1500, 1501)
    canyon = np.tile(np.where(np.abs(across) < 1000, 0.0, 2000.0 * height_per_width), (21, 1))
    expected = np.cos(np.arctan(2.0 * height_per_width))
    assert factor_of(canyon, "cosine", north_up_cell(20000.0, 1.0)) == pytest.approx(expected, abs=0.001)


def test_openness_of_a_peak_and_of_a_pit_are_each_other_s():
    peak = -np.hypot(*np.mgrid[-30:31, -30:31])
    assert factor_of(peak, "openness") > 110.0
    assert factor_of(peak, "openness") == factor_of(-peak, "negative_openness")
    assert factor_of(peak, "negative_openness") == factor_of(-peak, "openness") < 70.0


@pytest.mark.parametrize("kind", SKY_VIEW_KINDS)
def test_the_eight_turns_of_a_grid_have_the_same_factor(kind, monkeypatch):
    monkeypatch.setattr(turned, "MAX_CHORD_ERROR", 0.0)  # blocks begin elsewhere on a turned grid
    random = np.random.default_rng(2)
    height_m = (20.0 * random.random((40, 77))).repeat(2, 0).astype(np.float32)
    cell = north_up_cell(7.0, 7.0)
    plain = sky_view_factor(HorizonGrid(height_m, cell), kind, 16)
    for mirrored in (False, True):
        for turns in range(4):
            turned_m, expected = (np.rot90(values[:, ::-1] if mirrored else values, turns) for values in (height_m, plain))
            np.testing.assert_allclose(sky_view_factor(HorizonGrid(turned_m, cell), kind, 16), expected, rtol=2e-5)


@pytest.mark.parametrize("kind", SKY_VIEW_KINDS)
def test_nodes_without_ground_have_no_factor(kind):
    height_m = np.zeros((9, 9), np.float32)
    height_m[4, 4] = np.nan
    factor = sky_view_factor(HorizonGrid(height_m, north_up_cell(1.0, 1.0)), kind, 8)
    assert np.isnan(factor[4, 4]) and np.isfinite(np.delete(factor.ravel(), 40)).all()
    np.testing.assert_allclose(np.delete(factor.ravel(), 40), 90.0 if "openness" in kind else 1.0, rtol=1e-6)


def test_slopes_of_a_turned_grid_are_east_and_north():
    cell = np.array([[4.0, 24.0], [-26.0, 5.0]])
    row, col = np.mgrid[:6, :7]
    east_m, north_m = cell[0, 0] * row + cell[0, 1] * col, cell[1, 0] * row + cell[1, 1] * col
    east, north = ground_slopes(HorizonGrid((0.3 * east_m - 0.2 * north_m).astype(np.float32), cell))
    np.testing.assert_allclose(east, 0.3, rtol=1e-4)
    np.testing.assert_allclose(north, -0.2, rtol=1e-4)


@compiled
def arctan_of(values, out):
    """Write the arc tangents of values (n,) to ``out``."""
    for n in range(len(values)):
        out[n] = arctan(values[n])


def test_arc_tangent_series():
    values = np.concatenate([-np.logspace(-3, 8, 400), [0.0], np.logspace(-3, 8, 400)]).astype(np.float32)
    angles = np.empty_like(values)
    arctan_of(values, angles)
    np.testing.assert_allclose(angles, np.arctan(values.astype(np.float64)), atol=2e-7)


def test_a_plane_hides_the_sky_behind_itself_where_the_ground_falls_away():
    """On a ridge's round flank the ground uphill is lower than the flank's own plane, which hides more of the sky."""
    across = np.arange(-9.0, 12.0)  # the middle node is one metre beside the top
    flank = np.tile(-0.5 * across**2, (21, 1))
    long = north_up_cell(1000.0, 1.0)
    slope = np.arctan(across[10])
    assert factor_of(flank, "tilted", long) == pytest.approx((1.0 + np.cos(slope)) / 2.0, abs=0.001)
