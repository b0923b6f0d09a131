"""Comparisons: rows, their names and measurements, and the texel footprints that errors are compared with."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skugga.api.catalogue import find_level
from skugga.selector.candidates import MAX_CANDIDATES, candidates, name_of
from skugga.selector.measure.compare import (
    COUNTERS,
    Comparison,
    compare,
    measure_plan,
    picture_blocks,
    run_light,
    run_light_at_rest,
)
from skugga.selector.measure.footprint import texel_footprint_px
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.texels import texel_on_level_ground_m
from skugga.shadows.passes import PassLog
from skugga.shadows.render import render_frame
from skugga.shadows.truth.metrics import soft_error
from skugga.shadows.visibility import fill_steps, without_hidden_points
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.metrics import soft_truth
from tests.render import plan_of

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [80, 64]}

numbers = st.floats(-2.0, 2.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Scene of tetrahedra on a level floor."""
    path = tmp_path_factory.mktemp("comparison") / "figure.yaml"
    keys = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
        "meshes": [{"generate": "tetrahedra"}], "sun": {"azimuth": 200, "altitude": 35},
    }  # fmt: skip
    path.write_text(json.dumps(keys), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def comparison(scene) -> Comparison:
    """The comparison of all algorithms in the scene's view ``eye``."""
    return compare(scene, scene.view("eye"), "eye", time_limit_s=600.0)  # compilation must not use up the time limit


def test_compare_gives_rows_unique_names(gl, comparison):
    names = [row.figures["name"] for row in comparison.rows]
    assert len(set(names)) == len(names)
    assert {"shadow_map-2048-1-16", "perspective_shadow_map-1024-3-24", "shadow_volume", "shadow_volume-two_pass", "planar", "none",
            "hybrid-768-conservative", "hybrid-768-original", "shadow_map-1024-1-16-2cascades", "shadow_map-1024-1-32",
            "shadow_map-1024-1-16-polygon_offset", "relief=sweep,meshes=shadow_volume"} <= set(names)  # fmt: skip


def test_compare_counters_are_those_of_the_passes(gl, comparison):
    rows = {row.figures["name"]: row.figures for row in comparison.rows}
    assert all(tuple(figures["counters"]) == COUNTERS for figures in rows.values())
    volumes, hybrid = rows["shadow_volume"]["counters"], rows["hybrid-768-conservative"]["counters"]
    assert volumes["edges"] == hybrid["edges"] > 0 == volumes["marked"] == volumes["map_texels"]
    assert 0 < hybrid["tiles"] <= hybrid["marked"] < 80 * 64 and hybrid["map_texels"] > 0
    assert rows["perspective_shadow_map-512-1-24"]["counters"]["map_texels"] == 512**2
    assert rows["shadow_volume"]["wrong_cast"] < 0.01 > rows["hybrid-768-conservative"]["wrong_cast"]


def test_measure_plan_discards_the_cold_run_if_it_repeats(gl, scene):
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=64)
    for repeats, runs, cold in ((0, 1, True), (1, 1, False), (4, 4, False)):
        figures = measure_plan(scene, view, plan, repeats=repeats).figures
        assert (figures["runs"], figures["cold"]) == (runs, cold)
        assert figures["ms_p95"] >= figures["ms_median"] > 0.0
        assert list(figures["stages"]) == ["depth map", "visibility"]
        if runs == 1:
            assert all(ms > 0.0 for ms in figures["stages"].values())
            assert sum(figures["stages"].values()) <= figures["ms_median"] + 0.001


def test_run_light_draws_what_a_frame_draws(gl, scene):
    """The timed run includes the edge samples. Errors count the picture's own pixels."""
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=256)
    pictures = picture_blocks(scene, view)
    run = run_light(scene, pictures, plan, "sun")
    clear_caches("light")
    frame = render_frame(scene, view, plan, pixel_sampling="points")  # samples of shadow edges are not timed
    ((picture, _),) = pictures
    assert len(picture.buffer.valid) > picture.picture_rows == view.rows
    triangles = {name: record.triangles for name, record in run.log.records.items()}
    assert triangles == {record.name: record.triangles for record in frame.passes if record.name in triangles} != {}
    visibility = run.parts[0].copy()
    visibility[attached_shadow_mask(picture.pixel_buffer, scene, "sun")] = 0.0
    np.testing.assert_array_equal(np.where(picture.pixel_buffer.valid, visibility, np.nan), frame.visibility)


