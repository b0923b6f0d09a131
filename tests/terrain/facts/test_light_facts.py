"""Light facts of views against known geometry."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.terrain.casters.rays import RayScene, trees_as_mesh
from skugga.terrain.describe import describe
from skugga.terrain.facts.caster_facts import drawn_trees_of
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX
from skugga.terrain.facts.leaf_rays import first_leaf_hits
from skugga.terrain.facts.mesh_rays import any_hit, bvh_of
from skugga.terrain.facts.probes import quasirandom, stratified_indices
from skugga.terrain.facts.silhouette_facts import mean_volume_layers, mesh_edges, projected_edge_length
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING


def scene_with_body(folder: Path, body: trimesh.Trimesh | None = None, size: float = 300.0, **keys) -> Scene:
    """Build a floor with one body on it, which stands at its own coordinates."""
    level = {"version": 1, "terrain": {"flat": {"size": [size, size], "cells": [30, 30]}}, **keys}
    if body is not None:
        body.export(folder / "body.ply")
        level["meshes"] = [{"source": "body.ply", "at": [0, 0]}]
    (folder / "level.yaml").write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(folder / "level.yaml"))


def plate(side: float, x: float, y: float, z: float) -> trimesh.Trimesh:
    """Return a horizontal square mesh around (x, y, z)."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 2 + [x, y, z]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def keep_body_height(body: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a body that keeps its height: its lowest point, a speck in a corner of the floor, stands on the floor."""
    speck = trimesh.Trimesh([[149.0, 149.0, 0.0], [149.01, 149.0, 0.0], [149.0, 149.01, 0.0]], [[0, 1, 2]], process=False)
    return trimesh.util.concatenate([body, speck])


def box_on_ground(size: tuple[float, float, float]) -> trimesh.Trimesh:
    """Return a box mesh that stands on the origin."""
    body = trimesh.creation.box(extents=size)
    body.apply_translation([0.0, 0.0, size[2] / 2])
    return body


SUN = {"azimuth": 180, "altitude": 45}
DOWN_VIEW = {"kind": "perspective", "eye": [0, -1, 250], "target": [0, 0, 0], "fov": 50, "size": [512, 512]}


def describe_map(scene: Scene) -> Descriptor:
    """Return the descriptor of the scene's map."""
    return describe(scene, scene.view("map", size=(300, 300)))


def test_the_shadow_of_a_plate_is_as_large_as_the_plate(tmp_path):
    facts = describe_map(scene_with_body(tmp_path, keep_body_height(plate(120.0, 0.0, -60.0, 140.0)), sun=SUN)).lights["sun"]
    assert facts.facing_share == 1.0
    assert facts.cast_share == pytest.approx(120.0**2 / 310.0**2, rel=0.1)  # half a cell more on each side of the ground
    assert facts.casts["meshes"].share == facts.cast_share
    assert facts.casts["relief"].share == 0.0


def test_facts_of_a_map_include_shadows_on_bodies(tmp_path):
    """Of two plates the higher one shades part of the lower one and hides the ground below. Planar shadows ignore both."""
    low_plate, high_plate = plate(100.0, 60.0, 60.0, 20.0), plate(60.0, 60.0, 20.0, 60.0)
    facts = (
        describe_map(scene_with_body(tmp_path, keep_body_height(trimesh.util.concatenate([low_plate, high_plate])), sun=SUN))
        .lights["sun"]
        .casts["meshes"]
    )
    # The sun stands at 45 degrees in the south: the shadow on the lower plate lies 40 m north of the higher one.
    on_top_m2 = 60.0 * 60.0 - 60.0 * 20.0
    assert facts.on_bodies == pytest.approx(on_top_m2 / 310.0**2, rel=0.35)
    ground = describe_map(scene_with_body(tmp_path, keep_body_height(high_plate), sun=SUN)).lights["sun"].casts["meshes"]
    assert ground.on_bodies == 0.0 and ground.share > 0.0


