"""Policy `predict`: choices for hand-written views and devices, and for stored views with their measurements."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from skugga.selector import predict
from skugga.selector.choices import StandaloneRequest
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel, HillCurve, SharedErrors, error_groups
from skugga.selector.formatting import format_duration, format_percent
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.selector.options import PredictedChoice, predicted_choices
from skugga.selector.planner.planner import Planner, make_plan, planner_of
from skugga.selector.predict import predicted_plan
from skugga.shadows.plan import Plan
from skugga.shadows.volumes.shadow_volume import GROUND_EXCLUSION_REASON, MAX_GROUND_TRIANGLES
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX, CastBand, CasterFacts, Casting, LampFacts, LightFacts
from skugga.terrain.level.level import SUN, Shadows

SELECTION_TABLE = Path(__file__).resolve().parents[2] / "benchmarks" / "selection" / "selection.jsonl"

ERROR_MODEL = ErrorModel(
    counted={kind: HillCurve(most=1.0, half_px=1.0, steepness=1.0) for kind in ("relief", "meshes", "forest")},
    perspective=2.0,
    floor=dict.fromkeys(error_groups(), 1e-4),
    interior=dict.fromkeys(error_groups(), 0.0),
    spread=dict.fromkeys(error_groups(), 0.05),
    interior_spread=dict.fromkeys(error_groups(), 0.05),
    time_spread=0.2,
    shared=SharedErrors(**dict.fromkeys(("error", "interior", "time"), SharedVariance(view=0.0, family=0.0))),
)
"""Error model with hardly any uncertainty."""

RATES_NS: dict[str, dict[str, float]] = {
    "shadow_map, perspective": {"blocks": 5e6, "texels": 1.0},
    "perspective_shadow_map, sun": {"blocks": 50e6, "texels": 1.0},
    "shadow_map, spot": {"blocks": 5e6, "texels": 1.0},
    "perspective_shadow_map, spot": {"blocks": 50e6, "texels": 1.0},
    "silhouettes, perspective": {"blocks": 1e6},
    "counting, perspective": {"blocks": 1e6, "faces drawn": 20e3, "faces beside marks": 20e3},
    "conservative map, perspective": {"blocks": 20e6},
    "mask": {"blocks": 10e6},
    "planar": {"blocks": 2e6},
}
"""Rates under which a map of 4096 texels a side takes some 22 ms, volumes of 1200 faces some 26 ms, and planar shadows 2 ms."""


def shadow_facts(cast: float = 0.2) -> LightFacts:
    """Return shadows with an edge every hundred pixels or so, a quarter of them on bodies."""
    differs = tuple(px / 320.0 for px in TEXEL_SIZES_PX)
    bands = (CastBand(near_m=32.0, far_m=64.0, share=1.0, cast=cast, pixel_m=0.1, light_m=50.0, differs=differs),)
    casts = {"meshes": Casting(share=cast, on_bodies=cast / 4.0, bands=bands)}
    return LightFacts(cast_share=cast, silhouette_edges=200, volume_layers=1.0, casts=casts)


def make_descriptor(**changes) -> Descriptor:
    """Return bodies on level ground, seen from nearby under the sun: 640 x 512 pixels of 0.1 m."""
    bodies = CasterFacts(kind="meshes", count=10, triangles=2000, closed_share=1.0, height_m=4.0, width_m=5.0)
    fields = {
        "view": "main", "view_kind": "perspective", "flat_world": True, "pixel_m": 0.1, "pixel": 0.0015, "rows": 512, "cols": 640,
        "node_m": 2.0, "casters": ("relief", "meshes"), "stands": (bodies,), "relief_m": 0.0, "block_relief_m": 4.0,
        "tallest_m": 4.0, "sun_azimuth_deg": 140.0, "sun_altitude_deg": 30.0, "highest_sun_deg": 30.0,
        "receivers_light_m": (100.0, 100.0, 100.0), "lights": {SUN: shadow_facts()},
    }  # fmt: skip
    return Descriptor(**(fields | changes))


def device(scale: Callable[[str, str], float] = lambda part, name: 1.0, rates_ns: dict = RATES_NS) -> DeviceProfile:
    """Return a device with the given rates, multiplied by ``scale(part, name)``."""
    rates_ns = {part: {name: ns * scale(part, name) for name, ns in rates.items()} for part, rates in rates_ns.items()}
    return DeviceProfile(
        renderer="a device", version="1", cpus=2, engine="0", measured=datetime(2025, 1, 1, tzinfo=UTC), took_s=1.0,
        rates_ns=rates_ns,
    )  # fmt: skip


def expensive_texels(part: str, name: str) -> float:
    """Return a factor of the cost of a unit of work: 50 for texels, else 1."""
    return 50.0 if name.startswith("texels") else 1.0


def cheap_faces(part: str, name: str) -> float:
    """Return a factor of the cost of a unit of work: 0.01 for faces, else 1."""
    return 0.01 if name.startswith("faces") else 1.0


def make_request(descriptor: Descriptor, **shadows) -> StandaloneRequest:
    """Return a planning request for a descriptor with keys of ``shadows``."""
    return StandaloneRequest(Shadows(**shadows), tuple(descriptor.lights))


def plan_view(
    descriptor: Descriptor,
    profile: DeviceProfile | None = None,
    overrides: dict[str, Any] | None = None,
    errors: ErrorModel | None = ERROR_MODEL,
    **shadows,
) -> Plan:
    """Return the predicted plan of a descriptor, for a level with keys of ``shadows`` and a request with overrides."""
    return predicted_plan(descriptor, make_request(descriptor, **shadows), overrides, profile or device(), errors)


def name_of(plan: Plan, light: str = SUN) -> str:
    """Return a plan's algorithm for meshes, with the map size if it has one."""
    size = getattr(plan.settings.get(light, {}).get("meshes"), "map_size", None)
    return plan.algorithm[light]["meshes"] + ("" if size is None else f" {size}")


