"""Points that several facets share: nodes, and points between two facets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer, map_geometry
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.gbuffer.smooth_ground import move_to_smooth_ground
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.lights import light_position
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING

CELL_M = 8.0
SIDE_NODES = 8

GroundFactory = Callable[..., tuple[Scene, MapView]]


@pytest.fixture
def make_ground(write_raster, make_scene) -> GroundFactory:
    """``make_ground(heights, azimuth, altitude)`` returns a level and its view, with a pixel on each cell, a node of the ground."""

    def make(heights: np.ndarray, azimuth: float = 180.0, altitude: float = 30.0, **keys) -> tuple[Scene, MapView]:
        rows, cols = heights.shape
        raster = write_raster(heights.astype(np.float32), ENGINEERING, 0.0, rows * CELL_M, CELL_M, nodata=-9999.0)
        scene = make_scene(raster, azimuth, altitude, **keys)
        view = scene.view(bounds=(0, 0, cols * CELL_M, rows * CELL_M), size=(cols, rows))
        assert view.is_on_nodes
        return scene, view

    return make


def geometry(scene: Scene, view: MapView) -> GeometryBuffer:
    """Return the visible points of a map."""
    return map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))


def half_step_view(view: MapView) -> MapView:
    """Return a view with pixels on the nodes, half-way between two, and in the middles of quads, on their diagonals."""
    return MapView(view.grid, view.row0, view.col0, 0.5, 0.5, 2 * view.rows - 1, 2 * view.cols - 1)


def casting_facets(buffer: GeometryBuffer) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals (n, 3) of facets of casting ground, and which facets touch each pixel's point (rows, cols, n).

    Every facet is tested against every point.
    """
    assert buffer.surface is not None
    sheet = buffer.surface.with_rim.sheet
    o, a, b = sheet.position_frame_m.reshape(-1, 3)[sheet.triangles].transpose(1, 0, 2)
    offset = buffer.position_frame_m[:, :, None] - o
    (ax, ay, _), (bx, by, _) = (a - o).T, (b - o).T
    area = ax * by - ay * bx
    u = (offset[..., 0] * by - offset[..., 1] * bx) / area
    v = (ax * offset[..., 1] - ay * offset[..., 0]) / area
    normal = np.cross(a - o, b - o)
    is_touched = np.minimum(np.minimum(u, v), 1.0 - u - v) > -1e-9  # false without a surface, where all values are NaN
    return normal / np.linalg.norm(normal, axis=1, keepdims=True), is_touched


def without_rim(buffer: GeometryBuffer) -> GeometryBuffer:
    """Return the same ground without its rim, the extra ring of nodes beyond the data, as at a pole."""
    assert buffer.surface is not None
    return replace(buffer, surface=replace(buffer.surface, rim=None))


