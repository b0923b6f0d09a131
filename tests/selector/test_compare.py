"""Comparisons: rows that can be told apart, what they are measured by, and the size of texels that errors are held against."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from api.comparison import row_name
from selector import compare as compare_module
from selector.compare import COUNTERS, Comparison, candidates, compare, texel_footprint_px, texel_on_level_ground_m
from terrain.geometry import GeometryBuffer
from terrain.level import load_level
from terrain.picture import geometry_of
from terrain.scene import Scene, build_scene
from tests.render import plan_of

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [80, 64]}

numbers = st.floats(-2.0, 2.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    path = tmp_path_factory.mktemp("comparison") / "figure.yaml"
    keys = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
        "meshes": [{"generate": "tetrahedra"}], "sun": {"azimuth": 200, "altitude": 35},
    }  # fmt: skip
    path.write_text(json.dumps(keys), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def compared(scene) -> Comparison:
    return compare(scene, scene.view("eye"), "eye")


def test_rows_have_names_of_their_own(gl, compared):
    names = [row_name(row.figures) for row in compared.rows]
    assert len(set(names)) == len(names)
    assert {"shadow_map-512-1-16", "perspective_shadow_map-1024-3-24", "shadow_volume", "hybrid-768-conservative",
            "hybrid-768-original", "planar", "none"} <= set(names)  # fmt: skip


def test_counters_are_those_of_the_passes(gl, compared):
    rows = {row_name(row.figures): row.figures for row in compared.rows}
    assert all(tuple(figures["counters"]) == COUNTERS for figures in rows.values())
    volumes, hybrid = rows["shadow_volume"]["counters"], rows["hybrid-768-conservative"]["counters"]
    assert volumes["edges"] == hybrid["edges"] > 0 == volumes["marked"] == volumes["map_texels"]
    assert 0 < hybrid["tiles"] <= hybrid["marked"] < 80 * 64 and hybrid["map_texels"] > 0
    assert rows["perspective_shadow_map-512-1-24"]["counters"]["map_texels"] == 512**2
    assert rows["shadow_volume"]["wrong_cast"] < 0.01 > rows["hybrid-768-conservative"]["wrong_cast"]


def test_what_takes_long_is_measured_less_often(gl, scene, monkeypatch):
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=64)
    for enough_s, runs in ((60.0, 4), (0.0, 1)):
        monkeypatch.setattr(compare_module, "ENOUGH_S", enough_s)
        assert compare_module.measure(scene, view, plan, repeats=4).figures["runs"] == runs


@given(st.lists(numbers, min_size=16, max_size=16), st.lists(numbers, min_size=3, max_size=3))
def test_a_texel_on_level_ground_is_what_steps_on_it_say(entries, point):
    matrix, point = np.reshape(entries, (4, 4)), np.array(point)
    assume(abs((matrix @ np.append(point, 1.0))[3]) > 0.3)

    def texels(at: np.ndarray) -> np.ndarray:
        mapped = matrix @ np.append(at, 1.0)
        return mapped[:2] / mapped[3]

    step = 1e-5
    slopes = np.stack([(texels(point + step * axis) - texels(point - step * axis)) / (2 * step) for axis in np.eye(3)[:2]])
    least = np.linalg.svd(slopes, compute_uv=False)[1]
    assume(least > 1e-3)
    assert texel_on_level_ground_m(matrix, point) == pytest.approx(1.0 / least, rel=1e-3)


def test_texels_of_a_perspective_map_follow_the_eye(gl, scene):
    """In the picture they are more even than one uniform map's, and smaller at their largest; twice as many are half as large."""
    view = scene.view("eye")
    buffer: GeometryBuffer = geometry_of(scene, view)
    floor = buffer.there & (buffer.height_m == 0.0)
    spread, largest = {}, {}
    for name in ("shadow_map", "perspective_shadow_map"):
        (step,) = plan_of(scene, view, algorithm={"relief": name, "meshes": name}, map_size=512, cascades=1).steps
        size_px = texel_footprint_px(scene, step, buffer, 1.0)[floor]
        assert (size_px > 0.0).all()
        spread[name], largest[name] = size_px.max() / size_px.min(), size_px.max()
        halved = step.settings.model_copy(update={"map_size": 1024})
        if name == "perspective_shadow_map":
            finer = texel_footprint_px(scene, type(step)(step.light, step.kinds, step.algorithm, halved), buffer, 1.0)[floor]
            np.testing.assert_allclose(size_px / finer, 2.0, rtol=0.05)
    assert spread["perspective_shadow_map"] < spread["shadow_map"]
    assert largest["perspective_shadow_map"] < largest["shadow_map"]


def test_everything_that_is_a_candidate_is_a_row(gl, scene, compared):
    assert len(compared.rows) == len(list(candidates(scene, scene.view("eye"), "eye"))) == 21
