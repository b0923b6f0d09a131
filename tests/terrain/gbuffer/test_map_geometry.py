"""Grids, surfaces and geometry buffers of map views."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from morecantile import tms as matrix_sets
from pyproj import CRS, Geod, Transformer

from skugga.api.catalogue import find_level
from skugga.api.compute import product_of_frame
from skugga.shadows.truth.truth import jittered_views
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.gbuffer.subsampled import subsampled_view
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, shared_nodes, view_frame
from skugga.terrain.geo.grid import BLOCK_PX, blocks_of, map_grid, map_view, tile_grid
from skugga.terrain.geo.world import EARTH_RADIUS_M, World
from skugga.terrain.ground.sheet import sheet_triangles
from skugga.terrain.level.level import load_level
from skugga.terrain.lights import light_position
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING
from tests.render import block_at, render

WORLD = World(CRS.from_epsg(4326), False, 15.0, 47.0, 15.0, 47.0)


@pytest.mark.parametrize(("name", "epsg"), [("WebMercatorQuad", 3857), ("WGS1984Quad", 4326)])
def test_map_views_at_a_zoom_s_resolution_share_the_tile_grid(name, epsg):
    tms = matrix_sets.get(name)
    for zoom in (3, 9, 14):
        grid = tile_grid(tms, zoom)
        assert map_grid(WORLD, CRS.from_epsg(epsg), grid.step) == grid
        assert map_grid(WORLD, CRS.from_epsg(epsg), grid.step * 1.9) == grid
        bounds = tms.xy_bounds(*tms.tile(15.0, 47.0, zoom))
        view = map_view(WORLD, CRS.from_epsg(epsg), (bounds.left, bounds.bottom, bounds.right, bounds.top), 256, 256)
        assert view.is_on_nodes and view.grid == grid
        tile = tms.tile(15.0, 47.0, zoom)
        assert (view.row0, view.col0) == (tile.y * 256, tile.x * 256)


@given(st.floats(0.01, 5000))
def test_map_grid_step_is_the_power_of_two_at_or_below(resolution):
    grid = map_grid(WORLD, CRS.from_epsg(32633), resolution)
    assert grid.step <= resolution * (1 + 1e-9) < 2 * grid.step * (1 + 2e-9)
    assert float(np.log2(grid.step)).is_integer()


def test_blocks_on_nodes_are_world_fixed_and_cover_the_view():
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), 12)
    view = block_at(15.0, 47.0, 12).part(700, 900, 1300, 300)
    covered = np.zeros((view.rows, view.cols), int)
    for block, row, col in blocks_of(view):
        assert block.grid == grid and block.rows == block.cols == BLOCK_PX
        assert block.row0 % BLOCK_PX == 0 and block.col0 % BLOCK_PX == 0
        assert (block.row0, block.col0) == (view.row0 + row, view.col0 + col)
        covered[max(row, 0) : row + BLOCK_PX, max(col, 0) : col + BLOCK_PX] += 1
    assert (covered == 1).all()


@pytest.mark.parametrize(("epsg", "place"), [(3857, (-84.25, 36.2933)), (4326, (-84.25, 36.2933)), (32616, (-84.25, 36.2933))])
def test_nodes_lie_where_proj_says(epsg, place):
    """Interpolated nodes agree with the transformation of every node: under a millimetre on earth, 1e-6 of a cell."""
    scene = build_scene(load_level("configs/jacksboro.yaml"))
    crs = CRS.from_epsg(epsg)
    x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(*place)
    grid = map_grid(scene.world, crs, 20.0 if epsg != 4326 else 2e-4)
    frame = scene.world.frame_near(crs, x, y)
    row0, col0 = int((grid.y0 - y) / grid.step), int((x - grid.x0) / grid.step)
    window = scene.surface(grid).window(row0, col0, 130, 140, frame)
    cols, rows = np.meshgrid(col0 + np.arange(140), row0 + np.arange(130))
    lon, lat = Transformer.from_crs(crs, 4326, always_xy=True).transform(grid.x(cols), grid.y(rows))
    to_earth = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    earth = np.stack(to_earth.transform(lon, lat, window.height_m.astype(float)), axis=-1)
    window_earth_m = window.position_frame_m @ frame.frame_from_earth + frame.origin_earth_m
    assert np.abs(window_earth_m - earth).max() < 1e-3
    row, col = scene.elevation.cell_of(lon, lat)
    height, _ = scene.elevation.heights_at(scene.surface(grid).lod, row, col)
    np.testing.assert_allclose(window.height_m, height, atol=1e-3)


def test_a_node_has_the_same_bits_in_every_window():
    scene = build_scene(load_level("configs/jacksboro.yaml"))
    block = block_at(-84.25, 36.2933, 13)
    frame = scene.world.frame_near(block.grid.crs, *block.centre)
    surface = scene.surface(block.grid)
    row, col = int(block.row0), int(block.col0)
    window = surface.window(row, col, 300, 300, frame)
    other_window = surface.window(row + 111, col + 57, 300, 300, frame)
    np.testing.assert_array_equal(window.position_frame_m[111:, 57:], other_window.position_frame_m[:-111, :-57])
    np.testing.assert_array_equal(window.height_m[111:, 57:], other_window.height_m[:-111, :-57])


@pytest.mark.parametrize("tile", [True, False])
def test_points_lie_on_the_triangle_they_name(tile):
    scene = build_scene(load_level("configs/jacksboro_alpine.yaml"))
    if tile:
        view = block_at(-84.25, 36.2933, 12)
    else:
        view = scene.view(size=(300, 310))
    frame = scene.world.frame_near(view.grid.crs, *view.centre)
    buffer = map_geometry(scene.surface(view.grid), view, frame)
    valid = buffer.valid
    assert valid.sum() > 5000
    row, col, half = buffer.triangle[valid].T
    sheet = buffer.surface.sheet
    corners = sheet_triangles(sheet.is_cut_nw_se)[2 * (row * sheet.is_cut_nw_se.shape[1] + col) + half]
    o, a, b = sheet.position_frame_m.reshape(-1, 3)[corners].transpose(1, 0, 2)
    point = buffer.position_frame_m[valid]
    face = np.cross(a - o, b - o)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    assert np.abs(((point - o) * face).sum(axis=1)).max() < 1e-6
    for start, end in ((o, a), (a, b), (b, o)):  # inside the edge, or on it but for rounding
        inwards = np.cross(face, end - start)
        assert (((point - start) * inwards).sum(axis=1) / np.linalg.norm(inwards, axis=1)).min() > -1e-3
    assert np.abs(sheet.normals_frame[row, col, half] - face).max() < 1e-6
    normal = buffer.normal_frame[valid].astype(float)
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-6
    assert (normal[:, 2] > 0).all() and (buffer.shading_normal_frame[valid][:, 2] > 0).all()


@pytest.mark.parametrize(("tile", "share"), [(True, 1.0), (False, 0.99)])
def test_position_lies_on_the_raster_s_surface(tile, share):
    """``--layer position`` lies within 1 % of a cell of the bilinear surface everywhere in tiles, whose pixels are nodes.

    Between nodes the drawn quads, half a pixel wide, cut the kinks of the bilinear surface, so 99 % of the pixels do.
    """
    scene = build_scene(load_level("configs/jacksboro.yaml"))
    view = block_at(-84.25, 36.2933, 12).part(313, 300, 200, 200) if tile else scene.view()
    position = product_of_frame(scene, render(scene, view, algorithm="none"), "position")
    is_valid = np.isfinite(position[..., 2])
    assert is_valid.sum() > 10_000
    x, y, height = position[is_valid].T
    lon, lat = scene.world.lon_lat(view.grid.crs, x, y)
    row, col = scene.elevation.cell_of(lon, lat)
    truth, _ = scene.elevation.heights_at(scene.surface(view.grid).lod, row[None], col[None])
    within = np.abs(height - truth[0]) < 0.01 * scene.elevation.cell_size_m(1.0)
    assert within.mean() >= share


def test_crease_is_0_on_planes_and_normal_distance_on_folds(write_raster, make_scene):
    """Between nodes the crease is the distance of two facets' normals.

    On a node, whose normal is the mean of both, the crease is the distance from the mean to either.
    """
    heights = np.zeros((40, 40), np.float32)
    heights[:, 20:] = np.arange(20) * 10.0  # a plane of 45 degrees from column 20 on
    scene = make_scene(write_raster(heights, ENGINEERING, 0, 400, 10))
    view = scene.view(bounds=(0, 0, 400, 400), size=(50, 50))
    assert view.is_on_nodes
    # Nodes of 8 m do not fall on the fold, at 205 m: from 204 to 212 m the ground rises by 7 m, and only then by 8 m in 8 m.
    fold = np.arctan(7.0 / 8.0)
    for pixels, expected in ((view, 2.0 * np.sin(fold / 4.0)), (view.shifted(0.2, 0.3), 2.0 * np.sin(fold / 2.0))):
        buffer = map_geometry(scene.surface(view.grid), pixels, scene.world.frame_near(view.grid.crs, *view.centre))
        crease = buffer.crease[20]
        assert crease[:20] == pytest.approx(0.0, abs=1e-6) and crease[32:45] == pytest.approx(0.0, abs=1e-6)
        assert crease[20:32].max() == pytest.approx(expected, abs=1e-5)


def test_frames_are_true_to_north_and_scale_in_web_mercator():
    """At latitude 60 a metre in a frame is a metre on the ground, and the frame's north is true north."""
    world = World(CRS.from_epsg(4326), False, 10.0, 60.0, 10.0, 60.0)
    frame = world.frame_near(CRS.from_epsg(4326), 10.0, 60.0)
    lon, lat, _ = Geod(ellps="WGS84").fwd(10.0, 60.0, 0.0, 1000.0)
    point, _ = world.points_at_zero_height(CRS.from_epsg(4326), np.array(lon), np.array(lat))
    east, north, up = frame.frame_from_earth @ (point - frame.origin_earth_m)
    assert (east, north) == (pytest.approx(0.0, abs=1e-3), pytest.approx(1000.0, abs=0.01))
    assert up == pytest.approx(-(1000.0**2) / 2 / 6.38e6, abs=1e-3)  # the earth falls away


