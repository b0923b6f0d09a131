"""Many lamps: only those that reach a view cost work (counted, not timed), and no lamp is omitted whose light would be missed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects.lamps import negligible_lamps
from skugga.terrain.facts import light_facts
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

NEAR_LAMP = {"near": {"kind": "spot", "position": [6, 0, 10], "target": [0, 0, 0], "intensity": 0.5}}
FAR_LAMPS = {
    f"far{number}": {"kind": "omni", "position": [400.0 - 7 * (number % 9), 400.0 - 7 * (number // 9), 3], "intensity": 1e-4}
    for number in range(60)
}
BASE_LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [900, 900], "cells": [30, 30]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 35},
    "views": {"eye": {"kind": "perspective", "eye": [-20, -28, 15], "target": [3, 2, 0], "fov": 30, "size": [48, 40]}},
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Return two scenes: one with all lamps, and one with only the lamp that reaches."""
    folder, built_scenes = tmp_path_factory.mktemp("lamps"), []
    for name, lights in (("all", NEAR_LAMP | FAR_LAMPS), ("near", NEAR_LAMP)):
        path = folder / f"{name}.yaml"
        path.write_text(json.dumps({**BASE_LEVEL, "lights": lights}))
        built_scenes.append(build_scene(load_level(path)))
    return built_scenes


def test_only_lamps_that_reach_are_probed_planned_and_drawn(gl, scenes, monkeypatch):
    probed_lamps, original_facts = [], light_facts._facts_of_light
    monkeypatch.setattr(
        light_facts,
        "_facts_of_light",
        lambda view_probes, lamp, share: probed_lamps.append(lamp and lamp.name) or original_facts(view_probes, lamp, share),
    )
    frames, descriptors = [], []
    for scene in scenes:
        view = scene.view("eye")
        descriptors.append(describe(scene, view, "eye"))
        frames.append(render_frame(scene, view, make_plan(descriptors[-1], scene.loaded.level)))
    assert probed_lamps == [None, "near"] * 2 and len(descriptors[0].lamps) == 61
    all_lamps_frame, near_lamp_frame = frames
    assert all_lamps_frame.plan.lights == near_lamp_frame.plan.lights == ("sun", "near")
    assert [record.name for record in all_lamps_frame.passes] == [record.name for record in near_lamp_frame.passes]
    assert (all_lamps_frame.color == near_lamp_frame.color).all() and set(all_lamps_frame.visibilities) == {"sun", "near"}
    reasons = {reasoned.name: reasoned.reason for reasoned in all_lamps_frame.plan.reasons}
    assert reasons["lamps left out"] == "no light from far0, far1, far2 and 57 others reaches the view"


def test_lamps_that_are_forced_on_are_all_planned(scenes):
    scene = scenes[0]
    level_with_lamps_on = scene.loaded.level.model_copy(update={"effects": {"lamps": "on"}})
    descriptor = describe(scene, scene.view("eye"), "eye")
    assert len(make_plan(descriptor, level_with_lamps_on).lights) == 62


def test_a_map_s_plan_keeps_lamps_that_do_not_reach_it(scenes):
    """The plan may serve other maps of the same scale, which that lamp reaches."""
    scene = scenes[0]
    view = scene.view("map", (-50.0, -50.0, 50.0, 50.0))
    descriptor = describe(scene, view)
    assert not all(lamp.reaches for lamp in descriptor.lamps)
    assert len(make_plan(descriptor, scene.loaded.level).lights) == 62


DIM_LAMP_COUNT = 30
"""Number of lamps, each too dim to be seen alone."""


@pytest.fixture(scope="module")
def dim_scene(tmp_path_factory):
    """Return a dark plain under a ring of lamps, each just too dim to be seen alone."""
    path = tmp_path_factory.mktemp("dim") / "dim.yaml"

    def scene_of(count: int, intensity: float):
        angles = np.radians(np.arange(count) * 360.0 / DIM_LAMP_COUNT)
        lights = {
            f"dim{number}": {"kind": "omni", "position": [np.cos(a), np.sin(a), 150], "intensity": intensity}
            for number, a in enumerate(angles.tolist())
        }
        path.write_text(json.dumps({**BASE_LEVEL, "meshes": [], "sun": "none", "lights": lights}))
        return build_scene(load_level(path))

    def single_lamp_is_visible(intensity: float) -> bool:
        scene = scene_of(1, intensity)
        return describe(scene, scene.view("eye"), "eye").lamps[0].reaches

    low_intensity, high_intensity = 1e-9, 1.0
    assert single_lamp_is_visible(high_intensity) and not single_lamp_is_visible(low_intensity)
    while high_intensity / low_intensity > 1.02:
        middle = (low_intensity * high_intensity) ** 0.5
        low_intensity, high_intensity = (low_intensity, middle) if single_lamp_is_visible(middle) else (middle, high_intensity)
    return scene_of(DIM_LAMP_COUNT, low_intensity / 1.02)  # others of the ring are a little nearer


def test_lamps_too_dim_alone_are_seen_together(gl, dim_scene):
    scene, view = dim_scene, dim_scene.view("eye")
    descriptor, level = describe(scene, view, "eye"), scene.loaded.level
    colors = []
    for effects in ("auto", {"lamps": "on"}, {"lamps": "off"}):
        level_with_effects = level.model_copy(update={"effects": effects})
        colors.append(render_frame(scene, view, make_plan(descriptor, level_with_effects)).color.astype(int))
    auto_color, color_with_lamps, color_without_lamps = colors
    assert np.abs(color_with_lamps - color_without_lamps).max() >= 5, "all of them together are seen"
    assert np.abs(color_with_lamps - auto_color).max() <= 1
    left_out = [lamp for lamp in descriptor.lamps if not lamp.reaches]
    assert 0 < len(left_out) < 5, "the plan omits only a few lamps, whose sum is invisible"


def test_negligible_lamps_are_the_dimmest_within_the_limit():
    assert negligible_lamps({}, 1.0) == set()
    assert negligible_lamps({"a": 0.4, "b": 0.1, "c": 0.5, "d": 3.0}, 1.0) == {"a", "b", "c"}, (
        "a sum that is no more than the limit"
    )
    assert negligible_lamps({"a": 0.4, "b": 0.2, "c": 0.5, "d": 3.0}, 1.0) == {"a", "b"}
    assert negligible_lamps({"a": 0.9, "b": 0.9, "c": 0.9}, 1.0) == {"a"}
    light, other_light = np.array([0.9, 0.0]), np.array([0.0, 0.8])
    assert negligible_lamps({"a": light, "b": other_light}, 1.0) == {"a", "b"}, "no point has the light of both"
    assert negligible_lamps({"a": light, "b": other_light, "c": light}, 1.0) == {"b", "a"}
    assert negligible_lamps({"a": 0.0, "b": 2.0, "c": 0.0}, 0.0) == {"a", "c"}, "what does not shine at all is never missed"


@given(irradiances=st.dictionaries(st.text(max_size=3), st.integers(0, 10), max_size=12), limit=st.integers(0, 30))
def test_negligible_lamps_sum_to_the_limit_at_most(irradiances, limit):
    negligible = negligible_lamps(irradiances, limit)
    kept_lamps = irradiances.keys() - negligible
    total_light = sum(irradiances[name] for name in negligible)
    assert negligible <= irradiances.keys() and total_light <= limit
    assert all(irradiances[dim] <= irradiances[bright] for dim in negligible for bright in kept_lamps)
    assert not kept_lamps or total_light + min(irradiances[name] for name in kept_lamps) > limit, (
        "adding the dimmest kept lamp would exceed the limit"
    )
