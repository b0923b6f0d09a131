"""The ground mesh of perspective views: the raster's own nodes where these can be drawn, and one conforming mesh per view."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from skugga.terrain.gbuffer import ground_mesh as module
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_creases, ground_mesh
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING
from tests.render import render

UTM = "EPSG:32633"
X0, Y0 = 450_000.0, 6_000_000.0
ROWS, COLS = 60, 80


def rolling_heights(rows: int = ROWS, cols: int = COLS) -> np.ndarray:
    """Return heights of smooth hills in metres (rows, cols)."""
    y, x = np.mgrid[0:rows, 0:cols] / 20.0
    return (200 + 25 * np.sin(1.7 * x + y) + 15 * np.cos(2.3 * y - 0.5 * x)).astype(np.float32)


@pytest.fixture
def hills(write_raster) -> Path:
    """File of a raster of smooth hills."""
    return write_raster(rolling_heights(), UTM, X0, Y0, 25.0)


def eye_views(
    east: float = 300.0, south: float = 1300.0, target: tuple[float, float] = (1000.0, 600.0), height: float = 30.0
) -> dict:
    """Return the keys of a perspective view. Eye and ``target`` are metres east and south of the raster's corner."""
    lon_lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform
    positions = [lon_lat(X0 + e, Y0 - s) for e, s in ((east, south), target)]
    return {"eye": {"kind": "perspective", "eye": [*positions[0], height], "target": [*positions[1], 0], "size": [80, 60]}}


def view_of(scene: Scene) -> PerspectiveView:
    """Return the view ``eye``."""
    return scene.view("eye")


