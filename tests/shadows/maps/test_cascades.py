"""Cascades: finer near the eye and as fine far away, in the memory of one map. Split distances follow the visible points."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import shadow_map
from skugga.shadows.maps.resolve import MAX_AUTOMATIC_MAP_SIZE, MAX_CASCADE_TEXEL_PX
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.truth.metrics import error_metrics
from skugga.shadows.truth.truth import trace_truth
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import Level, load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

VIEW_SIZE = [320, 240]
EYE_M = np.array([-9692.0, -11_000.0])
HOUSE_DISTANCES_M = (70, 110, 170, 260, 400, 600)


@pytest.fixture(scope="module")
def mountains(tmp_path_factory) -> Scene:
    """Return 24 x 24 km of ridges, seen from a summit over a few houses."""
    folder = tmp_path_factory.mktemp("mountains")
    trimesh.creation.box(extents=(12.0, 9.0, 8.0)).export(folder / "house.obj")
    forward = -EYE_M / np.linalg.norm(EYE_M)
    rightward = np.array([-forward[1], forward[0]])
    houses = [
        (EYE_M + distance_m * (forward + share * rightward)).round(1).tolist()
        for distance_m in HOUSE_DISTANCES_M
        for share in (-0.3, -0.05, 0.25)
    ]
    level = {
        "version": 1,
        "terrain": {"generate": {"kind": "ridges", "size": [24_000, 24_000], "cell": 40, "relief": 1500, "seed": 3}},
        "meshes": [{"source": "house.obj", "at": houses, "turn": 20}],
        "sun": {"azimuth": 300, "altitude": 15},
        "views": {"main": {"kind": "perspective", "eye": [*EYE_M, 25], "target": [0, 0, -100], "fov": 50, "size": VIEW_SIZE}},
    }
    path = folder / "level.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


def plan_for(scene: Scene, **overrides) -> Plan:
    """Return a plan of the view ``main`` with shadow maps."""
    view = scene.view("main")
    return make_plan(describe(scene, view, "main"), scene.loaded.level, {"algorithm": "shadow_map", **overrides})


@pytest.mark.parametrize(("azimuth", "altitude"), [(300, 15), (100, 10)])
def test_four_cascades_halve_the_edge_displacement(gl, mountains, azimuth, altitude):
    scene = mountains.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
    distance_m = [band.far_m for band in describe(scene, scene.view("main"), "main").bands]
    assert distance_m[0] <= 128 and distance_m[-1] >= 16_384
    buffer = geometry_buffer(scene, scene.view("main"))
    casters = find_casters(scene, buffer)
    truth, metrics = trace_truth(buffer, scene, casters), {}
    for count, size in ((1, 1024), (4, 512)):
        (step,) = plan_for(scene, cascades=count, map_size=size, depth_bits=24).steps
        assert len(step.settings.cascades) == count
        rendered = shadow_map.fill_visibility(
            receivers_of(buffer, scene, "sun"), scene, step.light, step.kinds, casters, step.settings, PassLog()
        )
        rendered[attached_shadow_mask(buffer, scene)] = 0.0
        metrics[count] = error_metrics(rendered, truth, 1.0)
    assert metrics[1].edge_p95 > 1.0
    assert metrics[4].edge_p95 <= 0.5 * metrics[1].edge_p95
    assert metrics[4].wrong_cast <= 0.5 * metrics[1].wrong_cast


# -- split distances, from descriptors alone


def band(octave: int, share: float) -> Band:
    """Return the visible part of level ground in an octave of distances, under a sun 45 degrees high."""
    far = 2.0**octave
    return Band(near_m=far / 2, far_m=far, share=share, low_light_m=(-far / 2, 0.0, 0.0), high_light_m=(far / 2, far / 2, far / 2))


def descriptor(shares: list[float]) -> Descriptor:
    """Return the descriptor of a view whose bands of distances have these shares of the points."""
    bands = tuple(band(5 + number, share) for number, share in enumerate(shares))
    return Descriptor(
        view="main", view_kind="perspective", flat_world=True, pixel_m=0.1, pixel=0.0015, node_m=10.0, casters=("relief",),
        relief_m=100.0, block_relief_m=100.0, sun_azimuth_deg=180.0, sun_altitude_deg=45.0, highest_sun_deg=45.0,
        receivers_light_m=(1e4, 1e4, 1e4), bands=bands,
    )  # fmt: skip


LEVEL = Level.model_validate({"version": 1, "terrain": {"flat": {"size": [10, 10], "cells": [2, 2]}}})


def cascade_ends(shares: list[float], **overrides) -> list[float | None]:
    """Return the ends of a plan's cascades, metres from the eye; ``None`` for the last."""
    plan = make_plan(descriptor(shares), LEVEL, {"algorithm": "shadow_map", **overrides})
    return [cascade.far_m for cascade in plan.settings["sun"]["relief"].cascades]


def test_cascade_splits_follow_the_visible_pixels():
    """The map size is fixed. Many far pixels move the splits away; many near pixels move them closer."""
    near = [0.4, 0.3, 0.2, 0.04, 0.02, 0.02, 0.01, 0.01]
    overrides = {"map_size": 512, "cascades": 3}
    near_ends, far_ends = cascade_ends(near, **overrides), cascade_ends(near[::-1], **overrides)
    assert near_ends[-1] is None and far_ends[-1] is None
    assert near_ends[0] < far_ends[0] and near_ends[1] < far_ends[1]


@settings(max_examples=40)
@given(st.lists(st.floats(0.001, 1.0), min_size=1, max_size=11), st.sampled_from(["auto", 1, 2, 3, 4]))
def test_automatic_map_size_bounds_texels_for_any_splits(shares, cascades):
    shares = [share / sum(shares) for share in shares]
    plan = make_plan(descriptor(shares), LEVEL, {"algorithm": "shadow_map", "cascades": cascades})
    map_settings = plan.settings["sun"]["relief"]
    if map_settings.map_size == MAX_AUTOMATIC_MAP_SIZE:
        return
    near_m, bands = 0.0, descriptor(shares).bands
    for cascade in map_settings.cascades:
        nearest = next(visible_band.near_m for visible_band in bands if visible_band.near_m >= near_m)
        sides_m = np.array(cascade.texel_m) / np.array([1.0, np.sin(np.radians(45.0))])
        assert sides_m.max() <= MAX_CASCADE_TEXEL_PX * nearest * 0.0015 * (1.0 + 1e-9)
        near_m = cascade.far_m
    assert near_m is None