def test_band_differs_by_the_mean_texel_strip_along_edges(tmp_path):
    """In a texel of side k a place is on average k / 4 from the texel's point.

    The strip that differs along an edge is that wide.
    """
    (band,) = (
        describe_map(scene_with_body(tmp_path, keep_body_height(plate(120.0, 0.0, -60.0, 140.0)), sun=SUN))
        .lights["sun"]
        .casts["meshes"]
        .bands
    )
    assert band.near_m == 0.0 and band.far_m is None and band.pixel_m == pytest.approx(310.0 / 300.0)
    seen_m2 = 310.0**2 - 120.0**2
    for rung, rel in ((6, 0.35), (7, 0.25)):
        strip_m = TEXEL_SIZES_PX[rung] * band.pixel_m / 4.0
        expected = (240.0 * strip_m / np.sin(np.radians(45.0)) + 240.0 * strip_m) / seen_m2
        assert band.differs[rung] == pytest.approx(expected, rel=rel)
    assert band.differs[0] <= 0.01


@pytest.mark.parametrize("view", ["map", "down"])
def test_nothing_casts_on_an_empty_plain(tmp_path, view):
    scene = scene_with_body(tmp_path, sun=SUN, views={"down": DOWN_VIEW})
    facts = describe(scene, scene.view(view), view).lights["sun"]
    assert facts.cast_share == 0.0 and facts.nearest_edge_m is None
    assert all(not any(band.differs) for casting in facts.casts.values() for band in casting.bands)


def test_by_night_nothing_faces_the_sun(tmp_path):
    scene = scene_with_body(tmp_path, box_on_ground((10, 10, 10)), sun={"azimuth": 0, "altitude": -20}, views={"down": DOWN_VIEW})
    facts = describe(scene, scene.view("down"), "down").lights["sun"]
    assert (facts.facing_share, facts.cast_share, facts.casts) == (0.0, 0.0, {})


def test_shadow_of_a_ridge_has_its_closed_form_length(make_scene, write_raster):
    """The shadow reaches 100 m / tan(30 degrees) from the crest. The far side of the ridge faces away from the sun."""
    heights = np.zeros((64, 64), np.float32)
    heights[32] = 100.0
    scene = make_scene(write_raster(heights, "EPSG:32616", 700_000.0, 4_000_000.0, 30.0), 180.0, 30.0)
    facts = describe(scene, scene.view("map")).lights["sun"]
    cells = 100.0 / np.tan(np.radians(30.0)) / 30.0
    assert facts.casts["relief"].share == pytest.approx((cells - 1.0) / 64.0, rel=0.2)
    assert facts.facing_share == pytest.approx(1.0 - 1.0 / 64.0, abs=0.01)


@pytest.mark.parametrize(("altitude_deg", "share"), [(30.0, 0.5), (50.0, 0.0)])
def test_ground_casting_share_of_a_ridge(make_scene, write_raster, altitude_deg, share):
    """The northern half of a ridge with slopes of 45 degrees faces away from a sun in the south that is lower than that.

    If the ground has gaps, all of its triangles make shadow volumes. A map view has no such share.
    """
    views = {"above": {"kind": "perspective", "eye": [0, -200, 900], "target": [0, 0, 0], "fov": 60, "size": [64, 64]}}
    heights = np.float32(10.0) * np.repeat(32.0 - np.abs(np.arange(65) - 32.0)[:, None], 65, axis=1).astype(np.float32)

    def share_of(heights: np.ndarray) -> float | None:
        scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 0.0, 10.0), 180.0, altitude_deg, views=views)
        assert describe(scene, scene.view("map")).lights["sun"].ground_casting_share is None
        return describe(scene, scene.view("above"), "above").lights["sun"].ground_casting_share

    assert share_of(heights) == pytest.approx(share, abs=0.01)
    heights[20:24, 20:24] = np.nan
    assert share_of(heights) == 1.0


def test_nearest_shadow_edge_has_its_closed_form_distance(tmp_path):
    """Seen from above, the shadow of a wall ends as far north of the wall as the wall is high."""
    scene = scene_with_body(tmp_path, box_on_ground((100.0, 1.0, 40.0)), sun=SUN, views={"down": DOWN_VIEW})
    facts = describe(scene, scene.view("down"), "down").lights["sun"]
    assert 205.0 < facts.nearest_edge_m < 255.0
    assert facts.to_view_deg == pytest.approx(135.0, abs=1.0)
    assert 0.0 < facts.area_share < 1.0
    shares = [band.share for band in facts.casts["meshes"].bands]
    assert sum(shares) == pytest.approx(facts.facing_share)


