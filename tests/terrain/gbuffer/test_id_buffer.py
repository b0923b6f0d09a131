"""The id buffer omits only what is not visible: ground outside the view, and pixels outside the mask."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.terrain.gbuffer import id_buffer
from skugga.terrain.gbuffer.antialias import multisampled
from skugga.terrain.gbuffer.view_geometry import RasterisedView
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene


@pytest.fixture(scope="module")
def landscape() -> Scene:
    """Scene of a bundled level with trees."""
    return build_scene(load_level(find_level("spatialace")))


def view_part(scene: Scene, name: str) -> PerspectiveView:
    """Return a part of 300 x 400 pixels of the perspective view ``name``."""
    view = scene.view(name)
    assert isinstance(view, PerspectiveView)
    return view.part(150, 200, 300, 400)


@pytest.mark.parametrize("name", ["main", "overview", "close"])
def test_frustum_culling_leaves_the_id_buffer_unchanged(gl, landscape, monkeypatch, name):
    view = view_part(landscape, name)
    frame = view.frame(landscape.world)
    culled_buffer, counts = RasterisedView(landscape, view, frame).id_buffer, []

    def every(position, triangles, *args):
        counts.append((len(id_buffer_in_view(position, triangles, *args)), len(triangles)))
        return np.arange(len(triangles))

    id_buffer_in_view = id_buffer._triangles_in_frustum
    monkeypatch.setattr(id_buffer, "_triangles_in_frustum", every)
    unculled_buffer = RasterisedView(landscape, view, frame).id_buffer
    assert all(0 < kept_count < triangle_count for kept_count, triangle_count in counts), counts
    np.testing.assert_array_equal(culled_buffer.triangle_number, unculled_buffer.triangle_number)
    np.testing.assert_array_equal(culled_buffer.depth, unculled_buffer.depth)


def test_pixel_mask_keeps_its_pixels_and_empties_the_others(gl, landscape):
    view = view_part(landscape, "main")
    frame, pixel_mask = view.frame(landscape.world), np.random.default_rng(5).random((view.rows, view.cols)) < 0.3
    full_buffer, masked_buffer = (
        RasterisedView(landscape, view, frame).id_buffer,
        RasterisedView(landscape, view, frame, pixel_mask=pixel_mask).id_buffer,
    )
    assert (full_buffer.triangle_number[pixel_mask] > 0).mean() > 0.5
    np.testing.assert_array_equal(masked_buffer.triangle_number[pixel_mask], full_buffer.triangle_number[pixel_mask])
    np.testing.assert_array_equal(masked_buffer.sqrt_albedo[pixel_mask], full_buffer.sqrt_albedo[pixel_mask])
    assert not masked_buffer.triangle_number[~pixel_mask].any()


def test_multisampled_buffer_is_cached_across_suns(gl, landscape):
    """The cache entry serves no other view and no other second of the clock."""
    view = view_part(landscape, "close")
    sampled_buffer = multisampled(landscape, view)
    assert multisampled(landscape.with_sun(SunSpec(azimuth=90, altitude=40)), view_part(landscape, "close")) is sampled_buffer
    assert multisampled(landscape, view.shifted(0.5, 0.0)) is not sampled_buffer
    sampled_buffer = multisampled(landscape, view)
    later_scene = landscape.at_second(2.0)
    assert multisampled(later_scene, view) is not sampled_buffer
    assert (multisampled(later_scene, view).pixel_buffer.surface_kind != sampled_buffer.pixel_buffer.surface_kind).any()
