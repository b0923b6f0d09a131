"""Matrices of perspective and of light-space perspective maps: guarantees for every caster, over many suns, spots and cameras."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows.maps.camera import Camera, Light
from skugga.shadows.maps.light_space_perspective import light_space_perspectives
from skugga.shadows.maps.perspective_shadow_map import MapCandidates
from skugga.shadows.maps.post_perspective import (
    UNIFORM_MAP_CONE_DEG,
    PostPerspective,
    camera_matrix,
    fit_to_bounds,
    horizon_distance,
    light_kind_in_clip_space,
    light_matrix,
    post_perspectives,
    project_points,
)

INNER_EXTENT = 0.97

SETUP_COUNT = 500
"""Number of set-ups with suns, and again with lamps."""

both_methods = pytest.mark.parametrize("find_candidates", [post_perspectives, light_space_perspectives])

finite_floats = st.floats(-3.0, 3.0)
vectors = st.tuples(finite_floats, finite_floats, finite_floats).map(np.array)


def make_camera(eye: np.ndarray, turn_deg: float, tilt_deg: float) -> Camera:
    """Return a camera that looks along an azimuth from north and an altitude."""
    azimuth_rad, altitude_rad = np.radians([turn_deg, tilt_deg])
    forward = np.array(
        [np.sin(azimuth_rad) * np.cos(altitude_rad), np.cos(azimuth_rad) * np.cos(altitude_rad), np.sin(altitude_rad)]
    )
    right = np.array([np.cos(azimuth_rad), -np.sin(azimuth_rad), 0.0])
    return Camera(np.asarray(eye, float), np.array([right, np.cross(forward, right), forward]))


def make_sun_light(direction: np.ndarray) -> Light:
    """Return a directional light. ``direction`` (3,) leads to the sun and may have any length."""
    return Light(np.array([*(direction / np.linalg.norm(direction)), 0.0]), np.zeros(3))


def to_clip_space(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) in clip space (n, 4)."""
    return points @ matrix[:, :3].T + matrix[:, 3]


# -- matrices


