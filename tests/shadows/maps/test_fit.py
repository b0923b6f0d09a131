"""Fit of the sun's map: stable windows keep every class while a view moves, tight windows have the finest texels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import shadow_map
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS, DepthMap, sun_maps
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.truth.metrics import error_metrics
from skugga.shadows.truth.truth import trace_truth
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.metrics import flicker

SHIFTS = [(1, 0), (0, 1), (7, -3), (31, 17)]
VIEW_PX = 250


@pytest.fixture(scope="module")
def jacksboro() -> Scene:
    """Scene of a bundled level of terrain only, under a low sun."""
    return build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=237, altitude=8))


@pytest.fixture(scope="module")
def ridge(jacksboro) -> PerspectiveView:
    """Return a view from above a ridge along the mountains."""
    eye, up = jacksboro.geolocator.point_above_ground((-84.30, 36.2333, 150.0), "eye")
    target, _ = jacksboro.geolocator.point_above_ground((-84.22, 36.3133, 0.0), "target")
    return look_at(eye, target, up, 40.0, 150, 200)


def plan_for(scene: Scene, view: MapView | PerspectiveView, **overrides) -> Plan:
    """Return a plan with one shadow map and one filter tap."""
    plan_overrides = {"algorithm": "shadow_map", "filter": 1, "cascades": 1, **overrides}
    level = scene.loaded.level.model_copy(update={"effects": {"cast_shadows": "on"}})  # also where no ground is steep enough
    return make_plan(describe(scene, view), level, plan_overrides)


def shadow_and_ground(scene: Scene, view: MapView | PerspectiveView, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return masks of a view drawn as one block: pixels in shadow, and pixels with ground."""
    buffer = geometry_buffer(scene, view)
    (step,) = plan.steps
    receivers = receivers_of(buffer, scene, step.light)
    rendered = shadow_map.fill_visibility(
        receivers, scene, step.light, step.kinds, find_casters(scene, buffer), step.settings, PassLog()
    )
    return (rendered < 0.5) | attached_shadow_mask(buffer, scene), buffer.valid


