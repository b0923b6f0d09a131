"""Capabilities: each algorithm renders or is refused with the registry's reason, for every light, caster kind, view and ground."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyogrio
import pytest
import shapely

from skugga.api.cli import main as cli
from skugga.api.http.server.app import create_app
from skugga.api.raster_view import raster_view
from skugga.api.settings import Settings
from skugga.selector.candidates import MAX_CANDIDATES, candidates
from skugga.selector.planner.planner import make_plan
from skugga.shadows.registry import ALGORITHMS, algorithms_serving
from skugga.shadows.render import render_frame
from skugga.shadows.requirements import ExtentKind, GroundKind, RayKind, Requirement, ViewKind
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import LightKind
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.api.conftest import running
from tests.conftest import write_geotiff
from tests.render import block_at, plan_of

CASTERS: tuple[CasterKind, ...] = get_args(CasterKind)
LIGHTS: tuple[LightKind, ...] = get_args(LightKind)
VIEWS: tuple[ViewKind, ...] = get_args(ViewKind)
GROUNDS: tuple[GroundKind, ...] = get_args(GroundKind)
COMBINATIONS = [
    combination
    for combination in product(ALGORITHMS, LIGHTS, CASTERS, VIEWS, GROUNDS)
    if combination[3:] not in (("bent map", "level"), ("bent map", "planes")) and combination[2::2] != ("forest", "planes")
]
"""All valid combinations: ground in a plane belongs to a flat world, whose maps never bend, and visible leaves lie in no plane."""

TERRAINS = {
    "planes": {"source": "slope.tif"},
    "level": {"flat": {"size": [60, 60], "cells": [30, 30]}},
    "uneven": {"generate": {"kind": "landscape", "size": [60, 60], "cell": 2, "relief": 6, "seed": 3}},
    "earth": {"source": "jacksboro", "resolution": 2500},  # otherwise pixels of 2.5 km are subdivided, and the parts do not bend
}
SPOT = {"kind": "spot", "position": [-14, -10, 22], "target": [0, 0, 0], "cutoff": 45}
OMNI = {"kind": "omni", "position": [5, -8, 16]}
FORCED_SHADOWS = {"cast_shadows": "on"}  # on empty level ground nothing casts
EYE = {"kind": "perspective", "eye": [-25, -30, 14], "target": [2, 2, 2], "fov": 45, "size": [48, 36]}
EARTH_POSITION = [-84.25, 36.3133]
"""Position of the objects on the earth, degrees."""


@pytest.fixture(scope="module")
def level_file(tmp_path_factory):
    """Return ``level_file(ground)``, the path of a level with trees, a figure, a sun, a spot and an omni light.

    ``earth`` is a ground on the round earth.
    """
    folder: Path = tmp_path_factory.mktemp("capabilities")
    for name, places, crs in (
        ("trees", ((-8, 6), (9, -4), (12, 10)), ENGINEERING_CRS_WKT),
        ("pines", (EARTH_POSITION,), "EPSG:4326"),
    ):
        points = shapely.to_wkb(np.array([shapely.Point(*place) for place in places], object))
        pyogrio.raw.write(folder / f"{name}.gpkg", points, [], [], geometry_type="Point", crs=crs)
    slope = 0.2 * np.arange(30.0) - 0.1 * np.arange(30.0)[:, None]
    write_geotiff(folder / "slope.tif", slope.astype(np.float32), ENGINEERING_CRS_WKT, -30, 30, 2.0)

    def path(ground: GroundKind | Literal["earth"], **keys) -> Path:
        if ground == "earth":
            above_ground = {"position": [*EARTH_POSITION, 900]}
            keys = {
                "lights": {"spot": {**SPOT, **above_ground, "target": [*EARTH_POSITION, 0]}, "omni": {**OMNI, **above_ground}},
                "views": {},
                "meshes": [{"generate": "tetrahedra", "at": EARTH_POSITION}],
                "forest": [{"source": "pines.gpkg", "height": [20, 30]}],
                "effects": {"alpha_test": "on"},  # the trees are too small to be drawn
                **keys,
            }  # fmt: skip
        level = {
            "version": 1, "terrain": TERRAINS[ground],
            "sun": {"azimuth": 215, "altitude": 30}, "lights": {"spot": SPOT, "omni": OMNI},
            "meshes": [{"generate": "tetrahedra"}], "forest": [{"source": "trees.gpkg", "height": [6, 8]}],
            "views": {"perspective": EYE, "map": {"kind": "map", "bounds": [-25, -25, 25, 25], "size": [47, 47]}}, **keys,
        }  # fmt: skip
        if ground == "planes":
            del level["forest"]
        file = folder / f"{ground}.yaml"
        file.write_text(json.dumps(level), encoding="utf-8")
        return file

    return path


@pytest.fixture(scope="module")
def scene_on(level_file):
    """Return ``scene_on(ground)``, the scene of that level."""
    return lru_cache(maxsize=4)(lambda ground: build_scene(load_level(level_file(ground))))


@pytest.fixture(scope="module")
def scene_and_view_of(scene_on):
    """Return ``scene_and_view_of(kind, ground)``, a scene and a view of it."""

    def scene_and_view(kind: ViewKind, ground: GroundKind) -> tuple[Scene, MapView | PerspectiveView]:
        scene = scene_on("earth" if kind == "bent map" else ground)
        return scene, scene.view("map", size=(12, 12)) if kind == "bent map" else scene.view(kind)  # pixels of 2.5 km

    return scene_and_view


def requirements_of(light: LightKind, caster: CasterKind, kind: ViewKind, ground: GroundKind) -> tuple[Requirement, ...]:
    """Return the requirements of a combination. A bent map is also a map."""
    return (*(("map",) if kind == "bent map" else ()), kind, light, caster, ground)


def single_algorithm_override(name: AlgorithmName, light: LightKind, caster: CasterKind) -> dict:
    """Return an override with one algorithm for one light and one caster kind. Nothing else casts."""
    choice = {light_kind: {kind: "none" for kind in CASTERS} for light_kind in LIGHTS}
    choice[light][caster] = name
    return choice


@pytest.mark.parametrize(("name", "light", "caster", "kind", "ground"), COMBINATIONS)
def test_algorithm_renders_or_gives_its_refusal(gl, scene_and_view_of, name, light, caster, kind, ground):
    (scene, view), algorithm = scene_and_view_of(kind, ground), ALGORITHMS[name]
    refusal = algorithm.refusal_reason(requirements_of(light, caster, kind, ground))
    if refusal is None:
        plan = plan_of(scene, view, algorithm=single_algorithm_override(name, light, caster), map_size=64)
        assert plan.algorithm[light][caster] == name
        frame = render_frame(scene, view, plan)
        assert [record.name for record in frame.passes] == plan.passes
        light_passes = [pass_name for pass_name in plan.passes if pass_name.startswith(f"{light}/{caster}: ")]
        assert [pass_name.split(": ")[1] for pass_name in light_passes] == list(algorithm.passes)
        assert np.isfinite(frame.visibilities[light][frame.valid]).all()
    else:
        with pytest.raises(UnsupportedError) as caught:
            plan_of(scene, view, algorithm=single_algorithm_override(name, light, caster))
        message = str(caught.value)
        refused = f"algorithm: '{name} for {caster} under {light}' is not supported here"
        assert message.startswith(f"{refused}: {refusal}; algorithms that can: ")
        assert "\n" not in message and name not in message.split("algorithms that can: ")[1]


def test_registry_refuses_only_known_requirements():
    known_requirements = {*CASTERS, *LIGHTS, *VIEWS, *GROUNDS, *get_args(RayKind), *get_args(ExtentKind)}
    for algorithm in ALGORITHMS.values():
        assert set(algorithm.refusals) <= known_requirements
        assert all(reason and reason[0].islower() and not reason.endswith(".") for reason in algorithm.refusals.values())
        assert all(set(kinds) - set(algorithm.refusals) for kinds in (CASTERS, LIGHTS, VIEWS, GROUNDS)), "serves nothing at all"


def test_registry_serves_every_combination():
    for light, caster, kind, ground in product(LIGHTS, CASTERS, VIEWS, GROUNDS):
        serve = algorithms_serving(requirements_of(light, caster, kind, ground))
        assert "shadow_map" in serve and not {"truth", "none"} & set(serve)


def test_registry_lists_passes_of_every_fill():
    assert all((algorithm.fill_visibility is not None) == bool(algorithm.passes) for algorithm in ALGORITHMS.values())


@pytest.mark.parametrize(
    ("name", "refused"),
    [
        ("shadow_map", {}),
        ("perspective_shadow_map", {"map": "perspective", "bent map": "perspective", "omni": "does not fit one"}),
        ("light_space_perspective_map", {"map": "perspective", "bent map": "perspective", "omni": "does not fit one"}),
        ("shadow_volume", {"forest": "ignore textures", "bent map": "a quarter of a pixel"}),
        ("hybrid", {"forest": "ignore textures", "bent map": "a quarter of a pixel"}),
        ("reconstructed_volume", {"map": "looked up as they are", "bent map": "looked up as they are"}),
        ("planar", {"uneven": "the ground is not flat: planar projects onto at most 64 planes, and not onto leaves"}),
        ("sweep", {"spot": "azimuth", "omni": "azimuth", "meshes": "one height per position", "forest": "heightfield"}),
    ],
)
def test_registry_refusals(name, refused):
    for light, caster, kind, ground in product(LIGHTS, CASTERS, VIEWS, GROUNDS):
        refusal = ALGORITHMS[name].refusal_reason(requirements_of(light, caster, kind, ground))
        words = [refused[part] for part in (light, caster, kind, ground) if part in refused]
        assert refusal is None if not words else any(word in refusal for word in words)


def test_plan_refuses_the_levels_algorithm_by_its_key(level_file):
    scene = build_scene(load_level(level_file("uneven", shadows={"algorithm": "planar"})))
    with pytest.raises(UnsupportedError, match=r"^shadows.algorithm: 'planar for relief under sun'"):
        make_plan(describe(scene, scene.view("map")), scene.loaded.level)


@pytest.mark.parametrize("source", ["level", "request"])
def test_plan_replaces_a_sweep_by_maps_where_rays_bend(gl, write_raster, make_scene, source):
    """A level that requests a sweep serves all zooms, and its widest zooms are no error."""
    row, col = np.mgrid[:100, :100]
    raster = write_raster((900.0 * np.sin(row / 3.0) * np.cos(col / 4.0) + 900.0).astype(np.float32), "EPSG:4326", 8.0, 48.0, 0.03)
    scene = make_scene(raster, 120.0, 4.0, **({"shadows": {"algorithm": {"relief": "sweep"}}} if source == "level" else {}))
    overrides = {} if source == "level" else {"algorithm": "sweep"}
    for width_deg, name in ((3.0, "shadow_map"), (0.05, "sweep")):
        view = scene.view(bounds=(9.0, 46.0, 9.0 + width_deg, 46.0 + 0.6 * width_deg), size=(40, 24), crs="EPSG:4326")
        plan = plan_of(scene, view, **overrides)
        assert plan.algorithm["sun"]["relief"] == name
        frame = render_frame(scene, view, plan)
        assert [record.name for record in frame.passes] == plan.passes
        (reason,) = [named_reason.reason for named_reason in plan.reasons if named_reason.name == f"sun/relief: {name}"]
        bends = "the sun's rays bend across the view; shadow_map can draw it"
        assert reason == (f"the {source} sets sweep, but {bends}" if name == "shadow_map" else f"set by the {source}")
        rejected = {named_reason.name: named_reason.reason for named_reason in plan.rejected}
        assert rejected.get("sweep") == (bends if name == "shadow_map" else None)


@pytest.mark.parametrize(
    ("azimuth", "name", "overrides"),
    [
        (180.0, "shadow_map", {}),
        (0.0, "shadow_map", {"algorithm": "sweep"}),
        (90.0, "sweep", {}),
        (90.0, "sweep", {"algorithm": "sweep"}),
    ],
)
def test_plan_draws_maps_near_a_pole_by_shadow_maps(gl, write_raster, make_scene, azimuth, name, overrides):
    """Rows of a map in degrees narrow towards the pole. Under a sun in the east, lines run along the rows."""
    heights = np.zeros((61, 61), np.float32)
    heights[27:34, 27:34] = 60.0
    scene = make_scene(write_raster(heights, "EPSG:4326", 15.0, 89.99, 1e-4), azimuth, 30.0)
    view = raster_view(scene, None, None, None, None).view
    plan = plan_of(scene, view, **overrides)
    assert plan.algorithm["sun"]["relief"] == name
    assert (render_frame(scene, view, plan).visibility == 0).any()


def test_plan_refuses_a_sweep_of_meshes_in_wide_views_too(level_file):
    wide = build_scene(load_level(level_file("earth")))
    with pytest.raises(UnsupportedError, match="meshes are not a heightfield"):
        plan_of(wide, wide.view("map", size=(12, 12)), algorithm="sweep")


def test_registry_refuses_area_lights_with_hard_edges_only():
    refused = {name for name, algorithm in ALGORITHMS.items() if algorithm.refusal_reason(("area light",))}
    assert refused == {"hybrid", "reconstructed_volume", "planar"}


def test_plan_gives_the_refusal_of_rejected_algorithms(scene_on):
    for ground, words in (("uneven", "the ground is not flat"), ("level", "was preferred")):
        plan = plan_of(scene_on(ground), scene_on(ground).view("map"))
        (reason,) = [item.reason for item in plan.rejected if item.name == "planar"]
        assert words in reason


def test_plan_refuses_planar_on_the_round_earth(write_raster, make_scene):
    """Level ground bends with the earth. Planar needs a flat world, where a raster of constant height is a plane."""
    heights = np.full((64, 64), 12.0, np.float32)
    flat_scene = make_scene(write_raster(heights, ENGINEERING_CRS_WKT, 0, 64, 1.0, name="flat.tif"), effects=FORCED_SHADOWS)
    assert plan_of(flat_scene, flat_scene.view(), algorithm="planar").algorithms_text == "planar"
    earth_scene = make_scene(write_raster(heights, "EPSG:32632", 500000, 5200000, 1.0, name="bent.tif"), effects=FORCED_SHADOWS)
    with pytest.raises(UnsupportedError, match="not flat"):
        plan_of(earth_scene, earth_scene.view(), algorithm="planar")


def test_candidates_leave_out_unsupported_algorithms(scene_on):
    for ground, is_served in (("level", True), ("uneven", False)):
        scene = scene_on(ground)
        names = {plan.algorithms_text for plan in candidates(scene, scene.view("map"))}
        assert ("planar" in names) is is_served and {"shadow_map", "none"} <= names


def test_candidates_use_maps_for_what_an_algorithm_refuses(scene_on):
    """Trees and omni lights fall back to shadow maps. Each setting is a separate plan."""
    scene = scene_on("uneven")
    plans = candidates(scene, scene.view("perspective"), "perspective")
    assert len({plan.model_dump_json() for plan in plans}) == len(plans) <= MAX_CANDIDATES
    plans_by_algorithm = {name: [plan for plan in plans if name in plan.algorithm["sun"].values()] for name in ALGORITHMS}
    assert {name for name, matching_plans in plans_by_algorithm.items() if not matching_plans} == {"planar", "truth"}
    for name, kinds in (("shadow_volume", 2), ("hybrid", 2), ("perspective_shadow_map", 2), ("sweep", 1)):
        served_kinds, fallback_kinds = [name] * kinds, ["shadow_map"] * (3 - kinds)
        assert list(plans_by_algorithm[name][0].algorithm["sun"].values()) == served_kinds + fallback_kinds
        assert all(set(plan.algorithm["omni"].values()) == {"shadow_map"} for plan in plans_by_algorithm[name])
    assert {plan.settings["sun"]["meshes"].mask for plan in plans_by_algorithm["hybrid"]} == {"conservative", "original"}
    perspective_plans = [
        plan for plan in plans_by_algorithm["perspective_shadow_map"] if plan.algorithm["sun"]["meshes"] == "perspective_shadow_map"
    ]
    assert {plan.settings["sun"]["meshes"].map_size for plan in perspective_plans} == {512, 1024, 2048}


def test_candidates_mix_algorithms_per_caster_kind(scene_on):
    scene = scene_on("uneven")
    mixes = {tuple(plan.algorithm["sun"].values()) for plan in candidates(scene, scene.view("perspective"), "perspective")}
    assert {
        ("sweep", "shadow_volume", "shadow_map"), ("sweep", "hybrid", "shadow_map"), ("shadow_map", "shadow_volume", "shadow_map"),
        ("perspective_shadow_map", "shadow_volume", "shadow_map"),
    } <= mixes  # fmt: skip


def test_plan_names_a_filter_without_effect(scene_on):
    scene = scene_on("level")
    view = scene.view("map")
    for name, (filter, is_named) in product(("planar", "shadow_volume", "hybrid"), ((3, True), (1, False))):
        plan = plan_of(scene, view, algorithm={"meshes": name}, filter=filter)
        assert any(f"{name} has hard edges only" in reason.reason for reason in plan.reasons) is is_named
    volumes = plan_of(scene, view, algorithm={"meshes": "shadow_volume"}, filter="sun")
    assert volumes.settings["sun"]["meshes"].filter == "sun"
    sweep = plan_of(scene_on("uneven"), view, algorithm={"relief": "sweep"}, filter="sun")
    assert sweep.settings["sun"]["relief"].filter == "sun"
    assert not any("hard edges" in reason.reason for reason in sweep.reasons)


# -- volumes beside trees and in bent maps


def test_plan_mixes_volumes_with_maps_for_trees(gl, scene_on):
    """Volumes for all kinds are refused with the reason and alternatives.

    Volumes for relief and meshes with a map for trees render.
    """
    scene = scene_on("uneven")
    view = scene.view("perspective")
    for name in ("shadow_volume", "hybrid"):
        with pytest.raises(UnsupportedError) as caught:
            plan_of(scene, view, algorithm=name)
        message = str(caught.value)
        assert f"'{name} for forest under sun'" in message and "every tree picture would cast a full rectangle" in message
        serving = "shadow_map, perspective_shadow_map, light_space_perspective_map, reconstructed_volume"
        assert message.endswith(f"; algorithms that can: {serving}.")
    choice = {"relief": "shadow_volume", "meshes": "shadow_volume", "forest": "shadow_map", "spot": "none", "omni": "none"}
    frame = render_frame(scene, view, plan_of(scene, view, algorithm=choice))
    assert [step.algorithm for step in frame.plan.steps[:2]] == ["shadow_volume", "shadow_map"]
    assert [record.name for record in frame.passes] == frame.plan.passes
    without_trees, trees_only = ({**choice, **change} for change in ({"forest": "none"}, {"relief": "none", "meshes": "none"}))
    partial_visibilities = [
        render_frame(scene, view, plan_of(scene, view, algorithm=part)).visibility for part in (without_trees, trees_only)
    ]
    np.testing.assert_array_equal(frame.visibility, partial_visibilities[0] * partial_visibilities[1])
    combined_count, *part = ((visibility[frame.valid] < 0.5).sum() for visibility in (frame.visibility, *partial_visibilities))
    assert combined_count > max(part) > min(part) > 0


def test_plan_refuses_volumes_in_maps_of_small_scale(gl, tmp_path):
    scene = build_scene(load_level("configs/jacksboro.yaml"))
    rough = Path("configs/jacksboro.yaml").read_text(encoding="utf-8").replace("jacksboro\n", "jacksboro\n  resolution: 600\n", 1)
    (tmp_path / "rough.yaml").write_text(rough, encoding="utf-8")
    rough_scene = build_scene(load_level(tmp_path / "rough.yaml"))
    for name in ("shadow_volume", "hybrid"):
        with pytest.raises(UnsupportedError, match=r"no affine camera fits.*; algorithms that can: shadow_map, sweep\.$"):
            plan_of(rough_scene, block_at(-84.25, 36.32, 8), algorithm=name)
        assert (
            plan_of(scene, block_at(-84.25, 36.32, 8), algorithm=name).algorithms_text == name
        )  # the subdivided pixels do not bend
        block = block_at(-84.25, 36.32, 12)
        view = replace(block, row0=block.row0 + 516, col0=block.col0 + 500, rows=48, cols=48)
        frame = render_frame(scene, view, plan_of(scene, view, algorithm=name))
        assert frame.plan.algorithms_text == name and 0.02 < (frame.visibility[frame.valid] < 0.5).mean() < 0.98


# -- user interfaces


REFUSAL_CASES = [
    ("planar", "uneven", "the ground is not flat"), ("sweep", "level", "trees are not a heightfield"),
    ("shadow_volume", "level", "ignore textures"), ("hybrid", "uneven", "ignore textures"),
    ("perspective_shadow_map", "level", "a map view has no perspective"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "ground", "sentence"), REFUSAL_CASES)
def test_cli_reports_a_refusal_in_one_line(level_file, monkeypatch, capsys, tmp_path, name, ground, sentence):
    path = level_file(ground)
    spelling = f"relief=none,meshes=none,forest={name}"
    arguments = ["skugga", "render", str(path), "--algorithm", spelling, "-o", str(tmp_path / "x.png")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as exit_info:
        cli.main()
    output = capsys.readouterr()
    assert exit_info.value.code == 2 and output.out == ""
    assert (
        output.err.count("\n") == 1
        and output.err.startswith(f"skugga: algorithm: '{name} for forest under sun'")
        and sentence in output.err
    )
    assert not (tmp_path / "x.png").exists()


@pytest.mark.long
def test_http_reports_a_refusal_as_a_problem(level_file):
    """The status is 422, the type ``application/problem+json``, and the parameter is named. Supported requests are drawn."""
    with running(create_app(Settings(workers=1), [level_file(ground) for ground in ("level", "uneven", "earth")])) as client:
        for name, ground, sentence in REFUSAL_CASES:
            response = client.get(f"/levels/{ground}/snapshot.png", params={"view": "map", "algorithm": f"forest={name}"})
            assert response.status_code == 422 and response.headers["content-type"].startswith("application/problem+json")
            problem = response.json()
            assert problem["code"] == "unsupported" and problem["parameter"] == "algorithm" and sentence in problem["detail"]
        picture_response = client.get("/levels/level/snapshot.png", params={"view": "perspective", "algorithm": "planar"})
        assert picture_response.status_code == 200 and "planar" in picture_response.headers["x-skugga-algorithm"]
        tiles, query = "/levels/earth/tiles/WebMercatorQuad", "algorithm=relief%3Dshadow_volume"
        bent_response, straight_response = (client.get(f"{tiles}/{zxy}.png?{query}") for zxy in ("9/136/200", "12/1089/1603"))
        assert bent_response.status_code == 422 and "at this scale no affine camera fits" in bent_response.json()["detail"]
        assert straight_response.status_code == 200 and "relief=shadow_volume" in straight_response.headers["x-skugga-algorithm"]
