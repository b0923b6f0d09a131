"""A new effect is one file and one name: an effect made up here is planned, run, forced and recorded like any other."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain import effects
from skugga.terrain.describe import describe
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact


def judge(descriptor: Descriptor) -> Verdict:
    """Require the effect if there is ground above 50 m."""
    highest = descriptor.facts["dust"]["highest_m"]
    assert isinstance(highest, float)
    return Verdict(highest > 50.0, f"the highest ground is at {highest:.0f} m")


def facts(scene, view, coarse_view) -> dict[str, Fact]:
    """Return the fact on which the effect depends: the highest ground, metres."""
    return {"highest_m": scene.height_range_m[1]}


def paint_dust(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Colour ground above 50 m in ``albedo`` (rows, cols, 3)."""
    albedo[block.buffer.height_m > 50.0] = (0.9, 0.8, 0.1)


@pytest.fixture
def dust(monkeypatch: pytest.MonkeyPatch):
    """Register the effect ``dust`` for a test."""
    effect = Effect("yellow dust on high ground", judge, facts, stage="albedo", apply=paint_dust)
    monkeypatch.setitem(effects.EFFECTS, "dust", effect)


def test_a_new_effect_is_planned_run_and_recorded(gl, dust, write_raster, make_scene):
    y, x = np.mgrid[0:40, 0:40]
    raster = write_raster((3.0 * x).astype(np.float32), "EPSG:32633", 500_000, 5_300_000, 10.0)
    scene = make_scene(raster, 90.0, 40.0)
    view = scene.view(size=(40, 40))
    plan = make_plan(describe(scene, view), scene.loaded.level)
    assert "dust" in plan.effect_names and "dust" in plan.passes
    frame = render_frame(scene, view, plan)
    assert "dust" in frame.effects
    yellow = frame.color[..., 0].astype(int) - frame.color[..., 2] > 60
    high = frame.height_m > 50.0
    assert (yellow == high)[frame.valid].all()

    dust_off_level = scene.loaded.level.model_copy(update={"effects": {"dust": "off"}})
    plan_without_dust = make_plan(describe(scene, view), dust_off_level)
    assert "dust" not in plan_without_dust.passes
    assert next(item.reason for item in plan_without_dust.left_out if item.name == "dust").startswith(
        "forced off by the level (the highest"
    )
    assert not (render_frame(scene, view, plan_without_dust).color[..., 0].astype(int) - frame.color[..., 2] > 60)[~high].any()


def test_an_effect_that_is_left_out_is_not_run(gl, dust, write_raster, make_scene, monkeypatch):
    raster = write_raster(np.full((40, 40), 12.0, np.float32), "EPSG:32633", 500_000, 5_300_000, 10.0)
    scene = make_scene(raster)
    effect = effects.EFFECTS["dust"]  # type: ignore[index]

    def fail(albedo: np.ndarray, block: ShadingBlock) -> None:
        raise AssertionError("the effect ran although the plan omits it")

    monkeypatch.setitem(effects.EFFECTS, "dust", Effect(effect.description, effect.judge, effect.facts, "albedo", fail))
    view = scene.view(size=(32, 32))
    plan = make_plan(describe(scene, view), scene.loaded.level)
    assert next(item.reason for item in plan.left_out if item.name == "dust") == "the highest ground is at 12 m"
    assert "dust" not in render_frame(scene, view, plan).effects
