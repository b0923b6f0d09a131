"""Levels with trees, buildings and lamps: agreement with truth, separate caster kinds, and exactly the planned passes."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
import trimesh
from affine import Affine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.render import render_frame
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE, MIN_COVERED_SHARE, block_shadow_shares, coverage_error, error_metrics
from skugga.shadows.truth.truth import TruthSettings, coverage_truth, fill_visibility, trace_truth
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING
from tests.render import plan_of, render, render_points

Build = Callable[..., Scene]

EYE = {"kind": "perspective", "eye": [-35, -55, 14], "target": [4, 0, 3], "fov": 45, "size": [256, 192]}
WOOD = {"source": "wood.gpkg", "density": 250, "height": [4, 9]}
TREES = {"source": "trees.gpkg", "height": "height"}
HOUSE = {"source": "house.obj", "at": [8, -6], "turn": 20}
SPOT = {"kind": "spot", "position": [-30, 10, 18], "target": [0, 0, 0], "cutoff": 40}
OMNI = {"kind": "omni", "position": [0, -8, 12]}


@pytest.fixture(scope="module")
def build(tmp_path_factory) -> Build:
    """Return ``build(azimuth, altitude, **keys)``, the scene of a level over rolling or level ground of 120 m."""
    folder: Path = tmp_path_factory.mktemp("populated")
    y, x = np.mgrid[0:61, 0:61] / 60.0
    grounds = {"rolling": 3 * np.sin(6 * x + 1) + 2.5 * np.cos(7 * y), "level": np.zeros((61, 61))}
    for name, heights in grounds.items():
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="GTiff", width=61, height=61, count=1, dtype="float32", crs=ENGINEERING,
            transform=Affine(2, 0, -61, 0, -2, 61),
        ) as dataset:  # fmt: skip
            dataset.write(heights.astype(np.float32), 1)
    rng = np.random.default_rng(12)
    points = [shapely.Point(*p) for p in rng.uniform(-45, 45, (40, 2))]
    vectors = {"wood": ([shapely.box(-40, -40, 40, 40)], {}), "trees": (points, {"height": rng.uniform(4, 9, len(points))})}
    for name, (geometries, attributes) in vectors.items():
        wkb = shapely.to_wkb(np.array(geometries, object))
        kind = geometries[0].geom_type
        fields = list(attributes.values())
        pyogrio.raw.write(folder / f"{name}.gpkg", wkb, fields, list(attributes), geometry_type=kind, crs=ENGINEERING)
    for name, size in {"house": (12.0, 8.0, 6.0), "plank": (16.0, 2.0, 6.0), "low": (4.0, 4.0, 2.0)}.items():
        trimesh.creation.box(extents=size).export(folder / f"{name}.obj")

    @lru_cache(maxsize=64)
    def build_from_json(text: str) -> Scene:
        path = folder / "level.yaml"
        path.write_text(text, encoding="utf-8")
        return build_scene(load_level(path))

    def level(azimuth: float = 215.0, altitude: float = 32.0, ground: str = "rolling", **keys) -> Scene:
        sun = keys.pop("sun", {"azimuth": azimuth, "altitude": altitude})
        terrain = {"source": f"{ground}.tif"}
        return build_from_json(json.dumps({"version": 1, "terrain": terrain, "sun": sun, "views": {"eye": EYE}, **keys}))

    return level


def view_of(scene: Scene, kind: str):
    """Return a view of a kind. A map's pixels lie off its grid's nodes, so that no whole block is drawn."""
    return scene.view("eye") if kind == "perspective" else scene.view(bounds=(-40, -40, 40, 40), size=(240, 240))


# -- accuracy


@pytest.mark.parametrize("kind", ["perspective", "map"])
def test_shadow_coverage_of_a_wood_is_near_truth(gl, build, kind):
    """Coverage in blocks of 16 pixels is within 0.02 of truth by 16 points a pixel."""
    scene = build(forest=[WOOD])
    view = view_of(scene, kind)
    frame = render_points(scene, view, map_size=4096)
    buffer = geometry_buffer(scene, view)
    casters = find_casters(scene, buffer)
    shares = coverage_truth(buffer, scene, casters, 16, max_blocks=48, sample_count=16)
    assert 0.1 < np.nanmean(shares) < 0.9 and (buffer.surface_kind == FOREST).mean() > 0.1
    rendered_shares = block_shadow_shares(1.0 - frame.visibility)
    assert coverage_error(rendered_shares, shares) <= 0.02
    inverted_error = coverage_error(block_shadow_shares(frame.visibility), shares)
    assert inverted_error > 0.1


@pytest.mark.parametrize("kind", ["perspective", "map"])
@pytest.mark.parametrize("altitude", [12.0, 50.0])
def test_shadows_of_buildings_have_no_interior_error(gl, build, kind, altitude):
    scene = build(300.0, altitude, meshes=[HOUSE, {"source": "plank.obj", "at": [[-15, 5], [-20, -18]], "turn": 70}])
    view = view_of(scene, kind)
    frame = render_points(scene, view, map_size=4096, filter=1)
    buffer = geometry_buffer(scene, view)
    reference = trace_truth(buffer, scene, find_casters(scene, buffer))
    metrics = error_metrics(frame.visibility, reference, describe(scene, view).pixel_m, 0.5)
    cast_shadow = ~reference.lit & ~reference.attached_shadow_mask & reference.valid
    assert (
        0.02 < cast_shadow.sum() / reference.valid.sum()
        and (buffer.surface_kind == MESHES).any()
        and (buffer.surface_kind == RELIEF).any()
    )
    assert (
        metrics.interior <= MAX_INTERIOR_SHARE
        and metrics.interior_parts == 0
        and metrics.wrong_cast < 0.03
        and metrics.edge_p95 <= 2.0
    )
    assert metrics.interior_sees >= MIN_COVERED_SHARE


# -- caster kinds


def test_each_caster_kind_casts_its_own_shadow(gl, build):
    """A kind without an algorithm casts nothing. Truths of single kinds multiply to truth of all, and the map agrees with each."""
    scene = build(300.0, 20.0, meshes=[HOUSE], forest=[TREES])
    view = view_of(scene, "perspective")
    buffer = geometry_buffer(scene, view)
    casters = find_casters(scene, buffer)
    all_kinds = scene.objects.caster_kinds
    assert all_kinds == ("relief", "meshes", "forest")
    reference = {kind: fill_visibility(buffer, scene, SUN, (kind,), casters, TruthSettings(), PassLog()) for kind in all_kinds}
    combined = fill_visibility(buffer, scene, SUN, all_kinds, casters, TruthSettings(), PassLog())
    assert (
        np.prod(list(reference.values()), axis=0) != combined
    ).mean() < 1e-4  # the offset of a ray's start depends on its casters
    ground = buffer.valid & (buffer.surface_kind == RELIEF)
    masks = {}
    for kind in all_kinds:
        algorithm = {other: "shadow_map" if other == kind else "none" for other in all_kinds}
        frame = render_points(scene, view, algorithm=algorithm, map_size=4096, filter=1)
        assert frame.plan.algorithm[SUN] == algorithm
        assert [name for name in frame.plan.passes if name.startswith("sun/")] == PassLog.pass_names(
            SUN, (kind,), ("depth map", "visibility")
        )
        masks[kind] = frame.visibility < 0.5
        assert (masks[kind] != (reference[kind] < 0.5))[ground].mean() < 0.02
    assert masks["meshes"][ground].mean() > 0.01 and masks["forest"][ground].mean() > 0.02
    assert (masks["meshes"] != masks["forest"])[ground].mean() > 0.03
    attached_frame = render_points(scene, view, algorithm="none")
    np.testing.assert_array_equal(attached_frame.visibility[buffer.valid] == 0.0, attached_shadow_mask(buffer, scene)[buffer.valid])


def test_two_algorithms_of_a_light_multiply(gl, build):
    """The override is ``relief=none,meshes=truth,forest=shadow_map``. Each algorithm has its own passes."""
    scene = build(300.0, 20.0, meshes=[HOUSE], forest=[TREES])
    view = view_of(scene, "perspective")
    combined = render_points(
        scene, view, algorithm={"relief": "none", "meshes": "truth", "forest": "shadow_map"}, map_size=2048, filter=1
    )
    parts = [
        render_points(scene, view, algorithm={"relief": "none", "meshes": m, "forest": f}, map_size=2048, filter=1).visibility
        for m, f in (("truth", "none"), ("none", "shadow_map"))
    ]
    np.testing.assert_array_equal(combined.visibility, parts[0] * parts[1])
    assert [name for name in combined.plan.passes if "/" in name] == [
        "sun/meshes: rays", "sun/forest: depth map", "sun/forest: visibility",
    ]  # fmt: skip


def test_plan_lists_the_present_caster_kinds(build):
    for keys, kinds in (
        ({}, ["relief"]),
        ({"meshes": [HOUSE]}, ["relief", "meshes"]),
        ({"forest": [TREES]}, ["relief", "forest"]),
        ({"meshes": [HOUSE], "forest": [TREES]}, ["relief", "meshes", "forest"]),
    ):
        scene = build(lights={"spot": SPOT}, **keys)
        plan = plan_of(scene, scene.view("eye"))
        assert list(plan.algorithm) == [SUN, "spot"]
        assert all(list(per_kind) == kinds for per_kind in plan.algorithm.values())
    level = build(ground="level", meshes=[HOUSE])
    plan = plan_of(level, level.view("eye"))
    assert plan.algorithm[SUN] == {"relief": "none", "meshes": "shadow_volume"}  # flat ground casts no shadow


# -- stand-ins and the clock


def floor_shadow(scene: Scene, **options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a map's shadow on level ground, and its pixels' coordinates. Meshes count as lit."""
    view = scene.view(bounds=(-30, -30, 30, 30), size=(170, 170))
    frame = render_points(scene, view, map_size=2048, filter=1, **options)
    x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
    y = view.grid.y(view.row0 + np.arange(view.rows) * view.row_step)
    x, y = np.meshgrid(x, y)
    return (frame.visibility < 0.5) & (frame.height_m < 1e-3), x, y


