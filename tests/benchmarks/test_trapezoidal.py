"""Trapezoidal maps of the seeds' page: the matrix by hand-computed set-ups, and the verdict from figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.seeds import trapezoidal
from benchmarks.seeds.trapezoidal_matrix import (
    FOCUS_LINE,
    apex_distance,
    receiver_frustum,
    trapezoid_matrix,
    trapezoidal_maps,
)
from skugga.shadows.maps.post_perspective import project_points, uniform_matrix
from tests.shadows.maps.test_light_space_perspective import strip_of_ground
from tests.shadows.maps.test_post_perspective import INNER_EXTENT, fitted_map, make_sun_light, random_setup

HEIGHT, FOCUS = 10.0, 2.5
APEX = 10.0 / 11.0
"""0.4 * 10 * 2.5 / (1.6 * 10 - 2 * 2.5): the paper's formula for a trapezoid 10 high, whose focus lies 2.5 behind its top."""

SIDES_RATIO = (HEIGHT + APEX) / APEX
"""Length of the base line over that of the top line, where the sides meet at the apex: 12."""


def trapezoid(turn_deg: float, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (8, 2) of a frustum seen as a trapezoid with a top line 2 long, and its axis's points (3, 2)."""
    corners = np.array([[-1.0, 0.0], [1.0, 0.0], [SIDES_RATIO, HEIGHT], [-SIDES_RATIO, HEIGHT]])
    axis = np.array([[0.0, 0.0], [0.0, HEIGHT], [0.0, FOCUS]])
    turn = np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.repeat(corners, 2, axis=0) @ rotation.T + shift, axis @ rotation.T + shift


def in_square(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 2) of the light's plane in the map (n, 2)."""
    return project_points(matrix, np.column_stack([points, np.zeros(len(points))]))[:, :2]


@pytest.mark.parametrize(("turn_deg", "shift"), [(0.0, (0.0, 0.0)), (35.0, (4.0, -7.0)), (200.0, (-30.0, 2.0))])
def test_trapezoid_maps_to_the_square_and_its_focus_to_the_line(turn_deg, shift):
    corners, axis = trapezoid(turn_deg, shift)
    apex, matrix = trapezoid_matrix(corners, axis)
    assert apex == pytest.approx(APEX)
    np.testing.assert_allclose(np.abs(in_square(matrix, corners)), 1.0, atol=1e-12)
    # The top line, which is nearest to the eye, lies at y = 1, and 80 % of the square lie between it and the focus.
    np.testing.assert_allclose(in_square(matrix, axis), [[0.0, 1.0], [0.0, -1.0], [0.0, -0.6]], atol=1e-12)
    np.testing.assert_allclose(in_square(matrix, corners)[:4, 1], 1.0, atol=1e-12)
    assert in_square(matrix, corners)[0, 0] == pytest.approx(-in_square(matrix, corners)[2, 0])


def test_sides_of_the_trapezoid_touch_the_polygon():
    """A corner off to one side widens the trapezoid there: it alone lies on x = 1 or x = -1, on that side."""
    corners, axis = trapezoid(0.0, (0.0, 0.0))
    corners = np.concatenate([corners * [0.5, 1.0], [[3.0, 4.0]]])
    x = in_square(trapezoid_matrix(corners, axis)[1], corners)[:, 0]
    assert np.abs(x).max() == pytest.approx(1.0) and np.abs(x[-1]) == pytest.approx(1.0)
    assert (np.abs(x[:-1]) < 1.0 - 1e-9).sum() == 4, "the other side touches the near and the far corners"


def test_apex_recedes_until_an_affine_map_serves():
    """At 80 % of the height an affine map takes the focus to the line by itself. Just before that the apex is far away."""
    assert apex_distance(10.0, 4.0) == pytest.approx(0.4 * 10.0 * 4.0 / 8.0)
    assert apex_distance(10.0, 7.99) > 1e3
    assert apex_distance(10.0, 8.0) == np.inf and apex_distance(10.0, 9.0) == np.inf
    corners, axis = trapezoid(0.0, (0.0, 0.0))
    assert trapezoid_matrix(corners, np.concatenate([axis[:2], [[0.0, 8.5]]]))[0] == np.inf


def test_frustum_holds_the_receivers_and_is_symmetric():
    camera, points = strip_of_ground()
    corners, axis = receiver_frustum(camera, points, 0.25)
    np.testing.assert_allclose(axis, [[0, 10, 2], [0, 90, 2], [0, 30, 2]], atol=1e-12)
    seen, receivers = camera.to_camera(corners), camera.to_camera(points)
    limits = np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0)
    np.testing.assert_allclose(limits, [0.6, 0.2], atol=1e-12)  # 6 m aside and 2 m below, 10 m ahead
    assert (np.abs(receivers[:, :2] / receivers[:, 2:]) <= limits + 1e-12).all()