@pytest.fixture(scope="module")
def hazy(tmp_path_factory) -> Scene:
    """Return bodies near and far in dense haze, which hides the sun's effect on the far ones."""
    path = tmp_path_factory.mktemp("haze") / "hazy.yaml"
    keys = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
        "meshes": [{"generate": "tetrahedra"}], "sun": {"azimuth": 200, "altitude": 30}, "weather": {"visibility": 50},
    }  # fmt: skip
    path.write_text(json.dumps(keys), encoding="utf-8")
    return build_scene(load_level(path))


def test_compare_ignores_points_hidden_by_haze(gl, hazy):
    """Points that haze hides are not sampled, neither in rows nor in pictures, and no error counts them."""
    view = hazy.view("eye", size=(240, 192))
    requests = [{"algorithm": "shadow_map", "map_size": 256, "filter": 1}, {"algorithm": "shadow_volume"}]
    plans = [plan_of(hazy, view, **request) for request in requests]
    comparison = compare(hazy, view, "eye", plans=plans, time_limit_s=0.0)
    buffer = geometry_buffer(hazy, view)
    haze_mask = buffer.valid & ~without_hidden_points(buffer, hazy, "sun", {"haze"}).valid
    for row, plan in zip(comparison.rows, plans, strict=True):
        frame = render_frame(hazy, view, plan)
        visibility_u8 = np.rint(255.0 * np.nan_to_num(frame.visibility, nan=1.0)).astype(np.uint8)
        np.testing.assert_array_equal(row.visibility, np.where(haze_mask, 255, visibility_u8))
        unhazed_visibility = fill_steps(plan.steps_of_light("sun"), buffer, hazy, find_casters(hazy, buffer), (), PassLog())
        assert min(np.count_nonzero((unhazed_visibility < 0.5) & valid) for valid in (haze_mask, buffer.valid & ~haze_mask)) > 50
        assert not (row.false_shadow | row.missed_shadow)[haze_mask].any()
        assert not comparison.valid[haze_mask].any()
        assert row.figures["wrong_cast"] == measure_plan(hazy, view, plan).figures["wrong_cast"]


def test_compare_without_time_keeps_every_algorithm(gl, scene):
    limited = compare(scene, scene.view("eye"), "eye", time_limit_s=0.0)
    algorithms = {name for row in limited.rows for name in row.figures["algorithm"]["sun"].values()}
    assert algorithms == {
        "shadow_map", "perspective_shadow_map", "light_space_perspective_map", "shadow_volume", "hybrid",
        "reconstructed_volume", "planar", "sweep", "none",
    }  # fmt: skip
    assert all(row.figures["cold"] and row.figures["runs"] == 1 for row in limited.rows)
    all_names = {name_of(plan) for plan in candidates(scene, scene.view("eye"), "eye")}
    missing = all_names - {row.figures["name"] for row in limited.rows}
    assert "shadow_map-1024-1-16" in missing and missing == set(limited.left_out)


def test_compare_measures_named_rows_beyond_the_time_limit(gl, scene):
    names = ["shadow_map-1024-1-32", "shadow_map-1024-1-16"]
    comparison = compare(scene, scene.view("eye"), "eye", time_limit_s=0.0, only=names)
    assert sorted(row.figures["name"] for row in comparison.rows) == sorted(names) and not comparison.left_out
    with pytest.raises(InputError, match="only: 'sundial' is not allowed. Allowed: .*shadow_map-1024-1-32"):
        compare(scene, scene.view("eye"), "eye", only=["sundial"])


