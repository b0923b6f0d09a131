"""Sky view and horizon band of tilted planes in closed form, and the ground's own plane."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows.irradiation.ground_plane import ground_plane
from skugga.shadows.irradiation.planes import TiltedPlane, reflecting_share
from skugga.shadows.point.place import place_at

AZIMUTH_DEG = np.arange(360.0)
LEVEL_DEG = np.zeros(360)

tilts, azimuths = st.floats(0.0, 180.0), st.floats(0.0, 360.0)


def wall_horizon_deg(angle_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the horizon of an endless wall, which rises by an angle in the azimuth that is square to it."""
    facing = np.cos(np.radians(AZIMUTH_DEG - azimuth_deg))
    return np.degrees(np.arctan(np.tan(np.radians(angle_deg)) * np.maximum(facing, 0.0)))


@given(tilts, azimuths)
def test_open_planes_see_half_of_one_and_the_cosine(tilt, azimuth):
    plane = TiltedPlane(tilt, azimuth)
    assert plane.sky_view(AZIMUTH_DEG, LEVEL_DEG) == pytest.approx((1.0 + np.cos(np.radians(tilt))) / 2.0, abs=2e-5)
    assert plane.horizon_band(AZIMUTH_DEG, LEVEL_DEG) == pytest.approx(np.sin(np.radians(tilt)), abs=5e-5)


@pytest.mark.parametrize("angle_deg", [3.0, 20.0, 45.0, 80.0])
def test_planes_beside_an_endless_wall(angle_deg):
    """In a section across the wall the sky is the arc from the wall's top to the far horizon: half the sum of its chords."""
    horizon_deg, angle = wall_horizon_deg(angle_deg, 135.0), np.radians(angle_deg)
    expected = {(0, 0): (1 + np.cos(angle)) / 2, (90, 135): (1 - np.sin(angle)) / 2, (90, 315): 0.5}
    for (tilt, azimuth), sky_view in expected.items():
        assert TiltedPlane(tilt, azimuth).sky_view(AZIMUTH_DEG, horizon_deg) == pytest.approx(sky_view, abs=5e-5)


@pytest.mark.parametrize("pit_deg", [5.0, 30.0, 70.0])
def test_a_pit_with_a_level_rim(pit_deg):
    """A level plane has the squared cosine of the rim's angle; a wall's light of each azimuth is an integral over altitudes."""
    rim_deg, rim = np.full(360, pit_deg), np.radians(pit_deg)
    assert TiltedPlane(0.0, 0.0).sky_view(AZIMUTH_DEG, rim_deg) == pytest.approx(np.cos(rim) ** 2, abs=1e-9)
    expected = 0.5 - (rim + np.sin(rim) * np.cos(rim)) / np.pi
    assert TiltedPlane(90.0, 77.0).sky_view(AZIMUTH_DEG, rim_deg) == pytest.approx(expected, abs=2e-5)
    assert TiltedPlane(180.0, 0.0).sky_view(AZIMUTH_DEG, rim_deg) == pytest.approx(0.0, abs=1e-12)


@given(tilts, azimuths, st.lists(st.floats(-90.0, 90.0), min_size=8, max_size=8))
def test_sky_view_is_that_of_sampled_directions(tilt, azimuth, angles_deg):
    """The factor is the mean over directions of the sky, weighted by the cosine of incidence, for any horizon."""
    horizon_deg = np.repeat(angles_deg, 45)
    altitude = np.radians(np.arange(0.05, 90.0, 0.1))[:, None]
    facing = np.cos(np.radians(AZIMUTH_DEG - azimuth))
    cosine = np.sin(np.radians(tilt)) * np.cos(altitude) * facing + np.cos(np.radians(tilt)) * np.sin(altitude)
    is_open = altitude > np.radians(horizon_deg)
    share = (np.maximum(cosine, 0.0) * np.cos(altitude) * is_open).sum() * np.radians(0.1) * np.radians(1.0) / np.pi
    assert TiltedPlane(tilt, azimuth).sky_view(AZIMUTH_DEG, horizon_deg) == pytest.approx(share, abs=1.5e-3)


