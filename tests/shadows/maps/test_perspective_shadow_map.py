"""Maps that are warped towards the eye: agreement with truth from all sides, no acne, finer near edges than a shadow map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh

from skugga.selector.measure.compare import measure_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import perspective_shadow_map
from skugga.shadows.maps.post_perspective import UNIFORM_MAP_CONE_DEG
from skugga.shadows.maps.settings import PerspectiveMapSettings
from skugga.shadows.passes import PassLog
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE, error_metrics
from skugga.shadows.truth.truth import coverage_truth, trace_truth
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING
from tests.render import plan_of, render
from tests.shadows.boxes import box, build_mesh_scene

ALGORITHM = "perspective_shadow_map"

LIGHT_SPACE = "light_space_perspective_map"

both_algorithms = pytest.mark.parametrize("algorithm", [ALGORITHM, LIGHT_SPACE])

EYE = {"kind": "perspective", "eye": [2, -18, 5], "target": [0, 10, 1], "fov": 60, "size": [240, 180]}
SPOT = {"kind": "spot", "position": [20, -12, 20], "target": [0, 0, 0], "cutoff": 40}


def render_visibility(
    buffer: GeometryBuffer, scene: Scene, light: str, algorithm: str = ALGORITHM, **overrides
) -> tuple[np.ndarray, PassLog]:
    """Return the visibility of a light and the pass log. Attached shadow counts; NaN marks no surface."""
    settings = PerspectiveMapSettings(**{"map_size": 1024, "depth_bits": 24 if light == "sun" else 32, "filter": 1, **overrides})
    log = PassLog()
    receivers = receivers_of(buffer, scene, light)
    casters, kinds = find_casters(scene, buffer), ("relief", "meshes", "forest")
    rendered = ALGORITHMS[algorithm].fill_visibility(receivers, scene, light, kinds, casters, settings, log)
    rendered[attached_shadow_mask(buffer, scene, light)] = 0.0
    rendered[~buffer.valid] = np.nan
    return rendered, log


def write_plane(write_raster, slope_deg: float, towards_deg: float) -> Path:
    """Write a plane of 960 m that faces an azimuth with a slope."""
    axis = (np.arange(96) - 47.5) * 10.0
    east, north = np.meshgrid(axis, -axis)
    facing = np.radians(towards_deg)
    rise = -np.tan(np.radians(slope_deg)) * (east * np.sin(facing) + north * np.cos(facing))
    return write_raster(rise.astype(np.float32), ENGINEERING, -480, 480, 10.0, name="plane.tif")


# -- self-shadowing


@pytest.mark.parametrize("bits", [16, 24, 32])
@pytest.mark.parametrize(("slope", "towards"), [(0, 0), (30, 203), (70, 290)])
@both_algorithms
def test_perspective_map_does_not_self_shadow_planes(gl, write_raster, make_scene, algorithm, slope, towards, bits):
    """Suns range from high to grazing, before, behind and beside the camera. A lamp and all tap counts are covered."""
    raster = write_plane(write_raster, slope, towards)
    for altitude, azimuth_offset in ((75.0, 0.0), (25.0, -60.0), (6.0, 70.0), (4.0, 0.0)):
        views = {"eye": {"kind": "perspective", "eye": [10, -40, 12], "target": [0, 30, 3], "fov": 50, "size": [120, 90]}}
        lamp = {"kind": "spot", "position": [-20, 10, 9], "target": [0, 0, 0], "cutoff": 80}
        scene = make_scene(raster, towards + azimuth_offset, altitude, views=views, lights={"lamp": lamp})
        buffer = geometry_buffer(scene, scene.view("eye"))
        for light in ("sun", "lamp"):
            for taps in (1, 2, 3, 5) if bits == 24 else (3,):
                rendered, _ = render_visibility(buffer, scene, light, algorithm, filter=taps, depth_bits=bits, map_size=256)
                receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
                assert (rendered[receivers] == 1.0).all(), (light, altitude, azimuth_offset, taps)


@both_algorithms
def test_perspective_map_of_constant_depth_has_no_acne(gl, write_raster, make_scene, algorithm):
    """All receivers are at one distance from the sun, and rounding to float32 must not shade them."""
    raster = write_plane(write_raster, 40, 180)
    views = {"eye": {"kind": "perspective", "eye": [100, -200, 12], "target": [-100, 30, 3], "fov": 50, "size": [120, 90]}}
    scene = make_scene(raster, 180, 50, views=views)
    buffer = geometry_buffer(scene, scene.view("eye"))
    for bits in (16, 24, 32):
        assert (render_visibility(buffer, scene, "sun", algorithm, depth_bits=bits)[0][buffer.valid] == 1.0).all()


@both_algorithms
def test_perspective_map_without_bias_has_acne(gl, write_raster, make_scene, algorithm):
    raster = write_plane(write_raster, 40, 203)
    views = {"eye": {"kind": "perspective", "eye": [10, -40, 12], "target": [0, 30, 3], "fov": 50, "size": [120, 90]}}
    scene = make_scene(raster, 260, 20, views=views)
    buffer = geometry_buffer(scene, scene.view("eye"))
    assert (render_visibility(buffer, scene, "sun", algorithm, bias_scale=0.0)[0] < 1.0).mean() > 0.02


# -- against truth


def tower_scene(folder: Path, azimuth: float, altitude: float, **keys) -> Scene:
    """Return towers around the eye and boxes before it. Most casters lie behind the eye or beside it."""
    towers = [box((3, 3, 14), 0, (24 * np.sin(t), -18 + 24 * np.cos(t))) for t in np.radians(np.arange(15, 375, 45))]
    near = [box((2, 2, 2), 0, (-3, -8)), box((4, 3, 5), 0, (5, 4)), box((5, 5, 0.3), 6, (-8, 6)), box((30, 1, 4), 0, (0, 40))]
    return build_mesh_scene(folder, [trimesh.util.concatenate([*towers, *near])], azimuth, altitude, views={"eye": EYE}, **keys)


def check_against_truth(scene: Scene, light: str, algorithm: str) -> None:
    """Check the errors of an algorithm's map of a light in the view ``eye``."""
    view = scene.view("eye")
    buffer = geometry_buffer(scene, view)
    rendered, log = render_visibility(buffer, scene, light, algorithm, map_size=2048)
    truth = trace_truth(buffer, scene, find_casters(scene, buffer), light=light)
    metrics = error_metrics(rendered, truth, describe(scene, view, "eye").pixel_m)
    assert (truth.valid & ~truth.lit & ~truth.attached_shadow_mask).mean() > 0.005 and truth.decidable.mean() > 0.5
    assert metrics.interior <= MAX_INTERIOR_SHARE and metrics.interior_parts == 0, (light, metrics, log.records)
    assert metrics.edge_p95 <= 1.5 and metrics.missed_shadow < 0.02 and metrics.wrong_cast < 0.03  # interior misses thin shadows


