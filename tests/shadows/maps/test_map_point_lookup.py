"""Point lookup in maps: the compiled loop over a block's points agrees with the shader."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.shadows.maps import lookup as lookup_module
from skugga.shadows.maps import map_point_lookup
from skugga.shadows.render import Frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.render import render

MIN_KIND_PX = 30
"""Minimum number of pixels of each kind of surface in the map."""


@pytest.fixture(scope="module")
def landscape() -> Scene:
    """Scene of a bundled level with trees and meshes, under a low sun."""
    return build_scene(load_level(find_level("jacksboro_wooded"))).with_sun(SunSpec(azimuth=199, altitude=12))


def village_map(scene: Scene) -> MapView:
    """Return a map of ground, houses and trees."""
    view = scene.view("map", bounds=(-84.1590, 36.2255, -84.1560, 36.2280), crs="EPSG:4326", size=(300, 250))
    assert isinstance(view, MapView)
    return view


def render_map(scene: Scene, **overrides: Any) -> Frame:
    """Return the map, all by shadow maps, with empty caches."""
    clear_caches("light")
    return render(scene, village_map(scene), **{"algorithm": "shadow_map", "map_size": 512, **overrides})


def test_the_map_shows_all_kinds_of_surface(gl, landscape):
    """The tests below compare points of each kind."""
    kind = geometry_buffer(landscape, village_map(landscape)).surface_kind
    assert all((kind == each).sum() > MIN_KIND_PX for each in (RELIEF, MESHES, FOREST))


@pytest.mark.parametrize(
    "overrides",
    [
        {"filter": 1}, {"filter": 3}, {"filter": 5, "depth_bits": 24}, {"filter": 3, "depth_bits": 32},
        {"filter": 2, "fit": "tight"}, {"filter": 3, "bias": "normal_offset"}, {"filter": 3, "bias": "polygon_offset"},
    ],
    ids=lambda overrides: "-".join(str(value) for value in overrides.values()),
)  # fmt: skip
def test_map_point_lookup_equals_the_shader(gl, landscape, monkeypatch, overrides):
    """Results are equal to the bit on the rasteriser with the loop's arithmetic. Elsewhere only points on texel borders differ."""
    loop_frame = render_map(landscape, **overrides)
    with monkeypatch.context() as patch:
        patch.setattr(lookup_module, "_has_loop", lambda depth_map, settings: False)
        shader_frame = render_map(landscape, **overrides)
    assert any("map_point_lookup" in label for record in loop_frame.passes for label in record.loops)
    assert not any("map_point_lookup" in label for record in shader_frame.passes for label in record.loops)
    assert 0.05 < np.nanmean(shader_frame.visibility < 1.0) < 0.95
    if "llvmpipe" in gl.renderer:
        np.testing.assert_array_equal(loop_frame.visibility, shader_frame.visibility)
        np.testing.assert_array_equal(loop_frame.color, shader_frame.color)
    assert (np.nan_to_num(loop_frame.visibility) != np.nan_to_num(shader_frame.visibility)).mean() < 1e-3


def test_ground_is_compared_on_the_triangles_round_its_node(gl, landscape, monkeypatch):
    """Without the triangles, slopes shade themselves or lose shadows. The test above would not detect a ring that is never used."""
    frame = render_map(landscape, filter=1)

    def compare_without_triangles(settings: Any, taps: int) -> map_point_lookup.DepthComparison:
        return map_point_lookup.DepthComparison(False, False, np.float32(0), taps, taps)

    with monkeypatch.context() as patch:
        patch.setattr(lookup_module, "_depth_comparison", compare_without_triangles)
        without_triangles = render_map(landscape, filter=1)
    ground = geometry_buffer(landscape, village_map(landscape)).surface_kind == RELIEF
    assert np.nanmean(without_triangles.visibility[ground]) < np.nanmean(frame.visibility[ground]) - 0.01
