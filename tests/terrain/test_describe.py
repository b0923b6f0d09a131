"""Descriptors: minimal and invalid values, round trips through JSON, and equal descriptors for equal views."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from skugga.selector.choices import StandaloneRequest
from skugga.selector.planner.planner import make_plan
from skugga.terrain.describe import describe
from skugga.terrain.facts.coarse_view import rasterize_triangles
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import Shadows, load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"

MINIMAL_DESCRIPTOR = {
    "view": "map", "view_kind": "map", "flat_world": True, "pixel_m": 1.0, "node_m": 1.0, "casters": ["relief"], "relief_m": 50.0,
    "block_relief_m": 50.0, "sun_azimuth_deg": 180, "sun_altitude_deg": 30, "highest_sun_deg": 30,
    "receivers_light_m": [1000, 500, 900],
}  # fmt: skip

BAND = {"near_m": 4, "far_m": 8, "share": 0.5, "low_light_m": [0, 0, 0], "high_light_m": [1, 1, 1]}
CAST_BAND = {"near_m": 4, "far_m": 8, "share": 0.5, "cast": 0.1, "pixel_m": 0.1, "differs": [0.0] * 8}
STAND = {"kind": "relief", "triangles": 8}
LAMP = {"name": "lamp", "kind": "spot", "cutoff_deg": 30, "reference_m": 10}


def scene_of(name: str):
    """Return the scene of a bundled level."""
    return build_scene(load_level(CONFIGS / f"{name}.yaml"))


def with_sun_facts(**facts) -> dict:
    """Return changes of a descriptor: facts of the sun."""
    return {"lights": {"sun": facts}}


def with_cast_bands(*bands: dict, share: float = 0.1) -> dict:
    """Return changes of a descriptor: bands of the sun's cast shadow of relief."""
    return with_sun_facts(casts={"relief": {"share": share, "bands": list(bands)}})


def with_band(**changes) -> dict:
    """Return changes of a descriptor: a band of distances."""
    return {"bands": [BAND | changes]}


