"""Replanning along a camera path: number of plan switches and visible change.

The camera glides over open ground, dives into a wood and glides there until the sun is down.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, partial
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.selector import replanning
from skugga.selector.choices import Choice
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.planner.planner import make_plan
from skugga.selector.replanning import (
    INITIAL_PATIENCE_FRAMES,
    MAX_CHANGED_SHARE,
    Replanner,
    casting_kinds,
    mix_pictures,
    next_share,
)
from skugga.selector.select import select
from skugga.shadows.plan import Plan, Predicted
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.level.level import SUN, Level, Pin, SunSpec, load_level
from skugga.terrain.scene import Scene, build_scene

CameraPose = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Camera position and target: metres east, north and above the ground."""

ROWS, COLS, FOV_DEG = 192, 256, 50.0
HOUSES_START, HOUSES_END = ((-150.0, -120.0, 45.0), (-330.0, -290.0, 0.0)), ((-130.0, -110.0, 45.0), (-310.0, -280.0, 0.0))
"""Ends of the first glide: houses are visible, and the wood lies behind the camera."""

WOOD_START, WOOD_END = ((190.0, 180.0, 14.0), (270.0, 280.0, 2.0)), ((205.0, 200.0, 13.0), (285.0, 300.0, 2.0))
"""Ends of the second glide, among trees."""

HOUSES_AND_WOOD = ((-160.0, -150.0, 60.0), (100.0, 100.0, 0.0))
"""Houses, and the wood beyond them."""

GLIDE_FRAMES, DIVE_FRAMES, COMPARED_FRAMES = 20, 12, 8
"""Frame counts: of each glide, of the dive, and of the switch whose first frames are compared."""

RATES_NS = {
    "shadow_map, perspective": {
        "blocks": 5.3e6, "maps": 8.3e5, "fitted pixels": 6.2, "look-ups by texels": 5.2, "look-ups, filter 1": 75.0,
        "look-ups, filter 3": 129.0, "ground": 148.0, "triangles": 239.0, "trees": 134.0, "trees drawn": 5900.0, "texels": 0.92,
        "texels of ground": 3.2, "texels of leaves": 12.8, "texels in shadow": 0.37,
    },
    "perspective_shadow_map, sun": {
        "blocks": 16.0e6, "fitted pixels": 13.5, "look-ups by texels": 12.1, "look-ups, filter 1": 83.0,
        "look-ups, filter 3": 127.0, "ground": 122.0, "triangles": 143.0, "trees": 613.0, "trees drawn": 5000.0,
        "texels of ground": 4.0, "texels of leaves": 16.7, "texels in shadow": 7.2,
    },
    "silhouettes, perspective": {"blocks": 1.4e6, "edges": 573.0, "ground": 211.0, "triangles": 210.0},
    "counting, perspective": {
        "blocks": 3.5e6, "pixels": 25.0, "facing": 40.0, "faces drawn": 960.0, "layers": 63.0, "faces beside marks": 1890.0,
        "layers beside marks": 90.0,
    },
    "conservative map, perspective": {"texels": 18.9, "texels in shadow": 11.1, "caps": 1460.0, "ground": 1250.0, "facing": 5.8},
    "mask": {"blocks": 1.4e5, "pixels": 35.0, "texels": 0.55},
    "planar": {"blocks": 2.2e6, "pixels": 9.6, "triangles": 183.0},
    "sweep, perspective": {"blocks": 53.0e6, "nodes": 9.4, "steps": 2.4, "answers": 113.0},
}  # fmt: skip
"""Rates of a device that renders on the CPU: each algorithm is the cheapest somewhere."""

