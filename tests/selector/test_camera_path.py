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
from skugga.selector.replanning import MAX_CHANGED, PATIENCE, Replanner, casting, mix_pictures, next_share
from skugga.selector.select import select
from skugga.shadows.plan import Plan, Predicted
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.ground.generated_ground import ENGINEERING
from skugga.terrain.level.level import SUN, Level, Pin, SunSpec, load_level
from skugga.terrain.scene import Scene, build_scene

Place = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Camera position and target: metres east, north and above the ground."""

ROWS, COLS, FOV_DEG = 192, 256, 50.0
OFF, NEARER = ((-150.0, -120.0, 45.0), (-330.0, -290.0, 0.0)), ((-130.0, -110.0, 45.0), (-310.0, -280.0, 0.0))
"""Ends of the first glide: houses are visible, and the wood lies behind the camera."""

UNDER, FARTHER = ((190.0, 180.0, 14.0), (270.0, 280.0, 2.0)), ((205.0, 200.0, 13.0), (285.0, 300.0, 2.0))
"""Ends of the second glide, among trees."""

ACROSS = ((-160.0, -150.0, 60.0), (100.0, 100.0, 0.0))
"""Houses, and the wood beyond them."""

GLIDE, DIVE, SEEN = 20, 12, 8
"""Frames of a glide, frames of the dive, and drawn frames of a switch."""

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
        "blocks": 3.5e6, "pixels": 25.0, "facing": 40.0, "faces drawn": 1400.0, "layers": 63.0, "faces beside marks": 3200.0,
        "layers beside marks": 90.0,
    },
    "conservative map, perspective": {"texels": 18.9, "texels in shadow": 11.1, "caps": 1460.0, "ground": 1250.0, "facing": 5.8},
    "mask": {"blocks": 1.4e5, "pixels": 35.0, "texels": 0.55},
    "planar": {"blocks": 2.2e6, "pixels": 9.6, "triangles": 183.0},
    "sweep, perspective": {"blocks": 53.0e6, "nodes": 9.4, "steps": 2.4, "answers": 113.0},
}  # fmt: skip
"""Rates of a device that renders on the CPU: each algorithm is the cheapest somewhere."""

predicted = partial(
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
    crs = {"type": "name", "properties": {"name": ENGINEERING}}
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
    return scene.loaded.level


def moment(scene: Scene, place: Place) -> Moment:
    (eye, up), (target, _) = (scene.place.above_ground(point, "place") for point in place)
    view = look_at(eye, target, up, FOV_DEG, ROWS, COLS)
    return Moment(scene, view, describe(scene, view, "flight"))


def between(start: Place, end: Place, frames: int) -> list[Place]:
    steps = np.linspace(np.array(start), np.array(end), frames, endpoint=False)
    return [tuple(map(tuple, step.tolist())) for step in steps]


@pytest.fixture(scope="module")
def flight(scene) -> Callable[[float, float], list[Moment]]:
    """Return ``flight(azimuth, altitude)``, the whole path under a sun that is down in the last frames."""

    def under(azimuth: float, altitude: float) -> list[Moment]:
        day, night = (scene.with_sun(SunSpec(azimuth=azimuth, altitude=each)) for each in (altitude, -1.0))
        places = [*between(OFF, NEARER, GLIDE), *between(NEARER, UNDER, DIVE), *between(UNDER, FARTHER, GLIDE)]
        return [*(moment(day, place) for place in places), *(moment(night, FARTHER) for _ in range(3))]

    return cache(under)


Chosen = dict[tuple[str, str], tuple[str, int | None, int | None]]


def chosen(plan: Plan) -> Chosen:
    """Return algorithm, map size and number of cascades by light and caster kind, of the kinds that cast."""
    found: Chosen = {}
    for light, per_kind in plan.algorithm.items():
        for kind, name in per_kind.items():
            settings = plan.settings.get(light, {}).get(kind)
            of_map = getattr(settings, "map", settings)
            cascades = getattr(of_map, "cascades", None)
            if name != "none":
                found[light, kind] = (name, getattr(of_map, "map_size", None), None if cascades is None else len(cascades))
    return found


def changes(plans: list[Plan]) -> list[int]:
    """Return the cumulative count of real changes before each frame: changes of the set of casters."""
    return np.cumsum([0, *(casting(one) != casting(other) for one, other in pairwise(plans))]).tolist()


def switches(plans: list[Plan]) -> list[int]:
    """Return the cumulative count of switches before each frame: a caster of both frames changes its algorithm or settings."""
    seen = [chosen(plan) for plan in plans]
    return np.cumsum([0, *(any(a[key] != b[key] for key in a.keys() & b.keys()) for a, b in pairwise(seen))]).tolist()


@pytest.mark.parametrize(
    "sun", [(200.0, 35.0), *(pytest.param(sun, marks=pytest.mark.long) for sun in [(200.0, 25.0), (290.0, 15.0)])]
)
def test_replanner_switches_no_more_often_than_casters_change(flight, level, sun):
    """The bound holds at every frame of the flight. Plans made anew for each frame switch back and forth."""
    moments = flight(*sun)
    director = Replanner(plans=predicted)
    plans = [director.plan(each.descriptor, level) for each in moments]
    anew = [predicted(each.descriptor, level) for each in moments]
    cast = [casting(plan)[SUN] for plan in plans]
    assert "forest" not in cast[0] and "forest" in cast[GLIDE + DIVE] and cast[-1] == frozenset()
    assert changes(plans) == changes(anew) and changes(plans)[-1] >= 2
    assert all(switched <= changed for switched, changed in zip(switches(plans), changes(plans), strict=True))
    assert switches(anew)[-1] > changes(anew)[-1]


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of the surface's pixels whose class changes."""
    valid = ~np.isnan(after)
    return float(((before < 0.5) != (after < 0.5))[valid].mean())


