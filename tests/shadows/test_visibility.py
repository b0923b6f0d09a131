"""Visibility of a light: the product of its steps, without sampling where haze hides the result."""

from __future__ import annotations

import json

import numpy as np
import pytest

from skugga.shadows.passes import PassLog
from skugga.shadows.visibility import fill_steps, with_apparent_sun, without_hidden_points
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [240, 192]}


@pytest.fixture(scope="module")
def hazy(tmp_path_factory) -> Scene:
    """Scene of tetrahedra in haze, under the sun and a lamp."""
    path = tmp_path_factory.mktemp("visibility") / "hazy.yaml"
    keys = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
        "meshes": [{"generate": "tetrahedra"}], "sun": {"azimuth": 200, "altitude": 30}, "weather": {"visibility": 50},
        "lights": {"lamp": {"kind": "omni", "position": [0, 0, 20]}},
    }  # fmt: skip
    path.write_text(json.dumps(keys), encoding="utf-8")
    return build_scene(load_level(path))


def visibility_and_haze_mask(scene: Scene, light: str, effects: set[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return a light's visibility at the points of the view (n,), and whether haze hides each."""
    view = scene.view("eye")
    buffer = geometry_buffer(scene, view)
    steps = plan_of(scene, view, algorithm="shadow_volume").steps_of_light(light)
    visibility = fill_steps(steps, buffer, scene, find_casters(scene, buffer), effects, PassLog())
    hidden_by_haze = buffer.valid & ~without_hidden_points(buffer, scene, "sun", {"haze"}).valid
    return visibility[buffer.valid], hidden_by_haze[buffer.valid]


def test_fill_steps_skips_the_sun_at_points_hidden_by_haze(gl, hazy):
    full_visibility, hidden_by_haze = visibility_and_haze_mask(hazy, "sun", set())
    haze_visibility, _ = visibility_and_haze_mask(hazy, "sun", {"haze"})
    assert (
        np.count_nonzero(full_visibility[hidden_by_haze] < 0.5) > 50
        and np.count_nonzero(full_visibility[~hidden_by_haze] < 0.5) > 50
    )
    assert (haze_visibility[hidden_by_haze] == 1.0).all()
    np.testing.assert_array_equal(haze_visibility[~hidden_by_haze], full_visibility[~hidden_by_haze])


def test_fill_steps_samples_lamps_in_any_haze(gl, hazy):
    full_visibility, _ = visibility_and_haze_mask(hazy, "lamp", set())
    haze_visibility, _ = visibility_and_haze_mask(hazy, "lamp", {"haze"})
    assert np.count_nonzero(full_visibility < 0.5) > 50
    np.testing.assert_array_equal(haze_visibility, full_visibility)


def test_without_hidden_points_keeps_all_points_of_a_map(hazy):
    buffer = geometry_buffer(hazy, hazy.view(size=(32, 32)))
    assert without_hidden_points(buffer, hazy, "sun", {"haze"}) is buffer


def test_fill_steps_multiplies_caster_kinds(gl, hazy):
    view = hazy.view("eye")
    buffer = geometry_buffer(hazy, view)
    casters = find_casters(hazy, buffer)
    overrides = {"algorithm": {"sun": {"relief": "shadow_map", "meshes": "shadow_volume"}}}
    steps = plan_of(hazy, view, **overrides).steps_of_light("sun")
    assert [step.algorithm for step in steps] == ["shadow_map", "shadow_volume"]
    combined = fill_steps(steps, buffer, hazy, casters, (), PassLog())
    separate = [fill_steps([step], buffer, hazy, casters, (), PassLog()) for step in steps]
    np.testing.assert_array_equal(combined[buffer.valid], (separate[0] * separate[1])[buffer.valid])
    assert (fill_steps([], buffer, hazy, casters, (), PassLog()) == 1.0).all()


def test_with_apparent_sun_without_refraction_lowers_the_sun(write_raster, make_scene):
    raster = write_raster(np.zeros((8, 8), np.float32), "EPSG:32633", 500_000, 5_300_000, 10.0)
    scene = make_scene(raster).with_sun(SunSpec(time="2024-06-21T20:30:00+02:00"))
    assert with_apparent_sun(scene, {"refraction"}) is scene
    assert with_apparent_sun(scene, ()).sun.altitude_deg < scene.sun.altitude_deg - 0.05
