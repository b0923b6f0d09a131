"""Rules policy: each rule of the thesis's advice, their order, and the thesis's scenes, on hand-written descriptors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.choices import Choice, StandaloneRequest
from skugga.selector.planner import advice
from skugga.selector.planner.advice import NO_RULE_REASON, choices_by_rules
from skugga.selector.planner.advice_rules import (
    MAX_LAMP_DISTANCE_SHARE,
    MAX_SHARP_TEXEL_PX,
    MAX_VISIBLE_LIT_SHARE,
    MAX_VOLUME_TRIANGLES,
    MIN_CLOSED_SHARE,
    MIN_COARSE_TEXEL_PX,
    MIN_COMPLEX_LAYERS,
    MIN_TEXEL_GAIN,
    REFERENCE_MAP_TEXELS,
    RULES,
    TYPICAL_MAP_ERROR,
    RuleInput,
)
from skugga.selector.planner.planner import make_plan
from skugga.shadows.bent_rays import MAX_STRAIGHT_RAYS_EXTENT_M, MAX_SUMMIT_SHIFT_PX
from skugga.shadows.registry import can_serve
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CasterFacts, LightFacts
from skugga.terrain.geo.world import EARTH_RADIUS_M
from skugga.terrain.level.level import Shadows, load_level
from skugga.terrain.scene import build_scene

TEXEL_M = 0.5
"""Texel of the usual map over the hand-written view, metres."""

PIXEL_TANGENT = 0.001
"""Tangent of a pixel in that view: at 500 m a texel covers one pixel."""

LAMP = {"name": "lamp", "kind": "spot", "cutoff_deg": 30.0, "reference_m": 40.0}


def band(near_m: float, far_m: float, share: float = 0.5) -> dict[str, Any]:
    """Return the keys of a band of distances. ``share`` is its share of the points."""
    return {"near_m": near_m, "far_m": far_m, "share": share, "low_light_m": (-1.0, -1.0, -1.0), "high_light_m": (1.0, 1.0, 1.0)}


def sun_descriptor(*casters: str, **keys: Any) -> Descriptor:
    """Return a hand-written perspective view of a flat world under the sun, from 16 m to 1 km, without further facts."""
    fields = {
        "view": "by hand", "view_kind": "perspective", "flat_world": True, "pixel_m": 0.1, "pixel": PIXEL_TANGENT, "node_m": 1.0,
        "casters": casters, "relief_m": 50.0 if "relief" in casters else 0.0, "block_relief_m": 50.0,
        "sun_azimuth_deg": 200.0, "sun_altitude_deg": 30.0, "highest_sun_deg": 30.0,
        "receivers_light_m": (TEXEL_M * REFERENCE_MAP_TEXELS, 300.0, 500.0), "bands": [band(16.0, 32.0), band(512.0, 1024.0)],
    }  # fmt: skip
    return Descriptor.model_validate(fields | keys)


def map_descriptor(*casters: str, **keys: Any) -> Descriptor:
    """Return the descriptor of a map under the sun with these kinds of casters."""
    return sun_descriptor(*casters, view_kind="map", pixel=None, bands=[], **keys)


def sun_facts(**facts: Any) -> dict[str, LightFacts]:
    """Return the facts of the sun in a descriptor."""
    return {"sun": LightFacts(**facts)}


def make_caster_facts(kind: str = "meshes", triangles: int = 50_000, **facts: Any) -> CasterFacts:
    """Return the facts of one kind of casters in a descriptor."""
    return CasterFacts(kind=kind, triangles=triangles, **facts)


def near_edge_facts(texel_px: float, **facts: Any) -> dict[str, LightFacts]:
    """Return a light whose nearest edge is where a texel covers that many pixels."""
    return sun_facts(nearest_edge_m=TEXEL_M / PIXEL_TANGENT / texel_px, **facts)


def rule_choices(descriptor: Descriptor, **settings: Any) -> dict[str, Choice]:
    """Return the choices of the rules for all lights."""
    return choices_by_rules(descriptor, Shadows(**settings), descriptor.light_kinds)


def chosen_algorithm(descriptor: Descriptor, kind: str = "meshes", light_name: str = "sun", **settings: Any) -> str:
    """Return the algorithm that the fixed rules choose for a kind of casters under a light."""
    return rule_choices(descriptor, **settings)[light_name].algorithm[kind]


def rule_of(descriptor: Descriptor, kind: str = "meshes", light_name: str = "sun") -> str | None:
    """Return the name of the first rule that applies and can be served."""
    case = RuleInput(descriptor, light_name, kind, Shadows())
    names = (rule.name for rule in RULES if can_serve(rule.algorithm, descriptor, light_name, kind) and rule.reason_for(case))
    return next(names, None)


def test_rules_fall_back_to_a_map_without_facts():
    """A rule does not apply while its facts are unknown. The fallback is a shadow map."""
    for descriptor in (sun_descriptor("meshes"), sun_descriptor("meshes", bands=[], pixel=None, receivers_light_m=None)):
        choice = rule_choices(descriptor)["sun"]
        assert choice.algorithm == {"meshes": "shadow_map"} and choice.reason == {"meshes": NO_RULE_REASON}
    round_earth = sun_descriptor("relief", flat_world=False)  # the extent of the ground to sweep is unknown
    assert rule_of(round_earth, "relief") is None
    assert rule_choices(map_descriptor("relief", sun_azimuth_deg=None, sun_altitude_deg=None, highest_sun_deg=None))


@pytest.mark.parametrize("descriptor", [sun_descriptor("relief", "meshes"), map_descriptor("relief", "meshes")])
def test_rules_sweep_relief_but_not_meshes(descriptor):
    assert rule_of(descriptor, "relief") == "a heightfield is swept" and chosen_algorithm(descriptor, "relief") == "sweep"
    assert chosen_algorithm(descriptor, "meshes") == "shadow_map"


def test_rules_do_not_sweep_under_lamps():
    assert chosen_algorithm(sun_descriptor("relief", lamps=[LAMP]), "relief", "lamp") == "shadow_map"


def test_rules_sweep_ground_only_while_rays_are_straight():
    """The block has 1024 pixels and reaches as far as its longest shadow: 50 m / tan 30 degrees, slightly less on a round earth."""
    max_pixel_m = (MAX_STRAIGHT_RAYS_EXTENT_M - 50.0 / np.tan(np.radians(30.0))) / 1024
    for pixel_m, algorithm in ((0.999 * max_pixel_m, "sweep"), (1.001 * max_pixel_m, "shadow_map")):
        wide = map_descriptor(
            "relief", flat_world=False, pixel_m=pixel_m, receivers_light_m=(2e5, 1e5, 2e5), lights=sun_facts(area_share=0.9)
        )
        assert chosen_algorithm(wide, "relief") == algorithm
    small = map_descriptor("relief", flat_world=False, pixel_m=1e4, lights=sun_facts(area_share=1.0))
    assert chosen_algorithm(small, "relief") == "sweep"  # the whole level, in large pixels
    assert chosen_algorithm(map_descriptor("relief", pixel_m=1e4), "relief") == "sweep"  # rays are straight in a flat world
    # In perspective the whole level counts: square, with 512 m x 300 m / sin 30 degrees visible.
    limit_share = TEXEL_M * REFERENCE_MAP_TEXELS * 300.0 / 0.5 / MAX_STRAIGHT_RAYS_EXTENT_M**2
    for share, algorithm in ((1.001 * limit_share, "sweep"), (0.999 * limit_share, "perspective_shadow_map")):
        assert (
            chosen_algorithm(sun_descriptor("relief", flat_world=False, lights=sun_facts(area_share=share)), "relief") == algorithm
        )


def test_rules_sweep_as_wide_an_angle_on_a_small_body():
    """The block, 1024 pixels of 10 m and its longest shadow, is as wide as 200 km on the earth if the radius is as much smaller."""
    block_m = 1024 * 10.0 + 50.0 / np.tan(np.radians(30.0))
    limit_m = EARTH_RADIUS_M * block_m / MAX_STRAIGHT_RAYS_EXTENT_M
    for radius_m, algorithm in ((1.001 * limit_m, "sweep"), (0.999 * limit_m, "shadow_map")):
        small_body = map_descriptor(
            "relief", flat_world=False, radius_m=radius_m, pixel_m=10.0, block_relief_m=1.0, receivers_light_m=(2e4, 1e4, 2e4),
            lights=sun_facts(area_share=0.9),
        )  # fmt: skip
        assert chosen_algorithm(small_body, "relief") == algorithm


def test_rules_sweep_while_summits_lean_by_less_than_a_pixel():
    """In a corner of the block, 512 sqrt(2) pixels from its middle, verticals lean by as many pixels per radius."""
    radius_m = 1_737_400.0
    limit_m = MAX_SUMMIT_SHIFT_PX * radius_m / (512.0 * np.sqrt(2.0))
    for relief_m, algorithm in ((0.999 * limit_m, "sweep"), (1.001 * limit_m, "shadow_map")):
        facts = {"flat_world": False, "block_relief_m": relief_m, "pixel_m": 10.0, "receivers_light_m": (2e4, 1e4, 2e4)}
        moon = map_descriptor("relief", radius_m=radius_m, lights=sun_facts(area_share=0.9), **facts)
        assert chosen_algorithm(moon, "relief") == algorithm
        assert chosen_algorithm(map_descriptor("relief", lights=sun_facts(area_share=0.9), **facts), "relief") == "sweep"


def test_rules_take_volumes_for_strict_errors_except_foliage():
    """Ground is swept all the same: a sweep has no texels either."""
    descriptor = sun_descriptor("relief", "meshes", "forest")
    choice = rule_choices(descriptor, max_error=0.9 * TYPICAL_MAP_ERROR)["sun"]
    assert choice.algorithm == {"relief": "sweep", "meshes": "shadow_volume", "forest": "shadow_map"}
    assert chosen_algorithm(descriptor, max_error=TYPICAL_MAP_ERROR) == "shadow_map"


@pytest.mark.parametrize(
    ("overrides", "relief", "meshes"),
    [
        ({}, "sweep", "shadow_volume"), ({"filter": 1}, "sweep", "shadow_volume"), ({"filter": "sun"}, "sweep", "shadow_map"),
        ({"filter": 5}, "shadow_map", "shadow_map"), ({"map_size": 512}, "shadow_map", "shadow_map"),
        ({"bias": "polygon_offset"}, "shadow_map", "shadow_map"), ({"stencil": "two_pass"}, "sweep", "shadow_volume"),
    ],
)  # fmt: skip
def test_rules_take_a_map_if_its_settings_are_requested(overrides, relief, meshes):
    descriptor = sun_descriptor("relief", "meshes", stands=[make_caster_facts(triangles=12, closed_share=1.0)])
    assert (
        chosen_algorithm(descriptor, "relief", **overrides) == relief
        and chosen_algorithm(descriptor, "meshes", **overrides) == meshes
    )


def test_rules_take_a_map_for_foliage_and_its_neighbours():
    few = {"stands": [make_caster_facts(triangles=12, closed_share=1.0)]}
    assert rule_of(sun_descriptor("meshes", **few)) == "few polygons"
    assert (
        rule_of(sun_descriptor("meshes", "forest", **few))
        == rule_of(sun_descriptor("meshes", "forest"), "forest")
        == "foliage needs a map"
    )


def test_rules_take_volumes_for_few_closed_polygons():
    for triangles, closed, algorithm in (
        (MAX_VOLUME_TRIANGLES, MIN_CLOSED_SHARE, "shadow_volume"), (MAX_VOLUME_TRIANGLES + 1, 1.0, "shadow_map"),
        (MAX_VOLUME_TRIANGLES, 0.9 * MIN_CLOSED_SHARE, "shadow_map"), (0, 1.0, "shadow_map"),
    ):  # fmt: skip
        descriptor = sun_descriptor("meshes", stands=[make_caster_facts(triangles=triangles, closed_share=closed)])
        assert chosen_algorithm(descriptor) == algorithm
    few = [make_caster_facts(triangles=400, closed_share=1.0)]
    assert chosen_algorithm(map_descriptor("meshes", stands=few)) == "shadow_volume"
    assert (
        chosen_algorithm(map_descriptor("meshes", stands=few, bend_px=5.0)) == "shadow_map"
    )  # a bent map, which no affine camera fits


def test_rules_take_a_map_for_a_narrow_lamp():
    """A texel at the lamp's target is 2 x 40 m x tan(cutoff) / 1024 wide, and a pixel is 0.05 m."""
    light_facts = {"lights": {"lamp": LightFacts(nearest_edge_m=0.1, volume_layers=100.0)}}
    sharp_deg = float(np.degrees(np.arctan(MAX_SHARP_TEXEL_PX * 0.05 * REFERENCE_MAP_TEXELS / 80.0)))
    for cutoff_deg, name in ((0.99 * sharp_deg, "narrow light"), (1.01 * sharp_deg, "complex shadows from near")):
        descriptor = sun_descriptor("meshes", lamps=[LAMP | {"cutoff_deg": cutoff_deg}], pixel_m=0.05, **light_facts)
        assert rule_of(descriptor, light_name="lamp") == name
    assert rule_of(sun_descriptor("meshes", pixel_m=0.05)) is None  # the rule does not apply to the sun


