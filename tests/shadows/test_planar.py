"""Planar shadows on level ground: known geometry, agreement with truth, and no pixel darkened twice."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows import planar
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.planar import clip_from_plane, plane_projection
from skugga.shadows.render import render_frame
from skugga.shadows.truth.truth import TruthSettings, trace_truth
from skugga.shadows.truth.truth import fill_visibility as truth_fill
from skugga.terrain.casters.caster_types import NO_CASTERS
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.antialias import multisampled
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of, render, render_points

Build = Callable[..., Scene]

EYE_VIEW = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [320, 240]}
BACK_VIEW = {**EYE_VIEW, "eye": [30, 48, 15]}
BOX_MESH = {"source": "box.obj", "at": [0, 0]}
SPOT = {"kind": "spot", "position": [-14, -18, 24], "target": [2, 2, 0], "cutoff": 50}
OMNI = {"kind": "omni", "position": [-6, -12, 18]}
LIGHTS = {"sun": {}, "spot": {"lights": {"spot": SPOT}, "sun": "none"}, "omni": {"lights": {"omni": OMNI}, "sun": "none"}}


@pytest.fixture(scope="module")
def build(tmp_path_factory) -> Build:
    """Return ``build(azimuth, altitude, **keys)``, the scene of a flat floor of 120 m.

    Files hold a box 8 m wide, 6 m deep and 5 m high, and a few trees.
    """
    folder = tmp_path_factory.mktemp("planar")
    trimesh.creation.box(extents=(8.0, 6.0, 5.0)).export(folder / "box.obj")
    rng = np.random.default_rng(5)
    points = shapely.to_wkb(np.array([shapely.Point(*p) for p in rng.uniform(-25, 25, (30, 2))], object))
    height = rng.uniform(5, 9, len(points))
    pyogrio.raw.write(folder / "trees.gpkg", points, [height], ["height"], geometry_type="Point", crs=ENGINEERING_CRS_WKT)

    @lru_cache(maxsize=32)
    def build_from_json(text: str) -> Scene:
        path = folder / "level.yaml"
        path.write_text(text, encoding="utf-8")
        return build_scene(load_level(path))

    def level(azimuth: float = 200.0, altitude: float = 35.0, **keys) -> Scene:
        sun = keys.pop("sun", {"azimuth": azimuth, "altitude": altitude})
        terrain = {"flat": {"size": [120, 120], "cells": [60, 60]}}
        return build_from_json(
            json.dumps({"version": 1, "terrain": terrain, "sun": sun, "views": {"eye": EYE_VIEW, "back": BACK_VIEW}, **keys})
        )

    return level


def view_of(scene: Scene, kind: str):
    """Return a view of a kind: ``map`` or ``perspective``."""
    return scene.view("eye") if kind == "perspective" else scene.view(bounds=(-40, -40, 40, 40), size=(240, 240))


def ground_errors(scene: Scene, view, visibility: np.ndarray, light: str) -> tuple[float, float]:
    """Return the wrong share of decidable ground pixels, and the share of them in shadow."""
    buffer = geometry_buffer(scene, view)
    reference = trace_truth(buffer, scene, find_casters(scene, buffer), light=light)
    ground = reference.decidable & (buffer.surface_kind == RELIEF)
    mismatch = ground & ((visibility < 0.5) != ~reference.lit)
    return mismatch.sum() / ground.sum(), (ground & ~reference.lit).sum() / ground.sum()


# -- arithmetic


@given(
    light=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(20.0, 1e3), st.sampled_from([0.0, 1.0])),
    point=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.0, 10.0)),
)
def test_plane_projection_follows_the_ray(light, point):
    """The image lies on the line through point and light, at height 0."""
    light, point = np.array(light), np.array(point)
    x, y, z, w = plane_projection(light) @ [*point, 1.0]
    assert z == pytest.approx(0.0, abs=1e-9) and w > 0.0
    projected = np.array([x, y, z]) / w
    to_light = light[:3] - light[3] * point
    assert np.linalg.norm(np.cross(projected - point, to_light)) <= 1e-9 * np.linalg.norm(to_light) * max(
        np.linalg.norm(projected - point), 1.0
    )


@pytest.mark.parametrize("kind", ["perspective", "map"])
def test_clip_from_plane_maps_points_to_their_pixels(build, kind):
    """A buffer's own points map to the centres of their pixels. Perspective views are also cut off-centre."""
    scene = build()
    view = view_of(scene, kind).part(20, 31, 150, 170)
    buffer = geometry_buffer(scene, view)
    row, col = np.nonzero(buffer.surface_kind == RELIEF)
    origin = np.array([3.0, -7.0, 0.0])
    points = np.column_stack([buffer.position_frame_m[row, col] - origin, np.ones(len(row))])
    x, y, _, w = clip_from_plane(scene.world, buffer.frame, view, origin) @ points.T
    # points are clamped to their triangles, whose corners the rasteriser rounds to 1/256 of a pixel
    np.testing.assert_allclose((x / w + 1.0) * view.cols / 2 - 0.5, col, rtol=0, atol=1 / 256)
    np.testing.assert_allclose((y / w + 1.0) * view.rows / 2 - 0.5, row, rtol=0, atol=1 / 256)


