"""Shadows of moving meshes and lamps: boxes on paths under the sun, and posts in the light of moving lamps.

Everything stands on level ground, so each shadow is known: the outline of the box's projected corners.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import trimesh

from skugga.shadows.point.horizon import load_surroundings, sees_sun
from skugga.shadows.point.place import place_at
from skugga.shadows.render import Frame
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import render, render_points

MARGIN_M = 0.35
"""Distance from an outline within which a pixel (0.5 m in the map) may be wrong."""

BOX_M = (4.0, 6.0, 3.0)

MOTION_PATH = [{"seconds": 0, "position": [22, 20]}, {"seconds": 10, "position": [82, 60, 24]}]
"""Start and stop are symmetric, so half the time is half-way in position and height. The shadow falls west by the height."""

POST_MESH = {"source": "box.ply", "at": [50, 50]}

EYE_POSITION = [50, -60, 55]

ALGORITHMS = ("shadow_map", "shadow_volume", "hybrid", "truth")

Build = Callable[..., Scene]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Return ``build(**keys)``: the scene of a level over level ground of 200 m, with a box on its base in a file beside it."""
    box = trimesh.creation.box(extents=BOX_M)
    box.apply_translation([0.0, 0.0, BOX_M[2] / 2])
    box.export(tmp_path / "box.ply")
    eye = {"kind": "perspective", "eye": EYE_POSITION, "target": [50, 35, 0], "fov": 50, "size": [320, 240]}

    def make(**keys: Any) -> Scene:
        path = tmp_path / "level.yaml"
        terrain = {"flat": {"size": [200, 200], "cells": [40, 40]}}
        level = {"version": 1, "terrain": terrain, "sun": {"azimuth": 90, "altitude": 45}, "views": {"eye": eye}, **keys}
        path.write_text(json.dumps(level), encoding="utf-8")
        return build_scene(load_level(path))

    return make


def moving_box(*keyframes: dict, **motion: Any) -> dict:
    """Return the keys of a moving box mesh. ``motion`` are further keys of its motion."""
    return {"source": "box.ply", "motion": {"path": list(keyframes), **motion}}


def view_of(scene: Scene, kind: str) -> MapView | PerspectiveView:
    """Return a view of a kind: ``map`` or ``perspective``."""
    return scene.view("eye") if kind == "perspective" else scene.view(bounds=(4, 4, 92, 76), size=(176, 144))


def box_corners(at: tuple[float, float, float]) -> np.ndarray:
    """Return the corners (8, 3) of the box at a position."""
    east, north, up = np.meshgrid(*[[-0.5, 0.5]] * 2, [0.0, 1.0])
    return np.column_stack([east.ravel(), north.ravel(), up.ravel()]) * BOX_M + at


def projected_shadow(points: np.ndarray, lamp: tuple[float, float, float] | None = None) -> shapely.Polygon:
    """Return the shadow of corners on the ground: under the sun from the east at 45 degrees, or in a lamp's light."""
    if lamp is None:
        return shapely.convex_hull(shapely.multipoints(points[:, :2] - points[:, 2:] * [1.0, 0.0]))
    source = np.array(lamp)
    ray_scale = source[2] / (source[2] - points[:, 2:])
    return shapely.convex_hull(shapely.multipoints((source + (points - source) * ray_scale)[:, :2]))


def check_shadow(scene: Scene, frame: Frame, light: str, outline: shapely.Polygon, lit: shapely.Polygon | None = None) -> None:
    """Check that the ground within an outline is in a light's shadow, and no other ground that the light reaches (``lit``)."""
    position = frame_points(scene, frame)
    ground = (frame.height_m < 1e-3) & np.isfinite(frame.height_m)
    ground_points = shapely.points(position[..., :2])
    dark = frame.visibilities[light] < 0.5
    inside = ground & shapely.within(ground_points, outline.buffer(-MARGIN_M))
    outside = ground & ~shapely.within(ground_points, outline.buffer(MARGIN_M))
    if lit is not None:
        inside, outside = inside & shapely.within(ground_points, lit), outside & shapely.within(ground_points, lit)
    assert inside.sum() > 20 and outside.sum() > 500
    assert dark[inside].all() and not dark[outside].any(), (dark[inside].mean(), dark[outside].sum())