INVALID_CHANGES = {
    "view_kind": {"view_kind": "globe"},
    "radius_m": {"radius_m": 0.0},
    "pixel_m": {"pixel_m": 0.0},
    "pixel": {"pixel": -0.1},
    "rows": {"rows": 0},
    "cols": {"cols": -1},
    "pixels": {"pixels": 0},
    "edge_share": {"edge_share": 1.1},
    "node_m": {"node_m": float("nan")},
    "casters.0": {"casters": ["clouds"]},
    "casters": {"casters": ["relief", "relief"]},
    "relief_m": {"relief_m": -1.0},
    "block_relief_m": {"block_relief_m": float("inf")},
    "mean_slope_deg": {"mean_slope_deg": 91.0},
    "p95_slope_deg": {"p95_slope_deg": -1.0},
    "highest_slope_deg": {"mean_slope_deg": 20.0, "highest_slope_deg": 10.0},
    "sun_azimuth_deg": {"sun_azimuth_deg": 1000.0},
    "sun_altitude_deg": {"sun_altitude_deg": 91.0},
    "highest_sun_deg": {"highest_sun_deg": None},
    "receivers_light_m.1": {"receivers_light_m": [1.0, -1.0, 1.0]},
    "bend_px": {"bend_px": -0.5},
    "row_width_ratio": {"row_width_ratio": 0.9},
    "tallest_m": {"tallest_m": -2.0},
    "weather.cloud_cover": {"weather": {"cloud_cover": 2.0}},
    "facts.haze.visibility_m": {"facts": {"haze": {"visibility_m": float("nan")}}},
    "cloudiness": {"cloudiness": 1.0},
    "bands.0.share": with_band(share=1.5),
    "bands.0.near_m": with_band(near_m=0.0),
    "far_m": with_band(far_m=4.0),
    "high_light_m": with_band(high_light_m=[1.0, -1.0, 1.0]),
    "bands add up": {"bands": [BAND, BAND, BAND]},
    "lamps.0.cutoff_deg": {"lamps": [LAMP | {"cutoff_deg": 181.0}]},
    "lamps.0.reference_m": {"lamps": [LAMP | {"reference_m": 0.0}]},
    "lamps: 'lamp'": {"lamps": [LAMP, LAMP]},
    "stands.0.triangles": {"stands": [STAND | {"triangles": -1}]},
    "stands.0.count": {"stands": [STAND | {"count": -1}]},
    "stands.0.outside_triangles": {"stands": [STAND | {"outside_triangles": -1}]},
    "stands.0.closed_share": {"stands": [STAND | {"closed_share": 1.1}]},
    "stands.0.alpha_share": {"stands": [STAND | {"alpha_share": -0.1}]},
    "stands.0.height_m": {"stands": [STAND | {"height_m": -1.0}]},
    "stands.0.width_m": {"stands": [STAND | {"width_m": -1.0}]},
    "stands.0.leaf_gap_m": {"stands": [STAND | {"leaf_gap_m": -1.0}]},
    "stands: 'forest'": {"stands": [STAND | {"kind": "forest"}]},
    "lights: 'lamp'": {"lights": {"lamp": {}}},
    "lights.sun.casts: 'meshes'": with_sun_facts(casts={"meshes": {"share": 0.0}}),
    "lights.sun.to_view_deg": with_sun_facts(to_view_deg=190.0),
    "lights.sun.facing_share": with_sun_facts(facing_share=1.2),
    "lights.sun.cast_share": with_sun_facts(cast_share=-0.2),
    "lights.sun.area_share": with_sun_facts(area_share=3.0),
    "lights.sun.nearest_edge_m": with_sun_facts(nearest_edge_m=-1.0),
    "lights.sun.silhouette_edges": with_sun_facts(silhouette_edges=-1),
    "lights.sun.silhouette_px": with_sun_facts(silhouette_px=float("inf")),
    "lights.sun.volume_layers": with_sun_facts(volume_layers=-1.0),
    "lights.sun.casts.relief.share": with_cast_bands(share=2.0),
    "lights.sun.casts.relief.bands.0.cast": with_cast_bands(CAST_BAND | {"cast": 1.1}),
    "lights.sun.casts.relief.bands.0.near_m": with_cast_bands(CAST_BAND | {"near_m": -1.0}),
    "lights.sun.casts.relief.bands.0.pixel_m": with_cast_bands(CAST_BAND | {"pixel_m": 0.0}),
    "lights.sun.casts.relief.bands.0.light_m": with_cast_bands(CAST_BAND | {"light_m": -1.0}),
    "lights.sun.casts.relief.bands.0.differs": with_cast_bands(CAST_BAND | {"differs": [0.1] * 7}),
    "lights.sun.casts.relief.bands.0.differs.2": with_cast_bands(CAST_BAND | {"differs": [0.0, 0.0, 1.1, *[0.0] * 5]}),
    "far_m 3": with_cast_bands(CAST_BAND | {"far_m": 3.0}),
    "near_m": with_cast_bands(CAST_BAND, CAST_BAND),
}


@pytest.mark.parametrize("name", INVALID_CHANGES)
def test_invalid_descriptor_names_the_field(name):
    with pytest.raises(ValidationError) as caught:
        Descriptor.model_validate(MINIMAL_DESCRIPTOR | INVALID_CHANGES[name])
    error = caught.value.errors()[0]
    error_text = f"{'.'.join(map(str, error['loc']))} {error['msg']}"
    assert all(word in error_text for word in name.split()), error_text


def test_minimal_descriptor_is_enough_for_a_plan():
    descriptor = Descriptor.model_validate(MINIMAL_DESCRIPTOR)
    assert descriptor.pixels == 1024**2 and descriptor.stands == () and descriptor.lights == {}
    assert Descriptor.model_validate(MINIMAL_DESCRIPTOR | {"rows": 100, "cols": 200}).pixels == 20_000
    plan = make_plan(descriptor, StandaloneRequest(Shadows(), ("sun",)))
    assert set(plan.algorithm["sun"]) == {"relief"}