def ridge_heights(ridge_axis: str = "column") -> np.ndarray:
    """Return a ridge with slopes of 45 degrees on both sides."""
    row, col = np.indices((SIDE_NODES, SIDE_NODES))
    return CELL_M * (SIDE_NODES // 2 - np.abs((col if ridge_axis == "column" else row) - SIDE_NODES // 2))


@pytest.mark.parametrize(("along", "azimuth"), [("column", 90.0), ("column", 270.0), ("row", 0.0), ("row", 180.0)])
def test_a_ridge_faces_the_sun_on_either_side(make_ground, along, azimuth):
    """One side of the ridge's facets faces the sun, so the ridge does. On the slope behind it all facets face away.

    Level ground continues from the foot of that slope and faces the sun, but the way to the sun leads below the slope.
    """
    scene, view = make_ground(ridge_heights(along), azimuth, 30.0)
    buffer = geometry(scene, view)
    attached_shadow, blocked = (
        attached_shadow_mask(buffer, scene),
        facing_normals(buffer, scene.light_position("sun", buffer.frame)).is_blocked,
    )
    if along == "row":
        attached_shadow, blocked = attached_shadow.T, blocked.T
    ridge = SIDE_NODES // 2
    if azimuth in (90.0, 180.0):  # the sun stands towards the last column, or row
        attached_shadow, blocked, ridge = attached_shadow[:, ::-1], blocked[:, ::-1], SIDE_NODES - 1 - ridge
    assert not attached_shadow[:, : ridge + 1].any() and attached_shadow[:, ridge + 1 : -1].all() and blocked[:, -1].all()


def test_a_node_faces_away_if_all_of_its_facets_do(make_ground):
    """The facets have two slopes, both steeper than the sun's altitude.

    At the top and the foot level ground continues and faces the sun.
    """
    col = np.indices((SIDE_NODES, SIDE_NODES))[1]
    scene, view = make_ground(np.where(col < 4, CELL_M * col, 4 * CELL_M + 2 * CELL_M * (col - 4)), 90.0, 30.0)
    buffer = geometry(scene, view)
    normals, is_touched = casting_facets(buffer)
    assert len(np.unique(np.round(normals[is_touched[4, 4]], 6), axis=0)) == 2
    attached_shadow = attached_shadow_mask(buffer, scene)
    assert attached_shadow[:, 1:-1].all() and not attached_shadow[:, [0, -1]].any()
    higher = scene.sun.in_frame(buffer.frame) + [0.0, 0.0, 1.0]  # over 45 degrees, under atan(2): the lower facets see it
    facing = facing_normals(buffer, light_position(higher / np.linalg.norm(higher), 0.0)).normal_frame @ higher > 0.0
    assert facing[:, :5].all() and not facing[:, 5:-1].any() and facing[:, -1].all()


def test_facing_depends_on_the_position_of_a_lamp(make_ground):
    """Two lamps hang over the two slopes of a ridge, below its crest. Each lights its own slope, and the ridge.

    At the foot of the other slope level ground continues and faces the lamp.
    """
    crest = SIDE_NODES // 2  # half a cell east of the middle, which positions are counted from
    lights = {
        name: {"kind": "omni", "position": [CELL_M / 2 + east_m, 0.0, CELL_M / 2]}
        for name, east_m in (("west", -2.0 * CELL_M), ("east", 2.0 * CELL_M))
    }
    scene, view = make_ground(ridge_heights(), lights=lights)
    buffer = geometry(scene, view)
    west, east = (np.s_[:, :crest], np.s_[:, 1:crest]), (np.s_[:, crest + 1 :], np.s_[:, crest + 1 : -1])
    for name, slope, other in (("west", west[0], east[1]), ("east", east[0], west[1])):
        attached_shadow = attached_shadow_mask(buffer, scene, name)
        source = scene.light_position(name, buffer.frame)
        assert source.w == 1.0 and source.z == pytest.approx((crest - 1.5) * CELL_M)
        assert not attached_shadow[slope].any() and not attached_shadow[:, crest].any()
        assert attached_shadow[other].all()
        chosen_normal = facing_normals(buffer, source).normal_frame[4, crest]
        assert chosen_normal == pytest.approx(np.array([-1.0 if name == "west" else 1.0, 0.0, 1.0]) / 2**0.5, abs=1e-6)


HEIGHTS = arrays(np.float32, (SIDE_NODES, SIDE_NODES), elements=st.floats(0, 40, width=32))
AZIMUTHS, ALTITUDES = st.floats(0, 360), st.floats(1, 89)


def with_few_examples(test):
    """Decorate a test to run with at most 20 random examples."""
    return settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])(test)