def test_soft_error_is_least_for_the_map_that_samples_the_disc(gl, scene):
    """The map that samples the disc comes nearest to truth of the disc.

    A view's error is that of all its pixels, within sampling noise.
    """
    view = scene.view("eye", size=(320, 256))
    plans = [plan_of(scene, view, algorithm="shadow_map", map_size=2048, filter=filter) for filter in (1, 3, "sun")]
    hard, taps, disc = (measure_plan(scene, view, plan).figures["soft_error"] for plan in plans)
    assert 0.0 < disc < min(hard, taps) < 0.05
    buffer = geometry_buffer(scene, view)
    real = soft_truth(buffer, scene, find_casters(scene, buffer))
    frame = render_frame(scene, view, plans[0])
    assert hard == pytest.approx(soft_error(frame.visibility, real), rel=0.1)


def test_compare_rows_are_consistent(gl, comparison):
    """Visibility classes, wrong pixels and figures agree with one another."""
    for row in comparison.rows:
        assert row.visibility.dtype == np.uint8 and row.visibility.shape == comparison.valid.shape
        assert (row.visibility[~comparison.valid] == 255).all()
        assert (row.visibility[row.false_shadow] < 128).all() and (row.visibility[row.missed_shadow] > 127).all()
        assert not (row.false_shadow & row.missed_shadow).any()
    rows = {row.figures["name"]: row for row in comparison.rows}
    assert rows["none"].missed_shadow.any() and not rows["none"].false_shadow.any()


@pytest.mark.parametrize(("front", "error"), [("pareto", "wrong_cast"), ("pareto_soft", "soft_error")])
def test_compare_marks_the_pareto_front(gl, comparison, front, error):
    rows = [row.figures for row in comparison.rows]
    assert comparison.error_metric == "wrong_cast"
    for row in rows:
        is_dominated = any(
            other["ms_median"] <= row["ms_median"] and other[error] <= row[error]
            and (other["ms_median"], other[error]) != (row["ms_median"], row[error])
            for other in rows
        )  # fmt: skip
        assert row[front] is not is_dominated


@pytest.mark.parametrize(
    ("level", "view", "light", "expected"),
    [
        ("spatialace", "main", "sun", {"relief+meshes=shadow_volume", "relief=sweep,meshes=hybrid-768-conservative", "none"}),
        ("thesis_street", "main", "lamp", {"shadow_map-1024-1-16", "shadow_volume", "planar", "hybrid-2048-conservative"}),
        ("jacksboro", "map", "sun", {"sweep", "sweep-sun", "shadow_map-1024-1-16-tight", "hybrid-768-original"}),
    ],
)
def test_candidates_of_bundled_levels(level, view, light, expected):
    """Candidates are few, and their names list every setting that distinguishes them."""
    scene = build_scene(load_level(find_level(level)))
    plans = candidates(scene, scene.view(view), view, light)
    names = [name_of(plan, light) for plan in plans]
    assert len(plans) <= MAX_CANDIDATES and len(set(names)) == len(names)
    assert len({repr((plan.algorithm[light], plan.settings.get(light))) for plan in plans}) == len(plans)
    assert all(any(name == part or name.startswith(part + ",") for name in names) for part in expected)
    if light != "sun":
        assert not any("cascades" in name or "=sweep" in name for name in names)


def test_candidates_vary_the_taps_of_the_default():
    """The first three candidates share the level's default algorithms."""
    scene = build_scene(load_level(find_level("jacksboro_wooded")))
    plans = candidates(scene, scene.view("village", size=(160, 128)), "village")
    assert {tuple(plan.algorithm["sun"].items()) for plan in plans[:3]} == {tuple(plans[0].algorithm["sun"].items())}
    assert {plan.settings["sun"]["meshes"].filter for plan in plans[:3]} == {1, 3, "sun"}


@given(st.lists(numbers, min_size=16, max_size=16), st.lists(numbers, min_size=3, max_size=3))
def test_texel_on_level_ground_matches_finite_differences(entries, point):
    matrix, point = np.reshape(entries, (4, 4)), np.array(point)
    assume(abs((matrix @ np.append(point, 1.0))[3]) > 0.3)

    def texels(position: np.ndarray) -> np.ndarray:
        mapped = matrix @ np.append(position, 1.0)
        return mapped[:2] / mapped[3]

    step = 1e-5
    slopes = np.stack([(texels(point + step * axis) - texels(point - step * axis)) / (2 * step) for axis in np.eye(3)[:2]])
    smallest_scale = np.linalg.svd(slopes, compute_uv=False)[1]
    assume(smallest_scale > 1e-3)
    assert texel_on_level_ground_m(matrix, point) == pytest.approx(1.0 / smallest_scale, rel=1e-3)