def lamp_descriptor(nearest_edge_m: float = 4.0, cutoff_deg: float = 60.0, **facts: Any) -> Descriptor:
    """Return the hand-written view under a spot whose texels are coarse, with complex shadows near the camera."""
    lamp_facts = LightFacts(nearest_edge_m=nearest_edge_m, volume_layers=2 * MIN_COMPLEX_LAYERS, **facts)
    return sun_descriptor("meshes", lamps=[LAMP | {"cutoff_deg": cutoff_deg}], lights={"lamp": lamp_facts}, bands=[], pixel_m=0.05)


def test_rules_take_a_map_for_a_lamp_near_the_camera():
    """A miner's lamp 1 m from the eye: all edges from 4 m on are as far from the lamp as from the eye, to within a quarter."""
    for eye_to_lamp_m, name in (
        (4.0 * MAX_LAMP_DISTANCE_SHARE, "lamp near the camera"),
        (4.1 * MAX_LAMP_DISTANCE_SHARE, "complex shadows from near"),
        (None, "complex shadows from near"),
    ):
        assert rule_of(lamp_descriptor(eye_to_lamp_m=eye_to_lamp_m), light_name="lamp") == name


def test_rules_do_not_take_a_map_for_the_sun_behind_the_camera():
    """The sun is never near, and a small share of shadow does not make shadows simple."""
    lights = near_edge_facts(
        2 * MIN_COARSE_TEXEL_PX, volume_layers=2 * MIN_COMPLEX_LAYERS, to_view_deg=179.0, casts={"meshes": {"share": 0.001}}
    )
    assert rule_of(sun_descriptor("meshes", lights=lights)) == "complex shadows from near"