def predicted_option(
    plan: Plan, planner: Planner, light: str, profile: DeviceProfile, errors: ErrorModel | None = ERROR_MODEL
) -> PredictedChoice:
    """Return the option that a plan took under a light."""
    steps = tuple(step for step in plan.steps if step.light == light and step.algorithm != "none")
    return next(
        option
        for option in predicted_choices(planner, light, planner.casting_kinds(light), profile, errors)
        if option.steps == steps
    )


@pytest.fixture(scope="module")
def measured_views() -> dict[str, dict[str, Any]]:
    """Return the measured views by name."""
    _, *lines = SELECTION_TABLE.read_text(encoding="utf-8").splitlines()
    return {view["name"]: view for view in map(json.loads, lines)}


@pytest.fixture(scope="module")
def measured_device() -> DeviceProfile:
    """Return the device on which the views were measured."""
    return DeviceProfile.model_validate_json(SELECTION_TABLE.read_text(encoding="utf-8").splitlines()[0])


def descriptor_of(record: dict[str, Any], **changes) -> Descriptor:
    """Return the descriptor of a record of measurements. ``changes`` replace fields."""
    return Descriptor.model_validate({**record["descriptor"], **changes})


def test_predict_takes_the_coarsest_map_that_meets_the_target():
    """A texel of a map of 1024 is a pixel wide: 1 / 320 differ, half of it counts, and over a fifth in cast shadow that is 0.8 %.

    Planar shadows are the quickest by far, but 25 % wrong.
    """
    assert name_of(plan_view(make_descriptor(), max_error=0.5)) == "planar"
    plan = plan_view(make_descriptor(), max_error=0.02)
    assert name_of(plan) == "shadow_map 1024"
    assert plan.predicted.wrong_cast == pytest.approx(0.5 / 320.0 / 0.2 + 1e-4, rel=0.05)
    assert plan.target.met and plan.policy == "predict"
    # The same map meets 1 % with 98 % probability: the expected miss costs more than the 3 ms that a map of 2048 adds.
    plan = plan_view(make_descriptor(), max_error=0.01)
    assert (
        name_of(plan) == "shadow_map 2048" and plan.predicted.ms - plan_view(make_descriptor(), max_error=0.02).predicted.ms > 3.0
    )
    assert name_of(plan_view(make_descriptor(), max_error=0.005)) == "shadow_map 2048"