predict_plan = partial(
    select,
    policy="predict",
    device=DeviceProfile(
        renderer="a device", version="1", cpus=2, engine="0", measured=datetime(2025, 1, 1, tzinfo=UTC), took_s=1.0,
        rates_ns=RATES_NS,
    ),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Moment:
    """The content of a frame."""

    scene: Scene
    view: PerspectiveView
    descriptor: Descriptor


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Return hills with forty houses in the south-west and a wood in the north-east."""
    folder = tmp_path_factory.mktemp("camera_path")
    trimesh.creation.box((14.0, 10.0, 9.0)).export(folder / "house.ply")
    number = np.arange(40)
    places = np.stack([(number * 0.6180339887498949) % 1.0 - 1.0, (number + 0.5) / 40 - 1.0], axis=1) * 400.0
    ring = [[150, 150], [450, 150], [450, 450], [150, 450], [150, 150]]
    wood = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    crs = {"type": "name", "properties": {"name": ENGINEERING_CRS_WKT}}
    (folder / "wood.geojson").write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [wood]}))
    level = {
        "version": 1,
        "terrain": {"generate": {"kind": "landscape", "size": [1200, 1200], "cell": 10, "relief": 60, "seed": 5}},
        "meshes": [{"source": "house.ply", "at": places.round(2).tolist()}],
        "forest": [{"source": "wood.geojson", "density": 60, "height": [8, 16], "species": "mixed", "seed": 3}],
        "sun": {"azimuth": 200, "altitude": 35},
    }  # fmt: skip
    (folder / "hills.yaml").write_text(json.dumps(level))
    return build_scene(load_level(folder / "hills.yaml"))


@pytest.fixture(scope="module")
def level(scene) -> Level:
    """The scene's level."""
    return scene.loaded.level


def moment(scene: Scene, pose: CameraPose) -> Moment:
    """Return the moment of a flight with a camera at ``pose``: eye and target."""
    (eye, up_vector), (target, _) = (scene.geolocator.point_above_ground(point, "place") for point in pose)
    view = look_at(eye, target, up_vector, FOV_DEG, ROWS, COLS)
    return Moment(scene, view, describe(scene, view, "flight"))


def interpolate_poses(start: CameraPose, end: CameraPose, frames: int) -> list[CameraPose]:
    """Return ``frames`` poses from ``start``, in equal steps towards ``end``, which is not included."""
    steps = np.linspace(np.array(start), np.array(end), frames, endpoint=False)
    return [tuple(map(tuple, step.tolist())) for step in steps]


@pytest.fixture(scope="module")
def flight(scene) -> Callable[[float, float], list[Moment]]:
    """Return ``flight(azimuth, altitude)``, the whole path under a sun that is down in the last frames."""

    def moments_under_sun(azimuth: float, altitude: float) -> list[Moment]:
        day_scene, night_scene = (
            scene.with_sun(SunSpec(azimuth=azimuth, altitude=sun_altitude)) for sun_altitude in (altitude, -1.0)
        )
        poses = [
            *interpolate_poses(HOUSES_START, HOUSES_END, GLIDE_FRAMES),
            *interpolate_poses(HOUSES_END, WOOD_START, DIVE_FRAMES),
            *interpolate_poses(WOOD_START, WOOD_END, GLIDE_FRAMES),
        ]
        return [*(moment(day_scene, pose) for pose in poses), *(moment(night_scene, WOOD_END) for _ in range(3))]

    return cache(moments_under_sun)


ChosenAlgorithms = dict[tuple[str, str], tuple[str, int | None, int | None]]


def chosen_algorithms(plan: Plan) -> ChosenAlgorithms:
    """Return algorithm, map size and number of cascades by light and caster kind, of the kinds that cast."""
    result: ChosenAlgorithms = {}
    for light, per_kind in plan.algorithm.items():
        for kind, name in per_kind.items():
            settings = plan.settings.get(light, {}).get(kind)
            map_settings = getattr(settings, "map", settings)
            cascades = getattr(map_settings, "cascades", None)
            if name != "none":
                result[light, kind] = (name, getattr(map_settings, "map_size", None), None if cascades is None else len(cascades))
    return result


def caster_change_counts(plans: list[Plan]) -> list[int]:
    """Return the cumulative count of real changes before each frame: changes of the set of casters."""
    return np.cumsum([0, *(casting_kinds(previous) != casting_kinds(current) for previous, current in pairwise(plans))]).tolist()


def switch_counts(plans: list[Plan]) -> list[int]:
    """Return the cumulative count of switches before each frame: a caster of both frames changes its algorithm or settings."""
    choices = [chosen_algorithms(plan) for plan in plans]
    return np.cumsum([0, *(any(a[key] != b[key] for key in a.keys() & b.keys()) for a, b in pairwise(choices))]).tolist()


@pytest.mark.parametrize(
    "sun", [(200.0, 35.0), *(pytest.param(sun, marks=pytest.mark.long) for sun in [(200.0, 20.0), (290.0, 10.0)])]
)
def test_replanner_switches_no_more_often_than_casters_change(flight, level, sun):
    """The bound holds at every frame of the flight. Plans made anew for each frame switch back and forth."""
    moments = flight(*sun)
    replanner = Replanner(plans=predict_plan)
    plans = [replanner.plan(frame_moment.descriptor, level) for frame_moment in moments]
    fresh_plans = [predict_plan(frame_moment.descriptor, level) for frame_moment in moments]
    caster_kinds = [casting_kinds(plan)[SUN] for plan in plans]
    assert (
        "forest" not in caster_kinds[0] and "forest" in caster_kinds[GLIDE_FRAMES + DIVE_FRAMES] and caster_kinds[-1] == frozenset()
    )
    assert caster_change_counts(plans) == caster_change_counts(fresh_plans) and caster_change_counts(plans)[-1] >= 2
    assert all(
        switch_count <= change_count
        for switch_count, change_count in zip(switch_counts(plans), caster_change_counts(plans), strict=True)
    )
    assert switch_counts(fresh_plans)[-1] > caster_change_counts(fresh_plans)[-1]


def changed_share(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of the surface's pixels whose class changes."""
    valid = ~np.isnan(after)
    return float(((before < 0.5) != (after < 0.5))[valid].mean())


def test_replanner_switch_in_flight_changes_few_pixels(gl, flight, level):
    """The first frames of a switch are compared with the previous frame's mixture, drawn from the present camera."""
    replanner, share, frame_changes, full_changes = Replanner(plans=predict_plan), 0.0, [], []
    for frame_moment in flight(200.0, 20.0):
        plan = replanner.plan(frame_moment.descriptor, level)
        if len(frame_changes) == COMPARED_FRAMES:
            break
        if replanner.transition is None:
            continue
        old, new = (
            render_frame(frame_moment.scene, frame_moment.view, drawn_plan) for drawn_plan in (replanner.transition.plan, plan)
        )
        before = 0.0 if share == 1.0 else share  # the last switch is complete, and this is another one
        share = replanner.share(old.visibilities, new.visibilities)
        assert share > before
        frame_changes.append(
            changed_share(*(mix_pictures(old.visibility, new.visibility, mix_share) for mix_share in (before, share)))
        )
        full_changes.append(changed_share(old.visibility, new.visibility))
    assert (
        len(frame_changes) == COMPARED_FRAMES and max(full_changes) > 3.0 * MAX_CHANGED_SHARE
    )  # otherwise the test would be vacuous
    assert max(frame_changes) <= MAX_CHANGED_SHARE


@settings(max_examples=20)
@given(st.integers(1, 50), st.integers(1, 50), st.integers(0, 2**32 - 1))
def test_next_share_ends_and_changes_few_pixels_a_frame(rows, cols, seed):
    """The pictures are noise under two lights, half of it without a surface."""
    rng = np.random.default_rng(seed)
    valid = rng.random((rows, cols)) < 0.5
    before, after = ({light: np.where(valid, rng.random((rows, cols)), np.nan) for light in (SUN, "lamp")} for _ in range(2))
    max_changed_pixels, share, frames = max(int(MAX_CHANGED_SHARE * valid.sum()), 1), 0.0, 0
    while share < 1.0:
        previous_share, share, frames = share, next_share(before, after, share), frames + 1
        classes = [
            np.stack([mix_pictures(before[k], after[k], mix_share) < 0.5 for k in before]) for mix_share in (previous_share, share)
        ]
        assert (classes[0] != classes[1]).any(axis=0).sum() <= max_changed_pixels
    differ = np.any([(before[k] < 0.5) != (after[k] < 0.5) for k in before], axis=0)
    assert frames == max(np.ceil(differ.sum() / max_changed_pixels), 1)


def make_choice(algorithms: str, **settings: int) -> Choice:
    """Return a choice of algorithms for relief, meshes and foliage."""
    return Choice(algorithms, dict(zip(("relief", "meshes", "forest"), algorithms.split(), strict=True)), settings)


COARSE_MAP = make_choice("shadow_map shadow_map shadow_map", map_size=1024, cascades=1)
CASCADED_MAP = make_choice("shadow_map shadow_map shadow_map", map_size=2048, cascades=4)
PERSPECTIVE_MAP = make_choice("perspective_shadow_map perspective_shadow_map perspective_shadow_map", map_size=4096)
EXACT_SHADOWS = make_choice("sweep shadow_volume shadow_map", map_size=4096)


class SwitchablePolicy:
    """A policy that always takes one of its choices, and that a test switches to another.

    The current choice is predicted to take ``min_ms``, others ``other_ms``, and all to be without error.
    """

    def __init__(self, *choices: Choice, min_ms: float = 1.0, other_ms: float = 10.0) -> None:
        self.choices, self.current_index, self.min_ms, self.other_ms = choices, 0, min_ms, other_ms

    def __call__(self, descriptor: Descriptor, plan_request: Level, overrides: dict | None) -> Plan:
        choice_by_light = {SUN: self.choices[self.current_index]}
        plan = make_plan(descriptor, plan_request, overrides, choice_by_light)
        is_current = chosen_algorithms(plan) == chosen_algorithms(make_plan(descriptor, plan_request, None, choice_by_light))
        prediction = Predicted(ms=self.min_ms if is_current else self.other_ms, wrong=0.0, wrong_cast=0.0)
        return plan.model_copy(update={"policy": "predict", "predicted": prediction})


@pytest.mark.parametrize("place", [HOUSES_START, WOOD_START], ids=["in the open", "in the wood"])
@pytest.mark.parametrize("pair", [(COARSE_MAP, CASCADED_MAP), (PERSPECTIVE_MAP, EXACT_SHADOWS), (CASCADED_MAP, COARSE_MAP)])
def test_replanner_switch_at_rest_changes_few_pixels_a_frame(gl, scene, level, place, pair):
    """The bound holds whatever errors were predicted.

    The number of frames follows from it, and the last frame is the new plan's.
    """
    rest_moment, policy = moment(scene, place), SwitchablePolicy(*pair)
    replanner, pictures = Replanner(plans=policy), {}

    def render_visibilities(plan: Plan) -> dict[str, np.ndarray]:
        key = repr((plan.algorithm, plan.settings))
        if key not in pictures:
            pictures[key] = render_frame(rest_moment.scene, rest_moment.view, plan).visibilities
        return pictures[key]

    shown_pictures = [render_visibilities(replanner.plan(rest_moment.descriptor, level))[SUN]]
    policy.current_index, mixed_count = 1, 0
    for _ in range(INITIAL_PATIENCE_FRAMES + 200):
        visibilities = render_visibilities(replanner.plan(rest_moment.descriptor, level))
        picture = visibilities[SUN]
        if replanner.transition is not None:
            old_visibilities = render_visibilities(replanner.transition.plan)
            picture, mixed_count = (
                mix_pictures(old_visibilities[SUN], picture, replanner.share(old_visibilities, visibilities)),
                mixed_count + 1,
            )
        shown_pictures.append(picture)
    frame_changes = [changed_share(before, after) for before, after in pairwise(shown_pictures)]
    valid_count = int((~np.isnan(shown_pictures[0])).sum())
    assert 0.0 < max(frame_changes) <= MAX_CHANGED_SHARE
    assert mixed_count == np.ceil(
        round(changed_share(shown_pictures[0], shown_pictures[-1]) * valid_count) / int(MAX_CHANGED_SHARE * valid_count)
    )
    assert np.array_equal(
        shown_pictures[-1], render_visibilities(replanner.plan(rest_moment.descriptor, level))[SUN], equal_nan=True
    )
    assert replanner.transition is None and len(pictures) == 2


def test_replanner_draws_new_casters_at_once_and_mixes_the_rest(gl, scene, level):
    """Foliage comes into view beside houses, and all kinds change their algorithm. Leaves cast under both plans."""
    wood_moment, policy = moment(scene, HOUSES_AND_WOOD), SwitchablePolicy(COARSE_MAP, PERSPECTIVE_MAP)
    replanner = Replanner(plans=policy)
    plan_without_wood = replanner.plan(moment(scene, HOUSES_START).descriptor, level)
    assert (SUN, "forest") not in chosen_algorithms(plan_without_wood)
    policy.current_index = 1
    plan = replanner.plan(wood_moment.descriptor, level)
    assert chosen_algorithms(plan)[SUN, "forest"][0] == "perspective_shadow_map"
    assert replanner.transition is not None and chosen_algorithms(replanner.transition.plan)[SUN, "forest"][0] == "shadow_map"
    old, new = (render_frame(scene, wood_moment.view, drawn_plan) for drawn_plan in (replanner.transition.plan, plan))
    share = replanner.share(old.visibilities, new.visibilities)
    assert changed_share(old.visibility, mix_pictures(old.visibility, new.visibility, share)) <= MAX_CHANGED_SHARE
    assert changed_share(old.visibility, new.visibility) > MAX_CHANGED_SHARE


def test_replanner_keeps_the_choice_of_returning_casters(scene, level):
    """Foliage was chosen for, left the view and returns. An equal alternative does not replace its choice."""
    houses_moment, wood_moment, policy = (
        moment(scene, HOUSES_START),
        moment(scene, HOUSES_AND_WOOD),
        SwitchablePolicy(COARSE_MAP, PERSPECTIVE_MAP, min_ms=1.0, other_ms=1.0),
    )
    replanner = Replanner(plans=policy)
    plans = [replanner.plan(houses_moment.descriptor, level), replanner.plan(wood_moment.descriptor, level)]
    policy.current_index = 1
    plans += [replanner.plan(frame_moment.descriptor, level) for frame_moment in (houses_moment, wood_moment)]
    assert [(SUN, "forest") in chosen_algorithms(plan) for plan in plans] == [False, True, False, True]
    assert switch_counts(plans)[-1] == 0 and chosen_algorithms(plans[-1]) == chosen_algorithms(plans[1])


def count_tie_switches(descriptor: Descriptor, level: Level, time_gain: float, frames: int, runs: int) -> int:
    """Return the switches of a camera that crosses a tie of two plans again and again.

    The cheaper plan alternates every ``frames`` frames; it saves the share ``time_gain`` of the time.
    """
    policy, plans = SwitchablePolicy(COARSE_MAP, CASCADED_MAP, min_ms=1.0 - time_gain, other_ms=1.0), []
    replanner = Replanner(plans=policy)
    for run in range(runs):
        policy.current_index = run % 2
        plans += [replanner.plan(descriptor, level) for _ in range(frames)]
    return switch_counts(plans)[-1]


def test_replanner_at_a_tie_switches_only_without_hysteresis(scene, level, monkeypatch):
    descriptor = moment(scene, WOOD_START).descriptor
    count_switches = partial(count_tie_switches, descriptor, level, time_gain=0.1, frames=2 * INITIAL_PATIENCE_FRAMES, runs=6)
    assert count_switches() == 0
    monkeypatch.setattr(replanning, "INITIAL_PATIENCE_FRAMES", 1)
    assert count_switches() == 0  # the margin alone prevents a switch
    monkeypatch.setattr(replanning, "SWITCH_TIME_GAIN", 0.0)
    assert count_switches() >= 3


def test_replanner_needs_more_patience_for_each_switch(scene, level):
    """The prediction swings by half for three times the initial patience: between the second and the third wait."""
    assert (
        count_tie_switches(moment(scene, WOOD_START).descriptor, level, time_gain=0.5, frames=3 * INITIAL_PATIENCE_FRAMES, runs=10)
        == 2
    )


def day_moments(scene: Scene, pose: CameraPose) -> list[Moment]:
    """Return a view at rest from before sunrise to after sunset, every five minutes of thirteen hours."""
    moments, hours = [], np.arange(-0.5, 12.5 + 1e-9, 5.0 / 60.0)
    for hour in hours.tolist():
        sun = SunSpec(azimuth=90.0 + 15.0 * hour, altitude=float(np.degrees(np.arcsin(0.77 * np.sin(np.pi * hour / 12.0)))))
        moments.append(moment(scene.with_sun(sun), pose))
    return moments


@pytest.mark.parametrize(
    "place", [HOUSES_AND_WOOD, pytest.param(WOOD_START, marks=pytest.mark.long)], ids=["houses and wood", "in the wood"]
)
def test_replanner_at_rest_keeps_its_plan_through_a_day(scene, level, place):
    """Other plans are often slightly better. At most two switches are added to the changes of casters."""
    moments, replanner = day_moments(scene, place), Replanner(plans=predict_plan)
    plans = [replanner.plan(frame_moment.descriptor, level) for frame_moment in moments]
    fresh_plans = [predict_plan(frame_moment.descriptor, level) for frame_moment in moments]
    assert casting_kinds(plans[0])[SUN] == casting_kinds(plans[-1])[SUN] == frozenset()
    assert "forest" in casting_kinds(plans[len(plans) // 2])[SUN]
    assert caster_change_counts(plans) == caster_change_counts(fresh_plans) and caster_change_counts(plans)[-1] >= 2
    assert switch_counts(plans)[-1] <= caster_change_counts(plans)[-1] + 2
    assert switch_counts(fresh_plans)[-1] > switch_counts(plans)[-1], "else nothing is tested"


def test_replanner_with_pins_switches_at_their_border(scene, level):
    """The plan switches at the first sun beyond the border and nowhere else, without a mixture."""
    low_sun_pin = Pin(
        sun_altitude_deg=(0.0, 20.0), algorithm={"relief": "sweep", "meshes": "hybrid", "forest": "shadow_map"}, map_size=512
    )
    high_sun_pin = Pin(sun_altitude_deg=(20.0, 90.0), algorithm="shadow_map", map_size=1024, cascades=1)
    pinned = level.model_copy(update={"shadows": level.shadows.model_copy(update={"pins": (low_sun_pin, high_sun_pin)})})
    replanner, moments = Replanner(plans=predict_plan), day_moments(scene, HOUSES_AND_WOOD)[::3]
    for frame_moment in moments:
        plan, altitude = replanner.plan(frame_moment.descriptor, pinned), frame_moment.descriptor.sun_altitude_deg
        names = {name for (_, kind), (name, *_) in chosen_algorithms(plan).items() if kind in ("relief", "meshes")}
        if names:
            assert names <= ({"sweep", "hybrid"} if altitude <= 20.0 else {"shadow_map"}) and replanner.transition is None
    assert any(frame_moment.descriptor.sun_altitude_deg <= 20.0 for frame_moment in moments)
