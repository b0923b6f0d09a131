"""The pinhole camera: its direction, and parts, shifts and finer views with the rays of the whole view."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from skugga.terrain.errors import InputError
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.world import World, geocentric
from tests.rasters import ENGINEERING

UP = np.array([0.0, 0.0, 1.0])
FLAT_WORLD = World(CRS.from_user_input(ENGINEERING), True, 0.0, 0.0)

points = st.tuples(*[st.floats(-1e3, 1e3)] * 3).map(np.array)
sizes = st.integers(1, 40)
offsets = st.integers(-50, 50)
views = st.builds(
    lambda fov, rows, cols, azimuth: look_at(
        np.array([3.0, -7.0, 12.0]), np.array([3.0 + np.sin(azimuth), -7.0 + np.cos(azimuth), 11.5]), UP, fov, rows, cols
    ),
    st.floats(1.0, 170.0), sizes, sizes, st.floats(0.0, 6.28),
)  # fmt: skip


def pixel_rays(view: PerspectiveView) -> np.ndarray:
    """Return the pixels' rays (rows, cols, 3), earth-fixed, as the module's docstring defines them."""
    x = (view.col0 + np.arange(view.cols) * view.step_px) / view.focal_px
    y = (view.row0 + np.arange(view.rows) * view.step_px) / view.focal_px
    x, y = (v[..., None] for v in np.meshgrid(x, y))
    right, down, forward = view.earth_from_camera.T
    return x * right + y * down + forward


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two vectors, exact for small angles."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@given(views, offsets, offsets, sizes, sizes)
def test_a_part_has_exactly_the_rays_of_the_whole(view, row, col, rows, cols):
    """Rays are equal bit by bit. Beyond the picture they continue evenly."""
    enclosing_view = view.part(min(row, 0), min(col, 0), rows + abs(row) + view.rows, cols + abs(col) + view.cols)
    top, left = row - min(row, 0), col - min(col, 0)
    np.testing.assert_array_equal(
        pixel_rays(view.part(row, col, rows, cols)), pixel_rays(enclosing_view)[top : top + rows, left : left + cols]
    )
    top, left = -min(row, 0), -min(col, 0)
    np.testing.assert_array_equal(pixel_rays(view), pixel_rays(enclosing_view)[top : top + view.rows, left : left + view.cols])


@given(views, offsets, offsets)
def test_a_shift_by_whole_pixels_is_a_part(view, rows, cols):
    np.testing.assert_array_equal(pixel_rays(view.shifted(rows, cols)), pixel_rays(view.part(rows, cols, view.rows, view.cols)))


@given(views, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_shift_within_a_pixel_lies_between_its_neighbours(view, down, right):
    enclosing_rays = pixel_rays(view.part(-1, -1, view.rows + 2, view.cols + 2))
    row, col = np.meshgrid(np.arange(view.rows) + 1, np.arange(view.cols) + 1, indexing="ij")
    middle = enclosing_rays[row, col]
    expected = middle + down * (enclosing_rays[row + 1, col] - middle) + right * (enclosing_rays[row, col + 1] - middle)
    np.testing.assert_allclose(pixel_rays(view.shifted(down, right)), expected, atol=1e-12 * np.abs(enclosing_rays).max())


@given(views, st.integers(1, 5))
def test_a_finer_view_lies_evenly_inside_the_pixels(view, side):
    """The means of its blocks are the pixels' own rays, its steps are even throughout, and it spans the same picture."""
    finer_view = view.finer(side)
    finer_rays = pixel_rays(finer_view)
    blocks = finer_rays.reshape(view.rows, side, view.cols, side, 3).mean(axis=(1, 3))
    scale = np.abs(finer_rays).max()
    np.testing.assert_allclose(blocks, pixel_rays(view), atol=1e-12 * scale)
    assert finer_view.pixel_tangent == pytest.approx(view.pixel_tangent / side)
    for axis in (0, 1):
        steps = np.diff(finer_rays, axis=axis)
        assert not steps.size or np.allclose(steps, np.take(steps, [0], axis=axis), atol=1e-12 * scale)
    assert (finer_view.row0 - finer_view.step_px / 2, finer_view.col0 - finer_view.step_px / 2) == pytest.approx(
        (view.row0 - 0.5, view.col0 - 0.5)
    )
    part = view.part(1, 2, 3, 4).finer(side)
    np.testing.assert_allclose(
        pixel_rays(part),
        pixel_rays(view.finer(side).part(side, 2 * side, 3 * side, 4 * side)),
        atol=1e-12 * max(scale, np.abs(pixel_rays(part)).max()),
    )