def test_map_of_a_fan_has_its_apex_by_the_rule_and_its_focus_on_the_line():
    """Under a sun overhead the trapezoid is the frustum's plan: 80 m high, its focus 32 m behind the top line."""
    camera, points = strip_of_ground()
    points[:, 0] *= points[:, 1] / 10.0  # a fan, as wide as the frustum is everywhere
    light = make_sun_light(np.array([0.0, 0.0, 1.0]))
    best = trapezoidal_maps(camera, light, points, INNER_EXTENT, focus_share=0.4)[0]
    assert best.kind == "parallel"
    assert best.slide_back_m == pytest.approx(0.4 * 80.0 * 32.0 / (1.6 * 80.0 - 2.0 * 32.0))
    corners, axis = receiver_frustum(camera, points, 0.4)
    uniform = uniform_matrix(light, points)
    _, matrix = trapezoid_matrix(*(project_points(uniform, part)[:, :2] for part in (corners, axis)))
    assert project_points(matrix @ uniform, axis)[2, 1] == pytest.approx(FOCUS_LINE)


@pytest.mark.parametrize("lamp", [False, True])
def test_warp_keeps_rays_parallel_and_receivers_in_the_map(lamp):
    rng = np.random.default_rng(7 + lamp)
    warped_count = 0
    for _ in range(40):
        camera, light, points = random_setup(rng, lamp)
        if len(points) < 3:
            continue
        best, clip = fitted_map(camera, light, points, trapezoidal_maps)
        warped_count += best.kind == "parallel"
        image = clip @ light.homogeneous_position
        scale = np.abs(clip).max() * np.linalg.norm(light.homogeneous_position)
        np.testing.assert_allclose(image[[0, 1, 3]] / scale, 0.0, atol=1e-12)
        if best.kind == "parallel":
            assert np.abs(project_points(best.clip_from_frame, points)[:, :2]).max() <= INNER_EXTENT + 1e-9
    assert warped_count > 5


def figures_with_error(error: float, ms: float = 1.0) -> dict[str, Any]:
    """Return the study's figures where both warped maps have an error of 1 %, and the trapezoidal one ``error``, in ``ms``."""
    names = {f"trapezoidal {share:g}": 2.0 * error for share in trapezoidal.FOCUS_SHARES} | {"trapezoidal 0.2": error}
    row = {
        "view": "rocks main", "uniform": [],
        "wrong_cast": {"shadow_map": 0.04, "perspective_shadow_map": 0.01, "light_space_perspective_map": 0.01} | names,
        "ms": {"shadow_map": 1.0, "perspective_shadow_map": 1.0, "light_space_perspective_map": 1.0, "trapezoidal": ms},
    }  # fmt: skip
    turns = {"perspective_shadow_map": [1.0, 2.0], "light_space_perspective_map": [1.0, 1.0], "trapezoidal": [1.0, 1.2]}
    return {"rows": [row], "turns": turns}


@pytest.mark.parametrize(
    ("error", "ms", "expected"),
    [(0.005, 1.0, True), (0.02, 1.0, False), (0.0091, 1.0, None), (0.005, 1.5, False), (0.005, 1.02, None)],
)
def test_promotion_follows_from_errors_and_times(error, ms, expected):
    figures = figures_with_error(error, ms)
    assert trapezoidal.best_focus_share(figures) == 0.2
    assert trapezoidal.promotion_verdict(figures) is expected
    assert trapezoidal.make_section(figures).claims[-1].verdict is expected


def test_largest_change_closes_the_circle():
    assert trapezoidal.largest_change([1.0, 1.5, 3.0]) == pytest.approx(3.0)
    assert trapezoidal.largest_change([2.0, 2.0, 2.0]) == 1.0
