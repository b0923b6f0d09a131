"""Replanner: hysteresis along camera paths, immediate switches where a plan cannot serve, and gradual transitions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.selector.replanning import (
    INITIAL_PATIENCE_FRAMES,
    MAX_CHANGED_SHARE,
    MAX_TRANSITION_FRAMES,
    SWITCH_TIME_GAIN,
    PlanFunction,
    Replanner,
    casting_kinds,
    choices_from_plan,
    expected_transition_frames,
    is_better,
    mix_pictures,
)  # fmt: skip
from skugga.shadows.plan import Plan, Predicted
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import Level, SunSpec, load_level
from skugga.terrain.scene import Scene, build_scene

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [160, 128]}
PLAIN_LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 35}, "views": {"eye": EYE},
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Scene of the level ``PLAIN_LEVEL``."""
    path = tmp_path_factory.mktemp("steady") / "figure.yaml"
    path.write_text(json.dumps(PLAIN_LEVEL), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def descriptor(scene) -> Descriptor:
    """Descriptor of the scene's view ``eye``."""
    return describe(scene, scene.view("eye"), "eye")


@pytest.fixture(scope="module")
def level(scene) -> Level:
    """The scene's level."""
    return scene.loaded.level


class TablePolicy:
    """A policy with a table of milliseconds and error by algorithm, which a test changes as the camera moves."""

    def __init__(self, **rows: tuple[float, float]) -> None:
        self.rows = rows

    def __call__(self, descriptor: Descriptor, plan_request: Level, overrides: dict | None) -> Plan:
        requested = (overrides or {}).get("algorithm")
        accurate_names = [name for name, (_, error) in self.rows.items() if error <= 0.03] or list(self.rows)
        name = requested["sun"]["meshes"] if requested else min(accurate_names, key=lambda name: self.rows[name])
        plan = make_plan(descriptor, plan_request, {**(overrides or {}), "algorithm": {"sun": {"meshes": name}}})
        ms, error = self.rows.get(name, (1.0, 0.0))
        target = plan.target.model_copy(update={"met": error <= 0.03})
        predicted = Predicted(ms=ms, wrong=error / 10.0, wrong_cast=error)
        return plan.model_copy(update={"policy": "predict", "predicted": predicted, "target": target})


def algorithm_names(plans: list[Plan]) -> list[str]:
    """Return each plan's algorithm for meshes under the sun."""
    return [plan.algorithm["sun"]["meshes"] for plan in plans]


def count_switches(names: list[str]) -> int:
    """Return how often successive names differ."""
    return sum(previous != current for previous, current in zip(names, names[1:], strict=False))


def test_replanner_ignores_a_gain_below_the_margin(descriptor, level):
    policy = TablePolicy(shadow_map=(10.0, 0.01), shadow_volume=(20.0, 0.01))
    replanner = Replanner(plans=policy)
    names = algorithm_names([replanner.plan(descriptor, level)])
    policy.rows["shadow_volume"] = (10.0 * (1.0 - SWITCH_TIME_GAIN) + 0.1, 0.01)
    names += algorithm_names([replanner.plan(descriptor, level) for _ in range(3 * INITIAL_PATIENCE_FRAMES)])
    assert set(names) == {"shadow_map"} and replanner.transition is None


def test_replanner_switches_after_patience_plans_in_a_row(descriptor, level):
    policy = TablePolicy(shadow_map=(10.0, 0.01), shadow_volume=(20.0, 0.01))
    replanner = Replanner(plans=policy)
    replanner.plan(descriptor, level)
    policy.rows["shadow_volume"] = (7.0, 0.01)
    names = algorithm_names([replanner.plan(descriptor, level) for _ in range(INITIAL_PATIENCE_FRAMES + 3)])
    assert names == ["shadow_map"] * (INITIAL_PATIENCE_FRAMES - 1) + ["shadow_volume"] * 4


def test_replanner_does_not_oscillate_at_a_border(descriptor, level):
    """Two algorithms are quicker in turns: by a third, plan for plan, then by a tenth, for many plans each."""
    policy = TablePolicy(shadow_map=(10.0, 0.01), shadow_volume=(10.0, 0.01))
    replanner, names = Replanner(plans=policy), []
    for number in range(8 * INITIAL_PATIENCE_FRAMES):
        policy.rows["shadow_volume"] = (15.0 if number % 2 else 6.6, 0.01)
        names += algorithm_names([replanner.plan(descriptor, level)])
    assert count_switches(names) == 0
    replanner, names = Replanner(plans=policy), []
    for number in range(8 * INITIAL_PATIENCE_FRAMES):
        policy.rows["shadow_volume"] = (11.0 if number // (2 * INITIAL_PATIENCE_FRAMES) % 2 else 9.0, 0.01)
        names += algorithm_names([replanner.plan(descriptor, level)])
    assert count_switches(names) == 0


def test_replanner_switches_at_once_on_a_badly_missed_target(descriptor, level):
    policy = TablePolicy(shadow_map=(10.0, 0.02), shadow_volume=(20.0, 0.0))
    replanner = Replanner(plans=policy)
    replanner.plan(descriptor, level)
    policy.rows["shadow_map"] = (10.0, 0.032)  # missed by less than a tenth: no switch
    assert algorithm_names([replanner.plan(descriptor, level) for _ in range(2 * INITIAL_PATIENCE_FRAMES)]) == ["shadow_map"] * (
        2 * INITIAL_PATIENCE_FRAMES
    )
    policy.rows["shadow_map"] = (10.0, 0.09)
    assert algorithm_names([replanner.plan(descriptor, level)]) == ["shadow_volume"]


def test_is_better_accepts_a_target_of_zero(descriptor, level):
    """A miss of the target 0 counts in thousandths."""
    policy = TablePolicy(shadow_map=(20.0, 0.002), shadow_volume=(30.0, 0.001))
    overrides = {"max_error": 0.0}
    exact_plan = policy(descriptor, level, overrides | {"algorithm": {"sun": {"meshes": "shadow_volume"}}})
    rough_plan = policy(descriptor, level, overrides | {"algorithm": {"sun": {"meshes": "shadow_map"}}})
    assert exact_plan.target.max_error == 0.0
    assert is_better(exact_plan, rough_plan) and not is_better(rough_plan, exact_plan)


def test_replanner_takes_overrides_at_once(descriptor, level):
    replanner = Replanner("rules")
    first = replanner.plan(descriptor, level)
    other = "shadow_volume" if algorithm_names([first]) != ["shadow_volume"] else "hybrid"
    overridden_plan = replanner.plan(descriptor, level, {"algorithm": {"sun": {"meshes": other}}})
    assert algorithm_names([overridden_plan]) == [other] and replanner.transition is None
    assert replanner.plan(descriptor, level).algorithm == first.algorithm


def test_replanner_switches_once_at_nightfall(scene, level):
    """Nightfall and daybreak make two switches, without a mixture: the old plan could not be drawn."""
    view, replanner, names = scene.view("eye"), Replanner("rules"), []
    altitudes = [*np.linspace(3.0, -3.0, 13), *np.linspace(-3.0, 3.0, 13)]
    for altitude in altitudes:
        sunlit_scene = scene.with_sun(SunSpec(azimuth=200, altitude=float(altitude)))
        names += algorithm_names([replanner.plan(describe(sunlit_scene, view, "eye"), level)])
        assert replanner.transition is None
    assert count_switches(names) == 2
    assert [name == "none" for name in names] == [altitude <= 0.0 for altitude in altitudes]


def test_replanner_resolves_settings_for_the_present_view(scene, descriptor, level):
    """The choice is kept. The texels are those of a plan for the view alone with that choice."""
    replanner = Replanner(plans=TablePolicy(shadow_map=(10.0, 0.01), shadow_volume=(20.0, 0.01)))
    first = replanner.plan(descriptor, level)
    choices = choices_from_plan(first)
    assert first.settings == make_plan(descriptor, level, choices=choices).settings
    near_view = replace(scene.view("eye"), eye_earth_m=scene.view("eye").eye_earth_m + np.array([14.0, 22.0, -8.0]))
    closer = describe(scene, near_view, "eye")
    replanned, fresh_plan = replanner.plan(closer, level), make_plan(closer, level, choices=choices)
    assert choices_from_plan(replanned) == choices
    assert (replanned.settings, replanned.passes, replanned.effect_names) == (
        fresh_plan.settings,
        fresh_plan.passes,
        fresh_plan.effect_names,
    )
    assert replanned.settings != first.settings


def test_choices_from_plan_reproduce_the_plan(descriptor, level):
    for name in ("shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid", "planar", "none"):
        plan = make_plan(descriptor, level, {"algorithm": {"sun": {"meshes": name}}, "map_size": 256, "cascades": 2})
        replanned = make_plan(descriptor, level, choices=choices_from_plan(plan))
        if name != "none":  # no choice is none
            assert (replanned.algorithm, replanned.settings) == (plan.algorithm, plan.settings)
        assert casting_kinds(plan) == {"sun": frozenset() if name == "none" else {"meshes"}}


def test_replanner_transition_changes_few_pixels_a_frame(gl, scene, descriptor, level):
    """The switch leads from a coarse map to volumes.

    Each frame stays within the limit, and the last one is wholly the new plan's.
    """
    view = scene.view("eye")
    policy = TablePolicy(shadow_map=(10.0, 0.03), shadow_volume=(20.0, 0.0))
    coarse_policy: PlanFunction = lambda *args: policy(*args[:2], {"map_size": 64, **(args[2] or {})})  # noqa: E731
    replanner = Replanner(plans=coarse_policy)
    before = render_frame(scene, view, replanner.plan(descriptor, level)).visibility
    policy.rows["shadow_volume"] = (5.0, 0.0)
    previous, frame_changes, mixed_count = before, [], 0
    for _ in range(INITIAL_PATIENCE_FRAMES + MAX_TRANSITION_FRAMES):
        frame = render_frame(scene, view, replanner.plan(descriptor, level)).visibility
        if replanner.transition is not None:
            old_visibility = render_frame(scene, view, replanner.transition.plan).visibility
            frame, mixed_count = mix_pictures(old_visibility, frame, replanner.transition.share), mixed_count + 1
        frame_changes.append(changed_share(previous, frame))
        previous = frame
    total_change = changed_share(before, previous)
    assert total_change > MAX_CHANGED_SHARE  # otherwise the test would be vacuous
    assert mixed_count + 1 == expected_transition_frames(
        *(policy(descriptor, level, {"algorithm": {"sun": {"meshes": name}}}) for name in policy.rows)
    )
    assert max(frame_changes) < 1.5 * total_change / (mixed_count + 1)
    assert frame_changes[-1] == 0.0 and replanner.transition is None


def changed_share(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of the pixels whose class changes."""
    valid = ~np.isnan(before)
    return float(((before < 0.5) != (after < 0.5))[valid].mean())


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_mix_pictures_is_even_and_monotonic(rows, cols, share, other_share):
    before, after = np.zeros((rows, cols)), np.ones((rows, cols))
    low_share, high_share = sorted((share, other_share))
    low_mix, high_mix = mix_pictures(before, after, low_share), mix_pictures(before, after, high_share)
    assert (high_mix >= low_mix).all()
    assert mix_pictures(before, after, 1.0).all() and not mix_pictures(before, after, 0.0).any()
    assert abs(low_mix.mean() - low_share) < 0.05 + 2.0 / np.sqrt(rows * cols)
    colours = mix_pictures(np.zeros((rows, cols, 3)), np.ones((rows, cols, 3)), low_share)
    assert (colours == low_mix[..., None]).all()


def test_expected_transition_frames_follow_predicted_errors(descriptor, level):
    plans = [
        make_plan(descriptor, level).model_copy(update={"predicted": Predicted(ms=1.0, wrong=w, wrong_cast=w)})
        for w in (0.0, 0.003, 1.0)
    ]
    assert expected_transition_frames(plans[0], plans[0]) == 1
    assert expected_transition_frames(plans[0], plans[1]) == 2 and expected_transition_frames(plans[1], plans[1]) == 3
    assert expected_transition_frames(plans[1], plans[2]) == MAX_TRANSITION_FRAMES