@pytest.mark.parametrize("azimuth", [0, 50, 90, 140, 183, 240, 270, 310])
@pytest.mark.parametrize("altitude", [18, 50])
@both_algorithms
def test_perspective_map_of_any_sun_agrees_with_truth(gl, tmp_path, algorithm, azimuth, altitude):
    """The camera looks north: suns stand before it, behind it and to the side."""
    check_against_truth(tower_scene(tmp_path, azimuth, altitude), "sun", algorithm)


@pytest.mark.parametrize(
    ("place", "target"),
    [
        ((4, 45, 25), (0, 5, 0)), ((-35, -20, 25), (0, 5, 0)), ((35, 10, 18), (0, 5, 0)), ((1, -40, 30), (0, 5, 0)),
        ((1, 6, 12), (2, 2, 0)),
    ],
)  # fmt: skip
@both_algorithms
def test_perspective_map_of_any_lamp_agrees_with_truth(gl, tmp_path, algorithm, place, target):
    """Lamps stand before the camera, beside it, behind it, and in the middle of its view."""
    lamp = {"kind": "spot", "position": place, "target": target, "cutoff": 40}
    check_against_truth(tower_scene(tmp_path, 90, 30, lights={"lamp": lamp}), "lamp", algorithm)


@both_algorithms
def test_perspective_map_holds_a_tower_behind_the_eye(gl, tmp_path, algorithm):
    """The tower is 30 m high, with its foot 5 m behind the eye, under a sun in the south at 45 degrees.

    Its shadow reaches half its width to either side, and its full height to the north.
    """
    eye = {"kind": "perspective", "eye": [0, -20, 3], "target": [0, 0, 0], "fov": 60, "size": [240, 180]}
    scene = build_mesh_scene(tmp_path, [box((4, 2, 30), 0, (0, -26))], 180, 45, views={"eye": eye})
    buffer = geometry_buffer(scene, scene.view("eye"))
    dark = render_visibility(buffer, scene, "sun", algorithm, map_size=2048)[0] < 0.5
    x, y = (buffer.position_frame_m @ buffer.frame.frame_from_earth + buffer.frame.origin_earth_m)[..., :2].transpose(2, 0, 1)
    inside = (np.abs(x) < 1.9) & (y < 4.9)  # the roof's far edge lies at -25, and its shadow ends 30 m further on
    outside = (np.abs(x) > 2.1) | (y > 5.1)
    assert inside[buffer.valid].sum() > 500 and dark[inside & buffer.valid].all() and not dark[outside & buffer.valid].any()


