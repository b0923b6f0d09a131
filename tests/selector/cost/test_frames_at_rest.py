"""Times of frames in which nothing has moved: the work of what is cached is not counted."""

from __future__ import annotations

import pytest

from skugga.selector.choices import StandaloneRequest
from skugga.selector.cost.cost_model import frames_at_rest_ms, predicted_ms, step_work
from skugga.selector.observation import Observation
from skugga.selector.planner.planner import make_plan, planner_of
from skugga.selector.predict import predicted_plan
from skugga.shadows.maps.settings import LampMapSettings
from skugga.shadows.maps.work import DRAWING_COUNTS
from skugga.shadows.plan import Plan, Step
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.work import RESULTS_AT_REST
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import LampFacts, LightFacts
from skugga.terrain.level.level import SUN, Shadows
from tests.selector.cost.test_cost_model import make_descriptor, make_map_descriptor, profile
from tests.selector.test_predict import ERROR_MODEL, device, predicted_option, shadow_facts
from tests.selector.test_predict import make_descriptor as make_bodies
from tests.selector.test_predict import plan_view as plan_bodies

RATES_NS = {
    part: dict.fromkeys([*DRAWING_COUNTS, "blocks", "look-ups, filter 1", "fitted pixels", "faces drawn"], 1.0)
    for part in (
        "shadow_map, perspective", "shadow_map, map", "shadow_map, spot", "perspective_shadow_map, sun", "silhouettes, perspective",
        "counting, perspective", "conservative map, perspective", "mask", "sweep, perspective",
    )
}  # fmt: skip
"""One nanosecond for each unit of work."""


def plan_for(descriptor: Descriptor, **shadows) -> Plan:
    """Return the plan of a descriptor by rules, for a level with keys of ``shadows``."""
    return make_plan(descriptor, StandaloneRequest(Shadows(**shadows), tuple(descriptor.lights)))


def only_step(descriptor: Descriptor, **shadows) -> Step:
    """Return the single step of the plan for ``shadows``."""
    (step,) = plan_for(descriptor, **shadows).steps_of_light(SUN)
    return step


@pytest.mark.parametrize("algorithm", ["shadow_map", "perspective_shadow_map", "light_space_perspective_map"])
def test_cached_maps_are_looked_up_but_not_drawn(algorithm):
    view = make_descriptor()
    step = only_step(view, algorithm=algorithm, map_size=1024)
    (anew,), (rest,) = (
        step_work(view, SUN, step.kinds, algorithm, step.settings, cached).values() for cached in (frozenset(), RESULTS_AT_REST)
    )
    assert anew["texels"] > 0.0 and anew["triangles"] > 0.0
    assert not DRAWING_COUNTS & rest.keys()
    assert rest == {name: count for name, count in anew.items() if name not in DRAWING_COUNTS}
    assert any(name.startswith("look-ups, filter") and count > 0.0 for name, count in rest.items())


@pytest.mark.parametrize(
    ("algorithm", "kept"),
    [("shadow_volume", {"silhouettes, perspective"}), ("hybrid", {"silhouettes, perspective", "conservative map, perspective"})],
)
def test_cached_volumes_and_masks_have_no_work(algorithm, kept):
    view = make_descriptor()
    step = only_step(view, algorithm=algorithm)
    anew, rest = (step_work(view, SUN, step.kinds, algorithm, step.settings, cached) for cached in (frozenset(), RESULTS_AT_REST))
    assert anew.keys() - rest.keys() == kept
    assert all(rest[part] == anew[part] for part in rest)


def test_sweep_keeps_its_ground_for_one_sun_only():
    view = make_descriptor()
    counts, for_disc = (
        step_work(view, SUN, ("relief",), "sweep", settings, RESULTS_AT_REST)["sweep, perspective"]
        for settings in (SweepSettings(), SweepSettings(filter="sun"))
    )
    assert "decimated" not in counts and "decimated" in for_disc
    assert counts["points"] > 0.0


@pytest.mark.parametrize("moving", [{"moves": True}, {"camera_moves": True}])
@pytest.mark.parametrize("algorithm", ["shadow_map", "shadow_volume", "hybrid"])
def test_frame_costs_as_much_as_a_new_one_where_something_moves(algorithm, moving):
    resting, moved = make_descriptor(), make_descriptor(**moving)
    step = only_step(resting, algorithm=algorithm)
    new_ms = predicted_ms(profile(RATES_NS), moved, SUN, step.kinds, algorithm, step.settings)
    assert frames_at_rest_ms(profile(RATES_NS), moved, [step])[SUN] == pytest.approx(new_ms)
    assert frames_at_rest_ms(profile(RATES_NS), resting, [step])[SUN] < new_ms


