"""Sweep over columns, on a curved earth with ground beyond the view: agreement with rays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skugga.shadows.passes import PassLog
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import fill_visibility
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.parts import SunSpec
from tests.rasters import ENGINEERING
from tests.terrain.ground.test_columns import UTM, scene_of


def city_heights(cells: int, cell_m: float) -> np.ndarray:
    """Return boxes on rolling ground, heights (cells, cells)."""
    rng = np.random.default_rng(3)
    row, col = np.indices((cells, cells))
    heights = 4.0 * cell_m * np.sin(row / 31.0) * np.cos(col / 23.0)
    for top, left, depth, width in rng.integers((0, 0, 3, 3), (cells, cells, 14, 14), (cells, 4)):
        heights[top : top + depth, left : left + width] += rng.uniform(1.0, 9.0) * cell_m
    return heights


def sweep_visibility(buffer: Any, scene: Any, log: PassLog | None = None, kinds: Any = ("relief",), **settings: Any) -> np.ndarray:
    """Return the sun's visibility (rows, cols) by the sweep."""
    casters = find_casters(scene, buffer)
    return fill_visibility(buffer, scene, "sun", kinds, casters, SweepSettings(**settings), log or PassLog())


@pytest.mark.parametrize(("azimuth", "altitude"), [(113.0, 30.0), (341.0, 9.0), (19.0, 3.0)])
@pytest.mark.parametrize("crs", [None, "EPSG:3857"])
@pytest.mark.parametrize("cell", [1.0, (30.0, 25.0)])
def test_sweep_of_a_city_on_the_globe_matches_rays(tmp_path: Path, cell: Any, crs: str | None, azimuth: float, altitude: float):
    """The view is a quarter of the raster. Boxes in the other quarters cast into it, and are read in patches."""
    scene = scene_of(tmp_path, city_heights(256, np.mean(cell)), UTM, cell, 420000.0, 6400000.0)
    scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
    west, south, east, north = scene.view(crs=crs, size=(128, 128)).bounds
    quarter = (west * 0.6 + east * 0.4, south * 0.4 + north * 0.6, west * 0.2 + east * 0.8, south * 0.2 + north * 0.8)
    buffer = geometry_buffer(scene, scene.view(crs=crs, bounds=quarter, size=(160, 160)))
    casters = find_casters(scene, buffer)
    assert casters.patches and buffer.valid.all()
    rays = ray_scene(buffer, scene, casters, ALL_CASTER_KINDS)
    log = PassLog(requested_layers=frozenset({"shadow-height"}))
    lit = sweep_visibility(buffer, scene, log) > 0.5
    ((shadow_m,),) = log.take_layers().values()
    above_m = shadow_m - buffer.height_m
    certain = (above_m == 0.0) | (above_m > rays.offset_m)  # where rays do not start above the shadow
    assert certain.mean() > 0.999 and 0.02 < lit.mean() < 0.98
    np.testing.assert_array_equal(lit, above_m == 0.0)
    assert not (lit != lit_mask(buffer, scene, "sun", rays, 0.25))[certain].any()


@pytest.mark.parametrize(("crs", "west"), [(ENGINEERING, 0.0), (UTM, 420000.0)])
def test_sweep_of_columns_reads_far_ground_at_half_detail(tmp_path: Path, crs: str, west: float):
    heights = np.zeros((120, 6400))
    heights[40:80, 6000:6064] = 400.0
    scene = scene_of(tmp_path, heights, crs, 1.0, west, 6400120.0).with_sun(SunSpec(azimuth=89.5, altitude=2.2))
    buffer = geometry_buffer(scene, scene.view(bounds=(west, 6400000.0, west + 60.0, 6400120.0), size=(60, 120)))
    casters = find_casters(scene, buffer)
    assert max(patch.lod for patch in casters.patches) == 1
    lit = sweep_visibility(buffer, scene) > 0.5
    assert 10 < (~lit).all(axis=1).sum() < 30  # the sun is half a degree off the rows, or grid north off true north: 52 m aside
    rays = ray_scene(buffer, scene, casters, ALL_CASTER_KINDS)
    np.testing.assert_array_equal(lit, lit_mask(buffer, scene, "sun", rays, 0.25))


def test_sweep_shades_roofs_of_meshes_beside_columns(tmp_path: Path):
    heights = np.zeros((60, 60))
    heights[30:34, 10:50] = 20.0
    scene = scene_of(tmp_path, heights, ENGINEERING, 1.0, meshes=[{"generate": "boxgrid", "at": [0.0, 12.0], "scale": 0.1}])
    buffer = geometry_buffer(scene, scene.view(size=(240, 240)))
    casters = find_casters(scene, buffer)
    on_mesh = buffer.surface_kind == MESHES
    assert on_mesh.any()
    rays = ray_scene(buffer, scene, casters, ("relief",))
    lit, expected = sweep_visibility(buffer, scene) > 0.5, lit_mask(buffer, scene, "sun", rays)
    facing = buffer.valid & (buffer.normal_frame @ scene.sun.in_frame(buffer.frame) > 1e-3)
    assert (lit != expected)[facing & ~on_mesh].sum() == 0
    assert (lit != expected)[facing & on_mesh].mean() < 0.01


def test_sweep_of_columns_disc_and_shadow_height(tmp_path: Path):
    heights = np.zeros((64, 64))
    heights[:, 20:24] = 30.6
    scene = scene_of(tmp_path, heights, ENGINEERING, 1.0).with_sun(SunSpec(azimuth=270.0, altitude=45.0))
    buffer = geometry_buffer(scene, scene.view(bounds=(0.0, 0.0, 64.0, 64.0), size=(64, 64)))
    log = PassLog(requested_layers=frozenset({"shadow-height"}))
    lit = sweep_visibility(buffer, scene, log)
    middle = np.arange(64) + 0.5
    shadow_m = np.where((middle > 24.0) & (middle < 54.6), 30.6 - (middle - 24.0), np.where(middle < 20.0, 0.0, heights[0]))
    assert (lit[10] < 0.5).tolist() == ((middle > 24.0) & (middle < 54.6)).tolist()
    ((height_m,),) = log.take_layers().values()
    np.testing.assert_allclose(height_m[10], shadow_m, atol=1e-3)
    soft = sweep_visibility(buffer, scene, filter="sun")
    edge = np.abs(middle - 54.6) < 0.3
    assert ((soft > 0.0) & (soft < 1.0))[10].any() and not ((soft > 0.0) & (soft < 1.0))[10][~edge].any()
