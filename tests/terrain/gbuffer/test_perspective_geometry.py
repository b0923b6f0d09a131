"""Perspective views: every pixel's point lies where its ray meets the visible surface, from 10 cm above ground to space."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pyproj import Transformer

from skugga.api.compute import product_of_frame
from skugga.shadows.render import render_frame
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import RasterisedView, geometry_buffer, resolve_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene
from skugga.terrain.shading import encode_srgb
from skugga.terrain.sky import HORIZON_COLOR, ZENITH_COLOR
from tests.rasters import ENGINEERING
from tests.render import plan_of, render

FLOOR_M = 200.0
"""Distance from the floor's middle to its outermost nodes, along each axis."""

RASTER_TOLERANCE_PX = 0.1
"""Tolerance, in pixels, between a pixel's ray and the triangle that it shows.

Rasterisers snap corners to a grid of 1/256 pixel, and compute those of a triangle that reaches behind the eye in float32.
"""

UTM = "EPSG:32633"
X0, Y0 = 400_000.0, 6_400_000.0


@pytest.fixture
def floor(write_raster) -> Path:
    """File of a raster of level ground."""
    return write_raster(np.zeros((41, 41), np.float32), ENGINEERING, -205.0, 205.0, 10.0)


@pytest.fixture
def hills(write_raster) -> Path:
    """Return rolling ground with about 120 m of relief over 3.2 km, 57.7 degrees north and off the zone's central meridian."""
    y, x = np.mgrid[0:65, 0:65] / 64.0
    heights = 300 + 40 * np.sin(9 * x + 2 * y) + 30 * np.cos(7 * y - 3 * x) + 8 * np.sin(31 * x) * np.sin(27 * y)
    return write_raster(heights.astype(np.float32), UTM, X0, Y0, 50.0)


def eye_view(eye, target, size=(64, 48), fov=50.0) -> dict:
    """Return the keys of the perspective view ``eye``."""
    return {"eye": {"kind": "perspective", "eye": list(eye), "target": list(target), "fov": fov, "size": list(size)}}


def lon_lat_at(east_m: float, north_m: float) -> tuple[float, float]:
    """Return longitude and latitude of a place, counted from the corner of the hills 3 km south of their north-west one."""
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(X0 + east_m, Y0 - 3000 + north_m)
    return float(lon), float(lat)


def rays_in_frame(view: PerspectiveView, buffer: GeometryBuffer) -> tuple[np.ndarray, np.ndarray]:
    """Return the eye (3,) and the pixels' rays (rows, cols, 3) of depth 1 in a buffer's frame."""
    x = (view.col0 + np.arange(view.cols) * view.step_px) / view.focal_px
    y = (view.row0 + np.arange(view.rows) * view.step_px) / view.focal_px
    x, y = np.meshgrid(x, y)
    eye, camera_from_frame = view.in_frame(buffer.frame)
    return eye, np.stack([x, y, np.ones_like(x)], axis=-1) @ camera_from_frame


