"""Tree instances: their quads in numba and in shaders, thinning that keeps their shade, and no change while cameras turn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Transformer

from skugga.api.catalogue import find_level
from skugga.shadows.truth import truth
from skugga.shadows.truth.truth import ALL_CASTER_KINDS
from skugga.terrain.casters.rays import sample_alpha
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer import tree_instances as module
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_instances_in_map, tree_instances_in_perspective
from skugga.terrain.gbuffer.view_geometry import RasterisedView, geometry_buffer, resolve_buffer
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, TREE_VARIANTS, foliage
from tests.rasters import ENGINEERING

UTM = "EPSG:32633"
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def floor(write_raster) -> Path:
    """Return a floor at height 0 that reaches 400 m from the middle."""
    return write_raster(np.zeros((81, 81), np.float32), ENGINEERING, -405.0, 405.0, 10.0)


@pytest.fixture
def make_wooded_scene(make_scene, tmp_path) -> Callable[..., Scene]:
    """``make_wooded_scene(raster, places, crs, **attributes)`` builds the scene of trees at some places (n, 2)."""

    def build(raster: Path, places, crs: str = ENGINEERING, sun=(200.0, 35.0), species: str = "mixed", **attributes) -> Scene:
        path = tmp_path / "trees.gpkg"
        path.unlink(missing_ok=True)
        points = [shapely.Point(*place) for place in np.atleast_2d(places)]
        fields = [np.broadcast_to(np.asarray(values, float), len(points)) for values in attributes.values()]
        wkb = shapely.to_wkb(np.array(points, object))
        pyogrio.raw.write(path, wkb, fields, list(attributes), geometry_type="Point", crs=crs)
        attribute_keys = {key: key for key in attributes}
        return make_scene(raster, *sun, forest=[{"source": path.name, "species": species, **attribute_keys}])

    return build


def camera_at(scene: Scene, eye, target, fov: float = 50.0, size=(64, 64)) -> PerspectiveView:
    """Return a camera of a flat world."""
    return look_at(np.array(eye, float), np.array(target, float), UP, fov, size[1], size[0])


def instances_of(scene: Scene, view: PerspectiveView) -> TreeInstances:
    """Return the trees that a view draws."""
    instances = tree_instances_in_perspective(scene.objects, view.frame(scene.world), tuple(view.eye_earth_m), view.focal_px)
    assert instances is not None
    return instances


def quad_coordinates(point: np.ndarray, quad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return texture coordinates (n, 2) of points (n, 3) on quads (n, 4, 3), and their distances from the quads.

    The corners of a quad are SW, SE, NE and NW.
    """
    right, up = quad[:, 1] - quad[:, 0], quad[:, 3] - quad[:, 0]
    to_point = point - quad[:, 0]
    u, v = ((to_point * side).sum(axis=1) / (side * side).sum(axis=1) for side in (right, up))
    quad_distance = np.linalg.norm(to_point - u[:, None] * right - v[:, None] * up, axis=1)
    return np.column_stack([u, 1.0 - v]), quad_distance