@both_algorithms
def test_perspective_map_of_trees_matches_rays(gl, write_raster, make_scene, tmp_path, algorithm):
    raster = write_raster(np.zeros((60, 60), np.float32), ENGINEERING, -60.0, 60.0, 2.0)
    rng = np.random.default_rng(11)
    points = np.array([shapely.Point(*p) for p in rng.uniform(-25, 25, (40, 2))], object)
    heights = rng.uniform(4, 9, len(points))
    pyogrio.raw.write(
        tmp_path / "trees.gpkg", shapely.to_wkb(points), [heights], ["height"], geometry_type="Point", crs=ENGINEERING
    )
    views = {"eye": {"kind": "perspective", "eye": [-5, -30, 22], "target": [0, 0, 0], "fov": 55, "size": [192, 160]}}
    forest = [{"source": "trees.gpkg", "height": "height"}]
    scene = make_scene(raster, 120, 35, forest=forest, views=views, lights={"lamp": SPOT})
    buffer = geometry_buffer(scene, scene.view("eye"))
    for light in ("sun", "lamp"):
        rendered, _ = render_visibility(buffer, scene, light, algorithm, filter=3)
        shares = coverage_truth(buffer, scene, find_casters(scene, buffer), 16, light=light)
        shade = np.nan_to_num(1.0 - rendered, nan=0.0).reshape(10, 16, 12, 16).mean(axis=(1, 3))
        covered_blocks = buffer.valid.reshape(10, 16, 12, 16).all(axis=(1, 3))
        assert np.abs(shade - shares)[covered_blocks].mean() < 0.04 and 0.1 < shares[covered_blocks].mean() < 0.9


@pytest.mark.long
@pytest.mark.parametrize("level", ["thesis_rocks", "thesis_rocks_sun"])
@both_algorithms
def test_perspective_map_has_finer_near_edges_than_shadow_map(gl, algorithm, level):
    scene = build_scene(load_level(f"configs/{level}.yaml"))
    view = scene.view("close", size=(320, 256))
    overrides = {"map_size": 512, "filter": 3}
    figures = {
        name: measure_plan(scene, view, plan_of(scene, view, algorithm=name, **overrides, **extra_overrides)).figures
        for name, extra_overrides in (("shadow_map", {"cascades": 1, "fit": "tight"}), (algorithm, {}))
    }
    assert figures[algorithm]["edge_p95"] < figures["shadow_map"]["edge_p95"]
    assert figures[algorithm]["wrong_cast"] < 0.5 * figures["shadow_map"]["wrong_cast"]


