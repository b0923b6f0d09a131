"""Every algorithm for every light, kind of casters, view and ground: it renders, or it is refused with the registry's sentence."""

from __future__ import annotations

import json
import sys
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
import pyogrio
import pytest
import shapely

from api import cli
from api.app import create_app
from api.settings import Settings
from selector.compare import candidates
from selector.rules import choose
from shadows.registry import ALGORITHMS, GroundKind, LightKind, Part, ViewKind, able
from shadows.render import FILLS, render_frame
from terrain.descriptor import describe
from terrain.errors import UnsupportedError
from terrain.level import AlgorithmName, CasterKind, load_level
from terrain.made_ground import ENGINEERING
from terrain.scene import build_scene
from tests.api.conftest import running
from tests.render import plan_of

CASTERS: tuple[CasterKind, ...] = get_args(CasterKind)
LIGHTS: tuple[LightKind, ...] = get_args(LightKind)
VIEWS: tuple[ViewKind, ...] = get_args(ViewKind)
GROUNDS: tuple[GroundKind, ...] = get_args(GroundKind)
EVERY = list(product(ALGORITHMS, LIGHTS, CASTERS, VIEWS, GROUNDS))

TERRAIN = {
    "level": {"flat": {"size": [60, 60], "cells": [30, 30]}},
    "uneven": {"generate": {"kind": "landscape", "size": [60, 60], "cell": 2, "relief": 6, "seed": 3}},
}
SPOT = {"kind": "spot", "position": [-14, -10, 22], "target": [0, 0, 0], "cutoff": 45}
OMNI = {"kind": "omni", "position": [5, -8, 16]}
FORCED = {"cast_shadows": "on"}  # on level ground with nothing on it nothing casts
EYE = {"kind": "perspective", "eye": [-25, -30, 14], "target": [2, 2, 2], "fov": 45, "size": [48, 36]}


@pytest.fixture(scope="module")
def level_file(tmp_path_factory):
    """``level_file(ground)`` is the path of a level with trees, a figure, a sun, a spot and an omni light."""
    folder: Path = tmp_path_factory.mktemp("capabilities")
    points = shapely.to_wkb(np.array([shapely.Point(*p) for p in ((-8, 6), (9, -4), (12, 10))], object))
    pyogrio.raw.write(folder / "trees.gpkg", points, [], [], geometry_type="Point", crs=ENGINEERING)

    def path(ground: GroundKind, **keys) -> Path:
        level = {
            "version": 1, "terrain": TERRAIN[ground],
            "sun": {"azimuth": 215, "altitude": 30}, "lights": {"spot": SPOT, "omni": OMNI},
            "meshes": [{"generate": "tetrahedra"}], "forest": [{"source": "trees.gpkg", "height": [6, 8]}],
            "views": {"perspective": EYE, "map": {"kind": "map", "bounds": [-25, -25, 25, 25], "size": [47, 47]}}, **keys,
        }  # fmt: skip
        file = folder / f"{ground}.yaml"
        file.write_text(json.dumps(level), encoding="utf-8")
        return file

    return path


@pytest.fixture(scope="module")
def scene_on(level_file):
    """``scene_on(ground)`` is that level's scene."""
    return lru_cache(maxsize=2)(lambda ground: build_scene(load_level(level_file(ground))))


def only(name: AlgorithmName, light: LightKind, caster: CasterKind) -> dict:
    """An override that asks for one algorithm, for one light and one kind of casters; nothing else casts."""
    choice = {each: {kind: "none" for kind in CASTERS} for each in LIGHTS}
    choice[light][caster] = name
    return choice


@pytest.mark.parametrize(("name", "light", "caster", "kind", "ground"), EVERY)
def test_it_renders_or_says_why_not(gl, scene_on, name, light, caster, kind, ground):
    scene, algorithm = scene_on(ground), ALGORITHMS[name]
    parts: tuple[Part, ...] = (kind, light, caster, ground)
    view = scene.view(kind)
    why = algorithm.refusal(parts)
    if why is None:
        plan = plan_of(scene, view, algorithm=only(name, light, caster), map_size=64)
        assert plan.algorithm[light][caster] == name
        frame = render_frame(scene, view, plan)
        assert [record.name for record in frame.passes] == plan.passes
        ran = [each for each in plan.passes if each.startswith(f"{light}/{caster}: ")]
        assert [each.split(": ")[1] for each in ran] == list(algorithm.passes)
        assert np.isfinite(frame.visibilities[light][frame.there]).all()
    else:
        with pytest.raises(UnsupportedError) as caught:
            plan_of(scene, view, algorithm=only(name, light, caster))
        said = str(caught.value)
        assert said.startswith(f"algorithm: '{name} for {caster} under {light}' cannot be served: {why}; what can: ")
        assert "\n" not in said and name not in said.split("what can: ")[1]


def test_every_refusal_is_of_something_that_can_be_asked_for():
    known = {*CASTERS, *LIGHTS, *VIEWS, *GROUNDS}
    for algorithm in ALGORITHMS.values():
        assert set(algorithm.refuses) <= known
        assert all(why and why[0].islower() and not why.endswith(".") for why in algorithm.refuses.values())
        assert all(set(kinds) - set(algorithm.refuses) for kinds in (CASTERS, LIGHTS, VIEWS, GROUNDS)), "serves nothing at all"