def test_example_in_the_docs_is_valid():
    text = (ROOT / "docs" / "descriptor.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    descriptor = Descriptor.model_validate_json(example)
    assert make_plan(descriptor, StandaloneRequest(Shadows(), ("sun",))).algorithm["sun"].keys() == {"relief", "meshes"}


def test_reference_lists_every_field():
    from scripts.descriptor_reference import DESCRIPTOR_TYPES, field_texts

    for facts in DESCRIPTOR_TYPES.values():
        _, fields = field_texts(facts)
        assert all(text for _, text in fields), facts.__name__
        assert sorted(name for names, _ in fields for name in names) == sorted(facts.model_fields), facts.__name__


@pytest.mark.parametrize("fact", [np.inf, -np.inf, 2.5, True, "why", None])
def test_facts_of_effects_round_trip_through_json(fact):
    descriptor = Descriptor.model_validate(MINIMAL_DESCRIPTOR | {"facts": {"haze": {"its": fact}}})
    assert Descriptor.model_validate_json(descriptor.model_dump_json()).facts["haze"]["its"] == fact


VIEWS = [("spatialace", "main"), ("spatialace", "map"), ("thesis_boxgrid", "main"), ("jacksboro", "map")]


@pytest.mark.long
@pytest.mark.parametrize(("level", "view"), VIEWS)
def test_descriptor_is_equal_from_json_and_in_every_process(level, view):
    scene = scene_of(level)
    text = describe(scene, scene.view(view), view).model_dump_json()
    assert Descriptor.model_validate_json(text).model_dump_json() == text
    script = (
        "from skugga.terrain.describe import describe\nfrom skugga.terrain.level.level import load_level\n"
        "from skugga.terrain.scene import build_scene\n"
        f"scene = build_scene(load_level({str(CONFIGS / f'{level}.yaml')!r}))\n"
        f"print(describe(scene, scene.view({view!r}), {view!r}).model_dump_json())"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert json.loads(run.stdout) == json.loads(text)


def test_another_sun_changes_only_its_light_facts():
    scene = scene_of("spatialace")
    view = scene.view("main")
    descriptor, other_descriptor = (
        describe(sun_scene, view, "main") for sun_scene in (scene, scene.with_sun(SunSpec(azimuth=20, altitude=60)))
    )
    assert descriptor.stands == other_descriptor.stands and descriptor.pixel_m == other_descriptor.pixel_m
    assert descriptor.lights["sun"] != other_descriptor.lights["sun"]


def test_map_facts_do_not_depend_on_the_visible_part():
    scene = scene_of("jacksboro")
    view = scene.view("map", size=(512, 512))
    left, right = (describe(scene, view.part(0, col, 256, 256)) for col in (0, 256))
    for field in ("stands", "lights", "mean_slope_deg", "highest_slope_deg"):
        assert getattr(left, field) == getattr(right, field)


def test_thesis_boxes_are_closed_and_cast():
    scene = scene_of("thesis_boxgrid")
    facts = describe(scene, scene.view("main"), "main")
    relief, meshes = facts.stands
    assert (relief.kind, relief.triangles) == ("relief", 20_000)
    assert (meshes.count, meshes.triangles, meshes.closed_share) == (1000, 12_000, 1.0)
    lamp = facts.lights["lamp"]
    assert 0.0 < lamp.cast_share < lamp.facing_share < 1.0
    assert lamp.silhouette_edges >= 6 * 1000 * 0.9 and lamp.volume_layers > 1.0
    assert lamp.casts["relief"].share == 0.0
    difference_shares = np.array([band.differs for band in lamp.casts["meshes"].bands])
    assert (difference_shares[:, -1] > difference_shares[:, 1]).any()


def test_spinning_caster_moves():
    assert describe(*_scene_view_and_name("spatialace", "map")).moves
    assert not describe(*_scene_view_and_name("jacksboro", "map")).moves


def _scene_view_and_name(level: str, view: str):
    """Return the arguments of ``describe`` for a view of a bundled level."""
    scene = scene_of(level)
    return scene, scene.view(view), view


def test_rasterize_triangles_shows_the_nearest_one():
    """A floor that extends behind the eye fills the lower half of the picture. A plate in front of it fills the middle."""
    scene = scene_of("thesis_room")
    view = scene.view("main", size=(64, 64))
    frame = view.frame(scene.world)
    eye, camera_from_frame = view.in_frame(frame)

    def placed(at_camera):
        return np.array(at_camera, float) @ camera_from_frame + eye

    floor = placed([[-500, 20, -100], [500, 20, -100], [500, 20, 1000], [-500, 20, 1000]])
    half = 8.0 / view.focal_px * 10.0  # eight pixels
    board = placed([[-half, -half, 10], [half, -half, 10], [half, half, 10], [-half, half, 10]])
    quads = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    number = rasterize_triangles(view, frame, [(floor, quads), (board, quads)], np.zeros((1, 2)))[0][..., 0]
    assert set(np.unique(number[40:])) <= {1, 2} and (number[:24] == 0).all()
    assert np.isin(number[24:40, 24:40], (3, 4)).all()
    assert (number[24:32, :24] == 0).all() and (number[34:, :24] > 0).all()


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 180))
def test_any_valid_share_and_angle_is_accepted(facing, cast, angle):
    facts = with_sun_facts(facing_share=facing, cast_share=cast, to_view_deg=angle)
    descriptor = Descriptor.model_validate(MINIMAL_DESCRIPTOR | facts)
    assert Descriptor.model_validate_json(descriptor.model_dump_json()) == descriptor