# -- maps and plans


@both_algorithms
def test_perspective_map_is_cached_while_unchanged(gl, tmp_path, algorithm):
    gl.depth_targets.clear()
    scene = tower_scene(tmp_path, 120, 30)
    buffer = geometry_buffer(scene, scene.view("eye"))
    (first, first_log), (second, second_log) = (render_visibility(buffer, scene, "sun", algorithm) for _ in range(2))
    records = [next(iter(log.records.values())) for log in (first_log, second_log)]
    assert [record.kept for record in records] == [0, 1] and records[0].draws > 0 and records[1].draws == 0
    np.testing.assert_array_equal(first, second)
    assert next(iter(render_visibility(buffer, scene, "sun", algorithm, map_size=512)[1].records.values())).kept == 0


@both_algorithms
def test_perspective_map_is_uniform_for_a_sun_in_the_view_axis(gl, tmp_path, algorithm):
    eye = {"kind": "perspective", "eye": [0, -20, 10], "target": [0, 0, 0], "fov": 50, "size": [120, 90]}
    down_deg = float(np.degrees(np.arctan2(10, 20)))
    for azimuth, altitude in ((180, down_deg), (180, down_deg + 2 * UNIFORM_MAP_CONE_DEG)):
        scene = build_mesh_scene(tmp_path, [box((2, 2, 3))], azimuth, altitude, views={"eye": eye})
        _, log = render_visibility(geometry_buffer(scene, scene.view("eye")), scene, "sun", algorithm)
        note = next(iter(log.records.values())).note
        assert note.startswith("a uniform map") == (altitude == down_deg)


@both_algorithms
def test_perspective_map_skips_a_light_that_reaches_nothing(gl, tmp_path, algorithm):
    lamp = {"kind": "spot", "position": [90, 90, 5], "target": [95, 95, 0], "cutoff": 5}
    scene = build_mesh_scene(tmp_path, [box((2, 2, 3))], 120, 30, views={"eye": EYE}, lights={"lamp": lamp})
    frame = render(scene, scene.view("eye"), algorithm=algorithm)
    assert list(frame.visibilities) == ["sun"]
    assert [record.name for record in frame.passes] == frame.plan.passes


@both_algorithms
def test_plan_names_perspective_map_settings_without_effect(tmp_path, algorithm):
    scene = build_mesh_scene(tmp_path, [box((2, 2, 3))], 120, 30, views={"eye": EYE}, lights={"lamp": SPOT})
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm=algorithm)
    assert [plan.settings[light]["meshes"].depth_bits for light in ("sun", "lamp")] == [24, 32]
    assert plan.settings["sun"]["meshes"].map_size == 1024 and plan.settings["sun"]["meshes"].filter == 3
    assert {"map_size 1024", "depth_bits 24", "filter 3", "lamp: depth_bits 32"} <= {reason.name for reason in plan.reasons}
    plan = plan_of(scene, view, algorithm=algorithm, cascades=4, fit="stable", culling="front", bias="normal_offset", map_size=700)
    left_out = {reason.name for reason in plan.reasons if reason.reason.startswith("no effect")}
    assert {"cascades 4", "fit stable", "culling front", "bias normal_offset"} <= left_out
    assert plan.settings["lamp"]["meshes"].map_size == 700
    soft_settings = plan_of(scene, view, algorithm=algorithm, filter="sun").settings
    assert (soft_settings["sun"]["meshes"].filter, soft_settings["lamp"]["meshes"].filter) == ("sun", 3), "the lamp is a point"
    with pytest.raises(UnsupportedError, match="a map view has no perspective"):
        plan_of(scene, scene.view(), algorithm=algorithm)


