"""Area lights: penumbrae of the sun's disc and of spherical lamps, for each algorithm that supports them, against rays."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.shadows.area_light import ball_points, disc_points
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.executed_effects import executed_effects
from skugga.shadows.penumbra import MAX_LIGHT_POINTS
from skugga.shadows.render import render_frame
from skugga.shadows.truth.metrics import soft_error
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, area_light_visibility, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of
from tests.shadows.boxes import View, box, build_mesh_scene

EYE = {"kind": "perspective", "eye": [-22, -30, 16], "target": [3, 2, 2], "fov": 45, "size": [96, 80]}
LAMPS = {
    "spot": {"kind": "spot", "position": [-9, -6, 14], "target": [2, 2, 0], "cutoff": 40, "radius": 0.5},
    "omni": {"kind": "omni", "position": [-4, 5, 9], "radius": 0.5},
}
MAX_SOFT_ERROR = 0.02


def area_light_scene(folder: Path, **keys) -> Scene:
    """Return a body on the ground, a high plate and a thin post under the sun, with optional lamps."""
    bodies = [box((5, 4, 4)), box((7, 5, 0.2), 9.0, (6, 6)), box((0.4, 0.4, 8), 0, (-5, 3))]
    return build_mesh_scene(folder, bodies, 205, 40, views={"eye": EYE}, **keys)


def reference_visibility(buffer: GeometryBuffer, scene: Scene, light: str) -> np.ndarray:
    """Return the true visibility (rows, cols) of an area light: dark where the surface faces away from its centre, NaN off the
    surface.
    """
    rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
    visibility = area_light_visibility(buffer, scene, light, rays, 256)
    visibility[attached_shadow_mask(buffer, scene, light)] = 0.0
    return np.where(buffer.valid, visibility, np.nan)


def rendered_visibility(scene: Scene, view: View, light: str, **overrides) -> np.ndarray:
    """Return the visibility of a light (rows, cols) in a rendered view."""
    return render_frame(scene, view, plan_of(scene, view, **overrides)).visibilities[light]


def disc_share_beyond_chord(u: np.ndarray) -> np.ndarray:
    """Return the part of a disc of radius 1 beyond a chord at u."""
    u = np.clip(u, -1.0, 1.0)
    return (np.arccos(u) - u * np.sqrt(1.0 - u**2)) / np.pi


# -- sample points of lights


def test_light_points_cover_disc_and_ball_evenly():
    """From every side, the share of points beyond a line or a plane is that of the visible disc."""
    directions_3d = np.random.default_rng(2).normal(size=(40, 3))
    directions_3d /= np.linalg.norm(directions_3d, axis=1, keepdims=True)
    directions_2d = directions_3d[:, :2] / np.linalg.norm(directions_3d[:, :2], axis=1, keepdims=True)
    chord_offsets = np.linspace(-0.95, 0.95, 39)
    for points, directions in ((disc_points(MAX_LIGHT_POINTS), directions_2d), (ball_points(MAX_LIGHT_POINTS), directions_3d)):
        assert np.linalg.norm(points, axis=1).max() < 1.0
        shares = (points @ directions.T > chord_offsets[:, None, None]).mean(axis=1)
        share_errors = np.abs(shares - disc_share_beyond_chord(chord_offsets)[:, None])
        assert share_errors.mean() < 0.03 and share_errors.max() < 0.12


@pytest.mark.parametrize("kind", ["spot", "omni"])
def test_area_truth_of_a_ball_is_a_disc_beyond_an_edge(tmp_path, kind):
    """A wide plate lies at half the height of a lamp.

    Along a line across its shadow's edge, the ground sees the part of the ball beyond the plane through the plate's edge.
    """
    radius, height, edge_offset_m = 0.8, 12.0, 6.0
    lamp = {"kind": kind, "position": [-edge_offset_m, 0, height], "radius": radius}
    lamp |= {"target": [edge_offset_m, 0, 0], "cutoff": 60} if kind == "spot" else {}
    scene = build_mesh_scene(tmp_path, [box((20, 80, 0.002), height / 2, (-10, 0))], 180, 45, sun="none", lights={"lamp": lamp})
    view = scene.view(bounds=(edge_offset_m - 2, -0.1, edge_offset_m + 2, 0.1), size=(100, 5))
    buffer = geometry_buffer(scene, view)
    x = buffer.position_frame_m[2, :, 0]
    ball_offset_m = (edge_offset_m - x) * height / 2 / np.hypot(x, height / 2)  # distance from the plane to the ball's centre
    expected_share = disc_share_beyond_chord(ball_offset_m / radius)
    assert expected_share.min() == 0.0 and expected_share.max() == 1.0
    assert np.abs(reference_visibility(buffer, scene, "lamp")[2] - expected_share).max() < 0.02


# -- algorithms


@pytest.mark.parametrize("algorithm", ["shadow_map", "perspective_shadow_map", "shadow_volume"])
def test_area_light_of_the_sun_matches_truth(gl, algorithm):
    scene = build_scene(load_level(find_level("thesis_boxgrid_sun")))
    view = scene.view("close", size=(120, 96))
    reference = reference_visibility(geometry_buffer(scene, view), scene, "sun")
    assert ((reference > 0.02) & (reference < 0.98)).mean() > 0.02
    hard, disc = (
        soft_error(rendered_visibility(scene, view, "sun", algorithm=algorithm, filter=filter, map_size=2048), reference)
        for filter in (1, "sun")
    )
    assert disc <= MAX_SOFT_ERROR and disc < 0.5 * hard


@pytest.mark.parametrize(
    ("algorithm", "light"),
    [("shadow_map", "spot"), ("shadow_map", "omni"), ("perspective_shadow_map", "spot"), ("shadow_volume", "omni")],
)
def test_area_light_of_a_lamp_matches_truth(gl, tmp_path, algorithm, light):
    """A lamp with a radius is a ball by default. With requested taps it is a point."""
    scene = area_light_scene(tmp_path, lights={light: LAMPS[light]}, sun="none")
    view = scene.view("eye")
    reference = reference_visibility(geometry_buffer(scene, view), scene, light)
    assert ((reference > 0.02) & (reference < 0.98)).mean() > 0.02
    hard, ball = (
        soft_error(rendered_visibility(scene, view, light, algorithm=algorithm, map_size=1024, **overrides), reference)
        for overrides in ({"filter": 1}, {})
    )
    assert ball <= MAX_SOFT_ERROR and ball < 0.5 * hard


def test_area_light_in_a_map_matches_truth(gl, tmp_path):
    scene = area_light_scene(tmp_path, lights={"spot": LAMPS["spot"]})
    view = scene.view(bounds=(-14, -14, 14, 14), size=(90, 90))
    buffer = geometry_buffer(scene, view)
    plan = plan_of(scene, view, algorithm={"sun": "shadow_volume", "spot": "shadow_map"}, filter="sun", map_size=1024)
    visibilities = render_frame(scene, view, plan).visibilities
    for light in ("sun", "spot"):
        assert soft_error(visibilities[light], reference_visibility(buffer, scene, light)) <= MAX_SOFT_ERROR


def test_truth_algorithm_samples_area_lights(gl, tmp_path):
    scene = area_light_scene(tmp_path, lights={"omni": LAMPS["omni"]})
    view = scene.view("eye")
    frame = render_frame(scene, view, plan_of(scene, view, algorithm="truth", filter="sun"))
    for light in ("sun", "omni"):
        reference = reference_visibility(geometry_buffer(scene, view), scene, light)
        penumbra_share = np.nanmean((reference > 0.0) & (reference < 1.0))
        assert soft_error(frame.visibilities[light], reference) < penumbra_share / 32  # 64 rays with equal weights


def test_lamp_with_radius_zero_is_a_point(gl, tmp_path):
    pictures = []
    for radius, filter in ((0.0, "auto"), (0.5, 3), (0.5, "auto")):
        scene = area_light_scene(tmp_path, lights={"omni": LAMPS["omni"] | {"radius": radius}}, sun="none")
        pictures.append(rendered_visibility(scene, scene.view("eye"), "omni", algorithm="shadow_map", map_size=512, filter=filter))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert np.nanmean(np.abs(pictures[0] - pictures[2])) > 0.005


# -- plans


def test_plan_and_records_name_light_points(gl, tmp_path):
    scene = area_light_scene(tmp_path, lights={"spot": LAMPS["spot"]})
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm={"sun": "shadow_volume", "spot": "perspective_shadow_map"}, filter="sun")
    assert plan.settings["sun"]["meshes"].filter == plan.settings["spot"]["meshes"].filter == "sun"
    reasons = {reason.name: reason.reason for reason in plan.reasons}
    assert str(MAX_LIGHT_POINTS) in reasons["filter sun"] and str(MAX_LIGHT_POINTS) in reasons["spot: filter sun"]
    frame = render_frame(scene, view, plan)
    assert "soft_edges" in plan.effect_names and "soft_edges" in executed_effects(frame.passes)
    points = {(record.name.split("/")[0], record.name.split(": ")[-1]): record.light_points for record in frame.passes}
    assert points["sun", "stencil"] == points["spot", "depth map"] == MAX_LIGHT_POINTS
    hard = render_frame(scene, view, plan_of(scene, view, algorithm="shadow_volume", filter=1))
    assert {record.light_points for record in hard.passes} == {1} and "soft_edges" not in executed_effects(hard.passes)


@pytest.mark.parametrize(("algorithm", "words"), [("hybrid", "hard edges to volumes"), ("planar", "hard edges only")])
def test_plan_refuses_area_lights_for_hard_edge_algorithms(tmp_path, algorithm, words):
    scene = area_light_scene(tmp_path, lights={"omni": LAMPS["omni"]})
    view = scene.view("eye")
    for overrides in ({"algorithm": algorithm, "filter": "sun"}, {"algorithm": {"omni": {"meshes": algorithm}}}):
        with pytest.raises(UnsupportedError, match=f"{algorithm} for .*{words}.*algorithms that can: shadow_map"):
            plan_of(scene, view, **overrides)
    assert plan_of(scene, view, algorithm=algorithm, filter=1).algorithm["omni"]["meshes"] == algorithm


def test_level_refuses_a_negative_radius(tmp_path):
    level = {
        "version": 1,
        "terrain": {"flat": {"size": [20, 20], "cells": [2, 2]}},
        "lights": {"lamp": LAMPS["omni"] | {"radius": -1}},
    }
    (tmp_path / "level.yaml").write_text(json.dumps(level), encoding="utf-8")
    with pytest.raises(Exception, match="lights.lamp.radius: .-1. is not allowed"):
        build_scene(load_level(tmp_path / "level.yaml"))
