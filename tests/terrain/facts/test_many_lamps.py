"""Of many lamps only those that reach a view make work: counted, not timed."""

from __future__ import annotations

import json

import pytest

from selector.planner.planner import make_plan
from shadows.render import render_frame
from terrain.describe import describe
from terrain.facts import light_facts
from terrain.level.level import load_level
from terrain.scene import build_scene

NEAR = {"near": {"kind": "spot", "position": [6, 0, 10], "target": [0, 0, 0], "intensity": 0.5}}
FAR = {
    f"far{number}": {"kind": "omni", "position": [400.0 - 7 * (number % 9), 400.0 - 7 * (number // 9), 3], "intensity": 1e-4}
    for number in range(60)
}
LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [900, 900], "cells": [30, 30]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 35},
    "views": {"eye": {"kind": "perspective", "eye": [-20, -28, 15], "target": [3, 2, 0], "fov": 30, "size": [48, 40]}},
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """With all lamps, and with the one that reaches."""
    folder, found = tmp_path_factory.mktemp("lamps"), []
    for name, lights in (("all", NEAR | FAR), ("near", NEAR)):
        path = folder / f"{name}.yaml"
        path.write_text(json.dumps({**LEVEL, "lights": lights}))
        found.append(build_scene(load_level(path)))
    return found


def test_only_lamps_that_reach_are_probed_planned_and_drawn(gl, scenes, monkeypatch):
    probed, own = [], light_facts._facts
    monkeypatch.setattr(
        light_facts, "_facts", lambda seen, lamp, share: probed.append(lamp and lamp.name) or own(seen, lamp, share)
    )
    frames, descriptors = [], []
    for scene in scenes:
        view = scene.view("eye")
        descriptors.append(describe(scene, view, "eye"))
        frames.append(render_frame(scene, view, make_plan(descriptors[-1], scene.loaded.level)))
    assert probed == [None, "near"] * 2 and len(descriptors[0].lamps) == 61
    many, few = frames
    assert many.plan.lights == few.plan.lights == ("sun", "near")
    assert [record.name for record in many.passes] == [record.name for record in few.passes]
    assert (many.color == few.color).all() and set(many.visibilities) == {"sun", "near"}
    why = {reasoned.name: reasoned.reason for reasoned in many.plan.reasons}
    assert why["lamps left out"] == "no light from far0, far1, far2 and 57 others reaches the view"


def test_lamps_that_are_forced_on_are_all_looked_at(scenes):
    scene = scenes[0]
    forced = scene.loaded.level.model_copy(update={"effects": {"lamps": "on"}})
    descriptor = describe(scene, scene.view("eye"), "eye")
    assert len(make_plan(descriptor, forced).lights) == 62


def test_in_a_map_a_lamp_beside_it_stays_in_the_plan(scenes):
    """It may stand for other maps of its scale, which that lamp reaches."""
    scene = scenes[0]
    view = scene.view("map", (-50.0, -50.0, 50.0, 50.0))
    descriptor = describe(scene, view)
    assert not all(lamp.reaches for lamp in descriptor.lamps)
    assert len(make_plan(descriptor, scene.loaded.level).lights) == 62