def ray_distance_px(view: PerspectiveView, point: np.ndarray, eye: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Return the distance of points (n, 3) from their pixels' rays, in pixels."""
    to_point = point - eye
    ray_distance = np.linalg.norm(np.cross(to_point, ray), axis=-1) / np.linalg.norm(ray, axis=-1)
    return ray_distance / np.linalg.norm(to_point, axis=-1) / view.pixel_tangent


def check_floor(scene: Scene, view: PerspectiveView) -> GeometryBuffer:
    """Assert that pixels show the floor where their rays meet height 0, and are invalid where their rays miss it."""
    buffer = geometry_buffer(scene, view)
    eye, ray = rays_in_frame(view, buffer)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(ray[..., 2] < 0.0, -eye[2] / ray[..., 2], np.nan)
    floor_points = eye + t[..., None] * ray
    border_distance_m = np.abs(floor_points[..., :2] + buffer.frame.origin_earth_m[:2]).max(axis=-1) - FLOOR_M
    pixel_m = t * np.linalg.norm(ray, axis=-1) * view.pixel_tangent
    slanted_m = 2.0 * pixel_m / np.maximum(np.abs(ray[..., 2]) / np.linalg.norm(ray, axis=-1), 1e-9)
    assert (buffer.valid == (border_distance_m < 0.0))[~(np.abs(border_distance_m) < slanted_m)].all()
    valid = buffer.valid & (border_distance_m < 0.0)
    assert valid.any()
    points = buffer.position_frame_m[valid]
    relative_error = np.linalg.norm(points - floor_points[valid], axis=-1) / np.linalg.norm(floor_points[valid] - eye, axis=-1)
    # A pixel beside a triangle's edge may get the neighbour, and then shows the nearest point of the neighbour's edge.
    is_exact = relative_error < 1e-6
    offset_px = ray_distance_px(view, points, eye, ray[valid])
    assert is_exact.mean() > 0.97 and offset_px.max() < RASTER_TOLERANCE_PX and np.abs(points[:, 2]).max() < 1e-9
    assert (buffer.surface_kind[buffer.valid] == RELIEF).all() and (buffer.height_m[buffer.valid] == 0.0).all()
    for normal in (buffer.normal_frame, buffer.shading_normal_frame):
        np.testing.assert_allclose(normal[buffer.valid], np.tile([0, 0, 1], (buffer.valid.sum(), 1)), atol=1e-6)
    assert np.isnan(buffer.position_frame_m[~buffer.valid]).all() and np.isnan(buffer.height_m[~buffer.valid]).all()
    return buffer


VIEWS = {
    "slanting": dict(eye=(0, -150, 20), target=(0, 50, 0)),
    "straight down": dict(eye=(10, 20, 300), target=(10, 20, 0), fov=40.0),
    "a hand above the ground": dict(eye=(0, 0, 0.1), target=(0, 3, 0)),
    "along the ground": dict(eye=(0, -190, 1.7), target=(0, 190, 1.7)),
    "from the edge of space": dict(eye=(5, -7, 500_000), target=(0, 0, 0), fov=0.05),
    "as a telescope": dict(eye=(0, -150, 20), target=(0, 50, 0), fov=0.01),
    "as wide as can be": dict(eye=(0, 0, 20), target=(0, 10, 0), fov=179.0),
    "straight down, as wide as can be": dict(eye=(0, 0, 2), target=(0, 0, 0), fov=179.0),
    "one pixel": dict(eye=(0, -150, 20), target=(0, 50, 0), size=(1, 1)),
    "a row": dict(eye=(0, -150, 20), target=(0, 50, 0), size=(300, 1)),
    "a column": dict(eye=(0, -150, 20), target=(0, 50, 0), size=(1, 300)),
}


@pytest.mark.parametrize("name", VIEWS)
def test_points_of_a_floor_in_closed_form(gl, floor, make_scene, name):
    scene = make_scene(floor, views=eye_view(**VIEWS[name]))
    check_floor(scene, scene.view("eye"))


@pytest.mark.parametrize("name", VIEWS)
def test_frames_of_extreme_views_are_finite(gl, floor, make_scene, name):
    """A box on the floor makes the depth map and its look-up run. No value is NaN, and only the box's shadow is dark."""
    trimesh.creation.box(extents=(2.0, 2.0, 2.0)).export(floor.parent / "box.obj")
    meshes = [{"source": "box.obj", "at": [3.0, 2.0]}]
    scene = make_scene(floor, 200.0, 40.0, views=eye_view(**VIEWS[name]), meshes=meshes)
    frame = render(scene, scene.view("eye"))
    valid = frame.valid
    assert valid.any() and np.isfinite(frame.height_m[valid]).all() and np.isfinite(frame.position_earth_m[valid]).all()
    assert np.isfinite(frame.visibility[valid]).all() and np.isnan(frame.visibility[~valid]).all()
    ground = valid & (frame.height_m < 1e-3)
    box_distance_m = np.abs(frame.position_earth_m[..., :2] - [3.0, 2.0]).max(axis=-1)
    assert (frame.visibility[ground & (box_distance_m > 8.0)] == 1.0).all()


def test_the_view_from_the_edge_of_space_is_finite_and_exact(gl, hills, make_scene):
    """From 500 km above ground in a UTM zone all values are finite, and points lie on the ground at the right place."""
    scene = make_scene(hills, views=eye_view((*lon_lat_at(1600, 1600), 500_000), (*lon_lat_at(1600, 1600), 0.0), fov=0.6))
    view = scene.view("eye")
    buffer = geometry_buffer(scene, view)
    assert 0.1 < buffer.valid.mean() < 0.9
    frame = render(scene, view)
    x, y, height = scene.world.map_position(scene.elevation.crs, frame.position_earth_m[frame.valid])
    np.testing.assert_allclose(height, frame.height_m[frame.valid], atol=0.3)
    middle = scene.world.map_position(scene.elevation.crs, frame.position_earth_m[23:25, 31:33].mean(axis=(0, 1)))
    np.testing.assert_allclose(middle[:2], [X0 + 1600, Y0 - 1400], atol=1.0)


def test_points_on_the_globe_lie_on_the_visible_triangle(gl, hills, make_scene):
    """Points lie in its plane, inside it, and on the pixel's ray. Heights, normals and corners are that triangle's, too."""
    scene = make_scene(hills, views=eye_view((*lon_lat_at(300, 300), 60), (*lon_lat_at(1500, 1500), 0), size=(160, 100)))
    view = scene.view("eye")
    visible = RasterisedView(scene, view, view.frame(scene.world))
    buffer = resolve_buffer(scene, view, visible)
    valid = buffer.valid
    assert (
        valid.mean() > 0.4
        and (visible.id_buffer.triangle_number[valid] > 0).all()
        and (visible.id_buffer.triangle_number[~valid] == 0).all()
    )
    ground = visible.ground
    corner_numbers = ground.triangles[visible.id_buffer.triangle_number[valid].astype(int) - 1]
    corners = ground.position_frame_m[corner_numbers]
    point = buffer.position_frame_m[valid]
    e, g = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e, g)
    area = np.linalg.norm(normal, axis=1)
    plane_distance = ((point - corners[:, 0]) * normal).sum(axis=1) / area
    assert np.abs(plane_distance).max() < 1e-6
    u = (np.cross(point - corners[:, 0], g) * normal).sum(axis=1) / area**2
    v = (np.cross(e, point - corners[:, 0]) * normal).sum(axis=1) / area**2
    assert min(u.min(), v.min(), (1 - u - v).min()) > -1e-9
    np.testing.assert_allclose(buffer.normal_frame[valid], normal / area[:, None], atol=1e-6)
    np.testing.assert_array_equal(buffer.corners_frame_m[valid], corners.reshape(-1, 9).astype(np.float32))
    heights = ground.height_m[corner_numbers].astype(float)
    height = (1 - u - v) * heights[:, 0] + u * heights[:, 1] + v * heights[:, 2]
    np.testing.assert_allclose(buffer.height_m[valid], height, atol=1e-3)
    # Points lie on the ray, except for the rasteriser's grid of 1/256 pixel and silhouettes that end within the pixel.
    eye, ray = rays_in_frame(view, buffer)
    offset_px = ray_distance_px(view, point, eye, ray[valid])
    assert np.quantile(offset_px, 0.9) < 1e-6 and offset_px.max() < RASTER_TOLERANCE_PX
    # No nearer triangle hides it.
    rays = RayScene(meshes=[(ground.position_frame_m, ground.triangles)])
    to_point = point - eye
    length = np.linalg.norm(to_point, axis=1)
    is_occluded = rays.is_blocked(np.tile(eye, (len(to_point), 1)), to_point / length[:, None], length * (1 - 1e-4) - 0.01)
    assert is_occluded.mean() < 0.002


