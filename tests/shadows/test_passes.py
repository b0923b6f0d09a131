"""Pass records: the number of real draw calls, their programs, and the textures that these can read."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pyogrio
import pytest
import shapely

from skugga.shadows.maps import lookup
from skugga.shadows.passes import PassLog, PassRecord
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import MIB, Cache, clear_caches
from skugga.terrain.gl import device as gl_module
from skugga.terrain.gl.programs import LinkedProgram, record_draw
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING
from tests.render import plan_of

TREE_PROGRAM, GROUND_PROGRAM = LinkedProgram("trees", ("foliage",)), LinkedProgram("ground", ())
LOOKUP_PROGRAM = LinkedProgram("look-up", ("position", "depth_map"))

VIEWS: dict[str, Any] = {
    "eye": {"kind": "perspective", "eye": [-35, -55, 14], "target": [4, 0, 3], "fov": 45, "size": [96, 72]},
    "map": {"kind": "map", "bounds": [-40, -40, 40, 40], "size": [96, 96]},
}
SPOT = {"kind": "spot", "position": [-20, 10, 25], "target": [0, 0, 0], "cutoff": 40}

Build = Callable[..., Scene]


@pytest.fixture(scope="module")
def build(tmp_path_factory) -> Build:
    """Return ``build(trees, **keys)``, a level floor with a figure on it, with or without trees."""
    folder: Path = tmp_path_factory.mktemp("passes")
    points = shapely.to_wkb([shapely.Point(12.0 - 9.0 * n, 14.0 - 4.0 * n) for n in range(3)])
    pyogrio.raw.write(folder / "trees.gpkg", points, [np.full(3, 6.0)], ["height"], geometry_type="Point", crs=ENGINEERING)

    def level(trees: bool = False, **keys: Any) -> Scene:
        path = folder / "level.yaml"
        level_keys = {
            "version": 1, "terrain": {"flat": {"size": [200, 200], "cells": [20, 20]}}, "views": VIEWS,
            "meshes": [{"generate": "tetrahedra", "at": [2, -6]}], "sun": {"azimuth": 215, "altitude": 32},
            "forest": [{"source": "trees.gpkg", "height": "height"}] if trees else [], **keys,
        }  # fmt: skip
        path.write_text(json.dumps(level_keys), encoding="utf-8")
        return build_scene(load_level(path))

    return level


def render_uncached(scene: Scene, view: str = "eye", **overrides: Any) -> Frame:
    """Return a frame drawn with empty caches."""
    clear_caches("light")
    return render_planned(scene, view, plan_of(scene, scene.view(view), **overrides))


def render_planned(scene: Scene, view: str, plan: Plan) -> Frame:
    """Render the view ``view`` by a plan."""
    return render_frame(scene, scene.view(view), plan)


def record_of(frame: Frame, ending: str) -> PassRecord:
    """Return the only record of a pass whose name has an ending."""
    (record,) = (record for record in frame.passes if record.name.endswith(ending))
    return record


# -- pass records


def test_pass_record_counts_draws_within_the_pass():
    """Programs are in the order of their first use, textures in alphabetical order, both without repetition."""
    log = PassLog()
    record_draw(TREE_PROGRAM)
    with log.record_pass("map") as record:
        for program in (LOOKUP_PROGRAM, GROUND_PROGRAM, LOOKUP_PROGRAM, GROUND_PROGRAM, TREE_PROGRAM):
            record_draw(program)
    record_draw(TREE_PROGRAM)
    assert record is log.records["map"] and record.draws == 5
    assert record.programs == ("look-up", "ground", "trees")
    assert record.textures == ("depth_map", "foliage", "position")


def test_pass_record_adds_up_over_repeated_runs():
    log = PassLog()
    for programs in ((GROUND_PROGRAM,), (), (TREE_PROGRAM, GROUND_PROGRAM), (LOOKUP_PROGRAM, TREE_PROGRAM)):
        with log.record_pass("map"):
            for program in programs:
                record_draw(program)
    with log.record_pass("rays"):
        pass
    map_record, rays = log.records.values()
    assert (map_record.draws, map_record.programs) == (5, ("ground", "trees", "look-up"))
    assert map_record.textures == ("depth_map", "foliage", "position")
    assert (rays.draws, rays.programs, rays.textures) == (0, (), ())


def test_pass_record_of_nested_passes_counts_in_both():
    log = PassLog()
    with log.record_pass("outer"):
        record_draw(GROUND_PROGRAM)
        with log.record_pass("inner"):
            record_draw(TREE_PROGRAM)
        record_draw(GROUND_PROGRAM)
    assert [(record.draws, record.programs) for record in log.records.values()] == [(3, ("ground", "trees")), (1, ("trees",))]


def test_pass_record_of_a_failed_pass_keeps_its_draws():
    log = PassLog()
    with pytest.raises(ZeroDivisionError), log.record_pass("map"):
        record_draw(GROUND_PROGRAM)
        _ = 1 / 0
    record_draw(GROUND_PROGRAM)
    assert log.records["map"].draws == 1 and log.records["map"].ms > 0.0


def test_pass_record_ignores_other_threads():
    log = PassLog()
    with log.record_pass("rays"):
        thread = threading.Thread(target=record_draw, args=(GROUND_PROGRAM,))
        thread.start()
        thread.join()
    assert log.records["rays"].draws == 0


def test_pass_record_round_trips_through_json():
    record = PassRecord("map", draws=2, programs=("a b", "c"), textures=("foliage",), loops=("d",))
    lists = {"programs": record.programs, "textures": record.textures, "loops": record.loops}
    assert json.loads(json.dumps(asdict(record))) | lists == asdict(record)


# -- frames


FRAME_CASES: list[tuple[str, bool, dict[str, Any]]] = [
    ("eye", True, {"algorithm": "shadow_map", "cascades": 3, "map_size": 256}),
    ("eye", False, {"algorithm": "shadow_map", "filter": "sun", "map_size": 256}),
    ("eye", False, {"algorithm": "shadow_map", "culling": "front", "map_size": 256}),
    ("map", True, {"algorithm": "shadow_map", "map_size": 256}),
    ("eye", True, {"algorithm": "perspective_shadow_map", "map_size": 256}),
    ("eye", False, {"algorithm": "shadow_volume"}),
    ("map", False, {"algorithm": "shadow_volume"}),
    ("eye", False, {"algorithm": "hybrid"}),
    ("eye", True, {"algorithm": "planar"}),
    ("map", True, {"algorithm": "planar"}),
    ("eye", True, {"algorithm": "truth"}),
]


@pytest.mark.parametrize(
    ("view", "trees", "overrides"), FRAME_CASES, ids=lambda value: value.get("algorithm") if isinstance(value, dict) else None
)
def test_pass_records_count_every_opengl_draw(gl, build, monkeypatch, view, trees, overrides):
    """Draws are counted at the OpenGL call: none is missing, none counts twice, and none was never made."""
    scene = build(trees, lights={"spot": SPOT} if overrides["algorithm"] != "truth" else {})
    plan = plan_of(scene, scene.view(view), **overrides)
    clear_caches("light")
    calls: list[moderngl.Program] = []
    original = moderngl.VertexArray.render
    monkeypatch.setattr(
        moderngl.VertexArray,
        "render",
        lambda self, *arguments, **keywords: calls.append(self.program) or original(self, *arguments, **keywords),
    )
    frame = render_planned(scene, view, plan)
    assert sum(record.draws for record in frame.passes) == len(calls) > 0
    assert {label for record in frame.passes for label in record.programs} == {program.extra.label for program in calls}
    assert all((record.draws > 0) == bool(record.programs) for record in frame.passes)
    assert json.loads(json.dumps([asdict(record) for record in frame.passes]))


def test_sweep_opens_no_device_and_records_no_draws(write_raster, make_scene, monkeypatch):
    heights = np.zeros((40, 40), np.float32)
    heights[18:22] = 30.0
    scene = make_scene(write_raster(heights, ENGINEERING, 0, 40, 1.0))
    monkeypatch.setattr(gl_module, "_device", None)
    frame = render_frame(scene, scene.view(), plan_of(scene, scene.view(), algorithm="sweep"))
    assert not gl_module.is_device_open() and len(frame.passes) > 2
    assert all((record.draws, record.programs, record.textures) == (0, (), ()) for record in frame.passes)


def test_cached_map_records_no_draws(gl, build):
    scene = build(trees=True)
    plan = plan_of(scene, scene.view("eye"), algorithm="shadow_map", map_size=256)
    clear_caches("light")
    first, second = (record_of(render_planned(scene, "eye", plan), "depth map") for _ in range(2))
    assert first.draws > 0 and first.programs and first.textures
    assert (second.draws, second.programs, second.textures, second.kept > 0) == (0, (), (), True)


def test_depth_map_reads_a_texture_only_for_foliage(gl, build):
    """Without a forest, no texture unit can be read: nothing is alpha-tested."""
    bare, wooded = (
        record_of(render_uncached(build(trees), algorithm="shadow_map", map_size=256), "depth map") for trees in (False, True)
    )
    assert (
        bare.draws > 0
        and bare.textures == ()
        and bare.programs == ("shadows/maps/light shadows/maps/depth.vert shadows/maps/depth.frag",)
    )
    assert wooded.textures == ("foliage",) and wooded.programs[0] == bare.programs[0]
    assert wooded.programs[1:] == (
        "shadows/maps/light terrain/gbuffer/tree shadows/maps/depth_tree.vert shadows/maps/depth_tree.frag",
    )


def test_programs_are_compiled_on_demand(gl, build, monkeypatch):
    """The sun's disc is compiled for soft edges, and leaves are compiled for trees."""
    monkeypatch.setattr(gl, "_programs", Cache("programs of this test", "process", 64 * MIB, lambda program: 1))
    frame = render_uncached(build(), algorithm="shadow_map", filter=3, map_size=256)
    assert set(gl.programs) == {label for record in frame.passes for label in record.programs}
    program_parts = {part for label in gl.programs for part in label.split()}
    assert record_of(frame, "visibility").loops == ("shadows/maps/point_lookup taps=3", "shadows/maps/point_lookup taps=1")
    assert "shadows/maps/depth.frag" in program_parts and not any("disc" in part or "tree" in part for part in program_parts)
    frame = render_uncached(build(), algorithm="shadow_map", filter="sun", map_size=256)
    assert any("shadows/maps/sun_disc.frag" in label.split() for label in gl.programs)
    soft_edge_record = record_of(frame, "visibility")
    assert "least_depth" in soft_edge_record.textures and any(
        "shadows/maps/sun_disc.frag" in label.split() for label in soft_edge_record.programs
    )
    render_uncached(build(trees=True), algorithm="shadow_map", filter=3, map_size=256)
    assert any("shadows/maps/depth_tree.frag" in label.split() for label in gl.programs)


def test_program_labels_name_compiled_constants(gl, build, monkeypatch):
    """Points of maps and of perspective views are looked up by loops, or else by shaders."""
    for taps in (1, 3):
        loops = record_of(render_uncached(build(), algorithm="shadow_map", filter=taps, map_size=256), "visibility").loops
        assert loops[0].split() == ["shadows/maps/point_lookup", f"taps={taps}"]
        map_settings = {"algorithm": "shadow_map", "filter": taps, "map_size": 256}
        loops = record_of(render_uncached(build(), "map", **map_settings), "visibility").loops
        assert loops[0].split() == ["shadows/maps/map_point_lookup", f"taps={taps}"]
        with monkeypatch.context() as patch:
            patch.setattr(lookup, "_has_loop", lambda depth_map, settings: False)
            visibility = record_of(render_uncached(build(), "map", **map_settings), "visibility")
        assert visibility.loops == ()
        assert f"taps={taps}" in visibility.programs[0].split() and "shadows/maps/shadow_map.frag" in visibility.programs[0].split()
        assert {"depth_map", "position_frame_m"} <= set(visibility.textures)