def test_replanner_switch_in_flight_changes_few_pixels(gl, flight, level):
    """The first frames of a switch are compared with the previous frame's mixture, drawn from the present camera."""
    director, share, steps, differing = Replanner(plans=predicted), 0.0, [], []
    for each in flight(200.0, 35.0):
        plan = director.plan(each.descriptor, level)
        if len(steps) == SEEN:
            break
        if director.transition is None:
            continue
        old, new = (render_frame(each.scene, each.view, its) for its in (director.transition.plan, plan))
        before, share = share, director.share(old.visibilities, new.visibilities)
        assert share > before
        steps.append(changed(*(mix_pictures(old.visibility, new.visibility, shown) for shown in (before, share))))
        differing.append(changed(old.visibility, new.visibility))
    assert len(steps) == SEEN and max(differing) > 3.0 * MAX_CHANGED  # otherwise the test would be vacuous
    assert max(steps) <= MAX_CHANGED


@settings(max_examples=20)
@given(st.integers(1, 50), st.integers(1, 50), st.integers(0, 2**32 - 1))
def test_next_share_ends_and_changes_few_pixels_a_frame(rows, cols, seed):
    """The pictures are noise under two lights, half of it without a surface."""
    rng = np.random.default_rng(seed)
    valid = rng.random((rows, cols)) < 0.5
    before, after = ({light: np.where(valid, rng.random((rows, cols)), np.nan) for light in (SUN, "lamp")} for _ in range(2))
    most, share, frames = max(int(MAX_CHANGED * valid.sum()), 1), 0.0, 0
    while share < 1.0:
        shown, share, frames = share, next_share(before, after, share), frames + 1
        classes = [np.stack([mix_pictures(before[k], after[k], each) < 0.5 for k in before]) for each in (shown, share)]
        assert (classes[0] != classes[1]).any(axis=0).sum() <= most
    differ = np.any([(before[k] < 0.5) != (after[k] < 0.5) for k in before], axis=0)
    assert frames == max(np.ceil(differ.sum() / most), 1)


def choice(algorithms: str, **settings: int) -> Choice:
    """Return a choice of algorithms for relief, meshes and foliage."""
    return Choice(algorithms, dict(zip(("relief", "meshes", "forest"), algorithms.split(), strict=True)), settings)


COARSE = choice("shadow_map shadow_map shadow_map", map_size=1024, cascades=1)
CASCADES = choice("shadow_map shadow_map shadow_map", map_size=2048, cascades=4)
PERSPECTIVE = choice("perspective_shadow_map perspective_shadow_map perspective_shadow_map", map_size=4096)
EXACT = choice("sweep shadow_volume shadow_map", map_size=4096)