@pytest.mark.parametrize("filter", [1, "sun"])
def test_light_space_map_has_its_own_matrix(gl, tmp_path, filter):
    """Few texels show whose matrix a map has, also where it is one of many for a sun that is a disc."""
    scene = tower_scene(tmp_path, 120, 30)
    buffer = geometry_buffer(scene, scene.view("eye"))
    shadows = [render_visibility(buffer, scene, "sun", name, map_size=128, filter=filter)[0] for name in (ALGORITHM, LIGHT_SPACE)]
    assert 0.005 < (np.abs(shadows[0] - shadows[1]) > 0.5)[buffer.valid].mean() < 0.2
    settings = PerspectiveMapSettings(map_size=128, depth_bits=24, filter=filter)
    texels_m = [ALGORITHMS[name].accuracy.texel_m(scene, "sun", ("meshes",), settings, buffer) for name in (ALGORITHM, LIGHT_SPACE)]
    floor = buffer.valid & (texels_m[0] > 0.0)
    ratio = np.where(floor, texels_m[1] / np.where(floor, texels_m[0], 1.0), np.nan)
    assert np.nanmedian(ratio[-5:]) > 1.2 and np.nanmin(ratio) < 0.9, "coarser before the feet, and finer farther away"


# -- several maps where one map is too coarse


def wide_view(tmp_path: Path, **view: Any) -> Scene:
    """Return a wall beside level ground of 20 km, seen from near the ground."""
    spec = {"kind": "perspective", "eye": [2, -18, 5], "target": [0, 10, 1], "fov": 60, "size": [160, 120], **view}
    walls = [box((3, 12, 4), at_m=(-5, 0)), box((200, 400, 300), at_m=(-900, 6000))]
    ground = {"flat": {"size": [20_000, 20_000], "cells": [80, 80]}}
    return build_mesh_scene(tmp_path, walls, 200, 25, views={"eye": spec}, terrain=ground)


def maps_of(scene: Scene, buffer: GeometryBuffer, map_size: int) -> list[perspective_shadow_map.FittedMap]:
    """Return the perspective shadow maps of the sun for the visible points. ``map_size`` is in texels a side."""
    settings = PerspectiveMapSettings(map_size=map_size, depth_bits=24, filter=1)
    return perspective_shadow_map.perspective_maps(
        buffer, buffer.valid & ~attached_shadow_mask(buffer, scene), scene, "sun", settings, None
    )


def test_perspective_maps_split_where_one_map_is_too_coarse(gl, tmp_path):
    """Each receiver is in one map. Truth agrees within the edge displacement of a texel, and fewer texels need more maps."""
    scene = wide_view(tmp_path, eye=[2, -18, 0.4], target=[0, 10, -1], fov=120)
    buffer = geometry_buffer(scene, scene.view("eye"))
    receivers = np.flatnonzero(buffer.valid & ~attached_shadow_mask(buffer, scene))
    counts = []
    for map_size in (2048, 256):
        maps = maps_of(scene, buffer, map_size)
        counts.append(len(maps))
        np.testing.assert_array_equal(
            np.sort(np.concatenate([fitted_map.depth_map.point_indices for fitted_map in maps])), receivers
        )
    assert counts[0] < counts[1] <= perspective_shadow_map.MAX_DISTANCE_RANGES
    single_map = perspective_shadow_map.perspective_map(
        buffer,
        buffer.valid & ~attached_shadow_mask(buffer, scene),
        scene,
        "sun",
        PerspectiveMapSettings(map_size=256, depth_bits=24, filter=1),
        None,
    )
    assert single_map.texel_px > perspective_shadow_map.MAX_TEXEL_PX
    assert max(fitted_map.texel_px for fitted_map in maps) < single_map.texel_px
    rendered, _ = render_visibility(buffer, scene, "sun", map_size=1024)
    errors = error_metrics(rendered, trace_truth(buffer, scene, find_casters(scene, buffer)), 1.0)
    assert errors.wrong_cast <= 0.05, errors


def test_perspective_maps_of_a_usual_view_are_one(gl, tmp_path):
    scene = wide_view(tmp_path)
    (fitted_map,) = maps_of(scene, geometry_buffer(scene, scene.view("eye")), 1024)
    assert fitted_map.texel_px <= perspective_shadow_map.MAX_TEXEL_PX