def test_rules_take_the_hybrid_for_near_complex_shadows():
    for texel_px, layers, name in (
        (1.01 * MIN_COARSE_TEXEL_PX, MIN_COMPLEX_LAYERS, "complex shadows from near"),
        (1.01 * MIN_COARSE_TEXEL_PX, 0.9 * MIN_COMPLEX_LAYERS, None),
        (0.99 * MIN_COARSE_TEXEL_PX, MIN_COMPLEX_LAYERS, "far from every edge"),
        (0.99 * MIN_COARSE_TEXEL_PX, 0.0, "far from every edge"),
    ):  # fmt: skip
        assert rule_of(sun_descriptor("meshes", lights=near_edge_facts(texel_px, volume_layers=layers))) == name


def test_rules_take_a_perspective_map_for_a_small_visible_part():
    for share, far_m, name in (
        (MAX_VISIBLE_LIT_SHARE, 1024.0, "small part of the lit area seen"), (1.01 * MAX_VISIBLE_LIT_SHARE, 1024.0, None),
        (MAX_VISIBLE_LIT_SHARE, 16.0 * MIN_TEXEL_GAIN, "small part of the lit area seen"),
        (MAX_VISIBLE_LIT_SHARE, 15.0 * MIN_TEXEL_GAIN, None),
    ):  # fmt: skip
        bands = [band(16.0, 32.0), band(32.0, far_m)]
        assert (
            rule_of(sun_descriptor("meshes", bands=bands, lights=near_edge_facts(2 * MIN_COARSE_TEXEL_PX, area_share=share)))
            == name
        )


