"""Forward shadow mapping of the seeds' page: samples on a plane, a box over a plane against truth, and the verdict."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks.seeds import forward
from benchmarks.seeds.forward_mapping import EyePicture, splat_samples
from benchmarks.seeds.views import ViewWithTruth, view_with_truth, write_and_build_scene

ROWS = COLS = 8
EYE_HEIGHT_M = 10.0
SUN_DEPTH_M = 20.0
"""Depth of the map, metres below its first plane, which lies ``EYE_HEIGHT_M`` above the ground."""


def picture_from_above() -> EyePicture:
    """Return a picture of level ground from 10 m above it: 8 x 8 pixels of 1 m, whose middle is the origin of the frame."""
    lens = np.array([10.0, -3.5, -3.5, 1.0])
    col, row = np.meshgrid(np.arange(COLS) - 3.5, np.arange(ROWS) - 3.5)
    position = np.stack([col, -row, np.zeros((ROWS, COLS))], axis=-1)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    normal = np.zeros((ROWS, COLS, 3), np.float32)
    normal[..., 2] = 1.0
    return EyePicture(np.array([0.0, 0.0, EYE_HEIGHT_M]), axes, lens, np.ones((ROWS, COLS), np.bool_), position, normal)


def map_from_above(texel_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return an empty map of 16 x 16 texels under a sun overhead, and its matrix. The map's middle is the frame's origin."""
    matrix = np.array([
        [1.0 / texel_m, 0.0, 0.0, 8.0], [0.0, 1.0 / texel_m, 0.0, 8.0], [0.0, 0.0, -1.0 / SUN_DEPTH_M, 0.5], [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip
    return np.ones((16, 16), np.float32), matrix


def depth_of(height_m: float) -> float:
    """Return the depth of a height in ``map_from_above``."""
    return 0.5 - height_m / SUN_DEPTH_M


def test_points_fall_four_to_a_pixel_of_two_by_two_texels():
    depths, matrix = map_from_above(texel_m=0.5)
    depths[:] = depth_of(0.0)
    mask = splat_samples(depths, matrix, picture_from_above(), False, 0.0, 1e-7)
    assert (mask.counts == 4).all() and mask.samples == 256


def test_points_leave_holes_between_texels_larger_than_pixels():
    """Texels of 2 m reach every other pixel of every other row. Quads between their centres reach all pixels within these."""
    depths, matrix = map_from_above(texel_m=2.0)
    depths[:] = depth_of(0.0)
    points = splat_samples(depths, matrix, picture_from_above(), False, 0.0, 1e-7)
    assert points.is_lit.sum() == ROWS * COLS // 4
    quads = splat_samples(depths, matrix, picture_from_above(), True, 0.0, 1e-7)
    assert quads.is_lit.all()


@pytest.mark.parametrize("as_quads", [False, True])
def test_samples_above_the_ground_light_nothing_beyond_the_tolerance(as_quads):
    """Samples 1 m above the ground lie on another surface, unless a step of depths is as deep."""
    depths, matrix = map_from_above(texel_m=0.5)
    depths[:] = depth_of(1.0)
    assert not splat_samples(depths, matrix, picture_from_above(), as_quads, 0.5, 1e-7).is_lit.any()
    assert splat_samples(depths, matrix, picture_from_above(), as_quads, 0.5, 1.1 / SUN_DEPTH_M).is_lit.any()


def test_empty_texels_are_no_samples():
    depths, matrix = map_from_above(texel_m=0.5)
    depths[:8] = depth_of(0.0)  # the southern half
    mask = splat_samples(depths, matrix, picture_from_above(), False, 0.0, 1e-7)
    assert mask.samples == 128
    assert mask.is_lit[ROWS // 2 :].all() and not mask.is_lit[: ROWS // 2].any()


@pytest.fixture(scope="module")
def box_view(tmp_path_factory) -> ViewWithTruth:
    """Return a box on a floor under the sun, with its truth."""
    folder = tmp_path_factory.mktemp("box")
    trimesh.creation.box(extents=(8.0, 6.0, 5.0)).export(folder / "box.obj")
    eye = {"kind": "perspective", "eye": [-30, -40, 22], "target": [2, 2, 0], "fov": 35, "size": [160, 128]}
    level = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [12, 12]}}, "meshes": [{"source": "box.obj", "at": [0, 0]}],
        "sun": {"azimuth": 300, "altitude": 35}, "views": {"main": eye},
    }  # fmt: skip
    return view_with_truth(write_and_build_scene(level, folder), "main", (160, 128))


@pytest.mark.parametrize("map_kind", ["uniform", "perspective"])
def test_quads_draw_the_shadow_of_a_box(gl, box_view, map_kind):
    """A map of 1024 over 160 pixels has fine texels. Quads are right away from edges; points leave few holes."""
    depth_map, settings, texel_px = forward.fitted_map(box_view, map_kind)
    assert texel_px < 0.5
    mask = forward.forward(box_view, depth_map, settings, True, 0.5)
    errors = box_view.errors(box_view.with_attached_shadow(mask.is_lit.astype(np.float32)))
    assert errors["wrong_cast"] < 0.03 and errors["interior"] < 1e-3
    assert (~box_view.truth.lit & box_view.receivers).sum() > 200, "the box casts a shadow in the view"
    points = forward.forward(box_view, depth_map, settings, False, 0.5)
    lit = box_view.truth.lit & box_view.truth.decidable & box_view.receivers
    assert (lit & ~points.is_lit).sum() / lit.sum() < 0.02
    assert np.median(points.counts[lit]) >= 4.0


def test_figures_of_a_map_name_both_methods(gl, box_view, monkeypatch):
    monkeypatch.setattr(forward, "REPEATS", 1)
    figures = forward.measure_map(box_view, "uniform")
    assert figures["look-up"]["wrong_cast"] <= figures["quads"]["0.5"]["wrong_cast"] < 0.05
    assert set(figures["ms"]) == {"look-up", "points", "quads"} and min(figures["ms"].values()) > 0.0
    section = forward.make_section({"rows": [{"view": "street main", "map": kind, **figures} for kind in forward.MAP_KINDS]})
    assert len(section.claims) == 4 and len(section.tables[0][1]) == 2


def row_of(map_kind: str, error: float, ms: float) -> dict[str, Any]:
    """Return a row of figures: the look-up has an error of 1 % in 1 ms, quads ``error`` in ``ms``, points far more of both."""

    def by_tolerance(errors: dict[str, float]) -> dict[str, dict[str, float]]:
        return {tolerance: {"wrong_cast": value, "holes": 0.1, "doubles": 0.1, "used": 0.5} for tolerance, value in errors.items()}

    return {
        "view": "street main", "map": map_kind, "texel_px": 2.0, "look-up": {"wrong_cast": 0.01},
        "points": by_tolerance({"0": 0.5, "0.5": 0.4, "2": 0.5}), "quads": by_tolerance({"0": 0.9, "0.5": error, "2": 0.8}),
        "ms": {"look-up": 1.0, "points": 5.0, "quads": ms},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("error", "ms", "expected"), [(0.009, 0.9, True), (0.03, 0.9, False), (0.009, 2.0, False), (0.0099, 0.9, None)]
)
def test_promotion_needs_no_larger_errors_and_no_longer_time(error, ms, expected):
    figures = {"rows": [row_of(kind, error, ms) for kind in forward.MAP_KINDS]}
    assert forward.best_tolerance(figures, "quads") == "0.5"
    assert forward.promotion_verdict(figures) is expected
    assert forward.make_section(figures).claims[-1].verdict is expected
