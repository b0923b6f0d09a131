"""Matrices of light-space perspective maps: parallel rays, the warp's centre by its formula, and the density of texels."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows.maps.camera import Camera, Light
from skugga.shadows.maps.light_space_perspective import light_space_perspectives, warped_matrix
from skugga.shadows.maps.post_perspective import HORIZON_MARGIN, horizon_distance, off_axis_deg, project_points
from tests.shadows.maps.test_post_perspective import INNER_EXTENT, fitted_map, make_camera, make_sun_light, random_setup

NEAR_M, FAR_M = 10.0, 90.0

CENTRE_M = 40.0
"""n = z_n + sqrt(z_n z_f) = 10 + sqrt(10 * 90), for a light across the view's axis."""


def strip_of_ground() -> tuple[Camera, np.ndarray]:
    """Return a camera 2 m above level ground that looks north, and a strip of receivers 10 to 90 m ahead of it."""
    north, east = np.meshgrid(np.linspace(NEAR_M, FAR_M, 81), np.linspace(-6.0, 6.0, 13))
    points = np.column_stack([east.ravel(), north.ravel(), np.zeros(north.size)])
    return make_camera([0, 0, 2], 0, 0), points


def texel_axes(matrix: np.ndarray, point: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the moves in the map, as lengths (n,), per metre along axes (n, 3) at a point (3,)."""
    w = horizon_distance(matrix, point[None])[0]
    moves = (matrix[:2, :3] - project_points(matrix, point[None])[0, :2, None] * matrix[3, :3]) / w
    return np.linalg.norm(moves @ axes.T, axis=0)


@pytest.mark.parametrize("lamp", [False, True])
def test_warp_keeps_rays_parallel(lamp):
    """The light's own image is the point at infinity of the map's depth axis, so its rays are lines of constant x and y.

    Depths along a ray are in their order, up to the light.
    """
    rng = np.random.default_rng(40 + lamp)
    warped_count = 0
    for _ in range(60):
        camera, light, points = random_setup(rng, lamp)
        if len(points) < 3:
            continue
        best, clip = fitted_map(camera, light, points, light_space_perspectives)
        warped_count += best.kind == "parallel"
        image = clip @ light.homogeneous_position
        scale = np.abs(clip).max() * np.linalg.norm(light.homogeneous_position)
        np.testing.assert_allclose(image[[0, 1, 3]] / scale, 0.0, atol=1e-12)
        assert image[2] < 0.0
        to_light = light.homogeneous_position[:3] - (points[:20] if lamp else 0.0)
        along_ray = [points[:20] + share * to_light for share in ((0.0, 0.3, 0.6, 0.9) if lamp else (0.0, 1.0, 50.0, 2e3))]
        depths = np.array([project_points(clip, ray_points) for ray_points in along_ray])
        np.testing.assert_allclose(depths[1:, :, :2], np.broadcast_to(depths[0, :, :2], depths[1:, :, :2].shape), atol=1e-6)
        assert (np.diff(depths[..., 2], axis=0) < 0.0).all()
    assert warped_count > 25


@pytest.mark.parametrize(("altitude_deg", "azimuth_deg"), [(90.0, 0.0), (30.0, 0.0), (30.0, 180.0), (20.0, 90.0)])
def test_centre_of_the_warp_follows_the_published_rule(altitude_deg, azimuth_deg):
    """The sun stands overhead, ahead, behind and beside. Its angle gamma to the view's axis divides the distance."""
    camera, points = strip_of_ground()
    altitude, azimuth = np.radians([altitude_deg, azimuth_deg])
    light = make_sun_light(np.array([np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude)]))
    sine = np.sqrt(1.0 - (np.cos(altitude) * np.cos(azimuth)) ** 2)
    _, centre_m = warped_matrix(camera, light, points, points)
    assert centre_m == pytest.approx(CENTRE_M / sine)
    assert light_space_perspectives(camera, light, points, INNER_EXTENT)[0].slide_back_m == pytest.approx(CENTRE_M / sine)


@pytest.mark.parametrize("sun", [[0.0, 0.0, 1.0], [0.0, -0.6, 0.8], [0.6, 0.0, 0.8]])
def test_density_of_texels_falls_with_the_distance_from_the_centre(sun):
    """At the distance d behind the nearest receiver, texels of the warp are (n + d)^2 / n^2 times as long along the axis.

    Across it they are (n + d) / n times as wide. Distances are those across the rays: the sun's view of the ground is shorter.
    """
    camera, points = strip_of_ground()
    light = make_sun_light(np.array(sun))
    shortening = np.sin(np.radians(off_axis_deg(camera, light, points[0])))
    best = light_space_perspectives(camera, light, points, INNER_EXTENT)[0]
    centre_m = CENTRE_M / shortening
    along = camera.forward_axis
    across = np.cross(along, light.homogeneous_position[:3])
    axes = np.array([along, across / np.linalg.norm(across)])
    nearest = texel_axes(best.clip_from_frame, np.array([0.0, NEAR_M, 0.0]), axes)
    for north_m in (20.0, 50.0, FAR_M):
        ratio = 1.0 + (north_m - NEAR_M) * shortening / centre_m
        density = texel_axes(best.clip_from_frame, np.array([0.0, north_m, 0.0]), axes)
        np.testing.assert_allclose(nearest / density, [ratio**2, ratio], rtol=1e-9)