def test_predict_follows_a_changed_calibration():
    """A target of 0.15 % needs a map of 4096 texels a side, in some 22 ms.

    Volumes with 1000 caps and 200 sides take longer for counting alone.
    """
    view = make_descriptor()
    assert name_of(plan_view(view, max_error=0.0015)) == "shadow_map 4096"
    assert name_of(plan_view(view, device(expensive_texels), max_error=0.0015)) == "shadow_volume"
    assert name_of(plan_view(view, device(cheap_faces), max_error=0.0015)) == "shadow_volume"
    # Expensive texels alone do not displace a coarse map.
    assert name_of(plan_view(view, max_error=0.04)) == "shadow_map 512"
    assert name_of(plan_view(view, device(expensive_texels), max_error=0.04)) == "shadow_map 512"
    slow_maps = device(lambda part, name: 50.0 if part.startswith("shadow_map") else 100.0 if part.startswith("counting") else 1.0)
    assert name_of(plan_view(view, slow_maps, max_error=0.04)) == "perspective_shadow_map 512"


def test_predict_follows_a_changed_calibration_on_measured_views(measured_views, measured_device):
    view = measured_views["boxgrid, spot, main"]

    def chosen_algorithm(scale: Callable[[str, str], float]) -> str:
        return plan_view(descriptor_of(view), device(scale, measured_device.rates_ns), errors=None, max_error=0.01).algorithm[
            "lamp"
        ]["meshes"]

    assert chosen_algorithm(lambda part, name: 1.0) == "shadow_map"
    assert chosen_algorithm(lambda part, name: 50.0 if " map" in part or "_map" in part else 1.0) == "shadow_volume"
    assert chosen_algorithm(lambda part, name: 0.01 if part.startswith(("silhouettes", "counting")) else 1.0) == "shadow_volume"


def test_predict_is_independent_of_the_unit_of_rates(measured_views, measured_device):
    """A device that is thirty times slower in everything takes the same choice, in thirty times the time."""
    slow = device(lambda part, name: 30.0, measured_device.rates_ns)
    for name in ("rocks, sun, main", "village, map, 9", "goteborg, eye, 22"):
        descriptor = descriptor_of(measured_views[name])
        quick_plan, slow_plan = (plan_view(descriptor, profile, errors=None, max_error=0.01) for profile in (measured_device, slow))
        assert (slow_plan.algorithm, slow_plan.settings) == (quick_plan.algorithm, quick_plan.settings), name
        assert slow_plan.predicted.ms == pytest.approx(30.0 * quick_plan.predicted.ms)


@pytest.mark.parametrize("who", ["the request", "the level"])
def test_predict_respects_requested_algorithms_and_settings(who):
    view = make_descriptor()

    def plan(**keys) -> Plan:
        return plan_view(view, overrides=keys) if who == "the request" else plan_view(view, **keys)

    volume_plan = plan(algorithm="shadow_volume")
    assert name_of(volume_plan) == "shadow_volume"
    assert next(item.reason for item in volume_plan.reasons if item.name == "sun/meshes: shadow_volume") == f"set by {who}"
    sized_plan = plan(algorithm="shadow_map", map_size=777, filter=5)
    assert (sized_plan.settings[SUN]["meshes"].map_size, sized_plan.settings[SUN]["meshes"].filter) == (777, 5)
    assert next(item.reason for item in sized_plan.reasons if item.name == "map_size 777") == f"set by {who}"
    unforced_plan = plan(map_size=777)  # only the size is set: the algorithm is still chosen by its cost
    assert name_of(unforced_plan) == "shadow_map 777"
    exact_plan = plan(max_error=0.001, map_size=64)  # a map of 64 texels is too coarse for this, except for that of the hybrid
    assert name_of(exact_plan) == "hybrid" and exact_plan.settings[SUN]["meshes"].map.map_size == 64
    assert exact_plan.target.max_error == 0.001 and name_of(plan(max_error=0.001)) != "hybrid"
    assert name_of(plan(stencil="two_pass")) == "shadow_volume"  # maps have no stencil
    assert name_of(plan(filter=1)) == name_of(plan())  # every algorithm has hard edges
    assert name_of(plan(max_error=0.001, filter=2)).startswith("shadow_map")  # the hybrid's own filter does not soften its edges


