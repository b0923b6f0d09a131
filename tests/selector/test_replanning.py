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
    MAX_CHANGED,
    MAX_TRANSITION_FRAMES,
    PATIENCE,
    SWITCH_TIME_GAIN,
    PlanFunction,
    Replanner,
    casting,
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
PLAIN = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 35}, "views": {"eye": EYE},
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    path = tmp_path_factory.mktemp("steady") / "figure.yaml"
    path.write_text(json.dumps(PLAIN), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def descriptor(scene) -> Descriptor:
    return describe(scene, scene.view("eye"), "eye")


@pytest.fixture(scope="module")
def level(scene) -> Level:
    return scene.loaded.level


class Table:
    """A policy with a table of milliseconds and error by algorithm, which a test changes as the camera moves."""

    def __init__(self, **rows: tuple[float, float]) -> None:
        self.rows = rows

    def __call__(self, descriptor: Descriptor, plan_request: Level, overrides: dict | None) -> Plan:
        asked = (overrides or {}).get("algorithm")
        right = [name for name, (_, error) in self.rows.items() if error <= 0.03] or list(self.rows)
        name = asked["sun"]["meshes"] if asked else min(right, key=lambda name: self.rows[name])
        plan = make_plan(descriptor, plan_request, {**(overrides or {}), "algorithm": {"sun": {"meshes": name}}})
        ms, error = self.rows.get(name, (1.0, 0.0))
        target = plan.target.model_copy(update={"met": error <= 0.03})
        predicted = Predicted(ms=ms, wrong=error / 10.0, wrong_cast=error)
        return plan.model_copy(update={"policy": "predict", "predicted": predicted, "target": target})


def algorithms(plans: list[Plan]) -> list[str]:
    return [plan.algorithm["sun"]["meshes"] for plan in plans]


def switches(names: list[str]) -> int:
    return sum(one != other for one, other in zip(names, names[1:], strict=False))


def test_replanner_ignores_a_gain_below_the_margin(descriptor, level):
    table = Table(shadow_map=(10.0, 0.01), shadow_volume=(20.0, 0.01))
    director = Replanner(plans=table)
    names = algorithms([director.plan(descriptor, level)])
    table.rows["shadow_volume"] = (10.0 * (1.0 - SWITCH_TIME_GAIN) + 0.1, 0.01)
    names += algorithms([director.plan(descriptor, level) for _ in range(3 * PATIENCE)])
    assert set(names) == {"shadow_map"} and director.transition is None


def test_replanner_switches_after_patience_plans_in_a_row(descriptor, level):
    table = Table(shadow_map=(10.0, 0.01), shadow_volume=(20.0, 0.01))
    director = Replanner(plans=table)
    director.plan(descriptor, level)
    table.rows["shadow_volume"] = (7.0, 0.01)
    names = algorithms([director.plan(descriptor, level) for _ in range(PATIENCE + 3)])
    assert names == ["shadow_map"] * (PATIENCE - 1) + ["shadow_volume"] * 4


def test_replanner_does_not_oscillate_at_a_border(descriptor, level):
    """Two algorithms are quicker in turns: by a third, plan for plan, then by a tenth, for many plans each."""
    table = Table(shadow_map=(10.0, 0.01), shadow_volume=(10.0, 0.01))
    director, names = Replanner(plans=table), []
    for number in range(8 * PATIENCE):
        table.rows["shadow_volume"] = (15.0 if number % 2 else 6.6, 0.01)
        names += algorithms([director.plan(descriptor, level)])
    assert switches(names) == 0
    director, names = Replanner(plans=table), []
    for number in range(8 * PATIENCE):
        table.rows["shadow_volume"] = (11.0 if number // (2 * PATIENCE) % 2 else 9.0, 0.01)
        names += algorithms([director.plan(descriptor, level)])
    assert switches(names) == 0


def test_replanner_switches_at_once_on_a_badly_missed_target(descriptor, level):
    table = Table(shadow_map=(10.0, 0.02), shadow_volume=(20.0, 0.0))
    director = Replanner(plans=table)
    director.plan(descriptor, level)
    table.rows["shadow_map"] = (10.0, 0.032)  # missed by less than a tenth: no switch
    assert algorithms([director.plan(descriptor, level) for _ in range(2 * PATIENCE)]) == ["shadow_map"] * (2 * PATIENCE)
    table.rows["shadow_map"] = (10.0, 0.09)
    assert algorithms([director.plan(descriptor, level)]) == ["shadow_volume"]


def test_is_better_accepts_a_target_of_zero(descriptor, level):
    """A miss of the target 0 counts in thousandths."""
    table = Table(shadow_map=(20.0, 0.002), shadow_volume=(30.0, 0.001))
    asked = {"max_error": 0.0}
    exact = table(descriptor, level, asked | {"algorithm": {"sun": {"meshes": "shadow_volume"}}})
    rough = table(descriptor, level, asked | {"algorithm": {"sun": {"meshes": "shadow_map"}}})
    assert exact.target.max_error == 0.0
    assert is_better(exact, rough) and not is_better(rough, exact)


def test_replanner_takes_overrides_at_once(descriptor, level):
    director = Replanner("rules")
    first = director.plan(descriptor, level)
    other = "shadow_volume" if algorithms([first]) != ["shadow_volume"] else "hybrid"
    asked = director.plan(descriptor, level, {"algorithm": {"sun": {"meshes": other}}})
    assert algorithms([asked]) == [other] and director.transition is None
    assert director.plan(descriptor, level).algorithm == first.algorithm


def test_replanner_switches_once_at_nightfall(scene, level):
    """Nightfall and daybreak make two switches, without a mixture: the old plan could not be drawn."""
    view, director, names = scene.view("eye"), Replanner("rules"), []
    altitudes = [*np.linspace(3.0, -3.0, 13), *np.linspace(-3.0, 3.0, 13)]
    for altitude in altitudes:
        its = scene.with_sun(SunSpec(azimuth=200, altitude=float(altitude)))
        names += algorithms([director.plan(describe(its, view, "eye"), level)])
        assert director.transition is None
    assert switches(names) == 2
    assert [name == "none" for name in names] == [altitude <= 0.0 for altitude in altitudes]


def test_replanner_resolves_settings_for_the_present_view(scene, descriptor, level):
    """The choice is kept. The texels are those of a plan for the view alone with that choice."""
    director = Replanner(plans=Table(shadow_map=(10.0, 0.01), shadow_volume=(20.0, 0.01)))
    first = director.plan(descriptor, level)
    choices = choices_from_plan(first)
    assert first.settings == make_plan(descriptor, level, choices=choices).settings
    near = replace(scene.view("eye"), eye_earth_m=scene.view("eye").eye_earth_m + np.array([14.0, 22.0, -8.0]))
    closer = describe(scene, near, "eye")
    kept, alone = director.plan(closer, level), make_plan(closer, level, choices=choices)
    assert choices_from_plan(kept) == choices
    assert (kept.settings, kept.passes, kept.runs) == (alone.settings, alone.passes, alone.runs)
    assert kept.settings != first.settings


def test_choices_from_plan_reproduce_the_plan(descriptor, level):
    for name in ("shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid", "planar", "none"):
        plan = make_plan(descriptor, level, {"algorithm": {"sun": {"meshes": name}}, "map_size": 256, "cascades": 2})
        again = make_plan(descriptor, level, choices=choices_from_plan(plan))
        if name != "none":  # no choice is none
            assert (again.algorithm, again.settings) == (plan.algorithm, plan.settings)
        assert casting(plan) == {"sun": frozenset() if name == "none" else {"meshes"}}


def test_replanner_transition_changes_few_pixels_a_frame(gl, scene, descriptor, level):
    """The switch leads from a coarse map to volumes.

    Each frame stays within the limit, and the last one is wholly the new plan's.
    """
    view = scene.view("eye")
    table = Table(shadow_map=(10.0, 0.03), shadow_volume=(20.0, 0.0))
    coarse: PlanFunction = lambda *given: table(*given[:2], {"map_size": 64, **(given[2] or {})})  # noqa: E731
    director = Replanner(plans=coarse)
    before = render_frame(scene, view, director.plan(descriptor, level)).visibility
    table.rows["shadow_volume"] = (5.0, 0.0)
    shown, seen, mixed = before, [], 0
    for _ in range(PATIENCE + MAX_TRANSITION_FRAMES):
        frame = render_frame(scene, view, director.plan(descriptor, level)).visibility
        if director.transition is not None:
            left = render_frame(scene, view, director.transition.plan).visibility
            frame, mixed = mix_pictures(left, frame, director.transition.share), mixed + 1
        seen.append(changed(shown, frame))
        shown = frame
    whole = changed(before, shown)
    assert whole > MAX_CHANGED  # otherwise the test would be vacuous
    assert mixed + 1 == expected_transition_frames(
        *(table(descriptor, level, {"algorithm": {"sun": {"meshes": name}}}) for name in table.rows)
    )
    assert max(seen) < 1.5 * whole / (mixed + 1)
    assert seen[-1] == 0.0 and director.transition is None


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of the pixels whose class changes."""
    valid = ~np.isnan(before)
    return float(((before < 0.5) != (after < 0.5))[valid].mean())


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_mix_pictures_is_even_and_monotonic(rows, cols, share, more):
    before, after = np.zeros((rows, cols)), np.ones((rows, cols))
    less, most = sorted((share, more))
    mixed, later = mix_pictures(before, after, less), mix_pictures(before, after, most)
    assert (later >= mixed).all()
    assert mix_pictures(before, after, 1.0).all() and not mix_pictures(before, after, 0.0).any()
    assert abs(mixed.mean() - less) < 0.05 + 2.0 / np.sqrt(rows * cols)
    colours = mix_pictures(np.zeros((rows, cols, 3)), np.ones((rows, cols, 3)), less)
    assert (colours == mixed[..., None]).all()


def test_expected_transition_frames_follow_predicted_errors(descriptor, level):
    plans = [
        make_plan(descriptor, level).model_copy(update={"predicted": Predicted(ms=1.0, wrong=w, wrong_cast=w)})
        for w in (0.0, 0.003, 1.0)
    ]
    assert expected_transition_frames(plans[0], plans[0]) == 1
    assert expected_transition_frames(plans[0], plans[1]) == 2 and expected_transition_frames(plans[1], plans[1]) == 3
    assert expected_transition_frames(plans[1], plans[2]) == MAX_TRANSITION_FRAMES