def test_a_box_shows_its_faces_with_outward_normals(gl, floor, make_scene, tmp_path):
    size, box_position = np.array([10.0, 6.0, 8.0]), np.array([20.0, 30.0])
    trimesh.creation.box(extents=size).export(tmp_path / "box.obj")
    meshes = [{"source": "box.obj", "at": list(box_position), "color": [1.0, 0.0, 0.0]}]
    scene = make_scene(floor, meshes=meshes, views=eye_view((0, 0, 25), (20, 30, 3), size=(120, 90), fov=30.0))
    view = scene.view("eye")
    buffer = geometry_buffer(scene, view)
    box = buffer.surface_kind == MESHES
    assert box.mean() > 0.1
    point = buffer.position_frame_m[box] + buffer.frame.origin_earth_m - [*box_position, 4.0]
    normal = buffer.normal_frame[box]
    axis = np.abs(normal).argmax(axis=1)
    outward = normal[np.arange(len(axis)), axis]
    np.testing.assert_allclose(np.abs(outward), 1.0, atol=1e-6)
    on_axis = point[np.arange(len(axis)), axis]
    np.testing.assert_allclose(on_axis, np.sign(outward) * size[axis] / 2, atol=1e-6)  # outside is where the normal points
    assert (np.abs(point) <= size / 2 + 1e-6).all()
    visible_faces = {(int(a), int(np.sign(s))) for a, s in zip(axis, outward, strict=True)}
    assert visible_faces == {(0, -1), (1, -1), (2, 1)}  # from the south-west and above
    np.testing.assert_allclose(buffer.albedo[box], np.tile([1.0, 0.0, 0.0], (box.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(buffer.shading_normal_frame[box], normal, atol=1e-6)
    np.testing.assert_allclose(buffer.height_m[box], point[:, 2] + 4.0, atol=1e-5)
    eye, ray = rays_in_frame(view, buffer)
    expected = _nearest_on_box(eye + buffer.frame.origin_earth_m - [*box_position, 4.0], ray, size / 2)
    is_decidable = box & np.isfinite(expected[..., 0])
    box_points = buffer.position_frame_m + buffer.frame.origin_earth_m - [*box_position, 4.0]
    assert is_decidable.sum() > 0.98 * box.sum()
    near = np.linalg.norm((box_points - expected)[is_decidable], axis=-1)
    assert np.quantile(near, 0.98) < 1e-6 and near.max() < 0.1


def _nearest_on_box(eye: np.ndarray, ray: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return where rays enter a box around the origin (slab method), or NaN where they miss it."""
    with np.errstate(divide="ignore"):
        near, far = (-np.sign(ray) * half - eye) / ray, (np.sign(ray) * half - eye) / ray
    entry_distance, exit_distance = near.max(axis=-1), far.min(axis=-1)
    return np.where((entry_distance < exit_distance)[..., None], eye + entry_distance[..., None] * ray, np.nan)


def test_a_sheet_s_normal_faces_the_eye_from_either_side(gl, floor, make_scene, tmp_path):
    """An open mesh has no inside: either side faces the eye."""
    sheet = trimesh.Trimesh([[-20, 0, 0], [20, 0, 0], [20, 0, 30], [-20, 0, 30]], [[0, 1, 2], [0, 2, 3]], process=False)
    sheet.export(tmp_path / "sheet.obj")
    for south in (1.0, -1.0):
        scene = make_scene(
            floor, meshes=[{"source": "sheet.obj", "at": [0, 0]}], views=eye_view((0, -60 * south, 12), (0, 0, 12), fov=20.0)
        )
        buffer = geometry_buffer(scene, scene.view("eye"))
        on_mesh = buffer.surface_kind == MESHES
        assert on_mesh.mean() > 0.5
        np.testing.assert_allclose(buffer.normal_frame[on_mesh], np.tile([0, -south, 0], (on_mesh.sum(), 1)), atol=1e-6)
        np.testing.assert_allclose(buffer.shading_normal_frame[on_mesh], buffer.normal_frame[on_mesh], atol=1e-6)


def test_depth_is_along_the_axis_and_position_in_the_map_s_crs(gl, hills, make_scene):
    """Positions agree with the raster between its cells."""
    scene = make_scene(hills, views=eye_view((*lon_lat_at(300, 300), 150), (*lon_lat_at(1500, 1500), 0), size=(80, 60)))
    view = scene.view("eye")
    frame = render(scene, view)
    valid = frame.valid
    position = product_of_frame(scene, frame, "position")
    assert np.isnan(position[~valid]).all() and valid.mean() > 0.3
    ground = scene.elevation.ground_m(position[valid, 0], position[valid, 1])
    np.testing.assert_allclose(position[valid, 2], frame.height_m[valid], atol=0.3)  # a chord of 50 m, and float32
    assert np.abs(position[valid, 2] - ground).max() < 1.5  # triangles against the bilinear surface
    assert np.abs(position[valid, 2] - ground).mean() < 0.2
    depth = product_of_frame(scene, frame, "depth")
    camera_points = (frame.position_earth_m - view.eye_earth_m) @ view.earth_from_camera
    np.testing.assert_allclose(depth[valid], camera_points[valid, 2], rtol=1e-6)
    x = (view.col0 + np.arange(view.cols)) / view.focal_px
    np.testing.assert_allclose(
        (camera_points[..., 0] / depth)[valid], np.broadcast_to(x, depth.shape)[valid], atol=0.1 * view.pixel_tangent
    )
    assert np.isnan(depth[~valid]).all() and depth[valid].min() > 0.0


def test_a_view_off_the_data_is_refused_in_one_line(floor, make_scene):
    for eye, target, name in (((300, 0, 10), (0, 0, 0), "eye"), ((0, 0, 10), (0, -5000, 0), "target")):
        scene = make_scene(floor, views=eye_view(eye, target))
        with pytest.raises(InputError, match=f"views.eye.{name}") as caught:
            scene.view("eye")
        assert "\n" not in str(caught.value) and "terrain's data" in str(caught.value)
    scene = make_scene(floor, views=eye_view((0, 0, 10), (0, 20, 0)))
    for keys, name in (({"bounds": (0, 0, 1, 1)}, "bounds"), ({"crs": UTM}, "crs"), ({"size": (5000, 10)}, "size")):
        with pytest.raises(InputError, match=name) as caught:
            scene.view("eye", **keys)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("target", [(0, 20, 100), (0, 0, 500)])
def test_a_view_of_the_sky_alone_runs_all_passes(gl, floor, make_scene, target):
    """No pixel shows a surface, every pixel shows the sky, and all of the plan's passes run."""
    scene = make_scene(floor, views=eye_view((0, 0, 10), target, fov=20.0))
    frame = render(scene, scene.view("eye"))
    assert not frame.valid.any() and np.isnan(frame.visibility).all() and np.isnan(frame.position_earth_m).all()
    assert frame.opaque_mask.all() and [record.name for record in frame.passes] == frame.plan.passes
    between = encode_srgb(np.array([ZENITH_COLOR, HORIZON_COLOR], np.float32)).astype(int)
    assert (frame.color >= between.min(axis=0) - 1).all() and (frame.color <= between.max(axis=0) + 1).all()


def test_the_sky_is_palest_at_the_horizon(gl, floor, make_scene):
    scene = make_scene(floor, views=eye_view((0, -180, 3), (0, 100, 20), fov=60.0))
    frame = render(scene, scene.view("eye"))
    column = frame.color[:, 32].astype(int)[~frame.valid[:, 32]]
    assert len(column) > 20 and (np.diff(column[:-1, 0]) >= 0).all() and column[-2, 0] > column[0, 0] + 40


@pytest.mark.parametrize(("down", "right"), [(0, 0), (7, 0), (0, 13), (16, 16), (-5, 9)])
def test_a_part_of_a_view_equals_the_whole_where_they_overlap(gl, hills, make_scene, tmp_path, down, right):
    """A shift by whole pixels with one plan gives the same points and the same visibility."""
    trimesh.creation.box(extents=(60.0, 60.0, 90.0)).export(tmp_path / "tower.obj")
    meshes = [{"source": "tower.obj", "at": [lon_lat_at(d, d + 40.0) for d in (560.0, 800.0, 1100.0)]}]
    views = eye_view((*lon_lat_at(300, 300), 90), (*lon_lat_at(1500, 1500), 0), size=(128, 96))
    scene = make_scene(hills, 275.0, 12.0, meshes=meshes, views=views)
    view = scene.view("eye")
    plan = plan_of(scene, view, map_size=256, filter=5)
    full_frame, part = render_frame(scene, view, plan), render_frame(scene, view.part(down, right, 96, 128), plan)
    full_slices = slice(max(down, 0), 96 + min(down, 0)), slice(max(right, 0), 128 + min(right, 0))
    part_slices = tuple(slice(s.start - o, s.stop - o) for s, o in zip(full_slices, (down, right), strict=True))
    valid, full_visibility = full_frame.valid[full_slices], full_frame.visibility[full_slices]
    np.testing.assert_array_equal(part.valid[part_slices], valid)
    point_distance = np.linalg.norm((part.position_earth_m[part_slices] - full_frame.position_earth_m[full_slices])[valid], axis=-1)
    is_same_point = point_distance < 1e-8  # beside a triangle's edge float32 may choose the neighbour
    assert is_same_point.mean() > 0.999
    assert 0.03 < (full_visibility < 0.5).mean() < 0.5 and ((full_visibility > 0.0) & (full_visibility < 1.0)).mean() > 0.005
    visibility, expected = part.visibility[part_slices][valid][is_same_point], full_visibility[valid][is_same_point]
    np.testing.assert_array_equal(visibility < 0.5, expected < 0.5)
    np.testing.assert_allclose(visibility, expected, atol=1e-4)
