"""Expected cost of a picture: the message names the key that reduces it, and commands and the service have the same limit."""

from __future__ import annotations

from pathlib import Path

import pytest

from skugga.api.cli import snapshot as snapshot_module
from skugga.api.errors import TooCostlyError
from skugga.api.picture_cost import ESTIMATE_MARGIN, check_cost, cost_remedy, sphere_lamps
from skugga.api.report.plan_text import format_expectation
from skugga.api.request import ProductRequest
from skugga.shadows.plan import Plan, Predicted
from skugga.terrain.scene import Scene
from tests.render import plan_of
from tests.shadows.test_area_light import LAMPS, area_light_scene


@pytest.fixture
def lamp_scene(tmp_path: Path) -> tuple[Scene, Plan]:
    """Return a scene whose view shows a lamp as a ball, and a plan with an expected time of 65 s."""
    scene = area_light_scene(tmp_path, lights={"spot": LAMPS["spot"]}, sun="none")
    plan = plan_of(scene, scene.view("eye"), algorithm="shadow_map")
    return scene, plan.model_copy(update={"predicted": Predicted(ms=65_000.0, wrong=0.01, wrong_cast=0.01)})


def test_a_slow_plan_names_the_key_that_makes_it_cheaper(lamp_scene: tuple[Scene, Plan]):
    _, plan = lamp_scene
    points = sphere_lamps(plan)["spot"]
    assert points > 1
    assert cost_remedy(plan) == f"lights.spot.radius: 0 makes shadows hard, which need 1 sample point of a lamp instead of {points}"
    assert "For less time, lights.spot.radius: 0" in format_expectation(plan)
    quick_plan = plan.model_copy(update={"predicted": Predicted(ms=100.0, wrong=0.01, wrong_cast=0.01)})
    assert "For less time" not in format_expectation(quick_plan)


def test_a_plan_over_the_limit_is_refused(lamp_scene: tuple[Scene, Plan]):
    _, plan = lamp_scene
    refusal = r"a block .* expected to take 65 s, more than the limit of 60 s \(SETTING\)\. lights.spot.radius: 0"
    with pytest.raises(TooCostlyError, match=refusal):
        check_cost(plan, "a block", 60_000.0, "SETTING")
    check_cost(plan, "a block", 70_000.0, "SETTING")
    check_cost(plan, "a block", None, "SETTING")
    check_cost(plan.model_copy(update={"predicted": None}), "a block", 60_000.0, "SETTING")


def test_an_estimate_refuses_far_beyond_the_limit_only(lamp_scene: tuple[Scene, Plan]):
    """65 s on a device that is not calibrated may be 30 s."""
    _, plan = lamp_scene
    assert plan.predicted is not None
    estimate = plan.model_copy(update={"predicted": plan.predicted.model_copy(update={"is_estimate": True})})
    check_cost(estimate, "a block", 65_000.0 / ESTIMATE_MARGIN, "SETTING")
    with pytest.raises(TooCostlyError):
        check_cost(estimate, "a block", 64_000.0 / ESTIMATE_MARGIN, "SETTING")


def test_commands_have_the_limit_of_the_service(lamp_scene: tuple[Scene, Plan], monkeypatch: pytest.MonkeyPatch):
    scene, plan = lamp_scene
    monkeypatch.setattr(snapshot_module, "scene_and_view", lambda *args: (scene, scene.view("eye")))
    monkeypatch.setattr(snapshot_module, "plan_for", lambda *args, **keys: plan)
    monkeypatch.setattr(snapshot_module, "compute", lambda *args: "drawn")
    path = scene.loaded.path
    with pytest.raises(TooCostlyError, match=r"the view .* limit of 60 s \(--max-ms\)"):
        snapshot_module.snapshot(path, "eye", ProductRequest(), {})
    assert snapshot_module.snapshot(path, "eye", ProductRequest(), {}, max_ms=70_000.0).computed == "drawn"
    monkeypatch.setenv("SKUGGA_RENDER_TIMEOUT_S", "70")
    assert snapshot_module.snapshot(path, "eye", ProductRequest(), {}).computed == "drawn"
