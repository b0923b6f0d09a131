"""Cache of depth maps: a hit while their inputs are unchanged, a redraw otherwise, and a bounded number of targets."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.describe import describe
from skugga.terrain.gl.depth_targets import MAX_TARGET_BYTES, MAX_TARGETS, DepthTargets, depth_bytes
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING
from tests.render import plan_of

SceneBuilder = Callable[..., Scene]

EYE = {"kind": "perspective", "eye": [-35, -55, 14], "target": [4, 0, 3], "fov": 45, "size": [96, 72]}
LAMP = {"kind": "spot", "position": [-30, 10, 18], "target": [0, 0, 0], "cutoff": 40}


@pytest.fixture(scope="module")
def build(tmp_path_factory) -> SceneBuilder:
    """Return ``build(trees=3, **keys)``, a level of a floor, a box, two tetrahedra that turn, and some trees."""
    folder: Path = tmp_path_factory.mktemp("kept")
    trimesh.creation.box(extents=(8.0, 6.0, 5.0)).export(folder / "house.obj")
    for count in (3, 4):
        points = shapely.to_wkb([shapely.Point(12.0 - 9.0 * n, 14.0 - 4.0 * n) for n in range(count)])
        heights = np.full(count, 6.0)
        pyogrio.raw.write(folder / f"trees{count}.gpkg", points, [heights], ["height"], geometry_type="Point", crs=ENGINEERING)

    def level(trees: int = 3, **keys: Any) -> Scene:
        path = folder / "level.yaml"
        level_data = {
            "version": 1, "terrain": {"flat": {"size": [200, 200], "cells": [40, 40]}},
            "forest": [{"source": f"trees{trees}.gpkg", "height": "height"}],
            "meshes": [{"source": "house.obj", "at": [2, -6]}, {"generate": "tetrahedra", "at": [-14, 6], "motion": {"spin": 30}}],
            "sun": {"azimuth": 215, "altitude": 32}, "views": {"eye": EYE}, **keys,
        }  # fmt: skip
        path.write_text(json.dumps(level_data), encoding="utf-8")
        return build_scene(load_level(path))

    return level


def plan_eye(scene: Scene, **overrides: Any) -> Plan:
    """Return a plan of the view ``eye`` with one shadow map."""
    plan_overrides = {"algorithm": "shadow_map", "map_size": 256, "cascades": 1, **overrides}
    return make_plan(describe(scene, scene.view("eye"), "eye"), scene.loaded.level, plan_overrides)


def render_eye(scene: Scene, plan: Plan | None = None, **overrides: Any) -> Frame:
    """Render the view ``eye`` by a plan, or with overrides of the usual plan: points alone, as samples of edges have maps, too."""
    return render_frame(scene, scene.view("eye"), plan or plan_eye(scene, **overrides), pixel_sampling="points")


def count_draws_and_hits(frame: Frame) -> tuple[int, int]:
    """Return the draw calls of a frame's depth maps, and the number of cache hits."""
    records = [record for record in frame.passes if record.name.endswith("depth map")]
    assert records and [record.name for record in frame.passes] == frame.plan.passes
    return sum(record.draws for record in records), sum(record.kept for record in records)


def test_cached_map_serves_a_repeated_frame(gl, build):
    gl.depth_targets.clear()
    scene = build()
    first, second = render_eye(scene), render_eye(scene)
    assert count_draws_and_hits(first) == (3, 0) and count_draws_and_hits(second) == (0, 1)
    assert 0.005 < (first.visibility < 0.5).mean() < 0.6
    np.testing.assert_array_equal(first.visibility, second.visibility)
    np.testing.assert_array_equal(first.color, second.color)


def test_evicted_map_is_drawn_anew(gl, build):
    scene = build()
    first = render_eye(scene)
    gl.depth_targets.clear()
    second = render_eye(scene)
    assert count_draws_and_hits(second) == (3, 0)
    np.testing.assert_array_equal(first.visibility, second.visibility)


def test_cascades_and_lamps_have_separate_cache_entries(gl, build):
    gl.depth_targets.clear()
    scene = build(lights={"lamp": LAMP})
    plan = plan_eye(scene, cascades=3)
    count, _ = count_draws_and_hits(render_eye(scene, plan))
    maps = len(plan.settings["sun"]["relief"].cascades) + 1
    assert maps > 2 and 2 * maps < count <= 3 * maps  # ground and figures, and trees where some may cast into the map
    assert count_draws_and_hits(render_eye(scene, plan)) == (0, maps)


SETTING_CHANGES: dict[str, dict[str, Any]] = {
    "map size": {"map_size": 320},
    "depth bits": {"depth_bits": 32},
    "bias": {"bias": "normal_offset"},
    "culling": {"culling": "front"},
    "fit": {"fit": "tight"},
    "cascades": {"cascades": 2},
}


@pytest.mark.parametrize("name", SETTING_CHANGES)
def test_changed_setting_misses_the_cache(gl, build, name):
    gl.depth_targets.clear()
    scene = build()
    before = render_eye(scene)
    changed_frame = render_eye(scene, **SETTING_CHANGES[name])
    assert changed_frame.plan.settings != before.plan.settings
    assert count_draws_and_hits(changed_frame)[0] > 0 and count_draws_and_hits(changed_frame)[1] == 0
    assert count_draws_and_hits(render_eye(scene)) == (0, 1)  # the first map is still cached


