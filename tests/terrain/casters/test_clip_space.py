"""Clip coordinates of cameras and maps: points lie in the pixels that show them, within a stated fraction of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.casters.clip_space import AFFINE_PART_PX, affine_camera_error_px, affine_parts, camera_clip, map_clip
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, view_frame
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import block_at
from tests.shadows.boxes import View, box, build_mesh_scene

EYE_VIEW = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [160, 120]}


@pytest.fixture(scope="module")
def flat_scene(tmp_path_factory) -> Scene:
    """Scene of a box in a flat world."""
    return build_mesh_scene(tmp_path_factory.mktemp("flat"), [box((8, 6, 5))], 200, 35, views={"eye": EYE_VIEW})


@pytest.fixture(scope="module")
def globe_scene() -> Scene:
    """Scene of a bundled level on the round earth."""
    return build_scene(load_level("configs/jacksboro.yaml"))


def project_to_pixels(clip: np.ndarray, points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and depths of points (n, 3) relative to the origin."""
    x, y, z, w = clip @ np.column_stack([points, np.ones(len(points))]).T
    return (y / w + 1.0) * view.rows / 2 - 0.5, (x / w + 1.0) * view.cols / 2 - 0.5, z / w


@pytest.mark.parametrize("cut", [None, (20, 31, 70, 90), (70, -20, 70, 90)])
@pytest.mark.parametrize("fine", [1, 2])
def test_camera_clip_places_points_in_their_pixels(gl, flat_scene, cut, fine):
    """The view is whole, cropped off-centre, or finer. Depth is the near distance divided by the distance along the axis."""
    view = flat_scene.view("eye") if cut is None else flat_scene.view("eye").part(*cut)
    view = view.finer(fine)
    buffer = geometry_buffer(flat_scene, view)
    shown_pixels, origin = np.nonzero(buffer.valid), np.array([3.0, -7.0, 1.0])
    points = buffer.position_frame_m[shown_pixels]
    row, col, depth = project_to_pixels(camera_clip(view, buffer.frame, origin, 0.5), points - origin, view)
    # points are clamped to their triangles, whose corners the rasteriser rounds to 1/256 of a pixel
    assert len(row) > 1000
    np.testing.assert_allclose(row, shown_pixels[0], rtol=0, atol=1 / 256)
    np.testing.assert_allclose(col, shown_pixels[1], rtol=0, atol=1 / 256)
    eye, camera_from_frame = view.in_frame(buffer.frame)
    np.testing.assert_allclose(depth, 0.5 / ((points - eye) @ camera_from_frame[2]), rtol=1e-12)


def test_camera_clip_depth_is_0_at_infinity_and_1_at_near(flat_scene):
    view = flat_scene.view("eye")
    frame = view_frame(flat_scene, view)
    eye, camera_from_frame = view.in_frame(frame)
    clip = camera_clip(view, frame, eye, 0.3)
    for direction in (camera_from_frame[2], camera_from_frame[2] + 0.1 * camera_from_frame[0]):
        _, _, z, w = clip @ np.append(direction, 0.0)
        assert z == 0.0 and w == pytest.approx(1.0)
    x, y, z, w = clip @ np.append(0.3 * camera_from_frame[2], 1.0)
    assert z / w == pytest.approx(1.0) and abs(x) < 1e-12 and abs(y) < 1e-12


def test_map_clip_is_exact_in_a_flat_world(gl, flat_scene):
    """Pixels and heights are exact: depth is 0 at the lower height and 1 at the higher one."""
    view = flat_scene.view(bounds=(-40, -30, 40, 30), size=(160, 120)).part(13, 7, 90, 101)
    buffer = geometry_buffer(flat_scene, view)
    origin = np.array([5.0, 2.0, 1.0])
    clip = map_clip(flat_scene.world, buffer.frame, view, origin, (-2.0, 8.0))
    row, col, depth = project_to_pixels(clip, buffer.position_frame_m.reshape(-1, 3) - origin, view)
    expected = np.indices(buffer.valid.shape).reshape(2, -1)
    np.testing.assert_allclose(np.stack([row, col]), expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(depth, (buffer.position_frame_m[..., 2].ravel() + 2.0) / 10.0, atol=1e-12)
    assert affine_camera_error_px(flat_scene, view.grid, 1.0, 1.0) == 0.0
    _, _, z, w = clip @ [0.0, 0.0, -1.0, 0.0]
    assert z < 0.0 and w == 0.0  # infinitely far below


@pytest.mark.parametrize("zoom", [9, 11, 13])
def test_affine_parts_of_a_globe_map_err_within_the_bound(gl, globe_scene, zoom):
    """The error is at most the bend of the level's parts, and slightly more where ground rises above the fitted heights."""
    block = block_at(-84.25, 36.2933, zoom)
    buffer = geometry_buffer(globe_scene, block)
    error_bound_px, max_error_px = affine_camera_error_px(globe_scene, block.grid, block.row_step, block.col_step), 0.0
    for part, top, left in affine_parts(globe_scene.world, block):
        inside = np.s_[top : top + part.rows, left : left + part.cols]
        pixel_indices = np.nonzero(buffer.valid[inside])
        if not len(pixel_indices[0]):
            continue
        points = buffer.position_frame_m[inside][pixel_indices]
        origin = points.mean(axis=0)
        clip = map_clip(globe_scene.world, buffer.frame, part, origin, (points[:, 2].min() - 1.0, points[:, 2].max() + 1.0))
        row, col, depth = project_to_pixels(clip, points - origin, part)
        max_error_px = max(max_error_px, float(np.hypot(row - pixel_indices[0], col - pixel_indices[1]).max()))
        assert 0.0 <= depth.min() and depth.max() <= 1.0
    assert 0.0 < max_error_px <= 1.5 * error_bound_px
    assert error_bound_px < (0.25 if zoom >= 11 else 20.0)


def test_coarser_maps_bend_more(globe_scene):
    bends = [affine_camera_error_px(globe_scene, block_at(-84.25, 36.2933, zoom).grid, 1.0, 1.0) for zoom in (13, 11, 9, 7)]
    assert bends == sorted(bends) and bends[-1] > 0.25


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (AFFINE_PART_PX, AFFINE_PART_PX), (AFFINE_PART_PX + 1, 3), (700, 513)])
def test_affine_parts_cover_a_view_once(globe_scene, flat_scene, rows, cols):
    block = block_at(-84.25, 36.2933, 12)
    view = MapView(block.grid, block.row0 + 5, block.col0 + 9, 1.0, 1.0, rows, cols)
    covered = np.zeros((rows, cols), int)
    for part, top, left in affine_parts(globe_scene.world, view):
        assert 0 < part.rows <= AFFINE_PART_PX and 0 < part.cols <= AFFINE_PART_PX
        assert (part.row0, part.col0) == (view.row0 + top, view.col0 + left)
        covered[top : top + part.rows, left : left + part.cols] += 1
    assert (covered == 1).all()
    assert affine_parts(flat_scene.world, view) == [(view, 0, 0)]
    eye = flat_scene.view("eye")
    assert affine_parts(globe_scene.world, eye) == [(eye, 0, 0)]