@pytest.mark.parametrize("altitude", [12.0, 35.0, 70.0])
def test_planar_shadow_of_a_box_under_the_sun(gl, build, altitude):
    """With the sun in the south, the shadow north of a box 6 m deep and 5 m high ends after h / tan(a), to a pixel."""
    scene = build(180.0, altitude, meshes=[BOX_MESH])
    view = scene.view(bounds=(-30, -30, 30, 30), size=(600, 600))
    frame = render_points(scene, view, algorithm="planar")
    y = view.grid.y(view.row0 + np.arange(view.rows) * view.row_step)
    dark = frame.visibility[:, 300] < 0.5
    ground = frame.height_m[:, 300] == 0.0
    length_m = y[dark & ground & (y > 0)].max() - 3.0
    assert length_m == pytest.approx(5.0 / np.tan(np.radians(altitude)), abs=0.1)
    assert not (dark & ground)[y < -3.0].any()


def test_planar_shadow_of_a_box_under_a_lamp(gl, build):
    """The line from (0, -20, 15) over the edge at y = 3, z = 5 ends at y = -20 + 23 * 15 / (15 - 5)."""
    lamp = {"kind": "omni", "position": [0, -20, 15]}
    scene = build(sun="none", lights={"lamp": lamp}, meshes=[BOX_MESH])
    view = scene.view(bounds=(-30, -30, 30, 30), size=(600, 600))
    frame = render_points(scene, view, algorithm="planar")
    y = view.grid.y(view.row0 + np.arange(view.rows) * view.row_step)
    dark = (frame.visibility[:, 300] < 0.5) & (frame.height_m[:, 300] == 0.0)
    assert y[dark].max() == pytest.approx(-20 + 23 * 1.5, abs=0.1) and y[dark].min() > 3.0


# -- against truth


@pytest.mark.parametrize(
    ("level", "name"),
    [
        ("thesis_boxgrid_sun", "main"), ("thesis_street_sun", "main"), ("thesis_street_sun", "map"), ("thesis_boxgrid", "main"),
        ("thesis_water_tower", "map"), ("thesis_room", "main"),
    ],
)  # fmt: skip
def test_planar_on_bundled_ground_equals_truth(gl, level, name):
    """At most 1 decidable ground pixel of 10,000 is wrong (measured: 1 of 100,000)."""
    scene = build_scene(load_level(f"configs/{level}.yaml"))
    view = scene.view(name, size=(320, 256) if name == "main" else (160, 160))
    frame = render_points(scene, view, algorithm="planar")
    error_share, shadow_share = ground_errors(scene, view, frame.visibility, frame.plan.lights[0])
    assert error_share <= 1e-4 and shadow_share > 0.01


@pytest.mark.parametrize("kind", ["perspective", "map"])
@pytest.mark.parametrize("light", LIGHTS)
def test_planar_trees_and_boxes_cast_from_every_light(gl, build, kind, light):
    """Leaves are projected with their texture, and agree with truth as well as boxes."""
    scene = build(meshes=[BOX_MESH], forest=[{"source": "trees.gpkg", "height": "height"}], **LIGHTS[light])
    view = view_of(scene, kind)
    frame = render(scene, view, algorithm="planar")
    buffer = geometry_buffer(scene, view)
    assert {RELIEF, MESHES, FOREST} <= set(np.unique(buffer.surface_kind))
    error_share, shadow_share = ground_errors(scene, view, frame.visibility, light)
    assert error_share <= 1e-3 and shadow_share > 0.02
    assert PassLog.pass_names(light, ("relief", "meshes", "forest"), planar.PASSES) == [n for n in frame.plan.passes if "/" in n]