@with_few_examples
@given(heights=HEIGHTS, azimuth=AZIMUTHS, altitude=ALTITUDES)
def test_the_facet_that_faces_the_light_most_is_chosen(make_ground, heights, azimuth, altitude):
    scene, view = make_ground(heights)
    buffer = geometry(scene, half_step_view(view))
    to_light = direction_enu(azimuth, altitude)
    facing = facing_normals(buffer, light_position(to_light, 0.0))
    chosen_normals, smooth_normals = facing.normal_frame, buffer.shading_normal_frame
    normals, is_touched = casting_facets(buffer)
    max_cosine = np.where(is_touched, normals @ to_light, -np.inf).max(axis=-1)
    assert buffer.lift_m is not None
    lift_m, towards = buffer.lift_m, smooth_normals @ to_light
    by_facets = np.isnan(lift_m) | ((towards > 1e-5) & ((max_cosine > 1e-5) | (lift_m == 0.0)))
    by_smooth = ~np.isnan(lift_m) & ((towards < -1e-5) | (max_cosine < -1e-5) & (lift_m > 0.01))
    np.testing.assert_allclose((chosen_normals @ to_light)[by_facets], max_cosine[by_facets], atol=1e-6)
    normal_distance = np.linalg.norm(normals - chosen_normals[:, :, None], axis=-1)
    assert np.where(is_touched, normal_distance, np.inf).min(axis=-1)[by_facets].max(initial=0.0) < 1e-6  # of one of the facets
    np.testing.assert_array_equal(chosen_normals[by_smooth], smooth_normals[by_smooth])
    assert not facing.is_lifted[by_facets].any()
    assert (facing.is_lifted == (towards > 0.0))[by_smooth & (np.abs(towards) > 1e-5)].all()


@with_few_examples
@given(heights=HEIGHTS)
def test_normal_without_a_light_is_the_mean_over_all_quads(make_ground, heights):
    scene, view = make_ground(heights)
    buffer = geometry(scene, half_step_view(view))
    normals, is_touched = casting_facets(without_rim(buffer))
    assert set(is_touched.sum(axis=-1).ravel().tolist()) >= {1, 2}
    pairs = is_touched.reshape(*is_touched.shape[:2], -1, 2)  # both facets of a quad weigh as much as a single one
    mean = (pairs / np.maximum(pairs.sum(axis=-1, keepdims=True), 1)).reshape(is_touched.shape) @ normals
    np.testing.assert_allclose(buffer.normal_frame, mean / np.linalg.norm(mean, axis=-1, keepdims=True), atol=1e-5)


@with_few_examples
@given(heights=HEIGHTS, azimuth=AZIMUTHS, altitude=ALTITUDES)
def test_crease_is_measured_from_the_chosen_facet(make_ground, heights, azimuth, altitude):
    """On a node the crease is the distance to the farthest of its facets' normals."""
    scene, view = make_ground(heights)
    buffer = geometry(scene, view)
    facing = facing_normals(buffer, light_position(direction_enu(azimuth, altitude), 0.0))
    for facet_buffer, crease, normal in (
        (buffer, facing.crease, facing.normal_frame),
        (without_rim(buffer), buffer.crease, buffer.normal_frame),
    ):
        normals, is_touched = casting_facets(facet_buffer)
        normal_distance = np.linalg.norm(normals - normal[:, :, None], axis=-1)
        np.testing.assert_allclose(crease, np.where(is_touched, normal_distance, 0.0).max(axis=-1), atol=1e-5)


def test_mirrored_ground_has_mirrored_normals(make_ground):
    """Neither facets nor their number depend on which diagonal cuts a plane quad."""
    heights = np.zeros((SIDE_NODES, SIDE_NODES))
    heights[:5, 5] = CELL_M  # a wall that ends in the middle
    (scene, view), (other, other_view) = make_ground(heights), make_ground(heights[::-1])
    normal = geometry(scene, view).normal_frame
    mirrored = geometry(other, other_view).normal_frame[::-1] * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(normal, mirrored, atol=1e-6)


@with_few_examples
@given(
    heights=HEIGHTS,
    azimuth=AZIMUTHS,
    altitude=ALTITUDES,
    holes=st.sets(st.tuples(*[st.integers(1, SIDE_NODES - 2)] * 2), max_size=4),
)
def test_points_are_lifted_above_all_of_their_facets(make_ground, heights, azimuth, altitude, holes):
    """The lift above each facet is a metre or more, also at the rim. Otherwise a ray would meet the facet that it starts from."""
    for hole in holes:
        heights[hole] = -9999.0
    scene, view = make_ground(heights)
    buffer = geometry(scene, half_step_view(view))
    lift = facing_normals(buffer, light_position(direction_enu(azimuth, altitude), 0.0), with_lifts=True).lift_frame
    normals, is_touched = casting_facets(buffer)
    assert np.where(is_touched, lift @ normals.T, np.inf).min() >= 1.0 - 1e-5