def test_a_wall_of_the_bands_height_hides_the_band():
    plane = TiltedPlane(90.0, 180.0)
    assert plane.horizon_band(AZIMUTH_DEG, np.full(360, 6.5)) == pytest.approx(0.0, abs=1e-12)
    half_deg = np.degrees(np.arctan(np.tan(np.radians(6.5)) / 2.0))
    assert plane.horizon_band(AZIMUTH_DEG, np.full(360, half_deg)) == pytest.approx(0.5, abs=1e-4)
    assert plane.horizon_band(AZIMUTH_DEG, np.where(np.abs(AZIMUTH_DEG - 180.0) < 90.0, 0.0, 40.0)) == pytest.approx(1.0, abs=1e-4)


def test_the_cosine_of_incidence_is_that_of_vectors():
    plane = TiltedPlane(35.0, 200.0)
    azimuth, altitude = np.array([200.0, 200.0, 110.0, 20.0, 20.0]), np.array([55.0, 10.0, 0.0, 60.0, 50.0])
    cosine = plane.cosine_towards(azimuth, altitude)
    assert cosine == pytest.approx([1.0, np.cos(np.radians(45.0)), 0.0, np.cos(np.radians(65.0)), np.cos(np.radians(75.0))])
    assert TiltedPlane(35.0, 200.0).cosine_towards(np.array([20.0]), np.array([30.0]))[0] == 0.0


@pytest.mark.parametrize(("tilt", "azimuth"), [(30.0, 250.0), (70.0, 10.0), (4.0, 135.0)])
def test_the_grounds_plane_is_its_slope(write_raster, make_scene, tilt, azimuth):
    row, col = np.mgrid[:21, :21] - 10.0
    fall = (col * np.sin(np.radians(azimuth)) - row * np.cos(np.radians(azimuth))) * 10.0 / 0.9996  # metres on the ground
    heights = 500.0 - np.tan(np.radians(tilt)) * fall
    scene = make_scene(write_raster(heights.astype(np.float32), "EPSG:32633", 499_895.0, 5_300_000.0, 10.0))
    plane = ground_plane(scene, place_at(scene, (500_003.0, 5_299_891.0), scene.elevation.crs, 2.0))
    assert plane.tilt_deg == pytest.approx(tilt, abs=0.02) and plane.azimuth_deg == pytest.approx(azimuth, abs=0.05)
    corner = ground_plane(scene, place_at(scene, (499_900.5, 5_299_994.5), scene.elevation.crs))
    assert corner.tilt_deg == pytest.approx(tilt, abs=0.02), "beside missing ground the slope is that on the other side"


def test_columns_are_level_ground(write_raster, make_scene):
    heights = np.arange(400.0).reshape(20, 20).astype(np.float32)
    raster = write_raster(heights, "EPSG:32633", 500_000.0, 5_300_000.0, 10.0)
    scene = make_scene(raster, terrain={"surface": "blocks"})
    assert ground_plane(scene, place_at(scene, (500_100.0, 5_299_900.0), scene.elevation.crs)).tilt_deg == 0.0


@pytest.mark.parametrize(
    ("sky_view", "level", "without_trees", "share"),
    [
        (1.0, 1.0, 1.0, 0.0), (0.8, 0.8, 0.8, 0.2), (0.5, 1.0, 1.0, 0.5), (0.01, 0.02, 1.0, 0.0198), (0.3, 0.4, 0.8, 0.35),
        (0.0, 0.0, 0.0, 0.0), (0.2, 0.9, 0.8, 0.8),
    ],
)  # fmt: skip
def test_surroundings_reflect_what_trees_leave_of_their_light(sky_view, level, without_trees, share):
    """In the open, in a valley, of an open wall, in a deep wood, beside trees in a valley, and without any sky."""
    assert reflecting_share(sky_view, level, without_trees) == pytest.approx(share, abs=1e-12)