@pytest.mark.parametrize("light", LIGHTS)
def test_planar_samples_match_rays_from_their_points(gl, build, light):
    """The samples are those of edge pixels beyond their own points."""
    positions = [[x, y] for x in (-18, -6, 6, 18) for y in (-12, 0, 12, 24)]
    scene = build(meshes=[{"source": "box.obj", "at": positions}], **LIGHTS[light])
    view = scene.view("back")
    buffer = multisampled(scene, view).buffer
    assert len(buffer.valid) > view.rows
    kinds = scene.objects.caster_kinds
    visibility = planar.fill_visibility(buffer, scene, light, kinds, NO_CASTERS, None, PassLog())
    reference = truth_fill(buffer, scene, light, kinds, find_casters(scene, buffer), TruthSettings(), PassLog())
    samples = (buffer.surface_kind == RELIEF) & ~attached_shadow_mask(buffer, scene, light)
    samples[: view.rows] = False
    dark_count = (reference < 0.5)[samples].sum()
    assert dark_count > 500 and dark_count < 0.95 * samples.sum()
    assert (visibility != reference)[samples].sum() <= 0.01 * dark_count


# -- stencil and clipping


def test_planar_overlapping_shadows_are_equally_dark(gl, build):
    """Two boxes stand in line with the sun. The stencil counts each pixel once, and visibility is 0 or 1."""
    scene = build(180.0, 25.0, meshes=[{"source": "box.obj", "at": [[0, 0], [0, 9]]}])
    view = scene.view(bounds=(-30, -30, 30, 30), size=(300, 300))
    frame = render_frame(scene, view, plan_of(scene, view, algorithm="planar"), layers=frozenset({"stencil"}))
    stencil = frame.layers["stencil"][SUN]
    single_box_frames = [
        render_points(build(180.0, 25.0, meshes=[{"source": "box.obj", "at": [0, y]}]), view, algorithm="planar") for y in (0, 9)
    ]
    ground = frame.height_m == 0.0
    in_both_shadows = ground & (single_box_frames[0].visibility == 0.0) & (single_box_frames[1].visibility == 0.0)
    assert in_both_shadows.sum() > 100
    assert stencil.dtype == np.uint8 and set(np.unique(stencil)) == {planar.LIT_VALUE, planar.SHADED_VALUE}
    assert (stencil[in_both_shadows] == planar.SHADED_VALUE).all() and (frame.visibility[in_both_shadows] == 0.0).all()
    assert set(np.unique(frame.visibility)) == {0.0, 1.0}
    np.testing.assert_array_equal(
        frame.color[in_both_shadows], np.broadcast_to(frame.color[in_both_shadows][0], (in_both_shadows.sum(), 3))
    )
    ground_only = plan_of(scene, view, algorithm="planar").model_copy(update={"settings": {}})
    ground_stencil = render_frame(scene, view, ground_only, layers=frozenset({"stencil"})).layers["stencil"][SUN]
    np.testing.assert_array_equal(ground_stencil, np.where(ground, stencil, planar.NO_GROUND_VALUE))


def test_planar_casters_receive_no_shadow(gl, build):
    """Without settings the ground alone receives: a box in the other's shadow stays lit where it faces the sun. Truth differs."""
    scene = build(180.0, 20.0, meshes=[{"source": "box.obj", "at": [[0, 0], [0, 9]]}])
    view = view_of(scene, "perspective")
    buffer = geometry_buffer(scene, view)
    kinds = scene.objects.caster_kinds
    visibility = planar.fill_visibility(buffer, scene, SUN, kinds, NO_CASTERS, None, PassLog())
    on_mesh = buffer.surface_kind == MESHES
    assert (visibility[on_mesh] == 1.0).all()
    reference = truth_fill(buffer, scene, SUN, kinds, find_casters(scene, buffer), TruthSettings(), PassLog())
    assert (reference < 0.5)[on_mesh & ~attached_shadow_mask(buffer, scene)].mean() > 0.05