def test_stand_in_mesh_casts_instead_of_the_visible_mesh(gl, build):
    """The view shows the house's roof. The shadow is that of a lower, narrower box: 2 m high at 45 degrees from the east."""
    scene = build(90.0, 45.0, "level", meshes=[{"source": "house.obj", "at": [0, 0], "caster": "low.obj"}])
    plain_scene = build(90.0, 45.0, "level", meshes=[{"source": "house.obj", "at": [0, 0]}])
    view = scene.view(bounds=(-30, -30, 30, 30), size=(170, 170))
    roof = geometry_buffer(scene, view).height_m
    np.testing.assert_array_equal(roof, geometry_buffer(plain_scene, view).height_m)
    assert roof.max() == pytest.approx(6.0)
    dark, x, y = floor_shadow(scene)
    assert not dark.any()  # the shadow ends 2 + 2 m west of the middle, below the house
    house = (np.abs(x) < 5.9) & (np.abs(y) < 3.9)
    frame = render_points(scene, view, map_size=2048, filter=1)
    assert (frame.visibility[house & (roof > 5)] == 1.0).all()  # the roof lies above the stand-in
    dark, x, y = floor_shadow(plain_scene)
    outline = (x < -6.05) & (x > -11.95) & (np.abs(y) < 3.95)
    assert dark[outline].all() and not dark[(x < -12.1) | (np.abs(y) > 4.1) | (x > -5.9)].any()
    tall_caster_scene = build(90.0, 45.0, "level", meshes=[{"source": "low.obj", "at": [0, 0], "caster": "house.obj"}])
    dark, x, y = floor_shadow(tall_caster_scene)
    assert dark[outline].all() and not dark[(x < -12.1) | (np.abs(y) > 4.1)].any()
    reference, _, _ = floor_shadow(tall_caster_scene, algorithm="truth")
    assert (dark != reference).mean() < 0.004