def test_predict_chooses_for_kinds_without_an_override(measured_views, measured_device):
    village = descriptor_of(measured_views["village, map, 9"])
    plan = plan_view(village, measured_device, {"algorithm": {"meshes": "shadow_volume"}}, None, max_error=0.03)
    assert plan.algorithm[SUN]["meshes"] == "shadow_volume" and plan.algorithm[SUN]["relief"] != "none"
    reasons = {item.name: item.reason for item in plan.reasons}
    assert reasons["sun/meshes: shadow_volume"] == "set by the request"
    assert "expected" in reasons[f"sun/relief: {plan.algorithm[SUN]['relief']}"]
    with pytest.raises(UnsupportedError, match="shadow volumes ignore textures"):
        plan_view(village, measured_device, {"algorithm": {"forest": "shadow_volume"}}, None)


def test_predict_rejects_algorithms_without_rates():
    plan = plan_view(make_descriptor(), device(rates_ns={part: rates for part, rates in RATES_NS.items() if part != "mask"}))
    assert plan.policy == "predict" and plan.predicted is not None
    reasons = {item.name: item.reason for item in plan.rejected}
    assert reasons["hybrid"] == "this device has no rates for mask: run skugga calibrate again"


def test_predict_falls_back_to_rules_with_a_reason():
    plan = plan_view(make_descriptor(), device(rates_ns={"another part": {"blocks": 1.0}}))
    assert plan.policy == "rules" and plan.predicted is None and plan.target.met is None
    assert plan.algorithm == make_plan(make_descriptor(), make_request(make_descriptor())).algorithm
    reason = next(item.reason for item in plan.reasons if item.name == "policy rules")
    assert (
        reason.startswith("no prediction is possible, so fixed rules choose: ") and "shadow_map: this device has no rates" in reason
    )


def test_predict_fallback_plans_only_reaching_lights(monkeypatch):
    lamp = {"kind": "spot", "cutoff_deg": 30.0, "reference_m": 40.0}
    lamps = [LampFacts(name="near", **lamp), LampFacts(name="far", reaches=False, **lamp)]
    planned_lights, original_rules = [], predict.choices_by_rules
    monkeypatch.setattr(
        predict,
        "choices_by_rules",
        lambda descriptor, shadows, lights: planned_lights.extend(lights) or original_rules(descriptor, shadows, lights),
    )
    plan = plan_view(
        make_descriptor(lamps=lamps, lights={SUN: shadow_facts(), "near": shadow_facts()}),
        device(rates_ns={"another part": {"blocks": 1.0}}),
    )
    assert plan.policy == "rules" and list(plan.lights) == planned_lights == [SUN, "near"]


@pytest.mark.parametrize("max_error", [0.0, 1e-6])
def test_predict_takes_the_nearest_plan_for_an_impossible_target(max_error):
    """The target is an error of zero, or a millionth, within 1 ms: everything takes longer.

    Planar shadows are 25 % wrong in 2 ms, volumes nearly right in 26 ms, so an option in between is nearest.
    """
    view = make_descriptor()
    plan = plan_view(view, max_error=max_error, max_ms=1.0)
    assert plan.target.met is False and name_of(plan) == "shadow_map 1024"
    (missed_reason,) = (item.reason for item in plan.reasons if item.name == "sun: target missed")
    prediction = plan.predicted
    excess = prediction.wrong_cast - max_error
    error = f"an error of {format_percent(prediction.wrong_cast)}, {format_percent(excess)} more than {format_percent(max_error)}"
    assert (
        missed_reason
        == f"expected: {error}; {format_duration(prediction.ms)}, {format_duration(prediction.ms - 1.0)} more than 1.0 ms"
    )
    # No other option is nearer: the distance is the larger overshoot, each relative to its limit.
    planner = planner_of(view, make_request(view))

    def overshoot(ms: float, error: float) -> float:
        return max((error - max_error) / 1e-3, ms - 1.0)  # error limits below a thousandth count as a thousandth

    options = predicted_choices(planner, SUN, ["meshes"], device(), ERROR_MODEL)
    min_overshoot = min(overshoot(item.ms, item.errors.wrong_cast) for item in options)
    assert overshoot(prediction.ms, prediction.wrong_cast) == pytest.approx(min_overshoot)
    assert "comes nearest" in next(item.reason for item in plan.reasons if item.name.startswith("sun/meshes"))