@pytest.mark.parametrize("light", LIGHTS)
def test_planar_clips_casters_below_the_ground(gl, build, light, monkeypatch):
    """A box sunk by 3 of its 5 m casts the shadow of a box 2 m high. A box wholly below the ground casts none."""
    scene = build(meshes=[BOX_MESH], **LIGHTS[light])
    view = view_of(scene, "map")
    buffer = geometry_buffer(scene, view)

    def shadow(low: float, high: float) -> np.ndarray:
        box = trimesh.creation.box(bounds=[[-4, -3, low], [4, 3, high]])
        casters = [(np.asarray(box.vertices) - buffer.frame.origin_earth_m, np.asarray(box.faces, np.int32))]
        monkeypatch.setattr(planar, "caster_meshes", lambda *_: casters)
        return planar.fill_visibility(buffer, scene, light, ("meshes",), NO_CASTERS, None, PassLog()) == 0.0

    sunk, low, high = shadow(-3.0, 2.0), shadow(0.0, 2.0), shadow(0.0, 5.0)
    ground = (np.abs(buffer.position_frame_m[..., 0]) > 4.01) | (np.abs(buffer.position_frame_m[..., 1]) > 3.01)
    assert (sunk != low)[ground].sum() <= 2 and low[ground].sum() > 100 and high.sum() > low.sum() + 100
    assert not shadow(-6.0, -1.0).any()


def test_planar_clips_casters_above_a_lamp(gl, build, monkeypatch):
    """The part of a mast above the lamp casts nothing. The part below casts a shadow without end."""
    scene = build(sun="none", lights={"omni": OMNI}, meshes=[BOX_MESH])
    view = view_of(scene, "perspective")
    buffer = geometry_buffer(scene, view)

    def shadow(low: float, high: float) -> np.ndarray:
        mast = trimesh.creation.box(bounds=[[2, -1, low], [3, 0, high]])
        casters = [(np.asarray(mast.vertices) - buffer.frame.origin_earth_m, np.asarray(mast.faces, np.int32))]
        monkeypatch.setattr(planar, "caster_meshes", lambda *_: casters)
        return planar.fill_visibility(buffer, scene, "omni", ("meshes",), NO_CASTERS, None, PassLog()) == 0.0

    assert not shadow(19.0, 60.0).any()
    low_mast_shadow, tall_mast_shadow = shadow(0.0, 17.999), shadow(0.0, 60.0)
    assert low_mast_shadow.sum() > 200
    assert (low_mast_shadow != tall_mast_shadow).sum() <= 0.01 * low_mast_shadow.sum()


@pytest.mark.parametrize("height_m", [0.0, 5.0])
def test_planar_light_below_the_ground_lights_none_of_it(gl, build, height_m):
    """The lights are a lamp on the floor, and a sun below the horizon with ``cast_shadows: on``."""
    keys = {"lights": {"lamp": {**OMNI, "position": [-20, 0, height_m]}}, "effects": {"cast_shadows": "on"}}
    scene = build(200.0, -5.0, meshes=[BOX_MESH], **keys)
    view = view_of(scene, "perspective")
    frame = render(scene, view, algorithm="planar")
    assert not np.nan_to_num(frame.visibilities[SUN]).any()
    ground = geometry_buffer(scene, view).surface_kind == RELIEF
    assert frame.visibilities["lamp"][ground].any() == (height_m > 0.0)


def test_planar_shadow_ends_at_the_grounds_rim(gl, build):
    """A low sun casts a box's shadow beyond the floor, where nothing is drawn."""
    scene = build(270.0, 4.0, meshes=[{"source": "box.obj", "at": [40, 0]}])
    view = scene.view(bounds=(20, -20, 100, 20), size=(400, 200))
    frame = render_frame(scene, view, plan_of(scene, view, algorithm="planar"), layers=frozenset({"stencil"}))
    x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
    stencil = frame.layers["stencil"][SUN]
    assert (stencil[100, (x > 45) & (x < 59.5)] == planar.SHADED_VALUE).all() and (
        stencil[:, x > 61.2] == planar.NO_GROUND_VALUE
    ).all()
    assert np.isnan(frame.visibility[:, x > 61.2]).all()


def test_planar_leaves_no_opengl_state(gl, build):
    """The picture by shadow map is the same before and after. The stencil starts at 0 each time."""
    scene = build(meshes=[BOX_MESH], forest=[{"source": "trees.gpkg", "height": "height"}])
    view = view_of(scene, "perspective")
    before = render(scene, view, algorithm="shadow_map")
    first, second = (render(scene, view, algorithm="planar") for _ in range(2))
    after = render(scene, view, algorithm="shadow_map")
    np.testing.assert_array_equal(before.color, after.color)
    np.testing.assert_array_equal(first.visibility, second.visibility)
