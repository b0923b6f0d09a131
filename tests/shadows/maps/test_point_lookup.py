"""Point lookup: the compiled loop of perspective views agrees with the shaders, and maps hold all relevant casters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.selector.select import plan_of_view
from skugga.shadows.maps import lookup as lookup_module
from skugga.shadows.maps import point_lookup
from skugga.shadows.maps.relevant_trees import _write_farthest_receivers, relevant_trees
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import PassLog
from skugga.shadows.render import Frame
from skugga.shadows.truth.truth import trace_truth
from skugga.shadows.visibility import fill_steps, receivers_of
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.render import render

SUN = SunSpec(azimuth=199, altitude=21)


@pytest.fixture(scope="module")
def landscape() -> Scene:
    """Scene of a bundled level with trees, under the sun ``SUN``."""
    return build_scene(load_level(find_level("spatialace"))).with_sun(SUN)


def close_view(scene: Scene) -> PerspectiveView:
    """Return a view of ground, meshes and trees."""
    view = scene.view("close")
    assert isinstance(view, PerspectiveView)
    return view.part(100, 100, 300, 400)


def render_close_view(scene: Scene, **overrides: Any) -> Frame:
    """Return the close view, all by shadow maps, with empty caches."""
    clear_caches("light")
    return render(scene, close_view(scene), **{"algorithm": "shadow_map", "map_size": 512, **overrides})


@pytest.mark.parametrize(
    "overrides",
    [
        {"filter": 1}, {"filter": 3}, {"filter": 5, "depth_bits": 24}, {"filter": 3, "depth_bits": 32, "cascades": 4},
        {"filter": 3, "bias": "normal_offset"}, {"filter": 3, "bias": "polygon_offset"},
    ],
    ids=lambda overrides: "-".join(str(value) for value in overrides.values()),
)  # fmt: skip
def test_point_lookup_equals_the_shader(gl, landscape, monkeypatch, overrides):
    """Results are equal to the bit on the rasteriser with the loop's arithmetic. Elsewhere only points on texel borders differ."""
    loop_frame = render_close_view(landscape, **overrides)
    with monkeypatch.context() as patch:
        # a map that reports not to be uniform is looked up by the shader
        patch.setattr(DepthMap, "is_uniform", property(lambda depth_map: False))
        shader_frame = render_close_view(landscape, **overrides)
    assert any("point_lookup" in label for record in loop_frame.passes for label in record.loops)
    assert not any("point_lookup" in label for record in shader_frame.passes for label in record.loops)
    assert 0.05 < np.nanmean(shader_frame.visibility < 1.0) < 0.95
    if "llvmpipe" in gl.renderer:
        np.testing.assert_array_equal(loop_frame.visibility, shader_frame.visibility)
    assert (np.nan_to_num(loop_frame.visibility) != np.nan_to_num(shader_frame.visibility)).mean() < 1e-3


def test_point_lookup_compares_on_the_points_own_triangle(gl, landscape, monkeypatch):
    """Otherwise slopes in a coarse map shade themselves. The test above would not detect a loop that never compares."""
    compared_frame = render_close_view(landscape, map_size=256)
    with monkeypatch.context() as patch:
        patch.setattr(
            lookup_module,
            "_depth_comparison",
            lambda settings, taps: point_lookup.DepthComparison(False, False, np.float32(0), taps, taps),
        )
        uncompared_frame = render_close_view(landscape, map_size=256)
    assert np.nanmean(uncompared_frame.visibility) < np.nanmean(compared_frame.visibility) - 0.01


def test_lifted_points_lie_on_no_triangle(gl, landscape):
    """The corners that their buffer keeps change nothing: visibility is that with the points themselves as corners."""
    scene = landscape.with_sun(SunSpec(azimuth=199, altitude=4))
    buffer = receivers_of(geometry_buffer(scene, close_view(scene)), scene, "sun")
    assert buffer.is_lifted is not None and buffer.corners_frame_m is not None
    points = np.tile(buffer.position_frame_m, 3).astype(np.float32)
    without_corners = replace(buffer, corners_frame_m=np.where(buffer.is_lifted[..., None], points, buffer.corners_frame_m))
    plan = plan_of_view(scene, close_view(scene), "close", {"algorithm": "perspective_shadow_map", "map_size": 256})
    casters, visibilities = find_casters(scene, buffer), []
    for receivers in (buffer, without_corners):
        clear_caches("light")
        visibilities.append(fill_steps(plan.steps_of_light("sun"), receivers, scene, casters, (), PassLog()))
    assert (visibilities[0][buffer.is_lifted] < 1.0).any()
    np.testing.assert_array_equal(*visibilities)


