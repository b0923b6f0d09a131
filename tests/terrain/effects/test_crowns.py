"""Light through crowns reaches leaves behind leaves, but none behind ground or meshes; normals hide the crossed quads."""

from __future__ import annotations

import json

import numpy as np
import pyogrio
import pytest
import shapely

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects.crowns import EFFECT, LEAF_TRANSMITTANCE, apply_crowns
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF, _write_leaf_shading
from skugga.terrain.geo.camera import look_at
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

TREE_HEIGHT_M = 12.0


@pytest.fixture
def make_wall_scene(tmp_path):
    """``make_wall_scene(**keys)`` builds a floor with a wall of ground 60 m high in its west, and a tree in its middle."""
    heights = np.zeros((64, 64), np.float32)
    heights[:, :6] = 60.0
    write_geotiff(tmp_path / "wall.tif", heights, ENGINEERING, -320.0, 320.0, 10.0)
    tree = shapely.to_wkb(np.array([shapely.Point(0.0, 0.0)], object))
    pyogrio.raw.write(tmp_path / "tree.gpkg", tree, [np.array([TREE_HEIGHT_M])], ["height"], geometry_type="Point", crs=ENGINEERING)

    def make(altitude=30.0, **keys) -> Scene:
        views = {
            "tree": {"kind": "perspective", "eye": [9, -30, 7], "target": [0, 0, 6], "fov": 30, "size": [160, 120]},
            "away": {"kind": "perspective", "eye": [9, -30, 7], "target": [30, -90, 6], "fov": 30, "size": [64, 48]},
        }
        level = {
            "version": 1, "terrain": {"source": "wall.tif"}, "sun": {"azimuth": 270, "altitude": altitude}, "views": views,
            "forest": [{"source": "tree.gpkg", "height": "height", "species": "broadleaf"}], **keys,
        }  # fmt: skip
        path = tmp_path / "level.yaml"
        path.write_text(json.dumps(level), encoding="utf-8")
        return build_scene(load_level(path))

    return make


def light_on_leaves(scene: Scene, points: np.ndarray, visibility: np.ndarray, kind: int = FOREST) -> np.ndarray:
    """Return the share of sunlight (n,) on leaves at points (n, 3), whose visibility by algorithms is ``visibility`` (n,)."""
    view = look_at(np.array([0.0, -40.0, 8.0]), np.array([0.0, 0.0, 6.0]), np.array([0.0, 0.0, 1.0]), 40.0, 1, len(points))
    frame = view.frame(scene.world)
    ones = np.ones((1, len(points)), np.float32)
    normal = np.broadcast_to(np.array([0.0, -1.0, 0.0], np.float32), (1, len(points), 3))
    position = ((points - frame.origin_earth_m) @ frame.frame_from_earth.T)[None]
    buffer = GeometryBuffer(view, frame, ones > 0, position, ones, normal, normal, 0 * ones, np.full(ones.shape, kind, np.uint8))
    sunlight = visibility[None].astype(np.float32)
    apply_crowns(sunlight, ShadingBlock(scene, view, buffer, {}))
    return sunlight[0]


LEAF_POINTS = np.array([[0.0, 0.0, 5.0], [3.0, 1.0, 8.0], [-4.0, 2.0, 11.0]])


def test_light_comes_through_leaves(make_wall_scene):
    scene = make_wall_scene()
    assert light_on_leaves(scene, LEAF_POINTS, np.zeros(3)) == pytest.approx(LEAF_TRANSMITTANCE)
    assert light_on_leaves(scene, LEAF_POINTS, np.full(3, 0.5)) == pytest.approx(0.5 + 0.5 * LEAF_TRANSMITTANCE)
    assert (light_on_leaves(scene, LEAF_POINTS, np.ones(3)) == 1.0).all()
    assert (light_on_leaves(scene, LEAF_POINTS, np.zeros(3), RELIEF) == 0.0).all()


def test_no_light_comes_through_ground(make_wall_scene):
    """The wall ends 260 m west of the tree. Its shadow there is 60 m high, less what the sun climbs over that distance."""
    low_sun_scene = make_wall_scene(altitude=8.0)  # 23 m over the floor at the tree
    assert (light_on_leaves(low_sun_scene, LEAF_POINTS, np.zeros(3)) == 0.0).all()
    over = LEAF_POINTS + [0.0, 0.0, 40.0]
    assert light_on_leaves(low_sun_scene, over, np.zeros(3)) == pytest.approx(LEAF_TRANSMITTANCE)