def test_texel_footprint_of_a_perspective_map_follows_the_eye(gl, scene):
    """Footprints are more even than a uniform map's, and the largest is smaller. Doubling the map size halves them."""
    view = scene.view("eye")
    buffer: GeometryBuffer = geometry_buffer(scene, view)
    floor = buffer.valid & (buffer.height_m == 0.0)
    spread, largest = {}, {}
    for name in ("shadow_map", "perspective_shadow_map"):
        (step,) = plan_of(scene, view, algorithm={"relief": name, "meshes": name}, map_size=512, cascades=1).steps
        size_px = texel_footprint_px(scene, step, buffer, 1.0)[floor]
        assert (size_px > 0.0).all()
        spread[name], largest[name] = size_px.max() / size_px.min(), size_px.max()
        halved = step.settings.model_copy(update={"map_size": 1024})
        if name == "perspective_shadow_map":
            finer_px = texel_footprint_px(scene, type(step)(step.light, step.kinds, step.algorithm, halved), buffer, 1.0)[floor]
            np.testing.assert_allclose(size_px / finer_px, 2.0, rtol=0.05)
    assert spread["perspective_shadow_map"] < spread["shadow_map"]
    assert largest["perspective_shadow_map"] < largest["shadow_map"]


def test_compare_measures_every_candidate(gl, scene, comparison):
    plans = candidates(scene, scene.view("eye"), "eye")
    assert [row.figures["name"] for row in comparison.rows] == [name_of(plan) for plan in plans]
    assert 30 <= len(plans) <= MAX_CANDIDATES


AT_REST = {
    "shadow_map": ("depth map",), "perspective_shadow_map": ("depth map",), "light_space_perspective_map": ("depth map",),
    "shadow_volume": ("silhouettes",), "hybrid": ("silhouettes", "map"),
}  # fmt: skip
"""Passes whose work is cached at rest, by algorithm: those that the cost model leaves out (``RESULTS_AT_REST``)."""


@pytest.mark.parametrize("algorithm", AT_REST)
def test_run_at_rest_takes_maps_and_volumes_from_caches(gl, scene, algorithm):
    """The same shadow comes of it. Nothing is drawn or found anew in the passes that are cached."""
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm=algorithm, map_size=512)
    pictures = picture_blocks(scene, view)
    anew, rest = run_light(scene, pictures, plan, "sun"), run_light_at_rest(scene, pictures, plan, "sun")
    np.testing.assert_array_equal(anew.parts[0], rest.parts[0])
    for stage in AT_REST[algorithm]:
        made, cached = ([record for name, record in run.log.records.items() if name.endswith(f": {stage}")] for run in (anew, rest))
        assert sum(record.kept for record in made) == 0, "a run with empty caches makes everything"
        assert sum(record.kept for record in cached) > 0 == sum(record.draws + record.triangles for record in cached)


def test_compare_times_frames_at_rest_in_perspective_views(gl, scene, comparison, tmp_path):
    times = {row.figures["name"]: row.figures["ms_at_rest"] for row in comparison.rows}
    assert all(ms is not None and ms >= 0.0 for ms in times.values())
    assert times["none"] == 0.0 < times["shadow_volume"]
    map_view = scene.view("map", size=(64, 64))
    (row,) = compare(scene, map_view, "map", only=[name_of(candidates(scene, map_view, "map", "sun")[0], "sun")]).rows
    assert row.figures["runs"] > 1 and row.figures["ms_at_rest"] is None
    moving = tmp_path / "moving.yaml"
    keys = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
        "meshes": [{"generate": "tetrahedra", "motion": {"spin": 30}}], "sun": {"azimuth": 200, "altitude": 35},
    }  # fmt: skip
    moving.write_text(json.dumps(keys), encoding="utf-8")
    turning = build_scene(load_level(moving))
    (row,) = compare(turning, turning.view("eye"), "eye", only=["shadow_volume"]).rows
    assert row.figures["runs"] > 1 and row.figures["ms_at_rest"] is None, "a level in which something moves is never at rest"