def alpha_at(instances: TreeInstances, tree: np.ndarray, part: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the full-resolution alpha (n,) of trees' quads at texture coordinates (n, 2)."""
    alpha = foliage().mip_levels[0][..., 3] / 255.0
    return sample_alpha(alpha, uv, 2 * instances.variant[tree] + (part == 2))


# -- the quads


@pytest.mark.parametrize("species", ["conifer", "broadleaf"])
def test_a_tree_shows_its_nearest_opaque_quad(gl, floor, make_wooded_scene, species):
    """Each pixel's ray meets the three quads of ``TreeInstances.corners`` in closed form."""
    scene = make_wooded_scene(floor, [[0.0, 0.0]], height=20.0, crown=9.0, species=species)
    view = camera_at(scene, (11.0, -15.0, 17.0), (0.0, 0.0, 9.0), 62.0, (420, 640))  # two pixels a texel: no mipmap
    visible = RasterisedView(scene, view, view.frame(scene.world))
    buffer = resolve_buffer(scene, view, visible)
    instances = visible.tree_instances
    assert instances is not None and len(instances) == 1
    quads = instances.corners()[0]
    eye, camera_from_frame = view.in_frame(visible.frame)
    x = (view.col0 + np.arange(view.cols)) / view.focal_px
    y = (view.row0 + np.arange(view.rows)) / view.focal_px
    ray = np.stack([*np.meshgrid(x, y), np.ones((view.rows, view.cols))], axis=-1) @ camera_from_frame
    nearest, expected = np.full(ray.shape[:2], np.inf), np.full(ray.shape[:2], -1)
    for part, quad in enumerate(quads):
        normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
        t = ((quad[0] - eye) @ normal) / (ray @ normal)
        uv, _ = quad_coordinates((eye + t[..., None] * ray).reshape(-1, 3), np.tile(quad, (ray[..., 0].size, 1, 1)))
        inside = ((uv >= 0) & (uv <= 1)).all(axis=1).reshape(t.shape)
        alpha = alpha_at(instances, np.zeros(len(uv), int), np.full(len(uv), part), uv).reshape(t.shape)
        is_hit = inside & (alpha >= ALPHA_THRESHOLD) & (t > 0) & (t < nearest)
        nearest[is_hit], expected[is_hit] = t[is_hit], part
    tree = buffer.surface_kind == FOREST
    first = len(visible.ground.triangles) + 1
    quad_index = np.where(tree, (visible.id_buffer.triangle_number.astype(int) - first) // 2, -1)
    assert {0, 1, 2} <= set(quad_index[tree].tolist()) <= {0, 1, 2} and 0.05 < tree.mean() < 0.6
    assert (quad_index == expected).mean() > 0.994
    is_same_quad = tree & (quad_index == expected)
    point_error = np.linalg.norm(buffer.position_frame_m - (eye + nearest[..., None] * ray), axis=-1)[is_same_quad]
    assert np.quantile(point_error, 0.97) < 1e-6 and point_error.max() < 0.05


def test_points_of_trees_lie_on_opaque_parts_of_their_quads(gl, floor, make_wooded_scene):
    """Each resolved point of many trees lies inside the quad that its number names, where the quad's alpha is opaque."""
    rng = np.random.default_rng(2)
    scene = make_wooded_scene(floor, rng.uniform(-40, 40, (40, 2)), height=rng.uniform(8, 20, 40), crown=rng.uniform(4, 9, 40))
    view = camera_at(scene, (5.0, -75.0, 14.0), (0.0, 0.0, 6.0), 50.0, (400, 300))
    visible = RasterisedView(scene, view, view.frame(scene.world))
    buffer = resolve_buffer(scene, view, visible)
    instances = visible.tree_instances
    assert instances is not None
    on_tree = buffer.surface_kind == FOREST
    number = visible.id_buffer.triangle_number[on_tree].astype(int) - 1 - len(visible.ground.triangles)
    tree, part = number // 6, number % 6 // 2
    assert len(set(tree.tolist())) > 30 and set(part.tolist()) == {0, 1, 2}
    uv, quad_distance = quad_coordinates(buffer.position_frame_m[on_tree], instances.corners()[tree, part])
    assert quad_distance.max() < 1e-6 and uv.min() > -1e-9 and uv.max() < 1 + 1e-9
    alpha = alpha_at(instances, tree, part, uv)
    assert (alpha >= ALPHA_THRESHOLD).mean() > 0.9 and (alpha >= 0.25).mean() > 0.95  # half of them come from mipmaps
    height = buffer.height_m[on_tree]
    np.testing.assert_allclose(height, buffer.position_frame_m[on_tree][:, 2], atol=1e-4)
    assert (buffer.normal_frame[on_tree] @ UP)[part == 2] == pytest.approx(1.0, abs=1e-6)
    assert np.abs(buffer.normal_frame[on_tree] @ UP)[part < 2].max() < 1e-6


def test_tree_corners_match_their_closed_form(floor, make_wooded_scene):
    """Two upright quads cross, and a level one lies in between.

    They have the tree's height and crown, and are turned about its foot.
    """
    scene = make_wooded_scene(floor, [[120.0, -33.0]], height=16.0, crown=7.0)
    trees = scene.objects.trees
    instances = instances_of(scene, camera_at(scene, (120, -60, 5), (120, -33, 5)))
    corners = instances.corners()[0] - instances.base_frame_m[0]
    np.testing.assert_allclose(instances.base_frame_m[0] - [120, -33, 0], 0, atol=1e-9)
    rotation_rad = np.radians(float(trees.yaw_deg[0]))
    along_quad, across_quad = (
        np.array([np.cos(rotation_rad), np.sin(rotation_rad), 0]),
        np.array([-np.sin(rotation_rad), np.cos(rotation_rad), 0]),
    )
    top = np.array([0, 0, 16.0])
    for quad, side in ((0, along_quad), (1, across_quad)):
        expected = [-3.5 * side, 3.5 * side, 3.5 * side + top, -3.5 * side + top]
        np.testing.assert_allclose(corners[quad], expected, atol=1e-5)
    crown = np.array([0, 0, 16.0 * TREE_VARIANTS[int(trees.variant[0])].crown_quad_height])
    expected = [crown + 3.5 * (a * along_quad + b * across_quad) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    np.testing.assert_allclose(corners[2], expected, atol=1e-5)


def test_trees_on_the_globe_stand_upright_where_they_are(write_raster, make_wooded_scene):
    """Up is the ellipsoid's normal at the foot. It leans by 0.18 degrees at 20 km from a map frame's origin."""
    raster = write_raster(np.full((60, 60), 100.0, np.float32), UTM, 400_000.0, 6_400_000.0, 1000.0)
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(405_000, 455_000, 200), rng.uniform(6_345_000, 6_395_000, 200)])
    scene = make_wooded_scene(raster, places, UTM, height=30.0, crown=10.0)
    lon, lat = (v + 0.05 for v in (scene.world.anchor_lon_deg, scene.world.anchor_lat_deg))
    x, y = Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(lon, lat)
    frame = scene.world.frame_near(scene.elevation.crs, x, y)
    instances = tree_instances_in_map(scene.objects, frame, 0.5)
    assert instances is not None and len(instances) == 200
    top = instances.corners()[:, 0, 2:].mean(axis=1)
    earth = top @ frame.frame_from_earth + frame.origin_earth_m
    top_positions = np.stack(scene.world.map_position(scene.elevation.crs, earth), axis=-1)
    expected = scene.objects.trees_in_crs(scene.elevation.crs)[instances.tree_number]
    origin_distance_m = np.hypot(*instances.base_frame_m[:, :2].T)
    near = origin_distance_m < 20_000
    assert near.sum() > 20 and origin_distance_m[near].max() > 12_000
    np.testing.assert_allclose(top_positions[near] - expected[near], np.tile([0, 0, 30.0], (near.sum(), 1)), atol=0.02)


def test_tree_culling_keeps_every_tree_with_a_corner_inside(floor, make_wooded_scene):
    """Culling by cones and by boxes is compared with all corners of all trees."""
    rng = np.random.default_rng(5)
    scene = make_wooded_scene(
        floor, rng.uniform(-150, 150, (800, 2)), height=rng.uniform(3, 25, 800), crown=rng.uniform(2, 15, 800)
    )
    view = camera_at(scene, (20, -30, 9), (40, 60, 3), 40.0, (90, 60))
    instances = instances_of(scene, view)
    eye, camera = view.in_frame(view.frame(scene.world))
    corners = instances.corners().reshape(len(instances), 12, 3)
    camera_points = (corners - eye) @ camera.T
    half = np.array([45, 30]) / view.focal_px
    kept_trees = instances.in_frustum(eye, camera, np.column_stack([-half, half]))
    inside = (
        ((np.abs(camera_points[..., :2]) <= half * camera_points[..., 2:]) & (camera_points[..., 2:] > 0)).all(axis=2).any(axis=1)
    )
    assert 50 < inside.sum() < 500 and set(np.flatnonzero(inside)) <= set(kept_trees) and len(kept_trees) < 2 * inside.sum()
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    translation, low, high = rng.normal(size=3), np.array([-20.0, -30.0, -50.0]), np.array([60.0, 40.0, 50.0])
    camera_points = corners @ rotation.T + translation
    kept_trees = instances.in_box(rotation, translation, low, high)
    inside = ((camera_points >= low) & (camera_points <= high)).all(axis=2).any(axis=1)
    assert 20 < inside.sum() < 600 and set(np.flatnonzero(inside)) <= set(kept_trees) and len(kept_trees) < 3 * inside.sum()


# -- thinning


def test_drawn_share_in_perspective_follows_the_distance(floor, make_wooded_scene):
    """The share k is the square of a tree's height in pixels over ``FULL_STAND_TREE_PX``. Drawn trees grow by the root of 1 / k."""
    rng = np.random.default_rng(6)
    scene = make_wooded_scene(floor, rng.uniform(-390, 390, (20_000, 2)), height=5.0, crown=3.0)
    view = camera_at(scene, (0, -380, 30), (0, 0, 0), 50.0, (160, 100))
    trees, instances = scene.objects.trees, instances_of(scene, view)
    eye_distance_m = np.linalg.norm(trees.base_earth_m - view.eye_earth_m, axis=1)
    share = np.clip((5.0 * view.focal_px / eye_distance_m / module.FULL_STAND_TREE_PX) ** 2, module.MIN_DRAWN_TREE_SHARE, 1.0)
    np.testing.assert_array_equal(instances.tree_number, np.flatnonzero(trees.thinning_rank < share))
    assert share.max() == 1.0 and share.min() < 0.2
    scale = 1 / np.sqrt(share[instances.tree_number])
    crown_quad_height = np.array([TREE_VARIANTS[k].crown_quad_height for k in instances.variant])
    expected = np.stack([1.5 * scale, 1.5 * scale, 5.0 * scale, 5.0 * scale * crown_quad_height], axis=1)
    np.testing.assert_allclose(instances.quad_sizes_m, expected, rtol=1e-5)
    for nearer, farther in ((30, 150), (150, 300), (300, 450), (450, 700)):
        ring = (eye_distance_m >= nearer) & (eye_distance_m < farther)
        is_in_ring = ring[instances.tree_number]
        drawn_share, expected_share = is_in_ring.sum() / ring.sum(), share[ring].mean()
        assert drawn_share == pytest.approx(expected_share, abs=0.01)
        area = (instances.quad_sizes_m[is_in_ring, 0].astype(float) ** 2).sum() / (1.5**2 * ring.sum())
        assert area == pytest.approx(1.0, abs=0.03)  # crown area, and so shade, is kept


def test_turning_the_camera_changes_no_tree(floor, make_wooded_scene):
    rng = np.random.default_rng(7)
    scene = make_wooded_scene(floor, rng.uniform(-390, 390, (3000, 2)), height=5.0, crown=3.0)
    instance_sets = [
        instances_of(scene, camera_at(scene, (0, 0, 30), target)) for target in ((0, 100, 0), (-100, -20, 30), (0, 1e-9, 0))
    ]
    assert 0 < len(instance_sets[0]) < 3000
    for other in instance_sets[1:]:
        np.testing.assert_array_equal(other.tree_number, instance_sets[0].tree_number)
        np.testing.assert_array_equal(other.corners(), instance_sets[0].corners())


def test_drawn_share_in_a_map_follows_the_pixel_size(floor, make_wooded_scene):
    rng = np.random.default_rng(8)
    scene = make_wooded_scene(floor, rng.uniform(-390, 390, (8000, 2)), height=6.0, crown=4.0)
    frame = scene.world.frame_near(scene.elevation.crs, 0.0, 0.0)
    for pixel_m, share in ((0.5, 1.0), (4.0, (4.0 / 6.0) ** 2), (8.0, (4.0 / 12.0) ** 2), (100.0, module.MIN_DRAWN_TREE_SHARE)):
        instances = tree_instances_in_map(scene.objects, frame, pixel_m)
        assert instances is not None and len(instances) / 8000 == pytest.approx(share, abs=0.002)
        np.testing.assert_allclose(instances.quad_sizes_m[:, 0], 2.0 / np.sqrt(share), rtol=1e-5)
        x, y, _ = instances.base_frame_m.T
        for west in (-390, -130, 130):
            for south in (-390, -130, 130):
                all_bases = scene.objects.trees.base_earth_m
                inside = (
                    (all_bases[:, 0] >= west)
                    & (all_bases[:, 0] < west + 260)
                    & (all_bases[:, 1] >= south)
                    & (all_bases[:, 1] < south + 260)
                )
                drawn_count = ((x >= west) & (x < west + 260) & (y >= south) & (y < south + 260)).sum()
                assert drawn_count / inside.sum() == pytest.approx(share, abs=0.02)


def shadow_share(scene: Scene, view: PerspectiveView) -> float:
    """Return the share of shadow, by ground truth, on what a view shows of a stand and its ground."""
    buffer = geometry_buffer(scene, view)
    rays = truth.ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
    return float(1.0 - truth.lit_mask(buffer, scene, "sun", rays)[buffer.valid].mean())


@pytest.mark.parametrize(("altitude", "density"), [(60.0, 400.0), (25.0, 500.0)])
def test_a_thinned_stand_keeps_its_shade(gl, floor, make_scene, tmp_path, monkeypatch, altitude, density):
    """A quarter of a wood's trees, twice as large, gives the same mean share of shadow as all of them."""
    wood = shapely.to_wkb(np.array([shapely.box(-400, -400, 400, 400)], object))
    pyogrio.raw.write(tmp_path / "wood.gpkg", wood, [], [], geometry_type="Polygon", crs=ENGINEERING)
    spec = {"source": "wood.gpkg", "density": density, "height": [4.0, 4.0], "crown": [3.0, 3.0]}
    monkeypatch.setattr(module, "FULL_STAND_TREE_PX", 1e6)
    full_shares, thinned_shares = [], []
    for min_share, shares in ((1.0, full_shares), (0.25, thinned_shares)):
        monkeypatch.setattr(module, "MIN_DRAWN_TREE_SHARE", min_share)
        scene = make_scene(floor, 200.0, altitude, forest=[spec])
        for eye in ((0, -900, 500), (700, 600, 500), (-300, 100, 900)):
            view = camera_at(scene, eye, (0, 0, 0), 20.0, (160, 120))
            assert len(instances_of(scene, view)) == pytest.approx(density * 64 * min_share, rel=0.02)
            shares.append(shadow_share(scene, view))
    assert 0.15 < np.mean(full_shares) < 0.6
    assert abs(np.mean(thinned_shares) - np.mean(full_shares)) < 0.02


# -- cameras that circle a tree


def test_tree_quads_do_not_turn_towards_the_viewer(floor, make_wooded_scene):
    """The eyes are at one distance, where the tree is thinned and enlarged as distant trees are."""
    scene = make_wooded_scene(floor, [[30.0, 40.0]], height=5.0, crown=3.0)
    corner_sets = []
    for bearing in np.radians([0, 77, 180, 251]):
        eye = np.array([30.0, 40.0, 0.0]) + 42.0 * np.array([np.sin(bearing), np.cos(bearing), 0.4])
        view = camera_at(scene, eye, (30.0, 40.0, 0.0), 50.0, (60, 46))
        instances = instances_of(scene, view)
        assert instances.quad_sizes_m[0, 2] > 5.5  # drawn larger
        corner_sets.append(instances.corners() + view.frame(scene.world).origin_earth_m)
    for other in corner_sets[1:]:
        np.testing.assert_allclose(other, corner_sets[0], atol=1e-5)


def test_tree_instances_are_cached_while_a_mesh_moves(gl):
    """SpatialAce's figure flies. Its trees are the same objects at every second."""
    scene = build_scene(load_level(find_level("spatialace")))
    view = scene.view("main")
    assert isinstance(view, PerspectiveView)
    frame, eye = view.frame(scene.world), tuple(view.eye_earth_m)
    later_scene = scene.at_second(7.0)
    assert later_scene.objects is not scene.objects
    instances = tree_instances_in_perspective(scene.objects, frame, eye, view.focal_px)
    assert instances is not None and tree_instances_in_perspective(later_scene.objects, frame, eye, view.focal_px) is instances
    assert tree_instances_in_perspective(later_scene.objects, frame, (*eye[:2], eye[2] + 1.0), view.focal_px) is not instances