def test_a_spot_lights_only_its_cone(tmp_path):
    """A cone of 20 degrees from 100 m lights a disc of 36 m.

    An omni light lights all of the floor, one face of the cube around it.
    """
    spot = {"kind": "spot", "position": [0, 0, 100], "target": [0, 0, 0], "cutoff": 20}
    scene = scene_with_body(
        tmp_path, sun="none", lights={"spot": spot, "omni": {"kind": "omni", "position": [0, 0, 100]}}, size=180.0
    )
    lights = describe(scene, scene.view("map")).lights
    radius = 100.0 * np.tan(np.radians(20.0))
    assert lights["spot"].facing_share == pytest.approx(np.pi * radius**2 / (180.0 * 31.0 / 30.0) ** 2, rel=0.05)
    assert lights["spot"].area_share == pytest.approx(1.0, abs=0.1)
    assert lights["omni"].facing_share == 1.0 and 0.1 < lights["omni"].area_share < 0.25
    (band,) = lights["spot"].casts["relief"].bands
    assert 100.0 <= band.light_m <= 100.0 / np.cos(np.radians(20.0))


def test_distance_of_a_lamp_from_the_eye(tmp_path):
    """The eye is at (0, -1, 250), the lamp at (3, 3, 250): 5 m apart. The sun and a map view have no such distance."""
    lamp = {"kind": "omni", "position": [3, 3, 250]}
    scene = scene_with_body(tmp_path, sun=SUN, lights={"lamp": lamp}, views={"down": DOWN_VIEW})
    lights = describe(scene, scene.view("down"), "down").lights
    assert lights["lamp"].eye_to_lamp_m == pytest.approx(5.0) and lights["sun"].eye_to_lamp_m is None
    assert describe(scene, scene.view("map")).lights["lamp"].eye_to_lamp_m is None


@pytest.mark.parametrize(("body", "edges"), [(box_on_ground((20, 30, 25)), 6), (plate(30.0, 0.0, 0.0, 20.0), 4)])
def test_silhouettes_of_box_and_plate_have_6_and_4_edges(tmp_path, body, edges):
    scene = scene_with_body(tmp_path, body, sun={"azimuth": 205, "altitude": 40}, views={"down": DOWN_VIEW})
    facts = describe(scene, scene.view("down"), "down").lights["sun"]
    assert facts.silhouette_edges == edges
    assert facts.silhouette_px > 0.0


def test_mesh_edges_are_shared_by_position():
    edges = mesh_edges(np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 2], [3, 4, 5]]))
    assert len(edges.ends) == 5 and (edges.triangle_pair[:, 1] >= 0).sum() == 1


def test_projected_length_is_clipped_to_the_picture():
    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    inside = np.array([[[-5.0, 0.0, 100.0], [5.0, 0.0, 100.0]]])
    half = np.array([[[0.0, 0.0, 10.0], [20.0, 0.0, 10.0]]])
    edges_behind_eye = np.array([[[-1.0, 0.0, -5.0], [1.0, 0.0, -5.0]]])
    assert projected_edge_length(inside, low, high) == pytest.approx(0.1)
    assert projected_edge_length(half, low, high) == pytest.approx(1.0)
    assert projected_edge_length(edges_behind_eye, low, high) == 0.0


