"""The policy ``measure_plan``: thinned views are parts of the full ones, and who wins on them is who meets the target."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from selector.choices import Choice
from selector.measure import measuring, trials
from selector.measure.compare import measure_plan
from selector.measure.measuring import LightTrials, TargetBounds, confirm_winners, measured_plan, measured_rows, winners
from selector.measure.subsampled import subsampled_truth
from selector.measure.trials import Candidate, Trial, part_of, shadow_ms
from selector.measure.view_truth import truth_of_view
from selector.ranking import CandidateFigures
from shadows.render import render_frame
from shadows.truth.metrics import errors_of
from terrain.describe import describe
from terrain.gbuffer.picture import geometry_of
from terrain.gbuffer.subsampled import subsampled_view
from terrain.geo.grid import BLOCK_PX, blocks_of
from terrain.level.level import SunSpec, load_level
from terrain.scene import Scene, build_scene
from tests.render import plan_of

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [160, 128]}
PLAIN = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 35}, "views": {"eye": EYE, "map": {"kind": "map", "size": [160, 160]}},
}  # fmt: skip


def scene_of(folder, **keys) -> Scene:
    path = folder / "figure.yaml"
    path.write_text(json.dumps(PLAIN | keys), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return scene_of(tmp_path_factory.mktemp("measuring"))


@pytest.mark.parametrize("name", ["eye", "map"])
def test_a_thinned_view_shows_pixels_of_the_full_one(gl, scene, name):
    view = scene.view(name)
    full, few = geometry_of(scene, view), geometry_of(scene, subsampled_view(view, 3))
    same = full.there[::3, ::3] == few.there
    assert same.mean() > 0.999
    apart_m = np.linalg.norm(full.position_frame_m[::3, ::3] - few.position_frame_m, axis=-1)
    assert np.nanquantile(apart_m, 0.99) < 1e-3


@pytest.mark.parametrize("name", ["eye", "map"])
def test_with_every_pixel_errors_are_those_of_the_metrics(gl, scene, name):
    view = scene.view(name)
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=64, filter=1)
    visibility = render_frame(scene, view, plan).visibility
    pixel_m = describe(scene, view, name).pixel_m
    subsampled = subsampled_truth(truth_of_view(scene, view, "sun"), 1)
    found = subsampled.errors(visibility, plan.steps, pixel_m)
    plain = errors_of(visibility, subsampled.truth, pixel_m, 0.0)
    assert (found.wrong, found.wrong_cast) == (plain.wrong, plain.wrong_cast)
    assert 0.0 < found.wrong_cast < 1.0 and found.interior <= plain.interior


def test_every_third_pixel_tells_the_error_of_all(gl, scene):
    """But for chance. Pixels three times as wide have less than half of it: their truth does not tell what lies near edges."""
    view = scene.view("eye").finer(4)
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=160, filter=1, cascades=1)
    found, real = {}, truth_of_view(scene, view, "sun")
    for every in (1, 3):
        subsampled = subsampled_truth(real, every)
        found[every] = subsampled.errors(render_frame(scene, subsampled.buffer.view, plan).visibility, plan.steps, 1.0)
    assert found[1].wrong_cast > 0.01 and found[1].spread == 0.0 < found[3].spread < 0.2 * found[1].wrong_cast
    assert abs(found[3].wrong_cast - found[1].wrong_cast) < 3.0 * found[3].spread
    wide = subsampled_view(view, 3)
    naive = errors_of(render_frame(scene, wide, plan).visibility, truth_of_view(scene, wide, "sun").whole, 1.0)
    assert naive.wrong_cast < 0.6 * found[1].wrong_cast


def test_the_plan_is_the_cheapest_that_keeps_to_the_error(gl, scene):
    view = scene.view("eye")
    rows = measured_rows(scene, view, "eye")
    plan = measured_plan(scene, view, "eye", {"max_error": 0.1})
    assert plan.policy == "measure" and plan.target.met and plan.predicted.wrong_cast <= 0.1
    (reason,) = (one.reason for one in plan.reasons if one.name == "sun/meshes: " + plan.algorithm["sun"]["meshes"])
    assert reason.startswith("measured: ") and "the cheapest that keeps to 10 %" in reason
    assert rows["sun"].not_tried == () and len(rows["sun"].trials) > 10
    assert render_frame(scene, view, plan).passes  # it can be drawn
    tight = winners(rows, TargetBounds(1e-4))["sun"]
    loose = winners(rows, TargetBounds(0.5))["sun"]
    assert tight.met and loose.met and loose.winner.ms <= tight.winner.ms * 1.05


def test_a_target_out_of_reach_gets_the_nearest_plan_and_is_told(gl, scene):
    plan = measured_plan(scene, scene.view("eye"), "eye", {"max_error": 1e-6, "max_ms": 1e-3})
    assert plan.target.met is False
    (missed,) = (one.reason for one in plan.reasons if one.name == "target missed")
    assert missed.startswith("sun: ") and "more than 0.001" in missed


def test_what_is_asked_for_is_kept(gl, scene):
    plan = measured_plan(scene, scene.view("eye"), "eye", {"algorithm": "shadow_map", "map_size": 128, "max_error": 0.5})
    settings = plan.settings["sun"]["meshes"]
    assert plan.headline.endswith("shadow_map") and settings.map_size == 128
    assert "set by the request" in plan.reasons[0].reason or "asked for" in " ".join(one.reason for one in plan.reasons)


def test_night_needs_no_measurement(gl, scene, monkeypatch):
    monkeypatch.setattr(measuring, "trial_view_of", None)
    night = scene.with_sun(SunSpec(azimuth=200, altitude=-20))
    plan = measured_plan(night, night.view("eye"), "eye")
    assert plan.headline == "none" and plan.target.met and plan.predicted.ms == 0.0


def test_larger_maps_are_not_run_where_smaller_ones_decide(gl, scene, monkeypatch):
    monkeypatch.setattr(trials, "TRIAL_PIXELS", 2000)
    view = scene.view("eye")
    seen = []
    rows = measured_rows(scene, view, "eye", bounds=TargetBounds(0.9), on_step=lambda done, total: seen.append((done, total)))[
        "sun"
    ]
    assert rows.trial_view.pixels < view.rows * view.cols / 4
    tried, left_out = ({trial.candidate.choice.name for trial in rows.trials}, {one.choice.name for one in rows.not_tried})
    assert "shadow_map 512 x1" in tried and "shadow_map 4096 x1" in left_out
    assert seen[-1] == (len(tried) + len(left_out), len(tried) + len(left_out))
    assert not any(trial.at_full_resolution for trial in rows.trials)
    whole = confirm_winners({"sun": rows}, TargetBounds(0.9))
    winner = winners(whole, TargetBounds(0.9))["sun"].winner
    (trial,) = (one for one in whole["sun"].trials if one.figures == winner)
    assert trial.at_full_resolution and winner.ms == pytest.approx(np.median(trial.times_ms))


@pytest.mark.parametrize("name", ["eye", "map"])
def test_who_wins_has_the_errors_of_all_pixels(gl, scene, monkeypatch, name):
    """On few pixels a shadow map may keep to an error that it does not keep to on all of them."""
    monkeypatch.setattr(trials, "TRIAL_PIXELS", 2000)
    view = scene.view(name)
    rows = measured_rows(scene, view, name)
    for max_error in (0.1, 0.03, 0.01):
        bounds = TargetBounds(max_error)
        whole = confirm_winners(rows, bounds)["sun"]
        verdict = winners({"sun": whole}, bounds)["sun"]
        (trial,) = (one for one in whole.trials if one.figures == verdict.winner)
        row = measure_plan(scene, view, trial.candidate.plan)
        assert verdict.met and (trial.figures.error, trial.figures.interior) == (row.figures["wrong_cast"], row.figures["interior"])
        assert row.figures["wrong_cast"] <= max_error


class Confirming:
    """A probe that says of all pixels what it was told to, and of few what candidates are tried with."""

    error = "wrong_cast"

    def __init__(self, **whole: CandidateFigures) -> None:
        self.known = whole

    def full_resolution_trial(self, candidate: Candidate) -> Trial:
        figures = self.known[candidate.choice.name]
        return Trial(candidate, figures, figures.error, times_ms=(figures.ms,))

    def trial(self, candidate: Candidate) -> Trial:
        return Trial(candidate, self.known[candidate.choice.name], 0.0, spread=1e-4)

    def timed(self, trial: Trial, runs: int) -> Trial:
        return replace(trial, times_ms=(*trial.times_ms, *[trial.figures.ms] * runs))


def candidate_of(name: str, **settings: int) -> Candidate:
    return Candidate("sun", Choice(name, {"meshes": "shadow_map"}, settings), None)


def test_who_leads_by_chance_does_not_win():
    near, far = (candidate_of(name) for name in ("near", "far"))
    few = (
        Trial(near, CandidateFigures("near", 1.0, 0.0299, 0.0), 0.0, 1e-3),
        Trial(far, CandidateFigures("far", 4.0, 0.02, 0.0), 0.0, 1e-3),
    )
    for worse in (
        CandidateFigures("near", 1.0, 0.0301, 0.0),
        CandidateFigures("near", 1.0, 0.02, 0.0011),
        CandidateFigures("near", 9.0, 0.02, 0.0),
    ):
        trial_view = Confirming(near=worse, far=CandidateFigures("far", 4.0, 0.02, 0.0))
        rows = confirm_winners({"sun": LightTrials(trial_view, few)}, TargetBounds(0.03))
        assert winners(rows, TargetBounds(0.03))["sun"].winner.name == "far"
    better = Confirming(near=CandidateFigures("near", 1.0, 0.0299, 0.0))
    rows = confirm_winners({"sun": LightTrials(better, few)}, TargetBounds(0.03))
    assert winners(rows, TargetBounds(0.03))["sun"].winner.name == "near"
    assert [trial.at_full_resolution for trial in rows["sun"].trials] == [True, False]


def test_the_next_larger_map_is_tried_when_the_smaller_one_fails():
    small, large = candidate_of("small", map_size=512), candidate_of("large", map_size=1024)
    trial_view = Confirming(small=CandidateFigures("small", 1.0, 0.05, 0.0), large=CandidateFigures("large", 2.0, 0.01, 0.0))
    few = Trial(small, CandidateFigures("small", 1.0, 0.02, 0.0), 0.0, 1e-4)
    rows = confirm_winners({"sun": LightTrials(trial_view, (few,), (large,))}, TargetBounds(0.03))
    assert rows["sun"].not_tried == () and winners(rows, TargetBounds(0.03))["sun"].winner.name == "large"


def rows_of(*figures: CandidateFigures) -> LightTrials:
    tried = tuple(Trial(candidate_of(one.name), one, 0.0) for one in figures)
    return LightTrials(Confirming(), tried)


def test_lights_share_the_time():
    sun = rows_of(CandidateFigures("quick", 2.0, 0.2, 0.0), CandidateFigures("right", 8.0, 0.01, 0.0))
    lamp = rows_of(CandidateFigures("fast", 1.0, 0.2, 0.0), CandidateFigures("fine", 6.0, 0.01, 0.0))

    def names(max_ms: float | None) -> list[str]:
        return [verdict.winner.name for verdict in winners({"sun": sun, "lamp": lamp}, TargetBounds(0.05, max_ms)).values()]

    assert names(None) == names(14.0) == ["right", "fine"]
    assert names(10.0) == ["right", "fast"]
    assert names(8.5) == ["quick", "fine"]
    assert names(3.0) == ["quick", "fast"]


def test_lights_that_turn_out_slower_leave_less_time_for_others():
    """On few pixels the lamp takes 9 ms, and 10 are left for the sun; on all of them 12, and what takes 10 is too slow."""
    slow, quick, lamp = candidate_of("slow"), candidate_of("quick"), replace(candidate_of("lamp"), light="lamp")
    exact, rough = CandidateFigures("slow", 10.0, 0.001, 0.0), CandidateFigures("quick", 6.0, 0.002, 0.0)
    few = Trial(slow, exact, 0.0), Trial(quick, rough, 0.0)
    sun = LightTrials(Confirming(slow=exact, quick=rough), few)
    other = LightTrials(
        Confirming(lamp=CandidateFigures("lamp", 12.0, 0.0, 0.0)), (Trial(lamp, CandidateFigures("lamp", 9.0, 0.0, 0.0), 0.0),)
    )
    bounds = TargetBounds(5e-4, 20.0)
    rows = confirm_winners({"sun": sun, "lamp": other}, bounds)
    verdicts = winners(rows, bounds)
    assert [verdict.winner.name for verdict in verdicts.values()] == ["quick", "lamp"]
    assert all(trial.at_full_resolution for its in rows.values() for trial in its.trials)


def test_of_a_large_map_the_block_in_the_middle_is_measured(scene):
    view = scene.view("map", size=(3000, 900))
    part = part_of(view)
    assert (part.rows, part.cols) == (900, BLOCK_PX) and part.centre == pytest.approx(view.centre, abs=0.1)
    assert part_of(scene.view("eye")).rows == 128


def test_the_time_of_a_map_is_that_of_one_of_its_blocks(gl, scene):
    view = scene.view("map", size=(1100, 60))
    frame = render_frame(scene, view, plan_of(scene, view, algorithm="planar"))
    blocks = len(blocks_of(view))
    assert blocks > 1 and shadow_ms(frame, "sun") == sum(one.ms for one in frame.passes if one.name.startswith("sun/")) / blocks
    eye = render_frame(scene, scene.view("eye"), plan_of(scene, scene.view("eye"), algorithm="planar"))
    assert shadow_ms(eye, "sun") == sum(one.ms for one in eye.passes if one.name.startswith("sun/")) > 0.0
