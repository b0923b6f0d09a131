"""Shadow map and default algorithm: no seams, effective options, and no walls at holes."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows.render import Frame
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING
from tests.render import block_at, render, shadow


@pytest.fixture(scope="module")
def jacksboro() -> Scene:
    """Scene of a bundled level of terrain only."""
    return build_scene(load_level("configs/jacksboro.yaml"))


@pytest.mark.parametrize("algorithm", ["shadow_map", None])
def test_tile_equals_the_same_pixels_of_a_larger_map(gl, jacksboro, algorithm):
    """A part of a block equals the same part of a map across the block's border byte for byte."""
    block = block_at(-84.25, 36.2933, 12)
    tile = block.part(256, 512, 128, 128)
    bigger = block.part(256, 384, 192, 768)
    low_sun = jacksboro.with_sun(SunSpec(azimuth=237, altitude=8))
    small, large = (render(low_sun, view, algorithm=algorithm) for view in (tile, bigger))
    assert 0.01 < shadow(small).mean() < 0.99
    np.testing.assert_array_equal(small.color, large.color[:128, 128:256])
    np.testing.assert_array_equal(small.visibility, large.visibility[:128, 128:256])


@pytest.fixture(scope="module")
def default_frame(jacksboro) -> Frame:
    """Return the picture with default options, which each option must change."""
    return render(jacksboro, block_at(-84.25, 36.2933, 12).part(0, 0, 96, 96), algorithm="shadow_map")


@pytest.mark.parametrize(
    "change",
    [{"map_size": 256}, {"filter": 1}, {"filter": 5}, {"algorithm": "none"}],
    ids=lambda change: "=".join(str(part) for part in next(iter(change.items()))),
)
def test_shadow_map_options_change_the_picture(gl, jacksboro, default_frame, change):
    changed_frame = render(jacksboro, default_frame.view, **{"algorithm": "shadow_map", **change})
    assert (default_frame.color != changed_frame.color).any(axis=-1).mean() > 1e-3


@pytest.mark.parametrize("algorithm", ["shadow_map", None])
def test_holes_and_islands_cast_no_walls(gl, write_raster, make_scene, algorithm):
    """Level ground with holes stays lit around them, and the holes are transparent."""
    heights = np.full((80, 80), 50.0, np.float32)
    heights[30:50, 30:50] = -9999.0
    heights[10, 10] = -9999.0
    scene = make_scene(write_raster(heights, ENGINEERING, 0, 800, 10.0, nodata=-9999.0), 201, 5)
    frame = render(scene, scene.view(size=(160, 160)), algorithm=algorithm)
    assert not frame.valid[60:100, 60:100].any()
    assert np.nanmin(frame.visibility) == 1.0
    island = np.full((80, 80), -9999.0, np.float32)
    island[40, 40] = 10.0
    island_scene = make_scene(write_raster(island, ENGINEERING, 0, 800, 10.0, name="island.tif", nodata=-9999.0), 201, 5)
    frame = render(island_scene, island_scene.view(size=(160, 160)), algorithm=algorithm)
    assert frame.valid.sum() == 4 and np.nanmin(frame.visibility) == 1.0
