"""Precedence of shadow settings: request, first matching pin of the level, level, policy."""

from __future__ import annotations

import json

import pytest

from skugga.selector.planner.planner import make_plan
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.level.level import SunSpec, load_level
from skugga.terrain.scene import build_scene

PINS = [
    {"view": "eye", "sun_altitude_deg": [5, 20], "algorithm": {"meshes": "shadow_volume"}},
    {"view": "eye", "map_size": 256},
    {"view": "map", "algorithm": {"meshes": "hybrid"}, "map_size": "auto"},
]
LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 12},
    "views": {"eye": {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "size": [64, 48]}, "map": {"kind": "map"}},
    "shadows": {"algorithm": {"meshes": "shadow_map"}, "map_size": 300, "pins": PINS},
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Scene of the level ``LEVEL``."""
    path = tmp_path_factory.mktemp("pins") / "mine.yaml"
    path.write_text(json.dumps(LEVEL))
    return build_scene(load_level(path))


def plan_and_reasons(scene, view, altitude=12.0, **overrides):
    """Return the plan of the view ``view`` under a sun of an altitude, and the reasons of its choices by name."""
    sunlit_scene = scene.with_sun(SunSpec(azimuth=200, altitude=altitude))
    plan = make_plan(describe(sunlit_scene, sunlit_scene.view(view), view), sunlit_scene.loaded.level, overrides)
    return plan, {reasoned.name: reasoned.reason for reasoned in plan.reasons}


def test_pin_overrides_the_level_and_says_so(scene):
    plan, reasons = plan_and_reasons(scene, "eye")
    assert plan.algorithm["sun"]["meshes"] == "shadow_volume"
    assert reasons["sun/meshes: shadow_volume"] == "pinned by the level for view eye, sun 5 to 20 degrees high"
    assert reasons["map_size 300"].startswith("set by the level, without effect"), "what a pin does not name is the level's"
    rejected = {reasoned.name: reasoned.reason for reasoned in plan.rejected}
    assert rejected["hybrid"] == "the level's pin for view eye, sun 5 to 20 degrees high sets none, shadow_volume"


def test_pin_of_another_sun_altitude_is_skipped(scene):
    plan, reasons = plan_and_reasons(scene, "eye", 25.0)
    settings = plan.settings["sun"]["meshes"]
    assert plan.algorithm["sun"]["meshes"] == "shadow_map" and settings.map_size == 256
    assert (reasons["sun/meshes: shadow_map"], reasons["map_size 256"]) == ("set by the level", "pinned by the level for view eye")


def test_pin_auto_leaves_the_setting_to_the_policy(scene):
    plan, reasons = plan_and_reasons(scene, "map")
    assert plan.algorithm["sun"]["meshes"] == "hybrid" and not any(name.startswith("map_size 300") for name in reasons)
    requested_plan = make_plan(describe(scene, scene.view("map"), "map"), scene.loaded.level, {"map_size": "auto"})
    assert plan.settings == requested_plan.settings


def test_request_overrides_a_pin_key_by_key(scene):
    plan, reasons = plan_and_reasons(scene, "eye", algorithm={"meshes": "planar"})
    assert plan.algorithm["sun"]["meshes"] == "planar" and reasons["sun/meshes: planar"] == "set by the request"
    plan, reasons = plan_and_reasons(scene, "eye", map_size=700)
    assert plan.algorithm["sun"]["meshes"] == "shadow_volume" and reasons["map_size 700"].startswith("set by the request")


def test_pin_with_an_unsupported_algorithm_names_its_key(scene):
    level = scene.loaded.level
    pin = level.shadows.pins[2].model_copy(update={"algorithm": {"meshes": "perspective_shadow_map"}})
    shadows = level.shadows.model_copy(update={"pins": (*level.shadows.pins[:2], pin)})
    with pytest.raises(UnsupportedError) as error:
        make_plan(describe(scene, scene.view("map"), "map"), level.model_copy(update={"shadows": shadows}))
    assert error.value.name == "shadows.pins.2.algorithm" and "no perspective" in str(error.value)