def test_predict_takes_the_most_accurate_map_in_time():
    """Only maps are allowed: 4096 texels take some 22 ms, 2048 some 9, 1024 some 6. None meets an error of a millionth."""
    view = make_descriptor()
    accurate_plan, quick_plan = (plan_view(view, max_error=1e-6, max_ms=ms, algorithm="shadow_map") for ms in (60.0, 20.0))
    assert name_of(accurate_plan) == "shadow_map 4096" and 20.0 < accurate_plan.predicted.ms < 60.0
    assert name_of(quick_plan) == "shadow_map 2048" and quick_plan.predicted.ms < 20.0
    for plan in (accurate_plan, quick_plan):
        (missed_reason,) = (item.reason for item in plan.reasons if item.name == "sun: target missed")
        assert not plan.target.met and missed_reason.startswith("expected: an error of ") and "ms" not in missed_reason


def test_predict_plans_measured_views_with_impossible_targets(measured_views, measured_device):
    for view in [*measured_views.values()][::6]:
        descriptor = descriptor_of(view)
        plan = plan_view(descriptor, measured_device, errors=None, max_error=0.0, max_ms=1e-3)
        if not plan.steps or {step.algorithm for step in plan.steps} == {"none"}:
            continue
        assert plan.target.met is False, view["name"]
        assert any(item.name == f"{view['light']}: target missed" and " more than " in item.reason for item in plan.reasons)


def test_predict_never_takes_none_for_casting_kinds(measured_views, measured_device):
    casts = 0
    for view in measured_views.values():
        descriptor = descriptor_of(view)
        casting_kinds = planner_of(descriptor, make_request(descriptor)).casting_kinds(view["light"])
        for max_error, max_ms in ((1.0, None), (1e-6, 1e-3)):
            plan = plan_view(descriptor, measured_device, errors=None, max_error=max_error, max_ms=max_ms)
            algorithms = plan.algorithm[view["light"]]
            assert {kind for kind, name in algorithms.items() if name != "none"} == set(casting_kinds), view["name"]
            casts += bool(casting_kinds)
    assert casts > len(measured_views)  # nearly all views have casters


def test_predict_is_independent_of_the_view_name(measured_views, measured_device):
    for name in ("rocks, sun, main", "boxgrid, spot, main", "village, map, 9", "quebec, eye, 14"):
        main_plan, renamed_plan = (
            plan_view(descriptor_of(measured_views[name], view=view), measured_device, errors=None, max_error=0.01)
            for view in ("main", "somewhere else")
        )
        assert renamed_plan.view == "somewhere else"
        assert renamed_plan.model_copy(update={"view": main_plan.view}) == main_plan


def test_predict_is_independent_of_the_lamp_name(measured_views, measured_device):
    text = json.dumps(measured_views["boxgrid, spot, main"]["descriptor"])
    assert '"lamp"' in text
    lamp_plan, zenith_plan = (
        plan_view(Descriptor.model_validate_json(descriptor_json), measured_device, errors=None, max_error=0.01)
        for descriptor_json in (text, text.replace('"lamp"', '"zenith"'))
    )
    assert (zenith_plan.algorithm["zenith"], zenith_plan.settings["zenith"]) == (
        lamp_plan.algorithm["lamp"],
        lamp_plan.settings["lamp"],
    )
    assert zenith_plan.predicted == lamp_plan.predicted


def test_predict_reports_the_expectation_of_the_taken_option(measured_views, measured_device):
    for name in ("rocks, sun, main", "boxgrid, spot, main", "village, map, 9", "goteborg, eye, 22", "zion, map, 20"):
        view, light = descriptor_of(measured_views[name]), measured_views[name]["light"]
        plan = plan_view(view, measured_device, errors=None, max_error=0.01)
        option = predicted_option(plan, planner_of(view, make_request(view, max_error=0.01)), light, measured_device, None)
        expected = (option.ms, option.errors.wrong, option.errors.wrong_cast)
        assert (plan.predicted.ms, plan.predicted.wrong, plan.predicted.wrong_cast) == pytest.approx(expected), name
        reason = next(item.reason for item in plan.reasons if item.name.startswith(f"{light}/") and "none" not in item.name)
        assert (
            f"expected: {format_percent(option.errors.wrong_cast)} of the cast shadow wrong in {format_duration(option.ms)}"
            in reason
        ), name


