"""Plans: reasons, overrides, and the passes that run."""

from __future__ import annotations

from dataclasses import replace

import pytest

from skugga.selector.choices import Choice
from skugga.selector.planner.planner import make_plan
from skugga.shadows.maps import shadow_map
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.describe import describe
from skugga.terrain.errors import RenderError, UnsupportedError
from skugga.terrain.level.level import Level, Shadows, SunSpec, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import block_at, plan_of, render


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Scene of a bundled level of terrain only."""
    return build_scene(load_level("configs/jacksboro.yaml"))


@pytest.fixture(scope="module")
def wooded_scene() -> Scene:
    """Scene of a bundled level with trees."""
    return build_scene(load_level("configs/spatialace.yaml"))


def reasons_of(plan: Plan) -> dict[str, str]:
    """Return the reasons of a plan's choices and rejections, by name of the choice."""
    return {item.name: item.reason for item in (*plan.reasons, *plan.rejected)}


def test_plan_gives_reasons_for_chosen_and_omitted_effects(scene):
    plan = plan_of(scene, scene.view())
    assert plan.algorithm == {"sun": {"relief": "sweep"}} and plan.algorithms_text == "sweep" and plan.predicted is None
    assert [effect.name for effect in plan.effects] == [
        "refraction",
        "cast_shadows",
        "outside_casters",
        "sky_view",
        "texture_shading",
    ]
    assert [effect.name for effect in plan.left_out] == [
        "alpha_test", "soft_edges", "normal_maps", "ground_materials", "ground_detail", "roads", "facades", "textures", "snow",
        "crowns", "clouds", "ambient_occlusion", "sky_light", "lamps", "highlights", "water", "haze", "precipitation",
    ]  # fmt: skip
    assert "but not simulated: sweep for relief draws hard edges" in next(
        item.reason for item in plan.left_out if item.name == "soft_edges"
    )
    assert [reason.name for reason in plan.reasons] == ["sun/relief: sweep"] and "heightfield" in plan.reasons[0].reason
    assert [item.name for item in plan.rejected] == [name for name in ALGORITHMS if name != "sweep"]
    assert all(item.reason for item in (*plan.effects, *plan.left_out, *plan.rejected, *plan.reasons))


def test_plan_gives_reasons_for_map_settings(scene):
    plan = plan_of(scene, scene.view(), algorithm="shadow_map")
    assert {reason.name.split()[0] for reason in plan.reasons} == {"sun/relief:", "map_size", "depth_bits", "filter", "bias", "fit"}
    assert "soft_edges" in plan.effect_names


def test_plan_gives_reasons_for_rejected_algorithms(scene):
    """Under the rules the reason is a refusal or the algorithm that was preferred. Another policy supplies its own reasons."""
    reasons = reasons_of(plan_of(scene, scene.view()))
    assert reasons["perspective_shadow_map"] == ALGORITHMS["perspective_shadow_map"].refusals["map"]
    assert reasons["shadow_volume"] == f"sweep was preferred: {reasons['sun/relief: sweep']}"
    assert (
        reasons["truth"] == ALGORITHMS["truth"].description
        and reasons["none"] == "the view has casters and light, so shadows are drawn"
    )
    choices = {"sun": Choice("mine", {"relief": "hybrid"}, reason={"relief": "it is mine"})}
    rejected_reasons = {"sweep": "12 ms more", "perspective_shadow_map": "not asked"}
    plan = make_plan(describe(scene, scene.view()), scene.loaded.level, choices=choices, rejected=rejected_reasons)
    reasons = reasons_of(plan)
    assert plan.algorithms_text == "hybrid" and reasons["sun/relief: hybrid"] == "it is mine" and reasons["sweep"] == "12 ms more"
    assert reasons["shadow_volume"] == "hybrid was preferred: it is mine"


def test_plan_gives_rejection_reasons_per_caster_kind(wooded_scene):
    reasons = reasons_of(plan_of(wooded_scene, wooded_scene.view()))
    volume = ALGORITHMS["shadow_volume"].refusals["forest"]
    assert reasons["shadow_volume"] == (
        f"for relief: sweep was preferred; for meshes: shadow_map was preferred; for forest: {volume}"
    )
    plan = plan_of(wooded_scene, wooded_scene.view(), algorithm={"relief": "sweep", "meshes": "hybrid"})
    assert reasons_of(plan)["sun/meshes: hybrid"] == "set by the request"
    assert reasons_of(plan)["shadow_volume"] == volume  # only among the kinds left to choose


def test_plan_at_night_has_no_shadows_and_says_so(scene):
    night = scene.with_sun(SunSpec(time="2024-10-21T23:00:00-04:00"))
    plan = plan_of(night, night.view())
    assert plan.algorithm == {"sun": {"relief": "none"}} and plan.settings == {}
    assert "night" in next(item.reason for item in plan.left_out if item.name == "cast_shadows")
    assert not plan.effect_names & {"cast_shadows", "alpha_test", "soft_edges", "outside_casters", "clouds"}
    assert [item.name for item in plan.rejected] == [name for name in ALGORITHMS if name != "none"]