def test_points_of_trees_get_the_normal_offset(gl, landscape):
    by_bias = {bias: render_close_view(landscape, filter=1, bias=bias) for bias in ("receiver_plane", "normal_offset")}
    kind = geometry_buffer(landscape, close_view(landscape)).surface_kind
    plane, offset = (by_bias[bias].visibility for bias in ("receiver_plane", "normal_offset"))
    assert (kind == FOREST).sum() > 1000
    np.testing.assert_array_equal(plane[kind == FOREST], offset[kind == FOREST])
    assert (plane[kind == RELIEF] != offset[kind == RELIEF]).mean() > 0.001


@pytest.mark.parametrize("algorithm, taps", [("shadow_map", 1), ("shadow_map", "sun"), ("perspective_shadow_map", 1)])
def test_shaders_judge_trees_better_without_their_planes(gl, landscape, monkeypatch, algorithm, taps):
    """Compare wrong points of trees with those by shaders that know the trees' triangles."""
    overrides = {"algorithm": algorithm, "filter": taps, "map_size": 1024}
    gather, is_loop_left_out = lookup_module._gather_points, property(lambda depth_map: False)
    with monkeypatch.context() as patch:
        patch.setattr(DepthMap, "is_uniform", is_loop_left_out)
        without_planes = render_close_view(landscape, **overrides)
        patch.setattr(
            lookup_module,
            "_gather_points",
            lambda indices, position, normal, crease, corners, kind, *out: gather(
                indices, position, normal, crease, corners, np.zeros_like(kind), *out
            ),
        )
        with_planes = render_close_view(landscape, **overrides)
    buffer = geometry_buffer(landscape, close_view(landscape))
    truth = trace_truth(buffer, landscape, find_casters(landscape, buffer))
    trees = truth.decidable & (buffer.surface_kind == FOREST)
    wrong, wrong_by_planes = (
        int((trees & ((frame.visibility >= 0.5) != truth.lit)).sum()) for frame in (without_planes, with_planes)
    )
    assert 0 < wrong < 0.9 * wrong_by_planes


@pytest.mark.parametrize("taps", [3, "sun"])
@pytest.mark.parametrize("altitude_deg", [4.0, 21.0, 60.0])
def test_relevant_trees_leave_out_only_trees_without_shadow(gl, landscape, monkeypatch, taps, altitude_deg):
    """Maps with relevant trees give the same shadows as maps with all trees, and some trees are left out."""
    scene = landscape.with_sun(SunSpec(azimuth=150, altitude=altitude_deg))
    counts: list[tuple[int, int]] = []

    def record_relevant_trees(depth_map: DepthMap, *args: Any) -> np.ndarray:
        relevant = relevant_trees(depth_map, *args)
        assert depth_map.trees is not None
        counts.append((len(relevant), len(depth_map.trees)))
        return relevant

    def select_all_trees(depth_map: DepthMap, *args: Any) -> np.ndarray:
        assert depth_map.trees is not None
        return np.arange(len(depth_map.trees))

    with monkeypatch.context() as patch:
        patch.setattr("skugga.shadows.maps.relevant_trees.relevant_trees", record_relevant_trees)
        with_relevant_trees = render_close_view(scene, filter=taps)
    with monkeypatch.context() as patch:
        patch.setattr("skugga.shadows.maps.relevant_trees.relevant_trees", select_all_trees)
        with_all_trees = render_close_view(scene, filter=taps)
    assert counts and all(chosen < total for chosen, total in counts) and any(chosen > 0 for chosen, _ in counts)
    np.testing.assert_array_equal(with_relevant_trees.visibility, with_all_trees.visibility)
    for light, shown in with_all_trees.shown_visibilities.items():  # samples of edges lie between the pixels' points
        np.testing.assert_array_equal(with_relevant_trees.shown_visibilities[light], shown)


def test_relevant_trees_are_needed(gl, landscape, monkeypatch):
    """Maps without trees lose shadows, which the test above would detect."""
    with_trees = render_close_view(landscape)
    with monkeypatch.context() as patch:
        patch.setattr("skugga.shadows.maps.relevant_trees.relevant_trees", lambda depth_map, *args: np.zeros(0, np.int64))
        without_trees = render_close_view(landscape)
    assert np.nanmean(without_trees.visibility > with_trees.visibility) > 0.005


def test_ground_between_two_pixels_is_a_receiver():
    """Samples of edges lie between the points of pixels, one above the other, that a grazing view sets far apart."""
    position = np.array([[0.5, 0.5, 3.0], [8.5, 4.5, 7.0], [30.0, 30.0, 1.0]])
    farthest = np.full((1, 10, 10), -np.inf, np.float32)
    _write_farthest_receivers(
        0, 1, np.array([0, 1]), position, np.ones(3, np.bool_), 1, 2, np.array([0]), np.eye(3), np.zeros(3), np.ones(2), farthest
    )  # fmt: skip
    assert [(row, col) for row, col in np.argwhere(farthest[0] > -np.inf) if abs(row - 0.5 * col) > 1.0] == []
    assert (farthest[0].max(axis=0)[:9] == 7.0).all() and np.isinf(farthest[0, :, 9]).all()