class Turning:
    """A policy that always takes one of its choices, and that a test switches to another.

    The current choice is predicted to take ``min_ms``, others ``other_ms``, and all to be without error.
    """

    def __init__(self, *choices: Choice, min_ms: float = 1.0, other_ms: float = 10.0) -> None:
        self.choices, self.now, self.min_ms, self.other_ms = choices, 0, min_ms, other_ms

    def __call__(self, descriptor: Descriptor, plan_request: Level, overrides: dict | None) -> Plan:
        taken = {SUN: self.choices[self.now]}
        plan = make_plan(descriptor, plan_request, overrides, taken)
        own = chosen(plan) == chosen(make_plan(descriptor, plan_request, None, taken))
        predicted = Predicted(ms=self.min_ms if own else self.other_ms, wrong=0.0, wrong_cast=0.0)
        return plan.model_copy(update={"policy": "predict", "predicted": predicted})


@pytest.mark.parametrize("place", [OFF, UNDER], ids=["in the open", "in the wood"])
@pytest.mark.parametrize("pair", [(COARSE, CASCADES), (PERSPECTIVE, EXACT), (CASCADES, COARSE)])
def test_replanner_switch_at_rest_changes_few_pixels_a_frame(gl, scene, level, place, pair):
    """The bound holds whatever errors were predicted.

    The number of frames follows from it, and the last frame is the new plan's.
    """
    at, policy = moment(scene, place), Turning(*pair)
    director, pictures = Replanner(plans=policy), {}

    def drawn(plan: Plan) -> dict[str, np.ndarray]:
        key = repr((plan.algorithm, plan.settings))
        if key not in pictures:
            pictures[key] = render_frame(at.scene, at.view, plan).visibilities
        return pictures[key]

    shown = [drawn(director.plan(at.descriptor, level))[SUN]]
    policy.now, mixed = 1, 0
    for _ in range(PATIENCE + 200):
        visibilities = drawn(director.plan(at.descriptor, level))
        picture = visibilities[SUN]
        if director.transition is not None:
            left = drawn(director.transition.plan)
            picture, mixed = mix_pictures(left[SUN], picture, director.share(left, visibilities)), mixed + 1
        shown.append(picture)
    steps = [changed(before, after) for before, after in pairwise(shown)]
    valid_count = int((~np.isnan(shown[0])).sum())
    assert 0.0 < max(steps) <= MAX_CHANGED
    assert mixed == np.ceil(round(changed(shown[0], shown[-1]) * valid_count) / int(MAX_CHANGED * valid_count))
    assert np.array_equal(shown[-1], drawn(director.plan(at.descriptor, level))[SUN], equal_nan=True)
    assert director.transition is None and len(pictures) == 2


def test_replanner_draws_new_casters_at_once_and_mixes_the_rest(gl, scene, level):
    """Foliage comes into view beside houses, and all kinds change their algorithm. Leaves cast under both plans."""
    inside, policy = moment(scene, ACROSS), Turning(COARSE, PERSPECTIVE)
    director = Replanner(plans=policy)
    outside = director.plan(moment(scene, OFF).descriptor, level)
    assert (SUN, "forest") not in chosen(outside)
    policy.now = 1
    plan = director.plan(inside.descriptor, level)
    assert chosen(plan)[SUN, "forest"][0] == "perspective_shadow_map"
    assert director.transition is not None and chosen(director.transition.plan)[SUN, "forest"][0] == "shadow_map"
    old, new = (render_frame(scene, inside.view, its) for its in (director.transition.plan, plan))
    share = director.share(old.visibilities, new.visibilities)
    assert changed(old.visibility, mix_pictures(old.visibility, new.visibility, share)) <= MAX_CHANGED
    assert changed(old.visibility, new.visibility) > MAX_CHANGED


def test_replanner_keeps_the_choice_of_returning_casters(scene, level):
    """Foliage was chosen for, left the view and returns. An equal alternative does not replace its choice."""
    off, across, policy = moment(scene, OFF), moment(scene, ACROSS), Turning(COARSE, PERSPECTIVE, min_ms=1.0, other_ms=1.0)
    director = Replanner(plans=policy)
    plans = [director.plan(off.descriptor, level), director.plan(across.descriptor, level)]
    policy.now = 1
    plans += [director.plan(each.descriptor, level) for each in (off, across)]
    assert [(SUN, "forest") in chosen(plan) for plan in plans] == [False, True, False, True]
    assert switches(plans)[-1] == 0 and chosen(plans[-1]) == chosen(plans[1])


