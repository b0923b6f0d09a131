"""Plans: reasons for everything, overrides, and the passes that really run."""

from __future__ import annotations

import pytest

from selector.rules import choose
from shadows import render as render_module
from shadows import shadow_map
from shadows.registry import ALGORITHMS
from terrain.descriptor import describe
from terrain.errors import RenderError
from terrain.level import Level, SunSpec, load_level
from terrain.scene import Scene, build_scene
from tests.render import block_at, plan_of, render


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_scene(load_level("configs/jacksboro.yaml"))


def test_a_plan_gives_reasons_for_what_it_does_and_leaves_out(scene):
    plan = plan_of(scene, scene.view())
    assert plan.algorithm == {"sun": {"relief": "shadow_map"}} and plan.headline == "shadow_map"
    assert [effect.name for effect in plan.effects] == ["refraction", "cast_shadows", "soft_edges", "outside_casters", "sky_view"]
    assert [effect.name for effect in plan.left_out] == ["alpha_test", "snow", "clouds", "lamps", "water", "haze"]
    assert {reason.name.split()[0] for reason in plan.reasons} == {"sun/relief:", "map_size", "depth_bits", "filter", "bias", "fit"}
    assert [item.name for item in plan.rejected] == [name for name in ALGORITHMS if name != "shadow_map"]
    assert all(item.reason for item in (*plan.effects, *plan.left_out, *plan.rejected, *plan.reasons))


def test_night_needs_nothing_and_says_so(scene):
    night = scene.with_sun(SunSpec(time="2024-10-21T23:00:00-04:00"))
    plan = plan_of(night, night.view())
    assert plan.algorithm == {"sun": {"relief": "none"}} and plan.settings == {}
    assert "night" in next(item.reason for item in plan.left_out if item.name == "cast_shadows")
    assert not plan.runs & {"cast_shadows", "alpha_test", "soft_edges", "outside_casters", "clouds"}
    assert [item.name for item in plan.rejected] == [name for name in ALGORITHMS if name != "none"]


def test_overrides_win_and_are_named(scene):
    view = scene.view()
    plan = plan_of(scene, view, algorithm="none")
    assert plan.headline == "none" and "asked for by the request" in plan.reasons[0].reason
    assert "the algorithm is none" in next(item.reason for item in plan.left_out if item.name == "cast_shadows")
    plan = plan_of(scene, view, map_size=777, depth_bits=32, filter=5)
    settings = plan.settings["sun"]["relief"]
    assert (settings.map_size, settings.depth_bits, settings.filter) == (777, 32, 5)
    terrain = scene.loaded.level.terrain.model_dump()
    level = Level.model_validate({"version": 1, "terrain": terrain, "shadows": {"algorithm": "none"}})
    assert "asked for by the level" in choose(describe(scene, view), level).reasons[0].reason
    level = Level.model_validate({"version": 1, "terrain": terrain, "effects": {"cast_shadows": "off"}})
    plan = choose(describe(scene, view), level)
    left_out = {item.name: item.reason for item in plan.left_out}
    assert plan.headline == "none" and "forced off by the level" in left_out["cast_shadows"]
    assert "without cast_shadows there is nothing to do" in left_out["soft_edges"]


def test_depth_takes_more_bits_where_sixteen_shift_a_shadow(write_raster, make_scene):
    import numpy as np

    from tests.rasters import ENGINEERING

    heights = np.zeros((64, 64), np.float32)
    heights[30:34] = 200.0
    small = make_scene(write_raster(heights, ENGINEERING, 0, 64, 1.0), 200, 30)
    assert plan_of(small, small.view()).settings["sun"]["relief"].depth_bits == 16
    deep = heights * 500
    deep_scene = make_scene(write_raster(deep, ENGINEERING, 0, 64, 1.0, name="deep.tif"), 200, 30)
    plan = plan_of(deep_scene, deep_scene.view())
    assert plan.settings["sun"]["relief"].depth_bits == 24
    assert any("more than 0.25" in reason.reason for reason in plan.reasons)


def test_nothing_is_decided_per_tile(scene):
    """The plan is a function of (level, zoom, sun): the same for every block of a zoom."""
    plans = {plan_of(scene, block_at(lon, lat, 13)).model_dump_json() for lon in (-84.4, -84.1) for lat in (36.46, 36.7)}
    assert len(plans) == 1


@pytest.mark.parametrize("sun", [(246, 12), (246, -30)])
def test_the_passes_that_ran_are_the_plan_s(gl, scene, sun):
    lit = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    for view in (lit.view(size=(64, 64)), block_at(10.0, 50.0, 12)):  # the second is far off the data
        frame = render(lit, view)
        assert [record.name for record in frame.passes] == frame.plan.passes
        assert all(record.ms >= 0 for record in frame.passes)
        drew = sum(record.draws for record in frame.passes)
        assert drew > 0 if sun[1] > 0 and frame.there.any() else drew == 0


def test_a_renderer_that_skips_a_listed_pass_is_caught(gl, scene, monkeypatch):
    """The mutant: visibility without the depth map's pass."""
    import numpy as np

    def lazy(buffer, scene, light, kinds, casters, settings, log):
        with log.run(log.named(light, kinds, shadow_map.PASSES)[1]):
            return np.ones(buffer.there.shape, np.float32)

    monkeypatch.setitem(render_module.FILLS, "shadow_map", lazy)
    with pytest.raises(RenderError, match="are not the plan's"):
        render(scene, scene.view(size=(64, 64)))


def test_plans_and_descriptors_survive_json(scene):
    view = scene.view()
    plan, descriptor = plan_of(scene, view), describe(scene, view)
    assert type(plan).model_validate_json(plan.model_dump_json()) == plan
    assert type(descriptor).model_validate_json(descriptor.model_dump_json()) == descriptor