def test_a_point_of_one_facet_is_lifted_along_its_normal(make_ground):
    scene, view = make_ground(np.random.default_rng(1).uniform(0.0, 2.0, (SIDE_NODES, SIDE_NODES)))
    buffer = geometry(scene, view.shifted(0.2, 0.3).part(1, 1, SIDE_NODES - 3, SIDE_NODES - 3))
    facing = facing_normals(buffer, light_position(direction_enu(200.0, 40.0), 0.0), with_lifts=True)
    for direction in (facing.normal_frame, facing.lift_frame):
        np.testing.assert_array_equal(direction, buffer.normal_frame)
    np.testing.assert_array_equal(facing.crease, buffer.crease)


def test_rim_points_are_lifted_inwards_for_light_along_the_rim(make_ground):
    """This holds on the outer rows and columns. The lift is straight up inside, and where light enters or leaves the ground."""
    scene, view = make_ground(np.random.default_rng(1).uniform(0.0, 4.0, (SIDE_NODES, SIDE_NODES)))
    buffer = without_rim(geometry(scene, half_step_view(view)))
    last = 2 * SIDE_NODES - 2
    has_several_facets = casting_facets(buffer)[1].sum(axis=-1) > 1
    assert buffer.valid.all()

    def lift_under(azimuth: float) -> np.ndarray:
        return facing_normals(buffer, light_position(direction_enu(azimuth, 20.0), 0.0), with_lifts=True).lift_frame

    for azimuth in (0.0, 90.0, 113.0, 270.0):
        inside = lift_under(azimuth)[1:last, 1:last][has_several_facets[1:last, 1:last]]
        assert (inside[:, :2] == 0.0).all() and (inside[:, 2] >= 1.0).all()
    north, east, between = lift_under(0.0), lift_under(90.0), lift_under(113.0)
    assert (north[1:, 0, 0] > 0.1).all() and (north[1:, last, 0] < -0.1).all()
    assert (east[0, :last, 1] < -0.1).all() and (east[last, :last, 1] > 0.1).all()
    for rim in (np.s_[1:last, 0], np.s_[1:last, last], np.s_[0, 1:last], np.s_[last, 1:last]):
        assert (between[rim][has_several_facets[rim]][:, :2] == 0.0).all()


def test_the_rim_includes_diagonals_at_missing_nodes(make_ground):
    """At an oblique edge of the data a node is missing, and with it half of each quad around it.

    No whole quad is missing, so the diagonals are the rim.
    """
    scene, view = make_ground(np.random.default_rng(1).uniform(0.0, 4.0, (SIDE_NODES, SIDE_NODES)))
    full_buffer = geometry(scene, view)
    assert full_buffer.surface is not None and isinstance(full_buffer.view, MapView)
    row, col = (
        int(first) - origin for first, origin in ((view.row0, full_buffer.surface.row0), (view.col0, full_buffer.surface.col0))
    )
    position, height = full_buffer.surface.position_frame_m.copy(), full_buffer.surface.height_m.copy()
    position[row + 3, col + 3] = height[row + 3, col + 3] = np.nan
    buffer = replace(full_buffer, surface=replace(full_buffer.surface, position_frame_m=position, height_m=height))
    lift_along_rim, lift_across_rim = (
        facing_normals(buffer, light_position(direction_enu(azimuth, 20.0), 0.0), with_lifts=True).lift_frame
        for azimuth in (45.0, 113.0)
    )
    east, north, _ = lift_along_rim[3, 2]  # seen along the rim from (3, 2) to (2, 3), which has ground to its north-west
    assert east < -0.1 and north > 0.1
    assert (lift_across_rim[3, 2, :2] == 0.0).all()


def test_steep_ground_that_falls_to_the_rim_is_lifted_inwards(make_ground):
    heights = np.full((SIDE_NODES, SIDE_NODES), 24.0)
    heights[:, 0] = 0.0
    scene, view = make_ground(heights)
    buffer = without_rim(geometry(scene, half_step_view(view)))
    lift = facing_normals(buffer, light_position(direction_enu(0.0, 20.0), 0.0), with_lifts=True).lift_frame
    assert (lift[1:, 0, 0] > 0.0).all()