def test_blocks_of_maps_keep_nothing():
    view = make_map_descriptor()
    step = only_step(view, algorithm="shadow_map", map_size=1024)
    new_ms = predicted_ms(profile(RATES_NS), view, SUN, step.kinds, "shadow_map", step.settings)
    assert frames_at_rest_ms(profile(RATES_NS), view, [step])[SUN] == pytest.approx(new_ms)


@pytest.mark.parametrize(("lamp_count", "is_cached"), [(4, True), (5, False)])
def test_maps_that_do_not_fit_the_pool_together_are_drawn_again(lamp_count, is_cached):
    """A lamp's map of 4096 texels of 32 bits takes 64 MiB of the pool's 256."""
    names = [f"lamp{number}" for number in range(lamp_count)]
    lamps = tuple(LampFacts(name=name, kind="spot", cutoff_deg=45.0, reference_m=50.0) for name in names)
    view = make_descriptor(
        lamps=lamps,
        lights={name: LightFacts() for name in names},
        sun_altitude_deg=None,
        sun_azimuth_deg=None,
        highest_sun_deg=None,
    )
    settings = LampMapSettings(map_size=4096, depth_bits=32, filter=1)
    steps = [Step(name, ("meshes",), "shadow_map", settings) for name in names]
    at_rest = frames_at_rest_ms(profile(RATES_NS), view, steps)
    new_ms = predicted_ms(profile(RATES_NS), view, "lamp0", ("meshes",), "shadow_map", settings)
    assert at_rest.keys() == set(names)
    assert (at_rest["lamp0"] < new_ms) == is_cached


def test_plan_tells_both_times():
    plan = plan_bodies(make_bodies(), algorithm="hybrid")
    # Of silhouettes (1 ms), map (20 ms), mask (10 ms) and counting, the first two are cached.
    assert plan.predicted.ms_at_rest == pytest.approx(plan.predicted.ms - 21.0)
    moving = plan_bodies(make_bodies(moves=True), algorithm="hybrid")
    assert moving.predicted.ms_at_rest == moving.predicted.ms == plan.predicted.ms
    night = plan_bodies(make_bodies(sun_altitude_deg=-20.0, highest_sun_deg=-20.0))
    assert night.predicted.ms_at_rest == night.predicted.ms == 0.0


def test_plan_of_a_map_tells_no_time_at_rest():
    view = make_bodies(view_kind="map", pixel=None)
    rates_ns = {"shadow_map, map": {"blocks": 5e6}}
    plan = predicted_plan(view, StandaloneRequest(Shadows(), (SUN,)), None, device(rates_ns=rates_ns), ERROR_MODEL)
    assert plan.predicted.ms > 0.0 and plan.predicted.ms_at_rest is None


def test_plan_adds_the_times_of_lights_at_rest():
    lamp = LampFacts(name="lamp", kind="spot", cutoff_deg=45.0, reference_m=50.0)
    view = make_bodies(lamps=(lamp,), lights={SUN: shadow_facts(), "lamp": shadow_facts(0.05)})
    plan = predicted_plan(view, StandaloneRequest(Shadows(algorithm="hybrid"), (SUN, "lamp")), None, device(), ERROR_MODEL)
    assert plan.predicted.ms_at_rest == pytest.approx(plan.predicted.ms - 42.0)


def test_observed_times_are_scaled_by_the_share_that_remains():
    """A probe took twice as long as expected. The frame at rest then takes twice as long, too."""
    plan_request = StandaloneRequest(Shadows(algorithm="hybrid", mask="conservative", map_size=768), (SUN,))
    plan = predicted_plan(make_bodies(), plan_request, None, device(), ERROR_MODEL)
    option = predicted_option(plan, planner_of(make_bodies(), plan_request), SUN, device())
    noises = {"error_noise": 1e-6, "interior_noise": 1e-6, "ms_noise": 1e-6}
    observation = Observation(choice=option.choice.name, ms=2.0 * plan.predicted.ms, error=1e-4, interior=0.0, **noises)
    slow = predicted_plan(make_bodies(), plan_request, None, device(), ERROR_MODEL, {SUN: [observation]})
    assert slow.predicted.ms == pytest.approx(2.0 * plan.predicted.ms, rel=0.01)
    assert slow.predicted.ms_at_rest / slow.predicted.ms == pytest.approx(plan.predicted.ms_at_rest / plan.predicted.ms)