def test_bands_contain_the_visible_points_and_little_more(tmp_path):
    """A distant mountain of 4 km must not make the band within a metre of the eye 8 km large."""
    trimesh.creation.box(extents=(3000.0, 3000.0, 4000.0)).export(tmp_path / "mountain.ply")
    trimesh.creation.box(extents=(0.3, 0.3, 0.5)).export(tmp_path / "stone.ply")
    views = {"eye": {"kind": "perspective", "eye": [0, 0, 0.5], "target": [0.2, 1, 0.1], "fov": 70, "size": [96, 72]}}
    meshes = [{"source": "mountain.ply", "at": [-4000, 30_000]}, {"source": "stone.ply", "at": [0.3, 1.2]}]
    level = {
        "version": 1, "terrain": {"flat": {"size": [100_000, 100_000], "cells": [50, 50]}}, "meshes": meshes, "views": views,
        "sun": {"azimuth": 250, "altitude": 20},
    }  # fmt: skip
    (tmp_path / "level.yaml").write_text(json.dumps(level), encoding="utf-8")
    scene = build_scene(load_level(tmp_path / "level.yaml"))
    view = scene.view("eye")
    bands = describe(scene, view, "eye").bands
    assert bands[0].far_m <= 2.0 and bands[-1].far_m >= 16_384.0
    for band in bands:
        sides_m = np.subtract(band.high_light_m, band.low_light_m)
        assert (sides_m <= 2.2 * band.far_m).all(), f"the band of {band.far_m} m spans {sides_m} m in light space"
    buffer = geometry_buffer(scene, view)
    rotation, translation = scene.light_space.transform_from_frame(buffer.frame)
    points = buffer.position_frame_m[buffer.valid]
    distance_m = np.linalg.norm(points - view.in_frame(buffer.frame)[0], axis=-1)
    for band in bands:
        points_in_light_space = (points[(distance_m > band.near_m) & (distance_m <= band.far_m)] @ rotation.T + translation)[
            :, 1:
        ]  # the up and away axes, along which heights shift points
        assert (
            len(points_in_light_space)
            and (points_in_light_space >= band.low_light_m[1:]).all()
            and (points_in_light_space <= band.high_light_m[1:]).all()
        )