def test_changed_scene_misses_the_cache(gl, build):
    """Sun, clock of motions, camera position and trees change under one plan, so that the scene alone causes the miss."""
    gl.depth_targets.clear()
    scene = build()
    plan = plan_eye(scene)
    render_eye(scene, plan)
    moved_scene = build(views={"eye": {**EYE, "eye": [-35.5, -55, 14]}})
    for changed_scene in (scene.with_sun(SunSpec(azimuth=215.5, altitude=32)), scene.at_second(1.0), moved_scene, build(trees=4)):
        assert count_draws_and_hits(render_eye(changed_scene, plan)) == (3, 0)


def test_changed_scene_shows_its_new_shadow(gl, build):
    """The picture after a motion equals the picture with an empty cache."""
    scene = build()
    plan = plan_eye(scene)
    render_eye(scene, plan)
    turned_frame = render_eye(scene.at_second(1.0), plan)
    gl.depth_targets.clear()
    np.testing.assert_array_equal(turned_frame.visibility, render_eye(scene.at_second(1.0), plan).visibility)
    assert (turned_frame.visibility != render_eye(scene, plan).visibility).any()


def test_maps_of_map_views_are_not_cached(gl, build):
    """Their pictures are cached instead: block by block, by the callers."""
    scene = build()
    view = scene.view(bounds=(-40, -40, 40, 40), size=(120, 120))
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=256)
    for _ in range(2):
        count, hit_count = count_draws_and_hits(render_frame(scene, view, plan, pixel_sampling="points"))
        assert count > 0 and hit_count == 0


def test_cache_key_survives_reused_addresses(gl, build):
    """New scenes may reuse the addresses of deleted ones. Each draws its own maps."""
    plan = None
    for number in range(12):
        scene = build(trees=3 + number % 2)
        plan = plan or plan_eye(scene)
        assert count_draws_and_hits(render_eye(scene, plan)) == (3, 0)
        del scene


TARGET_SHAPES = st.tuples(st.sampled_from([64, 512, 2048, 4096, 8192, 16384]), st.just(4096), st.sampled_from([16, 24, 32]))


@given(st.lists(st.tuples(TARGET_SHAPES, st.one_of(st.none(), st.integers(0, 5))), max_size=60))
def test_depth_targets_are_bounded_and_hold_their_last_content(requests):
    """Number and bytes are bounded, nothing leaks, and a content is found exactly while its target holds it."""
    alive: dict[int, tuple[int, int, int]] = {}
    numbers = itertools.count()

    def make(*shape: int) -> int:
        alive[number := next(numbers)] = shape
        return number

    targets = DepthTargets(make, alive.pop)
    target_contents: dict[int, int | None] = {}
    for shape, content in requests:
        cached_target = None if content is None else targets.get((shape, content))
        if cached_target is not None:
            assert target_contents[cached_target] == content and alive[cached_target] == shape
            continue
        target = targets.acquire(*shape)
        assert alive[target] == shape
        target_contents[target] = content
        if content is not None:
            targets.cache_content(target, (shape, content))
        assert targets.count == len(alive) <= MAX_TARGETS
        assert targets.nbytes == sum(depth_bytes(*alive_shape) for alive_shape in alive.values())
        assert targets.nbytes <= MAX_TARGET_BYTES or targets.count <= 2
    targets.clear()
    assert all(targets.get((shape, content)) is None for shape, content in requests if content is not None)


def test_depth_targets_are_reused_by_a_moving_camera():
    """A frame has three maps of three shapes, and every frame draws them anew. Soon no further target is created."""
    created_shapes: list[tuple[int, int, int]] = []

    def make(*shape: int) -> int:
        created_shapes.append(shape)
        return len(created_shapes)

    targets = DepthTargets(make, lambda _: None)
    shapes = (4096, 2560, 16), (4096, 4096, 16), (5120, 4096, 16)
    for frame in range(30):
        if frame == 10:
            created_shapes.clear()
        for shape in shapes:
            targets.cache_content(targets.acquire(*shape), (frame, shape))
    assert not created_shapes


def test_depth_targets_keep_the_previous_map():
    """The previous map stays, however large the targets are and whatever their shapes."""
    numbers = itertools.count()
    released: list[int] = []
    targets = DepthTargets(lambda *shape: next(numbers), released.append)
    previous_target = None
    for number, side in enumerate((16384, 16384, 8192, 16384, 64, 16384, 64)):
        target = targets.acquire(side, side, 32)
        targets.cache_content(target, number)
        assert previous_target is None or (previous_target not in released and targets.get(number - 1) == previous_target != target)
        targets.get(number)
        previous_target = target


def test_depth_targets_evict_the_least_recently_used():
    numbers = itertools.count()
    targets = DepthTargets(lambda *shape: next(numbers), lambda _: None)
    for number in range(3 * MAX_TARGETS):
        targets.cache_content(targets.acquire(64, 64, 24), number)
        assert targets.get(0) == 0
    assert targets.get(1) is None and targets.get(3 * MAX_TARGETS - 1) is not None