@pytest.mark.parametrize(
    ("light", "is_positional"), [(np.array([0.0, 0.0, 1.0]), False), (np.array([5.0, 0.0, 20.0]), True)], ids=["sun", "lamp"]
)
def test_mean_volume_layers_counts_sides_before_points(light, is_positional):
    """An edge 10 m up runs from x = 0 to 10. Its volume side hangs down from it, and is wider below a lamp."""
    ends = np.array([[[0.0, 0.0, 10.0], [10.0, 0.0, 10.0]]])
    start = np.tile([5.0, -20.0, 5.0], (4, 1))
    rays = np.array([[0.0, 40.0, 0.0], [0.0, 10.0, 0.0], [0.0, 40.0, 20.0], [12.0, 40.0, 0.0]])
    through_layers, short_layers, above_layers, triangle_pair_layers = (
        mean_volume_layers(ends, light, is_positional, start[:1], ray[None]) for ray in rays
    )
    assert (through_layers, short_layers, above_layers) == (1.0, 0.0, 0.0)
    assert triangle_pair_layers == (1.0 if is_positional else 0.0)
    assert mean_volume_layers(ends, light, is_positional, start, rays) == pytest.approx((2.0 if is_positional else 1.0) / 4.0)


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.integers(1, 300))
def test_any_hit_agrees_with_embree(seed, count):
    rng = np.random.default_rng(seed)
    vertices = np.repeat(rng.uniform(-10, 10, (count, 1, 3)), 3, axis=1) + rng.uniform(-2, 2, (count, 3, 3))
    vertices, triangles = vertices.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    start, ray_direction = rng.uniform(-12, 12, (200, 3)), rng.normal(size=(200, 3))
    ray_direction /= np.linalg.norm(ray_direction, axis=1, keepdims=True)
    length = rng.uniform(1.0, 20.0, 200)
    tree = bvh_of(vertices, triangles)
    is_hit = any_hit(tree, start - tree.origin_earth_m, ray_direction, length)
    expected = RayScene(meshes=[(vertices, triangles)]).is_blocked(start, ray_direction, length)
    assert (is_hit != expected).sum() <= 1  # one that grazes an edge in float32


def test_first_leaf_hits_agree_with_embree(tmp_path):
    places = np.random.default_rng(3).uniform(-60, 60, (150, 2))
    wkb = shapely.to_wkb(shapely.points(places))
    pyogrio.raw.write(tmp_path / "trees.gpkg", wkb, [np.full(150, 12.0)], ["height"], geometry_type="Point", crs=ENGINEERING)
    view = {"kind": "perspective", "eye": [0, -150, 60], "target": [0, 0, 0], "fov": 50, "size": [512, 512]}
    scene = scene_with_body(tmp_path, sun=SUN, forest=[{"source": "trees.gpkg", "height": "height"}], views={"main": view})
    trees = drawn_trees_of(scene, scene.view("main"))
    rng = np.random.default_rng(5)
    start = np.column_stack([rng.uniform(-60, 60, (500, 2)), rng.uniform(0.1, 5.0, 500)])
    ray_directions = np.tile(scene.sun.to_sun_earth, (500, 1))
    hits, _ = first_leaf_hits(trees, start, ray_directions, np.full(500, np.inf))
    expected = RayScene(alpha_meshes=[trees_as_mesh(trees)]).is_blocked(start, ray_directions)
    assert 0.1 < expected.mean() < 0.9
    assert (np.isfinite(hits) == expected).mean() >= 0.97
    facts = describe(scene, scene.view("main"), "main")
    forest = facts.lights["sun"].casts["forest"]
    assert forest.share > 0.02
    (forest_facts,) = (stand_facts for stand_facts in facts.stands if stand_facts.kind == "forest")
    assert (forest_facts.count, forest_facts.triangles, forest_facts.alpha_share) == (150, 900, 1.0)
    assert forest_facts.height_m == pytest.approx(12.0) and 0.0 < forest_facts.leaf_gap_m < forest_facts.width_m


@given(st.integers(0, 5000), st.integers(1, 2000))
def test_stratified_indices_are_distinct_and_ordered(size, count):
    indices = stratified_indices(size, count)
    assert len(indices) == min(size, count)
    assert (np.diff(indices) > 0).all() and (not len(indices) or (indices[0] >= 0 and indices[-1] < size))


def test_quasirandom_points_are_evenly_spread():
    counts = np.histogram2d(*quasirandom(np.arange(1024)).T, bins=8, range=[[0, 1], [0, 1]])[0]
    assert counts.min() >= 12 and counts.max() <= 20