@given(vectors, st.one_of(finite_floats, st.just(0.0)), vectors)
def test_light_matrix_maps_any_light_to_one_point(place, w, middle):
    """Point, sink and parallel lights go to (0, 0, -1, 0), and the middle goes to the origin."""
    if np.linalg.norm(place - w * middle) < 1e-2:
        return
    matrix = light_matrix(np.array([*place, w]), middle)
    np.testing.assert_allclose(matrix @ [*place, w], [0, 0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(matrix @ [*middle, 1.0], [0, 0, 0, 1], atol=1e-6)


def test_camera_matrix_maps_its_planes_to_the_cube():
    camera = make_camera([3, -2, 5], 30, -10)
    points = np.array([camera.eye_m + camera.forward_axis * distance for distance in (2.0, 50.0)])
    for slide in (0.0, 7.0):
        matrix = camera_matrix(camera, 0.5, 2.0, 50.0, slide)
        np.testing.assert_allclose(project_points(matrix, points)[:, 2], [-1, 1], atol=1e-9)
    corner = camera.eye_m + 10.0 * (camera.forward_axis + 0.5 * camera.camera_from_frame[0] - 0.5 * camera.camera_from_frame[1])
    np.testing.assert_allclose(project_points(camera_matrix(camera, 0.5, 2.0, 50.0, 0.0), corner[None])[0, :2], [1, -1], atol=1e-9)


@pytest.mark.parametrize(("near", "far", "slide"), [(0.0, 5.0, 0.0), (5.0, 5.0, 1.0), (-3.0, 5.0, 2.0)])
def test_camera_matrix_refuses_invalid_planes(near, far, slide):
    with pytest.raises(ValueError, match="0 < near < far must hold"):
        camera_matrix(make_camera([0, 0, 0], 0, 0), 0.5, near, far, slide)


@pytest.mark.parametrize(
    ("direction", "kind"), [([0, 1, 0.5], "point"), ([0, -1, 0.5], "sink"), ([1, 0, 0.5], "parallel"), ([0, 0, 1], "parallel")]
)
def test_kind_of_classifies_suns(direction, kind):
    """The camera looks north: suns stand before it, behind it, and across its axis."""
    matrix = camera_matrix(make_camera([0, 0, 2], 0, 0), 0.5, 1.0, 100.0, 3.0)
    assert light_kind_in_clip_space(matrix @ [*direction, 0.0]) == kind


def test_kind_of_a_lamp_depends_on_the_slide_back():
    """Two metres behind the eye the lamp is a sink. From a slide of three metres on, it is a point in front."""
    camera = make_camera([0, 0, 2], 0, 0)
    kinds = [
        light_kind_in_clip_space(camera_matrix(camera, 0.5, 1.0, 100.0, slide) @ [5, -2, 4, 1]) for slide in (0.0, 1.9, 2.0, 3.0)
    ]
    assert kinds == ["sink", "sink", "parallel", "point"]


@pytest.mark.parametrize("behind", [False, True])
def test_depth_by_the_light_matrix_is_affine_in_inverse_distance(behind):
    """Behind the camera, depth is e / z between near = -e and far = +e (Kozlov).

    Before the camera it is a usual perspective depth between two planes.
    """
    camera = make_camera([0, 0, 2], 0, 0)
    view = camera_matrix(camera, 1.0, 1.0, 60.0, 2.0)
    light = view @ np.array([0.3, -0.8 if behind else 0.8, 0.5, 0.0])
    place, middle = light[:3] / light[3], np.array([0.0, 0.1, 0.4])
    matrix = light_matrix(light, middle)
    forward = (middle - place) / np.linalg.norm(middle - place)
    near, far = (-0.3, 0.3) if behind else (0.1, 50.0)
    rng = np.random.default_rng(0)
    points = project_points(view, camera.eye_m + rng.uniform([-5, 4, -3], [5, 50, 3], (200, 3)))
    axial_distance = (points - place) @ forward
    assert (axial_distance > 0).all()
    expected_depth = (far + near) / (far - near) - 2.0 * far * near / (far - near) / axial_distance
    actual_depth = project_points(matrix, points)
    # Both depths rise together along a ray: they differ by a scale and a shift that depend only on the position in the map.
    linear_fit = np.polyfit(actual_depth[:, 2], expected_depth, 1)
    np.testing.assert_allclose(np.polyval(linear_fit, actual_depth[:, 2]), expected_depth, atol=1e-9)
    assert linear_fit[0] > 0


def test_fit_to_bounds_maps_bounds_to_the_cube():
    rng = np.random.default_rng(1)
    matrix = light_matrix(np.array([0.2, 0.4, 0.8, 0.0]), np.array([1.0, 2.0, 3.0]))
    points = rng.uniform(-5, 9, (100, 3))
    projected_points = project_points(matrix, points)
    clip = project_points(fit_to_bounds(matrix, projected_points.min(axis=0), projected_points.max(axis=0), 0.9, 0.25), points)
    np.testing.assert_allclose(clip.min(axis=0), [-0.9, -0.9, -0.5], atol=1e-9)
    np.testing.assert_allclose(clip.max(axis=0), [0.9, 0.9, 1.0], atol=1e-9)


# -- many set-ups


def random_setup(rng: np.random.Generator, lamp: bool) -> tuple[Camera, Light, np.ndarray]:
    """Return a camera over level ground, a light anywhere, and lit receivers in view, on the ground and floating over it."""
    camera = make_camera(rng.uniform([-500, -500, 1], [500, 500, 60]), rng.uniform(0, 360), rng.uniform(-70, 25))
    reach_m, half_width = 10.0 ** rng.uniform(1.5, 4.3), rng.uniform(0.2, 1.2)
    rays = np.column_stack([rng.uniform(-half_width, half_width, (600, 2)), np.ones(600)]) @ camera.camera_from_frame
    with np.errstate(divide="ignore"):
        ground = -camera.eye_m[2] / rays[:, 2]
    floating = 10.0 ** rng.uniform(0.0, np.log10(reach_m), 600)
    distance = np.where((ground > 0.0) & (ground < reach_m) & (rng.random(600) < 0.8), ground, floating)
    points = camera.eye_m + rays * distance[:, None]
    if not lamp:
        direction = rng.normal(size=3)
        direction[2] = abs(direction[2])
        return camera, make_sun_light(direction), points
    place = camera.eye_m + rng.normal(size=3) * reach_m * 10.0 ** rng.uniform(-2.0, 0.0)
    target = points[rng.integers(len(points))]
    axis = (target - place) / np.linalg.norm(target - place)
    offsets = points - place
    lit = offsets @ axis > np.cos(np.radians(rng.uniform(10, 85))) * np.linalg.norm(offsets, axis=1)
    return camera, Light(np.array([*place, 1.0]), target), points[lit]


def fitted_map(
    camera: Camera, light: Light, points: np.ndarray, find_candidates: MapCandidates
) -> tuple[PostPerspective, np.ndarray]:
    """Return the map for receivers, and its matrix for upload."""
    best_map = find_candidates(camera, light, points, INNER_EXTENT)[0]
    projected_points = project_points(best_map.clip_from_frame, points)
    return best_map, fit_to_bounds(
        best_map.clip_from_frame, projected_points.min(axis=0), projected_points.max(axis=0), INNER_EXTENT, 0.01
    )


@pytest.mark.long
@pytest.mark.parametrize("lamp", [False, True])
@both_methods
def test_maps_lose_no_caster_in_a_thousand_set_ups(find_candidates, lamp):
    """Casters lie along the line from each receiver to the light, also behind the eye and beside the view.

    They project onto the receiver, with depths in their order. Receivers stay within the unit cube in float32 as well.
    """
    rng = np.random.default_rng(20 + lamp)
    kinds: Counter = Counter()
    behind_count = 0
    for _ in range(SETUP_COUNT):
        camera, light, points = random_setup(rng, lamp)
        if len(points) < 3:
            continue
        best_map, clip = fitted_map(camera, light, points, find_candidates)
        kinds["coarser" if "texels than" in best_map.uniform_map_reason else best_map.kind] += 1
        assert np.isfinite(clip).all() and bool(best_map.uniform_map_reason) == (best_map.kind is None)
        corners = to_clip_space(clip.astype(np.float32), points.astype(np.float32))
        assert corners.dtype == np.float32 and (corners[:, 3] > 0).all()
        ndc = corners[:, :3] / corners[:, 3:]
        assert np.abs(ndc).max() <= 1.0 + 1e-4
        sample = points[:: max(len(points) // 60, 1)]
        if lamp:
            share = np.array([0.0, 0.1, 0.5, 0.9, 0.99])[:, None, None]
            casters = sample + share * (light.homogeneous_position[:3] - sample)
        else:
            casters = sample + np.array([0.0, 1.0, 30.0, 1e3, 1e5])[:, None, None] * light.homogeneous_position[:3]
        behind_count += int((camera.to_camera(casters[1:])[..., 2] < 0).sum())
        clip_points = to_clip_space(clip, casters.reshape(-1, 3)).reshape(*casters.shape[:2], 4)
        assert np.isfinite(clip_points).all() and (clip_points[..., 3] > 0).all()
        map_points = clip_points[..., :3] / clip_points[..., 3:]
        assert np.abs(map_points[..., :2] - map_points[0, :, :2]).max() < 1e-5, "the same place in the map"
        assert (np.diff(map_points[..., 2], axis=0) < 0).all(), "nearer to the light, less deep"
        assert np.abs(map_points[..., :2]).max() <= INNER_EXTENT + 1e-5
    assert behind_count > 10_000
    assert kinds[None] < 0.05 * kinds.total()
    if find_candidates is post_perspectives:
        assert kinds["point"] > 100 and kinds["sink"] > 100
        assert kinds["coarser"] < (0.15 if lamp else 0.01) * kinds.total()
    else:
        assert kinds.keys() <= {"parallel", "coarser", None}
        assert kinds["coarser"] < (0.3 if lamp else 0.1) * kinds.total()


@pytest.mark.parametrize("lamp", [False, True])
@both_methods
def test_maps_are_never_coarser_than_uniform(find_candidates, lamp):
    rng = np.random.default_rng(30 + lamp)
    gain = []
    for _ in range(150):
        camera, light, points = random_setup(rng, lamp)
        if len(points) < 3:
            continue
        maps = find_candidates(camera, light, points, INNER_EXTENT)
        gain.append(maps[0].texel_size / maps[-1].texel_size)
        assert [post_map.texel_size for post_map in maps] == sorted(post_map.texel_size for post_map in maps)
    assert max(gain) <= 1.0 and np.median(gain) < (0.65 if lamp else 0.5)


# -- singular directions


@pytest.mark.parametrize("away", [1.0, -1.0])
@both_methods
def test_maps_are_uniform_around_the_view_axis(find_candidates, away):
    rng = np.random.default_rng(5)
    camera = make_camera([0, 0, 20], 0, -30)
    points = camera.eye_m + (np.column_stack([rng.uniform(-0.5, 0.5, (300, 2)), np.ones(300)]) * 30.0) @ camera.camera_from_frame
    for off_deg in (0.0, 0.9 * UNIFORM_MAP_CONE_DEG, 1.1 * UNIFORM_MAP_CONE_DEG, 30.0):
        turned_camera = make_camera([0, 0, 20], 0, -30 + off_deg)
        maps = find_candidates(camera, make_sun_light(away * turned_camera.forward_axis), points, INNER_EXTENT)
        if off_deg < UNIFORM_MAP_CONE_DEG:
            assert len(maps) == 1 and maps[0].kind is None
            assert (
                f"{off_deg:.1f} degrees off the view's axis, within the limit of {UNIFORM_MAP_CONE_DEG:g}"
                in maps[0].uniform_map_reason
            )
            w = horizon_distance(maps[0].clip_from_frame, points)
            np.testing.assert_allclose(w, w[0])
        elif find_candidates is post_perspectives:
            assert maps[0].kind == ("point" if away > 0 else "sink") and not maps[0].uniform_map_reason
        else:
            assert "no larger texels" in maps[0].uniform_map_reason, "all receivers lie at one distance along the axis"


def test_post_perspectives_of_a_lamp_amid_receivers_are_uniform():
    """The spot stands just above wide ground and points straight down, with a cone of 88 degrees."""
    rng = np.random.default_rng(6)
    camera = make_camera([0, -40, 30], 0, -35)
    points = np.column_stack([rng.uniform(-20, 20, (400, 2)), np.zeros(400)])
    light = Light(np.array([0.0, 0.0, 0.6, 1.0]), np.zeros(3))
    maps = post_perspectives(camera, light, points, INNER_EXTENT)
    assert (horizon_distance(maps[-1].clip_from_frame, points) > 0).all() and "no slide-back keeps" in maps[-1].uniform_map_reason
    for post_map in maps[:-1]:
        assert (horizon_distance(post_map.clip_from_frame, points) > 0).all()


def test_post_perspectives_are_continuous_as_the_sun_crosses_the_camera_plane():
    """The sun moves from before the camera across it to behind it. The kinds follow one another, and texels hardly change."""
    rng = np.random.default_rng(7)
    camera = make_camera([0, 0, 12], 0, -15)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, (800, 2)), np.ones(800)]) @ camera.camera_from_frame
    rays = rays[rays[:, 2] < -0.03]
    points = camera.eye_m + rays * (-camera.eye_m[2] / rays[:, 2])[:, None]
    angles = np.radians(90 - 15 + np.array([-1e-2, -1e-6, 0.0, 1e-6, 1e-2]))
    maps = [post_perspectives(camera, make_sun_light(np.array([0, np.cos(a), np.sin(a)])), points, INNER_EXTENT)[0] for a in angles]
    kinds = [post_map.kind for post_map in maps]
    assert kinds[:2] == ["point", "point"] and kinds[3:] == ["sink", "sink"]
    sizes = np.array([post_map.texel_size for post_map in maps])
    assert sizes.max() < 1.01 * sizes.min()


def test_post_perspectives_try_slide_backs_of_all_scales():
    """Slide-backs start at 0, continue at the nearest receiver's distance and double up to far beyond the farthest.

    Without short ones, near receivers of a deep view would get a sliver of the map.
    """
    camera = make_camera([0, 0, 2], 0, -60)
    tangents = np.linspace(-0.3, 0.3, 9)
    for depth_ratio in (1.5, 100.0, 500.0):
        depths = np.repeat([4.0, 4.0 * depth_ratio], 9)
        rays = np.column_stack([np.tile(tangents, 2), np.zeros(18), np.ones(18)])
        points = camera.eye_m + (rays * depths[:, None]) @ camera.camera_from_frame
        maps = post_perspectives(camera, make_sun_light(np.array([1.0, 0.2, 0.5])), points, INNER_EXTENT)[:-1]
        slides = sorted(post_map.slide_back_m for post_map in maps)
        assert slides[0] == 0.0 and slides[1] <= 4.0 / 2.0 and slides[-1] == pytest.approx(64 * 4.0 * depth_ratio)
        np.testing.assert_allclose(np.diff(np.log2(slides[1:])), 1.0)


@both_methods
def test_maps_hold_outer_receivers_without_weight(find_candidates):
    """The outermost receivers may be missing from a sample. The map holds them, and fits the sample."""
    camera = make_camera([0, 0, 20], 0, -30)
    rng = np.random.default_rng(9)
    rays = np.column_stack([rng.uniform(-0.1, 0.1, (200, 2)), np.ones(200)]) * 30.0
    points = camera.eye_m + rays @ camera.camera_from_frame
    outer_points = camera.eye_m + np.array([[15.0, 3.0, 40.0], [-20.0, 2.0, 35.0]]) @ camera.camera_from_frame
    light = make_sun_light(np.array([1.0, 0.3, 0.6]))
    unconstrained_maps = find_candidates(camera, light, points, INNER_EXTENT)
    assert any(np.abs(project_points(post_map.clip_from_frame, outer_points)[:, :2]).max() > 1.0 for post_map in unconstrained_maps)
    for post_map in find_candidates(camera, light, points, INNER_EXTENT, outer_points):
        map_points = project_points(post_map.clip_from_frame, np.concatenate([points, outer_points]))[:, :2]
        assert np.abs(map_points).max() <= 1.01 * INNER_EXTENT  # outlines have 64 directions


@both_methods
def test_maps_of_one_receiver_are_not_degenerate(find_candidates):
    camera, light = make_camera([0, 0, 20], 0, -30), make_sun_light(np.array([1.0, 0.3, 0.6]))
    point = (camera.eye_m + 30.0 * camera.forward_axis)[None]
    for post_map in find_candidates(camera, light, point, INNER_EXTENT):
        rows = (
            post_map.clip_from_frame[:2, :3]
            - project_points(post_map.clip_from_frame, point)[0, :2, None] * post_map.clip_from_frame[3, :3]
        )
        assert np.linalg.cond(rows) < 100.0