def test_rim_points_are_lifted_above_flat_and_steep_facets(make_ground):
    """The flat facet faces the sun more. The steep facet rises inwards, where points on the rim are lifted to."""
    heights = np.zeros((SIDE_NODES, SIDE_NODES))
    heights[6, 1] = 100.0
    scene, view = make_ground(heights)
    buffer = without_rim(geometry(scene, view))
    facing = facing_normals(buffer, light_position(direction_enu(0.0, 80.0), 0.0), with_lifts=True)
    assert facing.normal_frame[5, 0] == pytest.approx([0.0, 0.0, 1.0])
    normals, is_touched = casting_facets(buffer)
    assert (normals[is_touched[5, 0]] @ facing.lift_frame[5, 0]).min() >= 1.0 - 1e-5


def test_a_camera_s_points_have_one_triangle_each(gl, make_ground):
    views = {"low": {"kind": "perspective", "eye": [0, -30, 30], "target": [0, 10, 0], "size": [64, 48]}}
    scene, _ = make_ground(ridge_heights(), views=views)
    buffer = geometry_buffer(scene, scene.view("low"))
    facing = facing_normals(buffer, light_position(direction_enu(200.0, 20.0), 0.0), with_lifts=True)
    assert buffer.valid.any()
    assert facing.lift_frame is None  # the lift is along the buffer's own normals
    assert not facing.is_blocked.any()
    to_sun = direction_enu(200.0, 20.0)
    by_day = (buffer.normal_frame @ to_sun > 0.1) & (buffer.shading_normal_frame @ to_sun > 0.1)
    assert by_day.any()
    np.testing.assert_array_equal(facing.normal_frame[by_day], buffer.normal_frame[by_day])


def test_points_are_lifted_upwards_everywhere_on_the_globe(write_raster, make_scene):
    """The frame of the whole earth has one third axis, but up differs from place to place. By day no ground is in shadow."""
    heights = np.random.default_rng(3).uniform(-3000.0, 3000.0, (91, 180)).astype(np.float32)
    scene = make_scene(write_raster(heights, "EPSG:4326", -180.0, 91.0, 2.0), 67.0, 10.0)
    view = scene.view(bounds=(-178.0, -78.0, 178.0, 78.0), size=(178, 78))
    buffer = geometry_buffer(scene, view)
    source = scene.light_position("sun", buffer.frame)
    facing = facing_normals(buffer, source, with_lifts=True)
    up = buffer.position_frame_m - buffer.frame.points_from_earth(np.zeros(3))
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    assert ((facing.lift_frame * up).sum(axis=-1)[buffer.valid] > 0.9).all()
    to_sun = np.array(source[:3])
    day = buffer.valid & (facing.normal_frame @ to_sun > np.sin(np.radians(8.0)))
    rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
    assert day.mean() > 0.3 and lit_mask(buffer, scene, "sun", rays)[day].all() and not facing.is_blocked[day].any()


def test_points_moved_to_the_smooth_ground_keep_the_normals_of_the_others(make_ground):
    """The two buffers share one entry of the cache, so that computing either gives the same normals for a directional light."""
    row, col = np.mgrid[:24, :24]
    scene, view = make_ground(60.0 * np.exp(-((row - 11.0) ** 2 + (col - 12.0) ** 2) / 30.0), 200.0, 20.0)
    view = view.finer(8)
    buffer = geometry_buffer(scene, view, scene.world.frame_near(view.grid.crs, *view.centre))
    sun = scene.light_position("sun", buffer.frame)
    moved = move_to_smooth_ground(buffer, sun)
    own, shared = (facing_normals.__wrapped__(points, sun) for points in (moved, buffer))
    assert own.is_lifted.sum() > 100
    for name in ("normal_frame", "crease", "is_blocked", "is_lifted"):
        np.testing.assert_array_equal(getattr(own, name), getattr(shared, name), err_msg=name)
    assert facing_normals(moved, sun) is facing_normals(buffer, sun)