def frame_points(scene: Scene, frame: Frame) -> np.ndarray:
    """Return east, north and height (rows, cols, 3) of a frame's pixels."""
    buffer = geometry_buffer(scene, frame.view)
    return buffer.frame.points_to_earth(buffer.position_frame_m)


# -- boxes under the sun


@pytest.mark.parametrize("kind", ["map", "perspective"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_moving_box_casts_its_shadow_at_each_second(gl, build, algorithm, kind):
    scene = build(meshes=[moving_box(*MOTION_PATH)])
    for seconds, at in ((0.0, (22, 20, 0)), (5.0, (52, 40, 12)), (10.0, (82, 60, 24)), (99.0, (82, 60, 24))):
        later = scene.at_second(seconds)
        frame = render_points(later, view_of(later, kind), algorithm=algorithm, map_size=1024, filter=1)
        assert frame.plan.algorithm[SUN]["meshes"] == algorithm
        check_shadow(later, frame, SUN, projected_shadow(box_corners(at)))


def test_moving_box_casts_into_a_distant_view(gl, build):
    """The box is 60 m high and 60 m east of its shadow. The map shows only the shadow."""
    keyframes = [{"seconds": 0, "position": [-90, 0, 9]}, {"seconds": 8, "position": [70, 10, 60]}]
    scene = build(meshes=[moving_box(*keyframes)]).at_second(8.0)
    view = scene.view(bounds=(2, 2, 26, 26), size=(80, 80))
    for algorithm in ALGORITHMS:
        frame = render_points(scene, view, algorithm=algorithm, map_size=1024, filter=1)
        check_shadow(scene, frame, SUN, projected_shadow(box_corners((70, 10, 60))))


def test_moving_box_casts_in_perspective_shadow_maps(gl, build):
    scene = build(meshes=[moving_box(*MOTION_PATH)])
    for seconds, at in ((5.0, (52, 40, 12)), (10.0, (82, 60, 24))):
        later = scene.at_second(seconds)
        frame = render_points(
            later, later.view("eye"), algorithm={"relief": "none", "meshes": "perspective_shadow_map"}, map_size=2048, filter=1
        )
        check_shadow(later, frame, SUN, projected_shadow(box_corners(at)))


def test_moving_box_shades_a_point_report(build):
    """Rays of a point report do not depend on pictures. The point lies as far west of the box as the box is high."""
    scene = build(meshes=[moving_box(*MOTION_PATH)])
    for seconds, east, north in ((0.0, 19.5, 20.0), (5.0, 39.0, 40.0), (10.0, 57.0, 60.0)):
        for second in (0.0, 5.0, 10.0):
            later = scene.at_second(second)
            surroundings = load_surroundings(later, place_at(later, (east, north)))
            assert sees_sun(surroundings, np.array([90.0]), np.array([45.0])).tolist() == [second != seconds]


def test_moving_box_caches_are_keyed_by_second(gl, build):
    """Seconds alternate with cached maps and volumes. Each picture equals the picture of its second with a fresh scene."""
    scene, fresh_frames = build(meshes=[moving_box(*MOTION_PATH)]), {}
    seconds = (0.0, 7.0, 0.0, 3.0, 7.0)
    for algorithm in ("shadow_map", "shadow_volume", "hybrid"):
        for second in seconds:
            fresh_scene = build(meshes=[moving_box(*MOTION_PATH)], seconds=second)
            fresh_frames[second] = render(fresh_scene, fresh_scene.view("eye"), algorithm=algorithm)
        for second in seconds:
            later = scene.at_second(second)
            frame = render(later, later.view("eye"), algorithm=algorithm)
            np.testing.assert_array_equal(frame.visibility, fresh_frames[second].visibility)
            np.testing.assert_array_equal(frame.color, fresh_frames[second].color)
    assert (fresh_frames[0.0].visibility != fresh_frames[7.0].visibility).any()


def test_descriptor_of_a_moving_level_follows_the_second(build):
    scene = build(meshes=[{**moving_box(*MOTION_PATH), "scale": 4}])
    descriptors = {second: describe(scene.at_second(second), scene.view("eye"), "eye") for second in (0.0, 10.0)}
    assert all(descriptor.moves for descriptor in descriptors.values())
    assert [descriptor.tallest_m for descriptor in descriptors.values()] == pytest.approx([12.0, 36.0])
    edge_m = [descriptor.lights[SUN].nearest_edge_m for descriptor in descriptors.values()]
    outlines = [projected_shadow(box_corners((0, 0, 0)) * 4.0 + at) for at in ((22, 20, 0), (82, 60, 24))]
    assert edge_m == pytest.approx(
        [np.hypot(outline.distance(shapely.Point(*EYE_POSITION[:2])), EYE_POSITION[2]) for outline in outlines], rel=0.08
    )
    assert not describe(build(), build().view("eye"), "eye").moves


# -- moving lamps


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_moving_spot_casts_a_posts_shadow_at_each_second(gl, build, algorithm):
    """The spot's target moves, too."""
    keyframes = [
        {"seconds": 0, "position": [20, 50, 12], "target": [54, 50, 0]},
        {"seconds": 6, "position": [60, 80, 18], "target": [50, 46, 0]},
    ]
    lamp = {"kind": "spot", "cutoff": 40, "motion": {"path": keyframes}}
    scene = build(sun="none", meshes=[POST_MESH], lights={"lamp": lamp})
    for seconds, at, target in ((0.0, (20, 50, 12), (54, 50)), (3.0, (40, 65, 15), (52, 48)), (6.0, (60, 80, 18), (50, 46))):
        later = scene.at_second(seconds)
        lamp_now = later.lamps["lamp"]
        np.testing.assert_allclose(lamp_now.position_earth_m, at, atol=1e-6)
        aim = np.array([*target, 0.0]) - at
        np.testing.assert_allclose(lamp_now.earth_from_lamp[:, 2], aim / np.linalg.norm(aim), atol=1e-6)
        frame = render_points(
            later, later.view(bounds=(18, 18, 82, 82), size=(128, 128)), algorithm=algorithm, map_size=1024, filter=1
        )
        check_shadow(later, frame, "lamp", projected_shadow(box_corners((50, 50, 0)), at), lit=shapely.Point(target).buffer(10.0))


@pytest.mark.parametrize("algorithm", ["shadow_map", "shadow_volume", "truth"])
def test_looping_omni_light_casts_a_posts_shadow_all_around(gl, build, algorithm):
    """The light moves around the post in a square above sea level. The test takes each corner, also after whole loops."""
    ring = [(70, 70), (30, 70), (30, 30), (70, 30), (70, 70)]
    path = [{"seconds": 4 * n, "position": [*at, 9]} for n, at in enumerate(ring)]
    lamp = {"kind": "omni", "motion": {"path": path, "loop": True, "above": "sea"}}
    scene = build(sun="none", meshes=[POST_MESH], lights={"lamp": lamp})
    for seconds in (0.0, 4.0, 16.0 * 50 + 8.0, -4.0):
        at = (*ring[int(seconds / 4) % 4], 9)
        later = scene.at_second(seconds)
        frame = render_points(
            later, later.view(bounds=(18, 18, 82, 82), size=(128, 128)), algorithm=algorithm, map_size=1024, filter=1
        )
        check_shadow(later, frame, "lamp", projected_shadow(box_corners((50, 50, 0)), at), lit=shapely.box(20, 20, 80, 80))


def test_at_second_shares_meshes_if_only_lamps_move(build):
    """A later second makes no copy of the meshes. Without any motion it makes no copy of the scene."""
    lamp = {"kind": "omni", "motion": {"path": [{"seconds": 0, "position": [0, 0, 9]}, {"seconds": 9, "position": [9, 0, 9]}]}}
    house = {"source": "box.ply", "at": [0, 0]}
    scene = build(meshes=[house], lights={"lamp": lamp, "other": {"kind": "omni", "position": [5, 5, 5]}})
    later = scene.at_second(4.0)
    assert later.objects is scene.objects and later.lamps["other"] is scene.lamps["other"]
    assert later.lamps["lamp"] is not scene.lamps["lamp"] and describe(later, later.view()).moves
    assert (static_scene := build(meshes=[house])).at_second(4.0) is static_scene