def cast_band(near_m: float, far_m: float) -> dict[str, Any]:
    """Return the keys of a band of distances of the cast shadow."""
    return {"near_m": near_m, "far_m": far_m, "share": 0.4, "cast": 0.1, "pixel_m": 0.1, "light_m": 40.0, "differs": (0.1,) * 8}


def test_rules_take_a_perspective_map_under_a_spot():
    """The bands of the sun's view are unknown under a spot. Those of the visible surfaces in its light decide."""
    for share, far_m, name in (
        (MAX_VISIBLE_LIT_SHARE, 16.0 * MIN_TEXEL_GAIN, "small part of the lit area seen"),
        (1.01 * MAX_VISIBLE_LIT_SHARE, 16.0 * MIN_TEXEL_GAIN, None), (MAX_VISIBLE_LIT_SHARE, 15.0 * MIN_TEXEL_GAIN, None),
    ):  # fmt: skip
        casts = {"meshes": {"share": 0.1, "bands": [cast_band(16.0, 32.0), cast_band(32.0, far_m)]}}
        facts = LightFacts(nearest_edge_m=4.0, area_share=share, casts=casts)
        descriptor = sun_descriptor("meshes", lamps=[LAMP | {"cutoff_deg": 60.0}], lights={"lamp": facts}, bands=[], pixel_m=0.05)
        assert rule_of(descriptor, light_name="lamp") == name


FACTS = st.builds(
    LightFacts,
    to_view_deg=st.none() | st.floats(0, 180), eye_to_lamp_m=st.none() | st.floats(0, 1e5),
    cast_share=st.floats(0, 1), area_share=st.floats(0, 1),
    nearest_edge_m=st.none() | st.floats(0, 1e5), volume_layers=st.floats(0, 1e3), silhouette_edges=st.integers(0, 10**6),
    casts=st.dictionaries(st.sampled_from(["relief", "meshes"]), st.fixed_dictionaries({"share": st.floats(0, 1)})),
)  # fmt: skip


