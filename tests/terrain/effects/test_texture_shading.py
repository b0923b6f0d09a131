"""Texture shading: its factor in maps, on ground alone, and the same by both ways to draw a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.texture_shading import apply_texture_shading, texture_factor
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff

CELL_M = 30.0


@pytest.fixture(scope="module")
def valley(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return a level with a valley that runs north-south through its middle, with sides of 20 %."""
    folder = Path(tmp_path_factory.mktemp("valley"))
    x = np.abs(np.arange(301) - 150.0) * CELL_M
    write_geotiff(folder / "dem.tif", np.tile(0.2 * x, (301, 1)).astype(np.float32), "EPSG:32633", 5e5, 5.3e6, CELL_M)
    (folder / "level.yaml").write_text("version: 1\nterrain: {source: dem.tif}\nsun: {azimuth: 90, altitude: 30}\n")
    return build_scene(load_level(folder / "level.yaml"))


def test_valley_is_darkest_on_its_floor(valley: Scene):
    view = valley.view("map", size=(300, 300))
    factor = texture_factor(valley, view)
    floor = factor[150].argmin()
    assert abs(int(floor) - 150) <= 1
    assert 0.4 < factor[150, floor] < 0.8
    # Far from the floor and from the edges a side is a plane.
    assert np.abs(factor[100:200, 70:75] - 1.0).max() < 0.05


def test_only_ground_changes(gl, valley: Scene):
    view = valley.view("map", size=(300, 300))
    buffer = geometry_buffer(valley, view)
    skylight = np.ones(buffer.valid.shape, np.float32)
    buffer.surface_kind[:100] = RELIEF + 1
    apply_texture_shading(skylight, ShadingBlock(valley, view, buffer, {}))
    np.testing.assert_array_equal(skylight[:100], 1.0)
    np.testing.assert_array_equal(skylight[100:], texture_factor(valley, view)[100:])
