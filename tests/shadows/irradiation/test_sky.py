"""What planes of any tilt see of the sky: closed forms in the open, before a wall, and for planes that face down."""

from __future__ import annotations

import numpy as np
import pytest
from pvlib import irradiance

from skugga.shadows.horizons.grid import grid_of_array
from skugga.shadows.horizons.sky_view import ground_slopes, sky_view_factor
from skugga.shadows.irradiation.planes import PlaneNormals, TiltedPlane, normals_in_block_plane, normals_of_plane, normals_of_slopes
from skugga.shadows.irradiation.sky import sky_of_grid

SIDE = 41
MIDDLE = SIDE // 2, SIDE // 2


def sky_and_band(heights: np.ndarray, plane: TiltedPlane, azimuths: int = 72) -> tuple[float, float]:
    """Return the factors of the sky and of the horizon's band in the middle of ground with cells of 10 m."""
    grid = grid_of_array(heights.astype(np.float32), (10.0, 10.0))
    sky, band = sky_of_grid(grid, normals_of_plane(plane, heights.shape), azimuths)
    return float(sky[MIDDLE]), float(band[MIDDLE])


@pytest.mark.parametrize("azimuth_deg", [0.0, 100.0, 225.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 60.0, 89.0, 90.0, 91.0, 120.0, 170.0, 180.0])
def test_a_plane_in_the_open_sees_what_pvlib_says(tilt_deg, azimuth_deg):
    sky, band = sky_and_band(np.zeros((SIDE, SIDE)), TiltedPlane(tilt_deg, azimuth_deg), 360)
    assert sky == pytest.approx(float(irradiance.isotropic(tilt_deg, 1.0)), abs=1e-3)
    assert band == pytest.approx(np.sin(np.radians(tilt_deg)), abs=1e-3)


@pytest.mark.parametrize(("tilt_deg", "share"), [(0.0, 0.5), (90.0, 0.0)])
def test_a_wall_before_a_plane_takes_its_half_of_the_sky(tilt_deg, share):
    """A wall of 3 km hides nearly the whole half of the sky to the north."""
    heights = np.zeros((SIDE, SIDE))
    heights[: MIDDLE[0]] = 3000.0
    sky, band = sky_and_band(heights, TiltedPlane(tilt_deg, 0.0), 360)
    assert sky == pytest.approx(share, abs=5e-3) and band == pytest.approx(0.0, abs=5e-3)


@pytest.mark.parametrize("tilt_deg", [95.0, 120.0, 150.0])
def test_a_plane_that_faces_down_sees_the_strip_above_a_wall(tilt_deg):
    """Before an infinitely long wall, towards each azimuth the sky lies between the wall's top and the plane."""
    distance_m, top_m = 10.0, 3.0
    heights = np.zeros((SIDE, 4 * SIDE + 1))
    heights[: MIDDLE[0]] = top_m
    grid = grid_of_array(heights.astype(np.float32), (10.0, 10.0))
    sky, _ = sky_of_grid(grid, normals_of_plane(TiltedPlane(tilt_deg, 0.0), heights.shape), 360)
    # The factor of a strip that is infinitely long: (sin b - sin a) / 2 for angles a, b from the plane's normal.
    limits = np.arctan(top_m / distance_m), np.radians(180.0 - tilt_deg)
    normal_angle = np.radians(90.0 - tilt_deg)
    expected = (np.sin(limits[1] - normal_angle) - np.sin(limits[0] - normal_angle)) / 2.0
    assert float(sky[MIDDLE[0], 2 * SIDE]) == pytest.approx(expected, abs=3e-3)


def test_the_grounds_own_planes_see_the_tilted_sky_view_factor():
    rng = np.random.default_rng(3)
    heights = np.cumsum(np.cumsum(rng.normal(0.0, 0.3, (60, 60)), axis=0), axis=1).astype(np.float32)
    grid = grid_of_array(heights, (10.0, 10.0))
    sky, _ = sky_of_grid(grid, normals_of_slopes(*ground_slopes(grid)))
    np.testing.assert_allclose(sky, sky_view_factor(grid, "tilted"), atol=2e-5)
    assert sky.min() < 0.9


def test_verticals_lean_away_from_the_centre():
    """A level plane 1000 cells to the east leans to the east by the angle of the arc, as seen from the centre."""
    radius_m, cell_m, cols = 6.371e6, 30.0, 2001
    level = PlaneNormals(*(np.full((1, cols), value, np.float32) for value in (0.0, 0.0, 1.0)))
    leaning = normals_in_block_plane(level, np.array([[0.0, cell_m], [-cell_m, 0.0]]), 1.0 / radius_m)
    angle = 1000 * cell_m / radius_m
    assert float(leaning.east[0, -1]) == pytest.approx(angle, rel=1e-5) and float(leaning.east[0, 0]) == pytest.approx(-angle)
    steep = normals_of_plane(TiltedPlane(60.0, 90.0), (1, cols))
    leaning = normals_in_block_plane(steep, np.array([[0.0, cell_m], [-cell_m, 0.0]]), 1.0 / radius_m)
    exact = np.radians(60.0) + angle
    assert float(leaning.up[0, -1]) == pytest.approx(np.cos(exact), abs=2e-5)
    assert float(leaning.east[0, -1]) == pytest.approx(np.sin(exact), abs=2e-5)