def test_whatever_is_asked_for_something_serves_it():
    for light, caster, kind, ground in product(LIGHTS, CASTERS, VIEWS, GROUNDS):
        assert "shadow_map" in able((kind, light, caster, ground))
        assert not {"truth", "none"} & set(able((kind, light, caster, ground)))


def test_what_fills_is_what_has_passes():
    assert set(FILLS) == {name for name, algorithm in ALGORITHMS.items() if algorithm.passes}


def test_refusals_of_planar_and_sweep_are_these():
    planar, sweep = ALGORITHMS["planar"], ALGORITHMS["sweep"]
    assert (
        planar.refusal(("map", "sun", "meshes", "uneven")) == "it projects onto one plane, and the ground of this level is not flat"
    )
    assert planar.refusal(("map", "omni", "forest", "level")) is None
    assert "heightfield" in sweep.refusal(("map", "sun", "forest", "level"))
    assert "azimuth" in sweep.refusal(("map", "spot", "relief", "level"))


def test_an_algorithm_that_the_level_asks_for_is_refused_by_the_level_s_key(level_file):
    scene = build_scene(load_level(level_file("uneven", shadows={"algorithm": "planar"})))
    with pytest.raises(UnsupportedError, match=r"^shadows.algorithm: 'planar for relief under sun'"):
        choose(describe(scene, scene.view("map")), scene.loaded.level)


def test_what_was_not_taken_says_why_it_could_not_be(scene_on):
    for ground, words in (("uneven", "is not flat"), ("level", "casters projected")):
        plan = plan_of(scene_on(ground), scene_on(ground).view("map"))
        (reason,) = [item.reason for item in plan.rejected if item.name == "planar"]
        assert words in reason


def test_a_level_raster_on_the_round_earth_is_no_plane(write_raster, make_scene):
    """The ground bends with the earth: planar is for flat worlds, where a raster of one height will do."""
    heights = np.full((64, 64), 12.0, np.float32)
    flat = make_scene(write_raster(heights, ENGINEERING, 0, 64, 1.0, name="flat.tif"), effects=FORCED)
    assert plan_of(flat, flat.view(), algorithm="planar").headline == "planar"
    bent = make_scene(write_raster(heights, "EPSG:32632", 500000, 5200000, 1.0, name="bent.tif"), effects=FORCED)
    with pytest.raises(UnsupportedError, match="not flat"):
        plan_of(bent, bent.view(), algorithm="planar")


def test_a_comparison_leaves_out_what_cannot_be(scene_on):
    for ground, there in (("level", True), ("uneven", False)):
        scene = scene_on(ground)
        names = {plan.headline for plan in candidates(scene, scene.view("map"))}
        assert ("planar" in names) is there and {"shadow_map", "none"} <= names


def test_a_filter_that_plays_no_part_is_named(scene_on):
    scene = scene_on("level")
    view = scene.view("map")
    for filter, named in (("sun", True), (3, True), (1, False)):
        plan = plan_of(scene, view, algorithm="planar", filter=filter)
        assert any("sharp" in reason.reason for reason in plan.reasons) is named
    sweep = plan_of(scene_on("uneven"), view, algorithm={"relief": "sweep"}, filter="sun")
    assert sweep.settings["sun"]["relief"].filter == "sun"
    assert not any("sharp" in reason.reason for reason in sweep.reasons)


# -- what users see


REFUSED = [("planar", "uneven", "is not flat"), ("sweep", "level", "a tree is no heightfield")]


@pytest.mark.parametrize(("name", "ground", "sentence"), REFUSED)
def test_the_command_line_says_it_in_one_line(level_file, monkeypatch, capsys, tmp_path, name, ground, sentence):
    path = level_file(ground)
    spelling = f"relief=none,meshes=none,forest={name}"
    arguments = ["skugga", "render", str(path), "--algorithm", spelling, "-o", str(tmp_path / "x.png")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr()
    assert ended.value.code == 2 and said.out == ""
    assert (
        said.err.count("\n") == 1
        and said.err.startswith(f"skugga: algorithm: '{name} for forest under sun'")
        and sentence in said.err
    )
    assert not (tmp_path / "x.png").exists()


def test_http_says_it_as_a_problem(level_file):
    """422, ``application/problem+json``, the parameter named; what it can do is drawn."""
    with running(create_app(Settings(workers=1), [level_file("level"), level_file("uneven")])) as client:
        for name, ground, sentence in REFUSED:
            answer = client.get(f"/levels/{ground}/snapshot.png", params={"view": "map", "algorithm": f"forest={name}"})
            assert answer.status_code == 422 and answer.headers["content-type"].startswith("application/problem+json")
            problem = answer.json()
            assert problem["code"] == "unsupported" and problem["parameter"] == "algorithm" and sentence in problem["detail"]
        drawn = client.get("/levels/level/snapshot.png", params={"view": "perspective", "algorithm": "planar"})
        assert drawn.status_code == 200 and "planar" in drawn.headers["x-skugga-algorithm"]