def test_neighbouring_frames_have_the_same_distances_and_azimuths():
    """East and north of a frame are those of the ground near it: a step on the ground has its geodesic's length and azimuth."""
    crs = CRS.from_epsg(4326)
    world = World(crs, False, 10.0, 45.0, 10.0, 45.0)
    frames = [world.frame_near(crs, lon_deg, 45.0) for lon_deg in (10.1, 10.3)]
    assert frames[0].key != frames[1].key
    (lon_deg, lat_deg), (other_lon_deg, other_lat_deg) = (10.2, 45.05), (10.21, 45.06)
    azimuth_deg, _, distance_m = Geod(a=EARTH_RADIUS_M, f=0.0).inv(lon_deg, lat_deg, other_lon_deg, other_lat_deg)
    points, _ = world.points_at_zero_height(crs, np.array([lon_deg, other_lon_deg]), np.array([lat_deg, other_lat_deg]))
    for frame in frames:
        local = (points - frame.origin_earth_m) @ frame.frame_from_earth.T
        assert np.abs(local).max() < 25_000
        step = local[1] - local[0]
        assert np.hypot(*step[:2]) == pytest.approx(distance_m, rel=0.005)
        assert np.degrees(np.arctan2(step[0], step[1])) == pytest.approx(azimuth_deg, abs=0.3)