def test_spinning_casters_shadow_follows_the_clock(gl, build):
    """A plank that spins by 30 degrees a second stands at second 3 as one turned by 90. The trees do not change."""
    spinning_mesh = {"source": "plank.obj", "at": [0, 0], "motion": {"spin": 30.0}}
    scene = build(180.0, 45.0, "level", meshes=[spinning_mesh], forest=[TREES])
    later = scene.at_second(3.0)
    assert later.objects is not scene.objects and later.objects.trees is scene.objects.trees
    assert scene.at_second(None) is scene and scene.at_second(0.0).objects is scene.objects
    turned_scene = build(180.0, 45.0, "level", meshes=[{"source": "plank.obj", "at": [0, 0], "turn": 90.0}], forest=[TREES])
    started_scene = build(180.0, 45.0, "level", meshes=[spinning_mesh], forest=[TREES], seconds=3.0)
    masks = [floor_shadow(s)[0] for s in (scene, later, turned_scene, started_scene)]
    assert (masks[0] != masks[1]).mean() > 0.02
    assert (masks[1] != masks[2]).mean() < 1e-3
    np.testing.assert_array_equal(masks[1], masks[3])
    dark, x, y = floor_shadow(later)
    north = (np.abs(x) < 0.9) & (y > 8.1) & (y < 13.9)  # the plank is 6 m high, 2 m wide, and reaches from -8 to 8 m north
    assert dark[north].all()