def test_edge_of_the_grounds_shadow_lies_at_one_height_of_a_crown(make_wall_scene):
    """The shadow of the wall ends where the sun's ray over its top passes, between cells as well as within them."""
    scene, heights_m = make_wall_scene(altitude=8.0), np.arange(0.0, 50.0, 0.25)
    columns = [np.array([[x, 1.0, height] for height in heights_m]) for x in (-31.0, -1.0, 29.0)]
    edges_m = []
    for points in columns:
        light = light_on_leaves(scene, points, np.zeros(len(points)))
        assert (np.diff(light) >= 0.0).all() and light[0] == 0.0 and light[-1] == pytest.approx(LEAF_TRANSMITTANCE)
        is_edge = (light > 0.0) & (light < 0.99 * LEAF_TRANSMITTANCE)
        assert 1 <= is_edge.sum() <= 1.5 / 0.25
        edges_m.append(heights_m[is_edge].mean())
    assert np.diff(edges_m) == pytest.approx(-30.0 * np.tan(np.radians(8.0)), abs=0.75)


def test_no_light_comes_through_a_house(make_wall_scene, tmp_path):
    house = shapely.to_wkb(np.array([shapely.box(-30.0, -20.0, -20.0, 20.0)], object))
    pyogrio.raw.write(tmp_path / "house.gpkg", house, [np.array([40.0])], ["height_m"], geometry_type="Polygon", crs=ENGINEERING)
    scene = make_wall_scene(meshes=[{"source": "house.gpkg"}])
    assert (light_on_leaves(scene, LEAF_POINTS, np.zeros(3)) == 0.0).all()
    assert light_on_leaves(scene, LEAF_POINTS + [0.0, 0.0, 50.0], np.zeros(3)) == pytest.approx(LEAF_TRANSMITTANCE)


def verdict(scene: Scene, name: str):
    """Return whether the view ``name`` requires the effect, and why."""
    return EFFECT.judge(describe(scene, scene.view(name), name))


def test_crowns_are_needed_where_sunlit_trees_are_seen(make_wall_scene):
    scene = make_wall_scene()
    assert verdict(scene, "tree").is_needed and "1 tree" in verdict(scene, "tree").reason
    assert "no tree" in verdict(scene, "away").reason and not verdict(scene, "away").is_needed
    assert "from above" in verdict(scene, "map").reason and not verdict(scene, "map").is_needed
    for dark_scene in (make_wall_scene(altitude=-8.0), make_wall_scene(weather={"cloud_cover": 1.0})):
        assert "no direct sunlight" in verdict(dark_scene, "tree").reason and not verdict(dark_scene, "tree").is_needed


def test_crowns_lighten_only_leaves_and_keep_visibility(gl, make_wall_scene):
    scene = make_wall_scene()
    view = scene.view("tree")
    frames = {}
    for setting in ("on", "off"):
        level = scene.loaded.level.model_copy(update={"effects": {"crowns": setting, "cast_shadows": "on"}})
        frames[setting] = render_frame(scene, view, make_plan(describe(scene, view, "tree"), level, {}))
    with_crowns, without_crowns = frames["on"], frames["off"]
    assert "crowns" in with_crowns.effects and "crowns" not in without_crowns.effects
    np.testing.assert_array_equal(with_crowns.visibility, without_crowns.visibility)
    change = with_crowns.color.astype(int) - without_crowns.color
    assert change.min() >= 0 and change.max() > 5
    # Only leaves change, and pixels that they cover in part.
    assert ((change > 0).any(axis=-1)).mean() < 0.3


def crown_normal(point: np.ndarray, eye: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return a crown's unit normal (3,) where a ray from an eye meets a point; its foot is (0, 0, 0)."""
    shading, albedo = np.empty(3, np.float32), np.empty(3, np.float32)
    _write_leaf_shading(point, point - eye, np.zeros(3), shape, np.zeros(3, np.uint8), shading, albedo)
    return shading / np.linalg.norm(shading)


def test_crown_normal_depends_on_the_ray_not_on_the_quad():
    shape, eye = np.array([4.0, 4.0, 12.0, 5.0], np.float32), np.array([3.0, -40.0, 8.0])
    target = np.array([-1.5, 0.0, 7.0])
    ray = target - eye
    point_on_first_quad = eye + ray * (-eye[1] / ray[1])  # the quad in the plane y = 0
    point_on_second_quad = eye + ray * (-eye[0] / ray[0])  # the quad in the plane x = 0
    assert crown_normal(point_on_first_quad, eye, shape) == pytest.approx(crown_normal(point_on_second_quad, eye, shape), abs=1e-5)


def test_crown_normals_are_those_of_a_round_crown():
    shape, eye = np.array([4.0, 4.0, 12.0, 5.0], np.float32), np.array([0.0, -400.0, 6.6])
    left, middle, right, top = (
        crown_normal(np.array([x, 0.0, z]), eye, shape) for x, z in ((-3.9, 6.6), (0.0, 6.6), (3.9, 6.6), (0.0, 12.0))
    )
    assert left[0] < -0.9 and right[0] > 0.9 and middle[1] < -0.9 and top[2] > 0.9
    np.testing.assert_allclose(left * [-1, 1, 1], right, atol=1e-5)