def test_sub_samples_with_shared_nodes_are_identical():
    """Views lie on nodes, between nodes, or on every fourth node. A view that needs more nodes than it is given is refused."""
    scene = build_scene(load_level(find_level("jacksboro")))
    full_view = scene.view("map")
    for view in (full_view.part(100, 200, 90, 70), subsampled_view(full_view.part(301, 202, 90, 70), 4)):
        frame, views = view_frame(scene, view), jittered_views(view, 4)
        nodes = shared_nodes(scene, views, frame)
        for sample_view in views:
            buffer, shared_buffer = (
                geometry_buffer(scene, sample_view, frame),
                geometry_buffer(scene, sample_view, frame, nodes=nodes),
            )
            assert buffer.valid.any()
            for name in (
                "valid",
                "position_frame_m",
                "height_m",
                "normal_frame",
                "shading_normal_frame",
                "crease",
                "surface_kind",
                "lift_m",
            ):
                assert np.array_equal(getattr(buffer, name), getattr(shared_buffer, name), equal_nan=True), name
            light = light_position(np.array([0.6, 0.0, 0.8]), 0.0)
            for array, shared_array in zip(
                facing_normals(buffer, light, True), facing_normals(shared_buffer, light, True), strict=True
            ):
                assert np.array_equal(array, shared_array, equal_nan=True)
        with pytest.raises(ValueError, match="nodes"):
            geometry_buffer(scene, view.shifted(2.0, 0.0), frame, nodes=nodes)