def crossings(descriptor: Descriptor, level: Level, swing: float, frames: int, runs: int) -> int:
    """Return the switches of a camera that crosses a tie of two plans again and again.

    For ``frames`` frames one plan takes less time by the share ``swing``, then the other one does.
    """
    policy, plans = Turning(COARSE, CASCADES, min_ms=1.0 - swing, other_ms=1.0), []
    director = Replanner(plans=policy)
    for run in range(runs):
        policy.now = run % 2
        plans += [director.plan(descriptor, level) for _ in range(frames)]
    return switches(plans)[-1]


def test_replanner_at_a_tie_switches_only_without_hysteresis(scene, level, monkeypatch):
    descriptor = moment(scene, UNDER).descriptor
    crossed = partial(crossings, descriptor, level, swing=0.1, frames=2 * PATIENCE, runs=6)
    assert crossed() == 0
    monkeypatch.setattr(replanning, "PATIENCE", 1)
    assert crossed() == 0  # the margin alone prevents a switch
    monkeypatch.setattr(replanning, "SWITCH_TIME_GAIN", 0.0)
    assert crossed() >= 3


def test_replanner_needs_more_patience_for_each_switch(scene, level):
    """The prediction swings by half for 3 x ``PATIENCE`` frames: longer than the first and second wait, shorter than the third."""
    assert crossings(moment(scene, UNDER).descriptor, level, swing=0.5, frames=3 * PATIENCE, runs=10) == 2


def day(scene: Scene, place: Place) -> list[Moment]:
    """Return a view at rest from before sunrise to after sunset, every five minutes of thirteen hours."""
    moments, hours = [], np.arange(-0.5, 12.5 + 1e-9, 5.0 / 60.0)
    for hour in hours.tolist():
        sun = SunSpec(azimuth=90.0 + 15.0 * hour, altitude=float(np.degrees(np.arcsin(0.77 * np.sin(np.pi * hour / 12.0)))))
        moments.append(moment(scene.with_sun(sun), place))
    return moments


@pytest.mark.parametrize("place", [ACROSS, pytest.param(UNDER, marks=pytest.mark.long)], ids=["houses and wood", "in the wood"])
def test_replanner_at_rest_keeps_its_plan_through_a_day(scene, level, place):
    """Other plans are often slightly better. At most two switches are added to the changes of casters."""
    moments, director = day(scene, place), Replanner(plans=predicted)
    plans = [director.plan(each.descriptor, level) for each in moments]
    anew = [predicted(each.descriptor, level) for each in moments]
    assert casting(plans[0])[SUN] == casting(plans[-1])[SUN] == frozenset() and "forest" in casting(plans[len(plans) // 2])[SUN]
    assert changes(plans) == changes(anew) and changes(plans)[-1] >= 2
    assert switches(plans)[-1] <= changes(plans)[-1] + 2
    assert switches(anew)[-1] > switches(plans)[-1], "else nothing is tested"


def test_replanner_with_pins_switches_at_their_border(scene, level):
    """The plan switches at the first sun beyond the border and nowhere else, without a mixture."""
    low = Pin(sun_altitude_deg=(0.0, 20.0), algorithm={"relief": "sweep", "meshes": "hybrid", "forest": "shadow_map"}, map_size=512)
    high = Pin(sun_altitude_deg=(20.0, 90.0), algorithm="shadow_map", map_size=1024, cascades=1)
    pinned = level.model_copy(update={"shadows": level.shadows.model_copy(update={"pins": (low, high)})})
    director, moments = Replanner(plans=predicted), day(scene, ACROSS)[::3]
    for each in moments:
        plan, altitude = director.plan(each.descriptor, pinned), each.descriptor.sun_altitude_deg
        names = {name for (_, kind), (name, *_) in chosen(plan).items() if kind in ("relief", "meshes")}
        if names:
            assert names <= ({"sweep", "hybrid"} if altitude <= 20.0 else {"shadow_map"}) and director.transition is None
    assert any(each.descriptor.sun_altitude_deg <= 20.0 for each in moments)