def test_predict_chooses_per_light_and_adds_times():
    """A lamp with faint shadows shines beside the sun. Each light meets the target, and they share the time."""
    lamp = LampFacts(name="lamp", kind="spot", cutoff_deg=45.0, reference_m=50.0)
    view = make_descriptor(lamps=(lamp,), lights={SUN: shadow_facts(), "lamp": shadow_facts(0.05)})
    plan_request = StandaloneRequest(Shadows(max_error=0.01), (SUN, "lamp"))
    plan = predicted_plan(view, plan_request, None, device(), ERROR_MODEL)
    planner = planner_of(view, plan_request)
    options = [predicted_option(plan, planner, light, device()) for light in (SUN, "lamp")]
    assert plan.predicted.ms == pytest.approx(sum(item.ms for item in options)) and min(item.ms for item in options) > 0.0
    assert plan.predicted.wrong_cast == pytest.approx(max(item.errors.wrong_cast for item in options))
    assert plan.predicted.wrong == pytest.approx(max(item.errors.wrong for item in options))
    late_plan = predicted_plan(
        view, StandaloneRequest(Shadows(max_error=0.01, max_ms=1e-3), (SUN, "lamp")), None, device(), ERROR_MODEL
    )
    assert {item.name for item in late_plan.reasons if item.name.endswith("target missed")} == {
        "sun: target missed",
        "lamp: target missed",
    }


def test_predict_gives_expected_error_as_reason_of_rejection():
    plan = plan_view(make_descriptor(), max_error=0.01)
    reasons = {item.name: item.reason for item in plan.rejected}
    assert reasons["planar"].startswith("expected at best: an error of 25 %, 24 % more than 1.0 %")
    assert "ms with shadow_volume" in reasons["shadow_volume"] and "the choice takes " in reasons["shadow_volume"]
    assert "shadow_map" not in reasons and reasons["truth"]


def test_predict_at_night_takes_none_and_meets_the_target():
    night = make_descriptor(sun_altitude_deg=-20.0, highest_sun_deg=-20.0)
    plan = plan_view(night, max_error=1e-6, max_ms=1e-3)
    assert name_of(plan) == "none" and plan.target.met is True
    assert (plan.predicted.ms, plan.predicted.wrong_cast) == (0.0, 0.0)


def test_a_bounded_search_names_what_it_left_out(monkeypatch: pytest.MonkeyPatch):
    view = make_descriptor()
    names = [
        item.choice.name for item in predicted_choices(planner_of(view, make_request(view)), SUN, ["meshes"], device(), ERROR_MODEL)
    ]
    assert not [item for item in plan_view(view).reasons if item.name == "sun: search"], "all choices are searched"
    monkeypatch.setattr(predict, "MAX_OPTIONS", 3)
    plan = plan_view(view)
    (reason,) = (item.reason for item in plan.reasons if item.name == "sun: search")
    assert reason == f"3 of {len(names)} choices were searched; not searched: {', '.join(names[3:])}"
    assert name_of(plan) in names[:3]


@pytest.mark.parametrize(("triangles", "is_tried"), [(MAX_GROUND_TRIANGLES, True), (MAX_GROUND_TRIANGLES + 1, False)])
def test_volumes_of_too_much_ground_are_not_tried_and_the_plan_says_so(triangles: int, is_tried: bool):
    ground = CasterFacts(kind="relief", count=1, triangles=triangles, closed_share=1.0, height_m=50.0, width_m=1000.0)
    casts = {"relief": shadow_facts().casts["meshes"]}
    view = make_descriptor(
        flat_world=False, relief_m=50.0, casters=("relief",), stands=(ground,),
        lights={SUN: LightFacts(cast_share=0.2, silhouette_edges=200, volume_layers=1.0, casts=casts)},
    )  # fmt: skip
    reasons = {item.name: item.reason for item in plan_view(view, max_error=0.5).rejected}
    for name in ("shadow_volume", "hybrid"):
        assert (reasons.get(name) == GROUND_EXCLUSION_REASON) == (not is_tried), reasons
        assert is_tried or "262,144 triangles" in reasons[name]