def test_plan_overrides_win_and_are_named(scene):
    view, terrain = scene.view(), scene.loaded.level.terrain.model_dump()

    def of_level(**keys) -> Plan:
        return make_plan(describe(scene, view), Level.model_validate({"version": 1, "terrain": terrain, **keys}))

    plan = plan_of(scene, view, algorithm="none")
    assert plan.algorithms_text == "none" and "set by the request" in plan.reasons[0].reason
    assert "no caster has a shadow algorithm" in next(item.reason for item in plan.left_out if item.name == "cast_shadows")
    assert reasons_of(plan)["sweep"] == "the request sets none"
    assert "set by the level" in of_level(shadows={"algorithm": "none"}).reasons[0].reason
    plan = of_level(effects={"cast_shadows": "off"})
    left_out = {item.name: item.reason for item in plan.left_out}
    assert plan.algorithms_text == "none" and "forced off by the level" in left_out["cast_shadows"]
    assert "needs cast_shadows, which is left out" in left_out["soft_edges"]


def test_plan_names_the_source_of_requested_settings(scene):
    """The reason names the request or the level, and says where no chosen algorithm has the setting."""
    view = scene.view()
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=777, depth_bits=32, filter=5, cascades=1)
    settings = plan.settings["sun"]["relief"]
    assert (settings.map_size, settings.depth_bits, settings.filter) == (777, 32, 5)
    for name in ("map_size 777", "depth_bits 32", "filter 5", "cascades 1"):
        assert reasons_of(plan)[name] == "set by the request"
    level = scene.loaded.level.model_copy(update={"shadows": Shadows(algorithm="hybrid", map_size=512, mask="original")})
    reasons = reasons_of(make_plan(describe(scene, view), level, {"map_size": 256, "mask": None}))
    assert reasons["map_size 256"] == "set by the request" and reasons["mask original"] == "set by the level"
    assert "map_size 777" in reasons_of(plan_of(scene, view, map_size=777))["sun/relief: shadow_map"]  # only a map has this setting
    reasons = reasons_of(plan_of(scene, view, algorithm="sweep", map_size=777, stencil="two_pass"))
    for name in ("map_size 777", "stencil two_pass"):
        assert reasons[name] == "set by the request, without effect: no chosen algorithm has this setting"


@pytest.mark.parametrize("name", ["shadow_volume", "hybrid", "sweep"])
def test_plan_refuses_an_unsupported_override_with_a_reason(wooded_scene, name):
    with pytest.raises(UnsupportedError, match=f"{ALGORITHMS[name].refusals['forest']}.*algorithms that can: shadow_map"):
        plan_of(wooded_scene, wooded_scene.view(), algorithm={"forest": name})


def test_plan_uses_24_depth_bits_where_16_shift_a_shadow(write_raster, make_scene):
    import numpy as np

    from tests.rasters import ENGINEERING

    heights = np.zeros((64, 64), np.float32)
    heights[30:34] = 200.0
    small = make_scene(write_raster(heights, ENGINEERING, 0, 64, 1.0), 200, 30)
    assert plan_of(small, small.view(), algorithm="shadow_map").settings["sun"]["relief"].depth_bits == 16
    deep = heights * 500
    deep_scene = make_scene(write_raster(deep, ENGINEERING, 0, 64, 1.0, name="deep.tif"), 200, 30)
    plan = plan_of(deep_scene, deep_scene.view(), algorithm="shadow_map")
    assert plan.settings["sun"]["relief"].depth_bits == 24
    assert any("more than the 0.25 allowed" in reason.reason for reason in plan.reasons)


def test_plan_is_the_same_for_all_tiles_of_a_zoom(scene):
    """The plan is a function of (level, zoom, sun)."""
    plans = {plan_of(scene, block_at(lon, lat, 13)).model_dump_json() for lon in (-84.4, -84.1) for lat in (36.17, 36.41)}
    assert len(plans) == 1


@pytest.mark.parametrize("algorithm", [None, "shadow_map"])
@pytest.mark.parametrize("sun", [(246, 12), (246, -30)])
def test_frame_runs_the_passes_of_its_plan(gl, scene, sun, algorithm):
    lit_scene = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    for view in (lit_scene.view(size=(64, 64)), block_at(10.0, 50.0, 12)):  # the second view is far from the data
        frame = render(lit_scene, view, algorithm=algorithm)
        assert [record.name for record in frame.passes] == frame.plan.passes
        assert all(record.ms >= 0 for record in frame.passes)
        draw_count = sum(record.draws for record in frame.passes)
        assert draw_count == 0 or (sun[1] > 0 and frame.valid.any())
        assert draw_count > 0 or algorithm is None or sun[1] < 0 or not frame.valid.any()


def test_render_rejects_a_skipped_pass(gl, scene, monkeypatch):
    """The mutant fills visibility without the depth map's pass."""
    import numpy as np

    def skip_depth_pass(buffer, scene, light, kinds, casters, settings, log):
        with log.record_pass(log.pass_names(light, kinds, shadow_map.PASSES)[1]):
            return np.ones(buffer.valid.shape, np.float32)

    monkeypatch.setitem(ALGORITHMS, "shadow_map", replace(ALGORITHMS["shadow_map"], fill_visibility=skip_depth_pass))
    with pytest.raises(RenderError, match="differ from those of the plan"):
        render(scene, scene.view(size=(64, 64)), algorithm="shadow_map")


def test_plan_and_descriptor_round_trip_through_json(scene):
    view = scene.view()
    plan, descriptor = plan_of(scene, view), describe(scene, view)
    assert type(plan).model_validate_json(plan.model_dump_json()) == plan
    assert type(descriptor).model_validate_json(descriptor.model_dump_json()) == descriptor