# -- plans


ALGORITHM = st.sampled_from(["auto", "shadow_map", "truth", "none"])
CHOICES = st.one_of(
    ALGORITHM, st.fixed_dictionaries({}, optional={kind: ALGORITHM for kind in ("relief", "meshes", "forest", SUN)})
)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    meshes=st.booleans(), forest=st.booleans(), spot=st.booleans(), omni=st.booleans(),
    ground=st.sampled_from(["rolling", "level"]),
    sun=st.sampled_from([(215.0, 30.0), (215.0, -10.0), None]), choice=CHOICES, kind=st.sampled_from(["perspective", "map"]),
    effect=st.sampled_from(["auto", "on", "off"]),
)  # fmt: skip
def test_frame_runs_the_planned_passes(gl, build, meshes, forest, spot, omni, ground, sun, choice, kind, effect):
    """This holds for any casters, lights and overrides. Every light of the plan has its visibility."""
    keys = {"meshes": [HOUSE] if meshes else [], "forest": [TREES] if forest else [], "effects": {"cast_shadows": effect}}
    lights = {name: spec for name, spec, is_set in (("spot", SPOT, spot), ("omni", OMNI, omni)) if is_set}
    if sun is None:
        keys["sun"] = "none"
    scene = build(*(sun or (0.0, 0.0)), ground, lights=lights, **keys)
    view = scene.view("eye", size=(40, 30)) if kind == "perspective" else scene.view(bounds=(-40, -40, 40, 40), size=(37, 37))
    plan = plan_of(scene, view, algorithm=choice, map_size=256)
    assert Plan.model_validate_json(plan.model_dump_json()) == plan
    frame = render_frame(scene, view, plan)
    assert [record.name for record in frame.passes] == plan.passes
    assert list(frame.visibilities) == list(plan.lights)
    assert set(plan.lights) == set(scene.light_names) or plan.lights == (SUN,)
    for visibility in frame.visibilities.values():
        assert np.isfinite(visibility[frame.valid]).all()
    if sun is None or sun[1] < 0.0:
        assert SUN not in frame.visibilities or not np.nan_to_num(frame.visibilities[SUN]).any()


@pytest.mark.parametrize("kind", ["perspective", "map"])
@pytest.mark.parametrize("algorithm", ["auto", "truth"])
def test_forced_shadows_without_lights_are_all_dark(gl, build, kind, algorithm):
    """The level has ``cast_shadows: on`` but neither sun nor lamps."""
    scene = build(sun="none", effects={"cast_shadows": "on"}, meshes=[HOUSE])
    frame = render(scene, view_of(scene, kind), algorithm=algorithm)
    if np.nan_to_num(frame.visibility).any():
        raise RuntimeError("pixels are lit although no light exists")


@pytest.mark.parametrize("kind", ["perspective", "map"])
@pytest.mark.parametrize("algorithm", ["auto", "truth", "none"])
def test_descriptor_and_plan_round_trip_through_json(build, kind, algorithm):
    """HTTP sends both. A descriptor that is read back gives the same plan."""
    scene = build(meshes=[HOUSE], forest=[TREES], lights={"spot": SPOT, "omni": OMNI})
    view = view_of(scene, kind)
    descriptor = describe(scene, view, "eye")
    parsed_descriptor = Descriptor.model_validate_json(descriptor.model_dump_json())
    assert parsed_descriptor == descriptor and [lamp.name for lamp in parsed_descriptor.lamps] == ["spot", "omni"]
    overrides = {"algorithm": algorithm}
    plan = make_plan(descriptor, scene.loaded.level, overrides)
    assert make_plan(parsed_descriptor, scene.loaded.level, overrides) == plan
    parsed_plan = Plan.model_validate_json(plan.model_dump_json())
    assert parsed_plan == plan and parsed_plan.steps == plan.steps and type(parsed_plan.settings) is type(plan.settings)
    assert parsed_plan.model_dump() == plan.model_dump()