@given(
    facts=FACTS, of_lamp=FACTS, is_map=st.booleans(), flat=st.booleans(), forest=st.booleans(), bend_px=st.floats(0, 2),
    triangles=st.integers(0, 10**7), closed=st.floats(0, 1), max_error=st.floats(1e-6, 1), omni=st.booleans(),
)  # fmt: skip
def test_rules_choose_served_algorithms_with_reasons(
    facts, of_lamp, is_map, flat, forest, bend_px, triangles, closed, max_error, omni
):
    casters = ("relief", "meshes", *(("forest",) if forest else ()))
    lamp = LAMP | ({"kind": "omni", "cutoff_deg": 180.0} if omni else {})
    descriptor = (map_descriptor if is_map else sun_descriptor)(
        *casters, flat_world=flat, bend_px=bend_px, lamps=[lamp], lights={"sun": facts, "lamp": of_lamp},
        stands=[make_caster_facts(triangles=triangles, closed_share=closed)],
    )  # fmt: skip
    choices = rule_choices(descriptor, max_error=max_error)
    assert list(choices) == ["sun", "lamp"]
    for light_name, choice in choices.items():
        assert set(choice.algorithm) == set(choice.reason) == set(casters)
        for kind, name in choice.algorithm.items():
            assert can_serve(name, descriptor, light_name, kind) and choice.reason[kind]
            assert not (is_map and name == "perspective_shadow_map")
            assert not (kind == "forest" and name in ("shadow_volume", "hybrid", "sweep"))
    plan = make_plan(descriptor, StandaloneRequest(Shadows(max_error=max_error), ("sun", "lamp")))
    assert all(item.reason for item in (*plan.reasons, *plan.rejected)) and plan.policy == "rules"


def test_rules_have_unique_names_sources_and_known_algorithms():
    assert len({rule.name for rule in RULES}) == len(RULES) and all(rule.source for rule in RULES)
    assert {rule.algorithm for rule in RULES} == {"shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid", "sweep"}


THESIS_SCENES = {
    ("thesis_street", "main"): "shadow_volume", ("thesis_street_sun", "close"): "shadow_volume",
    ("thesis_boxgrid_sun", "main"): "hybrid", ("thesis_boxgrid_sun", "overview"): "shadow_map",
    ("thesis_boxgrid_sun", "map"): "shadow_map", ("thesis_rocks_sun", "main"): "perspective_shadow_map",
    ("thesis_rocks", "main"): "perspective_shadow_map", ("thesis_rocks", "overview"): "shadow_map",
    ("thesis_room", "overview"): "shadow_map", ("thesis_room", "close"): "hybrid", ("thesis_water_tower", "main"): "shadow_map",
}  # fmt: skip
"""Algorithm of the rules for the meshes of the thesis's scenes by the advice of its section 8.2.

Street has few polygons, the box grid and the room have complex shadows near the camera, the stone circles are a large lit area of
which the camera sees a little, and the water tower's lamp has a narrow cone.
"""


@pytest.mark.parametrize(("level", "view"), THESIS_SCENES)
def test_rules_follow_the_thesis_on_its_scenes(gl, level, view):
    scene = build_scene(load_level(f"configs/{level}.yaml"))
    light_name = "sun" if level.endswith("_sun") else "lamp"
    plan = make_plan(describe(scene, scene.view(view), view), scene.loaded.level)
    assert plan.algorithm[light_name] == {"relief": "none", "meshes": THESIS_SCENES[level, view]}


@pytest.mark.parametrize(
    ("view", "planned"), [(sun_descriptor, ["sun", "lamp"]), (map_descriptor, ["sun", "lamp", "far0", "far1"])]
)
def test_rules_see_only_planned_lights(view, planned, monkeypatch):
    """A perspective view plans the lights that reach it. A map's plan may stand for other blocks of its scale, so it plans all."""
    evaluated_lights, original_first = [], advice._first_applicable_rule
    monkeypatch.setattr(advice, "_first_applicable_rule", lambda case: evaluated_lights.append(case.light) or original_first(case))
    unreaching_lamps = [LAMP | {"name": f"far{number}", "reaches": False} for number in range(2)]
    plan = make_plan(view("meshes", lamps=[LAMP, *unreaching_lamps]), StandaloneRequest(Shadows(), ("sun", "lamp", "far0", "far1")))
    assert list(plan.lights) == evaluated_lights == planned