def edge_uses(mesh: GroundMesh) -> Counter:
    """Count the triangles at each edge between two nodes, in either direction."""
    ends = np.sort(np.concatenate([mesh.triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
    return Counter(map(tuple, ends.tolist()))


def plan_area_m2(mesh: GroundMesh) -> np.ndarray:
    """Return the triangles' areas (m,) on the map, positive if counter-clockwise."""
    x, y = mesh.x[mesh.triangles], mesh.y[mesh.triangles]
    return 0.5 * ((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0]))


def test_ground_mesh_of_square_cells_has_the_raster_s_nodes(hills, make_scene):
    """The mesh has every cell's centre, height and place. Each quad has two triangles, counter-clockwise from above."""
    scene = make_scene(hills, views=eye_views())
    mesh = ground_mesh(scene, view_of(scene))
    assert mesh.tolerance_px == 0.0 and len(mesh.x) == ROWS * COLS and len(mesh.triangles) == 2 * (ROWS - 1) * (COLS - 1)
    row, col = np.rint((Y0 - mesh.y) / 25.0 - 0.5).astype(int), np.rint((mesh.x - X0) / 25.0 - 0.5).astype(int)
    np.testing.assert_allclose(mesh.x, X0 + 25 * (col + 0.5), atol=1e-6)
    np.testing.assert_allclose(mesh.y, Y0 - 25 * (row + 0.5), atol=1e-6)
    np.testing.assert_allclose(mesh.height_m, rolling_heights()[row, col], atol=1e-4)
    frame = view_of(scene).frame(scene.world)
    earth = mesh.position_frame_m @ frame.frame_from_earth + frame.origin_earth_m
    x, y, height = scene.world.map_position(scene.elevation.crs, earth)
    np.testing.assert_allclose(np.column_stack([x, y, height]), np.column_stack([mesh.x, mesh.y, mesh.height_m]), atol=2e-3)
    np.testing.assert_allclose(plan_area_m2(mesh), 312.5, rtol=1e-9)
    corners = mesh.position_frame_m[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 2] > 0).all()
    uses = edge_uses(mesh)
    assert set(uses.values()) == {1, 2} and sum(n == 1 for n in uses.values()) == 2 * (ROWS + COLS - 2)


def test_normals_and_creases_of_a_plane_and_of_a_fold(write_raster, make_scene):
    """A plane has no crease. Along the fold of two planes the crease is the distance of their unit normals."""
    x = np.arange(40) * 10.0
    heights = np.tile(np.where(x < 200, 0.0, (x - 200) * 0.5), (30, 1)).astype(np.float32)
    raster = write_raster(heights, ENGINEERING, -200.0, 150.0, 10.0)
    views = {"eye": {"kind": "perspective", "eye": [-100, -100, 30], "target": [0, 0, 0], "size": [40, 30]}}
    scene = make_scene(raster, views=views)
    mesh = ground_mesh(scene, view_of(scene))
    slope = np.array([-0.5, 0, 1]) / np.hypot(0.5, 1)
    fold = np.linalg.norm(slope - [0, 0, 1])
    middle = mesh.x[mesh.triangles].mean(axis=1) - (-200 + 5 + 200)
    all_numbers = np.arange(1, len(mesh.triangles) + 1, dtype=np.uint32)[None]
    crease = ground_creases(mesh, all_numbers)
    np.testing.assert_allclose(crease[np.abs(middle) > 11], 0.0, atol=1e-5)
    np.testing.assert_allclose(crease[np.abs(middle) < 9], fold, atol=1e-5)
    partial_creases = ground_creases(
        mesh, np.concatenate([all_numbers[:, ::7], all_numbers[:, :1] * 0 + len(mesh.triangles) + 5], axis=1)
    )
    np.testing.assert_array_equal(partial_creases[::7], crease[::7])  # a number past the ground's triangles is ignored
    assert not np.delete(partial_creases, np.s_[::7]).any()
    node = mesh.x - 5.0
    np.testing.assert_allclose(mesh.normal_frame[node < -1], np.tile([0, 0, 1], ((node < -1).sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(mesh.normal_frame[node > 1], np.tile(slope, ((node > 1).sum(), 1)), atol=1e-6)
    assert 0.1 < (mesh.normal_frame[np.abs(node) < 1] @ slope).min() < 1.0 - 1e-3


def test_ground_mesh_keeps_nodata_holes(write_raster, make_scene):
    """No triangle has a corner without data, and the mesh is complete around the hole."""
    heights = rolling_heights()
    heights[20:30, 30:45] = -9999.0
    scene = make_scene(write_raster(heights, UTM, X0, Y0, 25.0, nodata=-9999.0), views=eye_views(target=(1500.0, 900.0)))
    mesh = ground_mesh(scene, view_of(scene))
    used_nodes = np.unique(mesh.triangles)
    assert np.isfinite(mesh.height_m[used_nodes]).all() and mesh.height_m[used_nodes].min() > 100.0
    row, col = (Y0 - mesh.y[mesh.triangles]) / 25 - 0.5, (mesh.x[mesh.triangles] - X0) / 25 - 0.5
    inside = (row > 19.5) & (row < 29.5) & (col > 29.5) & (col < 44.5)
    assert not inside.any()
    corner_triangle_count = 4  # at its corners a quad misses one node, and keeps the triangle of the other three
    assert len(mesh.triangles) == 2 * (ROWS - 1) * (COLS - 1) - 2 * 11 * 16 + corner_triangle_count


@pytest.mark.parametrize("terrain", [{}, {"resolution": 60.0}])
def test_a_geographic_raster_is_drawn_on_a_metric_grid(write_raster, make_scene, terrain):
    """Nodes lie on the level's map grid, as fine as the raster or as requested, square on the ground, and all on the data."""
    west, north, cell = 14.0, 54.2, 3e-4  # about 19.5 m by 33 m
    raster = write_raster(rolling_heights(), "EPSG:4326", west, north, (1.7 * cell, cell))
    views = {"eye": {"kind": "perspective", "eye": [west + 0.005, north - 0.014, 30], "target": [west + 0.02, north - 0.008, 0]}}
    scene = make_scene(raster, views=views, terrain=terrain)
    mesh = ground_mesh(scene, view_of(scene))
    assert mesh.grid.crs == scene.map_crs and scene.map_crs.to_epsg() == 32633
    detail = terrain.get("resolution", scene.elevation.cell_size_m(1.0))
    assert detail / 2 < mesh.grid.step <= 1.02 * detail
    np.testing.assert_allclose((mesh.x - mesh.grid.x0) / mesh.grid.step % 1.0 % 0.999999, 0.0, atol=1e-5)
    used_nodes = np.unique(mesh.triangles)
    lon, lat = scene.world.lon_lat(mesh.grid.crs, mesh.x[used_nodes], mesh.y[used_nodes])
    ground = scene.elevation.ground_m(lon, lat)
    assert np.isfinite(ground).all() and np.abs(mesh.height_m[used_nodes] - ground).max() < (0.01 if not terrain else 8.0)
    area = plan_area_m2(mesh)
    np.testing.assert_allclose(area, mesh.grid.step**2 / 2, rtol=1e-9)
    covered = area.sum() / (ROWS * COLS * 1.7 * cell * cell * 111_320**2 * np.cos(np.radians(north)))
    assert 0.88 < covered <= 1.0


def test_decimated_ground_mesh_is_conforming_within_its_budget(hills, make_scene):
    """Nodes are the raster's, no edge contains a node of another triangle, and the plan is covered once."""
    scene = make_scene(hills, views=eye_views())
    view = view_of(scene)
    full_mesh, mesh = ground_mesh(scene, view), ground_mesh(scene, view, 2000)
    assert 300 < len(mesh.triangles) <= 2000 and mesh.tolerance_px > 0.0
    places = {(x, y): h for x, y, h in zip(full_mesh.x, full_mesh.y, full_mesh.height_m, strict=True)}
    assert all(places[x, y] == h for x, y, h in zip(mesh.x, mesh.y, mesh.height_m, strict=True))
    area = plan_area_m2(mesh)
    assert (area > 0).all() and area.sum() == pytest.approx((ROWS - 1) * (COLS - 1) * 625.0)
    uses = edge_uses(mesh)
    assert set(uses.values()) == {1, 2}
    border = [edge for edge, n in uses.items() if n == 1]
    x, y = mesh.x[np.array(border)], mesh.y[np.array(border)]
    on_border = np.zeros(len(border), bool)
    for values, ends in ((x, (full_mesh.x.min(), full_mesh.x.max())), (y, (full_mesh.y.min(), full_mesh.y.max()))):
        for end in ends:
            on_border |= (values == end).all(axis=1)
    assert on_border.all()
    eye_distance_m = np.hypot(mesh.x[mesh.triangles].mean(axis=1) - X0 - 300, mesh.y[mesh.triangles].mean(axis=1) - Y0 + 1300)
    near, far = area[eye_distance_m < 300].mean(), area[eye_distance_m > 1000].mean()
    assert near <= far / 2


def test_parts_shifts_and_turned_cameras_share_one_mesh(hills, make_scene):
    """A view's parts and shifts share one object. Turning the camera on the spot changes no triangle."""
    scene = make_scene(hills, views=eye_views())
    view = view_of(scene)
    mesh = ground_mesh(scene, view, 2000)
    assert ground_mesh(scene, view.part(3, 5, 20, 20), 2000) is mesh and ground_mesh(scene, view.shifted(0.3, -0.2), 2000) is mesh
    assert ground_mesh(scene, view.finer(2), 2000) is mesh
    other = make_scene(hills, views=eye_views(target=(100.0, 1400.0)))
    turned = ground_mesh(other, view_of(other), 2000)
    np.testing.assert_array_equal(turned.triangles, mesh.triangles)
    np.testing.assert_array_equal(turned.position_frame_m, mesh.position_frame_m)


def test_a_ground_of_too_many_nodes_is_averaged(hills, make_scene, monkeypatch):
    monkeypatch.setattr(module, "MAX_NODES_PER_SIDE", 40)
    scene = make_scene(hills, views=eye_views())
    mesh = ground_mesh(scene, view_of(scene))
    assert mesh.grid.step == 50.0 and len(mesh.x) <= 31 * 41
    ground = scene.elevation.ground_m(mesh.x, mesh.y)
    is_valid = np.isfinite(mesh.height_m)
    assert is_valid.mean() > 0.9 and np.abs(mesh.height_m - ground)[is_valid].max() < 3.0


@pytest.mark.parametrize("shape", [(1, 50), (50, 1), (2, 50), (2, 2)])
def test_ground_mesh_needs_two_rows_and_two_columns(gl, write_raster, make_scene, shape):
    """Ground of one row or column has no triangle and is not visible. Ground of two rows is a ribbon."""
    raster = write_raster(np.zeros(shape, np.float32), ENGINEERING, -5.0 * shape[1], 5.0 * shape[0], 10.0)
    views = {"eye": {"kind": "perspective", "eye": [0, 0, 30], "target": [0.5, 0.5, 0], "size": [40, 30]}}
    scene = make_scene(raster, views=views)
    mesh = ground_mesh(scene, view_of(scene))
    assert len(mesh.triangles) == 2 * (shape[0] - 1) * (shape[1] - 1)
    assert geometry_buffer(scene, view_of(scene)).valid.any() == (min(shape) > 1)
    frame = render(scene, view_of(scene))
    assert frame.valid.any() == (min(shape) > 1)


@pytest.mark.parametrize("behind", [False, True])
def test_ground_behind_the_camera_casts_a_shadow(gl, write_raster, make_scene, behind):
    """A wall behind the camera casts a shadow of length h / tan(a) into the picture. Without the wall nothing is dark."""
    heights = np.zeros((80, 80), np.float32)
    if behind:
        heights[58:61] = 40.0  # its northern upper edge at y = -10 * (58 - 39.5) = -185
    raster = write_raster(heights, ENGINEERING, -400.0, 400.0, 10.0)
    views = {"eye": {"kind": "perspective", "eye": [0, -150, 20], "target": [0, 0, 0], "fov": 50, "size": [60, 90]}}
    scene = make_scene(raster, 180.0, 14.0, views=views)
    frame = render(scene, view_of(scene), algorithm="shadow_map", map_size=2048, filter=1)
    y, is_shadow = frame.position_earth_m[..., 1][frame.valid], frame.visibility[frame.valid] < 0.5
    if not behind:
        assert not is_shadow.any()
        return
    end = -185.0 + 40.0 / np.tan(np.radians(14.0))
    assert is_shadow[y < end - 1.0].all() and not is_shadow[y > end + 1.0].any() and (y < end - 1.0).any() and (y > end + 1.0).any()