def overlap(original: np.ndarray, shifted: np.ndarray, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the common points of a view and of the view shifted by whole pixels."""
    height, width = original.shape
    first = original[max(rows, 0) : height + min(rows, 0), max(cols, 0) : width + min(cols, 0)]
    return first, shifted[max(-rows, 0) : height + min(-rows, 0), max(-cols, 0) : width + min(-cols, 0)]


def measure_flicker(scene: Scene, view: MapView | PerspectiveView, **overrides) -> list[float]:
    """Return the flicker of whole-pixel shifts of a view. Truth stays: the points are the same.

    Each shift of a map has its own plan. Shifts of a perspective view share one plan, whose texels change in steps as it moves.
    """
    plan = plan_for(scene, view, **overrides)
    before, valid = shadow_and_ground(scene, view, plan)
    shares = []
    for rows, cols in SHIFTS:
        shifted_view = view.shifted(rows, cols)
        shifted_plan = plan_for(scene, shifted_view, **overrides) if isinstance(shifted_view, MapView) else plan
        after, shifted_valid = shadow_and_ground(scene, shifted_view, shifted_plan)
        dark, next_dark = overlap(before, after, rows, cols)
        comparable = np.logical_and(*overlap(valid, shifted_valid, rows, cols))
        assert comparable.mean() > 0.3 and 0.05 < dark[comparable].mean() < 0.95
        no_pixels = np.zeros_like(dark)
        shares.append(flicker(dark, next_dark, no_pixels, no_pixels, comparable))
    return shares


def middle_map_view(scene: Scene) -> MapView:
    """Return 6 x 6 km whose pixels lie off the grid's nodes, so that blocks count from the view's corner."""
    x, y = scene.view(size=(8, 8)).centre
    return scene.view(bounds=(x - 3000, y - 3000, x + 3000, y + 3000), size=(VIEW_PX, VIEW_PX))


@pytest.mark.long
def test_stable_fit_of_a_map_does_not_flicker(gl, jacksboro):
    """A texel covers 20 by 3 pixels, so that a moving lattice would show."""
    view, map_size = middle_map_view(jacksboro), 96
    texel_m = plan_for(jacksboro, view, map_size=map_size).settings["sun"]["relief"].cascades[0].texel_m
    assert max(texel_m) > 4.0 * describe(jacksboro, view).pixel_m
    assert measure_flicker(jacksboro, view, map_size=map_size) == [0.0] * len(SHIFTS)
    assert max(measure_flicker(jacksboro, view, map_size=map_size, fit="tight")) > 0.005


def test_stable_fit_of_a_perspective_view_does_not_flicker(gl, jacksboro, ridge):
    assert measure_flicker(jacksboro, ridge, map_size=256) == [0.0] * len(SHIFTS)
    assert max(measure_flicker(jacksboro, ridge, map_size=256, fit="tight")) > 0.002


def test_auto_fit_is_stable_with_a_reason(jacksboro, ridge):
    for view in (middle_map_view(jacksboro), ridge):
        plan = plan_for(jacksboro, view)
        assert plan.settings["sun"]["relief"].fit == "stable"
        assert any(reason.name == "fit stable" for reason in plan.reasons)
        tight_plan = plan_for(jacksboro, view, fit="tight")
        assert tight_plan.settings["sun"]["relief"].fit == "tight"
        reasons = [(reason.name, reason.reason) for reason in tight_plan.reasons if reason.name.startswith("fit")]
        assert reasons == [("fit tight", "set by the request")]


def maps_of(scene: Scene, buffer: GeometryBuffer, plan: Plan) -> list[DepthMap]:
    """Return the shadow maps of a plan for the visible points."""
    return sun_maps(buffer, scene, plan.settings["sun"]["relief"], None)


@settings(max_examples=12)
@given(
    azimuth=st.floats(0, 360), altitude=st.floats(2, 89), heading=st.sampled_from([(0.05, 0.05), (-0.04, 0.02), (0.01, -0.04)]),
    cascades=st.integers(1, 4), map_size=st.sampled_from([64, 200, 512]), bits=st.sampled_from([16, 24]),
)  # fmt: skip
def test_tight_fit_holds_receivers_and_is_never_coarser(jacksboro, azimuth, altitude, heading, cascades, map_size, bits):
    scene = jacksboro.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
    eye, up = scene.geolocator.point_above_ground((-84.25, 36.2933, 120.0), "eye")
    target, _ = scene.geolocator.point_above_ground((-84.25 + heading[0], 36.2933 + heading[1], 0.0), "target")
    view = look_at(eye, target, up, 40.0, 60, 80)
    buffer = geometry_buffer(scene, view)
    overrides = {"map_size": map_size, "cascades": cascades, "depth_bits": bits}
    stable, tight = (maps_of(scene, buffer, plan_for(scene, view, fit=fit, **overrides)) for fit in ("stable", "tight"))
    assert len(stable) == len(tight) > 0
    for stable_map, tight_map in zip(stable, tight, strict=True):
        assert (np.array(tight_map.uniforms["texel_m"]) <= stable_map.uniforms["texel_m"]).all()
        assert tight_map.uniforms["window_m"][2] <= stable_map.uniforms["window_m"][2] * (1.0 + 1e-5)
        np.testing.assert_array_equal(tight_map.point_indices, stable_map.point_indices)
        for depth_map in (stable_map, tight_map):
            rotation = np.array(depth_map.uniforms["light_from_frame"]).reshape(3, 3).T
            points = (
                buffer.position_frame_m.reshape(-1, 3)[depth_map.point_indices] @ rotation.T + depth_map.uniforms["light_offset_m"]
            )
            texels = points[:, :2] / depth_map.uniforms["texel_m"]
            assert (texels >= MAP_BORDER_TEXELS - 1e-6).all() and (
                texels <= np.array(depth_map.face_size) - MAP_BORDER_TEXELS + 1e-6
            ).all()
            assert (points[:, 2] > 0.0).all() and (points[:, 2] <= depth_map.uniforms["window_m"][2]).all()


def test_tight_fit_is_more_accurate(gl, jacksboro):
    """The view is smaller than a block, and all texels cover its visible part."""
    view = middle_map_view(jacksboro).part(60, 60, 120, 120)
    buffer = geometry_buffer(jacksboro, view)
    truth, metrics = trace_truth(buffer, jacksboro, find_casters(jacksboro, buffer)), {}
    for fit in ("stable", "tight"):
        dark, _ = shadow_and_ground(jacksboro, view, plan_for(jacksboro, view, map_size=256, fit=fit))
        metrics[fit] = error_metrics(1.0 - dark, truth, 1.0)
    assert metrics["tight"].wrong_cast < 0.5 * metrics["stable"].wrong_cast
    assert metrics["tight"].edge_mean < metrics["stable"].edge_mean