@given(st.floats(0.01, 179.0), st.integers(1, 3000), st.integers(1, 3000))
def test_the_field_of_view_is_the_vertical_one(fov, rows, cols):
    """The angle is from the first row's upper edge to the last row's lower edge, whatever the width."""
    view = look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]), UP, fov, rows, cols)
    top, bottom = (view.row0 - 0.5) / view.focal_px, (view.row0 + rows - 0.5) / view.focal_px
    assert np.degrees(np.arctan(bottom) - np.arctan(top)) == pytest.approx(fov, rel=1e-9)
    assert top == pytest.approx(-bottom)
    right = (view.col0 + cols - 0.5) / view.focal_px
    assert right == pytest.approx(bottom * cols / rows) and view.col0 == -(cols - 1) / 2


@given(
    st.tuples(*[st.floats(-1e3, 1e3)] * 3).map(np.array),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3).map(np.array),
    st.floats(1.0, 120.0),
)
def test_the_camera_is_upright_and_looks_at_its_target(eye, target, fov):
    """The picture's middle shows the target, its rows are level, and points above lie towards its top."""
    if np.linalg.norm(target - eye) < 1e-3:
        return
    view = look_at(eye, target, UP, fov, 5, 7)
    axes = view.earth_from_camera
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)  # right, down, forward: a right-handed system
    direction = (target - eye) / np.linalg.norm(target - eye)
    assert angle_deg(pixel_rays(view)[2, 3], direction) < 1e-9
    assert axes[2, 0] == pytest.approx(0.0, abs=1e-12)
    level = np.hypot(direction[0], direction[1])
    assert axes[2, 1] == pytest.approx(-level, abs=1e-9)
    assert pixel_rays(view)[0, 3] @ UP >= pixel_rays(view)[4, 3] @ UP


@pytest.mark.parametrize("height", [-50.0, 50.0])
def test_a_vertical_camera_has_north_at_its_top(height):
    view = look_at(np.array([1.0, 2.0, 0.0]), np.array([1.0, 2.0, height]), UP, 60.0, 4, 4)
    right, down, forward = view.earth_from_camera.T
    np.testing.assert_allclose(forward, [0, 0, np.sign(height)], atol=1e-15)
    np.testing.assert_allclose(down, [0, -1, 0], atol=1e-15)
    np.testing.assert_allclose(right, [-np.sign(height), 0, 0], atol=1e-15)  # from below east lies to the left


@pytest.mark.parametrize(("lon", "lat"), [(15.0, 57.0), (-84.0, -36.0), (179.9, 0.0)])
def test_a_vertical_camera_on_the_globe_has_north_at_its_top(lon, lat):
    ground, up = geocentric(np.float64(lon), np.float64(lat))
    north = geocentric(np.float64(lon), np.float64(lat + 1e-6))[0] - ground
    view = look_at(ground + 800.0 * up, ground, up, 60.0, 4, 4)
    assert angle_deg(-view.earth_from_camera[:, 1], north) < 1e-3
    assert angle_deg(view.earth_from_camera[:, 2], -up) < 1e-9


@pytest.mark.parametrize("tilt_tangent", [1e-3, 1e-6, 1e-8])
def test_a_nearly_vertical_camera_stays_upright(tilt_tangent):
    """The top is where the camera leans. It does not jump to north while the tilt has a direction at all."""
    view = look_at(np.zeros(3), np.array([tilt_tangent, 0.0, -1.0]), UP, 60.0, 4, 4)
    axes = view.earth_from_camera
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(-axes[:, 1], [1, 0, 0], atol=1.1 * tilt_tangent)


@pytest.mark.parametrize("offset_m", [0.0, 1e-9, np.nan])
def test_look_at_refuses_the_eye_as_target(offset_m):
    eye = np.array([3e6, 1e6, 5e6])
    with pytest.raises(InputError, match="target") as caught:
        look_at(eye, eye + np.array([offset_m, 0.0, 0.0]), UP, 50.0, 4, 4)
    assert "\n" not in str(caught.value) and "other than the eye" in str(caught.value)


def test_camera_coordinates_agree_by_way_of_the_frame():
    """A point has the same camera coordinates by way of the frame, whose origin is near the eye."""
    eye, target = np.array([40_000.0, -70_000.0, 300.0]), np.array([40_200.0, -69_000.0, 10.0])
    view = look_at(eye, target, UP, 50.0, 10, 20)
    frame = view.frame(FLAT_WORLD)
    assert np.abs((eye - frame.origin_earth_m)[:2]).max() <= 512.0
    in_frame, camera_from_frame = view.in_frame(frame)
    target_frame = frame.frame_from_earth @ (target - frame.origin_earth_m)
    np.testing.assert_allclose(camera_from_frame @ (target_frame - in_frame), [0, 0, np.linalg.norm(target - eye)], atol=1e-9)