def test_warp_of_a_high_lamp_is_that_of_the_sun():
    """A lamp a thousand kilometres up sees the ground as the sun does, so the same formulas hold."""
    camera, points = strip_of_ground()
    lamp = Light(np.array([0.0, 50.0, 1e6, 1.0]), np.array([0.0, 50.0, 0.0]))
    best = light_space_perspectives(camera, lamp, points, INNER_EXTENT)[0]
    assert best.slide_back_m == pytest.approx(CENTRE_M, rel=1e-6)
    near, far = (texel_axes(best.clip_from_frame, np.array([0.0, north_m, 0.0]), np.eye(3)[[1, 0]]) for north_m in (NEAR_M, FAR_M))
    np.testing.assert_allclose(near / far, [9.0, 3.0], rtol=1e-4)


def test_centre_lies_before_all_required_receivers():
    """Receivers that the sample lacks keep the distance n from the centre, too: w is their distance from it."""
    camera, points = strip_of_ground()
    light = make_sun_light(np.array([0.0, 0.0, 1.0]))
    outer = np.array([[0.0, 4.0, 0.0]])
    matrix, centre_m = warped_matrix(camera, light, points, np.concatenate([points, outer]))
    distance = horizon_distance(matrix, np.array([[0.0, 4.0, 0.0], [0.0, 44.0, 0.0]]))
    assert centre_m == pytest.approx(CENTRE_M), "the sample alone decides n"
    assert distance[1] / distance[0] == pytest.approx((CENTRE_M + 40.0) / CENTRE_M)


def test_map_is_uniform_with_the_reason_where_the_warp_gains_nothing():
    """A wall across the view's axis is as far everywhere, so all texels should be alike."""
    camera = make_camera([0, 0, 2], 0, 0)
    east, up = np.meshgrid(np.linspace(-30.0, 30.0, 21), np.linspace(0.0, 40.0, 21))
    wall = np.column_stack([east.ravel(), np.full(east.size, 50.0), up.ravel()])
    (only,) = light_space_perspectives(camera, make_sun_light(np.array([0.3, -0.5, 0.6])), wall, INNER_EXTENT)
    assert only.kind is None and only.slide_back_m == np.inf
    assert only.uniform_map_reason == "a uniform map: it has no larger texels than the light-space perspective map"


@pytest.mark.parametrize(("depth_ratio", "is_uniform"), [(0.99e6, False), (1.01e6, True)])
def test_map_is_uniform_where_float32_would_not_hold_the_warp(depth_ratio, is_uniform):
    """Across the axis, the nearest receiver's share of the farthest one's w is n / (n + z_f - z_n) = sqrt(z_n / z_f).

    At a ratio of a million it falls below ``HORIZON_MARGIN``.
    """
    camera = make_camera([0, 0, 2], 0, 0)
    north = np.array([1.0, 1.0, depth_ratio, depth_ratio]) * 0.01
    points = np.column_stack([np.zeros(4), north, 2.0 + north * [-0.5, 0.5, -0.5, 0.5]])
    first = light_space_perspectives(camera, make_sun_light(np.array([1.0, 0.0, 0.0])), points, INNER_EXTENT)[0]
    assert (first.kind is None) == is_uniform
    assert ("in front of the map's horizon" in first.uniform_map_reason) == is_uniform
    assert HORIZON_MARGIN**-2 == pytest.approx(1e6)


def test_lamp_whose_receivers_have_bounds_centred_behind_it():
    """Three receivers lie before the lamp, and the centre of their bounds behind it: a warp computed there would gain nothing."""
    axis = np.ones(3) / np.sqrt(3.0)
    offsets = 3.0 * np.array([[-9.0, 5.5, 5.5], [5.5, -9.0, 5.5], [5.5, 5.5, -9.0]])
    position = np.array([0.0, 40.0, 20.0])
    light = Light(np.array([*position, 1.0]), position + axis)
    points = position + offsets
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    assert ((points - position) @ axis > 0.0).all() and (centre - position) @ axis < 0.0
    best, uniform = light_space_perspectives(make_camera([0, -5, 2], 0, 0), light, points, INNER_EXTENT)
    assert best.kind == "parallel" and best.texel_size < 0.75 * uniform.texel_size
    assert (horizon_distance(best.clip_from_frame, points) > 0.0).all()
