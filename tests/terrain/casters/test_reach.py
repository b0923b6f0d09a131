"""Casters outside a block: which ground is read, how far out, and a bound on their number."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.casters.reach import find_casters, longest_shadow_m
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING
from tests.render import render


def casters(scene: Scene, view):
    """Return the visible points of a map and the objects that can cast shadow on them."""
    geometry = map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))
    return geometry, find_casters(scene, geometry)


def hills(rows: int, cols: int, relief: float, seed: int = 4) -> np.ndarray:
    """Return random heights (rows, cols) between 0 and ``relief`` metres."""
    rough = np.random.default_rng(seed).normal(size=(rows, cols)).cumsum(0).cumsum(1)
    return ((rough - rough.min()) / np.ptp(rough) * relief).astype(np.float32)


@pytest.mark.parametrize(
    ("relief", "altitude", "length_km"),
    # The table of caster distances includes terrestrial refraction; without it, curved distances are some per cent shorter.
    [(1500, 10, 8.46), (1500, 2, 39.46), (3000, 1, 113.7), (1500, 0, 138.2), (0, 5, 0.0), (-5, 5, 0.0)],
)
def test_longest_shadow_on_a_curved_earth(relief, altitude, length_km):
    assert longest_shadow_m(relief, altitude) / 1000 == pytest.approx(length_km, rel=0.005)


def test_longest_shadow_on_a_flat_earth():
    assert longest_shadow_m(100, 30, is_curved=False) == pytest.approx(100 / np.tan(np.radians(30)))
    assert longest_shadow_m(100, 0, is_curved=False) == np.inf


def test_find_casters_reads_only_high_ground_towards_the_sun(write_raster, make_scene):
    heights = np.zeros((400, 400), np.float32)
    heights[195:205, 20:30] = 200.0  # in the west
    heights[195:205, 370:380] = 200.0  # in the east
    heights[20:30, 195:205] = 200.0  # in the north, off the rays' path
    scene = make_scene(write_raster(heights, ENGINEERING, 0, 4000, 10.0), 270, 8)
    view = scene.view(bounds=(1700, 1900, 2100, 2100), size=(400, 200))
    buffer, sun_casters = casters(scene, view)
    assert sun_casters.patches
    for patch in sun_casters.patches:
        quads = 256 * 2**patch.lod
        x = view.grid.x(np.array([patch.col * quads, (patch.col + 1) * quads]))
        y = view.grid.y(np.array([patch.row * quads, (patch.row + 1) * quads]))
        assert x[0] <= 2100 and x[1] >= 0 and y[0] >= 1300 and y[1] <= 2700
    assert sun_casters.reach.needed_m > 1300
    assert render(scene.with_sun(SunSpec(azimuth=270, altitude=20)), view).reach.needed_m < sun_casters.reach.needed_m


def test_casters_are_the_same_across_the_antimeridian(write_raster, make_scene):
    """The same hills at longitude 180 and at 100 give the same casters and the same shadows."""
    results = []
    for lon in (180.0, 100.0):
        raster = write_raster(hills(120, 120, 900), "EPSG:4326", lon - 0.06, 10.06, 0.001, name=f"at{lon:.0f}.tif")
        scene = make_scene(raster, 90, 5)
        x = np.radians(lon) * 6378137.0
        view = scene.view(bounds=(x - 2000, 1113000, x + 400, 1118000), crs="EPSG:3857", size=(128, 256))
        buffer, sun_casters = casters(scene, view)
        results.append((len(sun_casters.patches), render(scene, view, filter=1)))
    assert abs(results[0][0] - results[1][0]) <= 4  # the two grids have different patch borders
    shadow, other_shadow = (frame.visibility < 0.5 for _, frame in results)
    assert 0.05 < shadow.mean() < 0.95
    assert (shadow != other_shadow).mean() < 0.02  # the sampled places differ by less than a pixel


def test_cells_far_larger_than_the_view_give_few_patches(write_raster, make_scene):
    scene = make_scene(write_raster(hills(20, 20, 3000), "EPSG:32633", 0, 9_000_000, 50_000.0), 200, 30)
    view = scene.view(bounds=(500000, 8500000, 500100, 8500100), size=(256, 256))
    _, sun_casters = casters(scene, view)
    assert len(sun_casters.patches) < 500
    assert len({(patch.lod, patch.row, patch.col) for patch in sun_casters.patches}) == len(sun_casters.patches)


def test_caster_detail_falls_only_with_distance(write_raster, make_scene):
    scene = make_scene(write_raster(hills(300, 300, 4000), "EPSG:32633", 300_000, 5_300_000, 500.0), 180, 1)
    view = scene.view(bounds=(370_000, 5_228_000, 371_000, 5_229_000), size=(512, 512))
    buffer, sun_casters = casters(scene, view)
    levels = {patch.lod for patch in sun_casters.patches}
    assert 0 in levels and max(levels) >= 3 and len(sun_casters.patches) < 3000
    for patch in sun_casters.patches:
        quads = 256 * 2**patch.lod
        row, col = (max(first - (index + 1) * quads, index * quads - last, 0) for first, last, index in (
            (buffer.surface.row0, buffer.surface.row0 + buffer.surface.height_m.shape[0], patch.row),
            (buffer.surface.col0, buffer.surface.col0 + buffer.surface.height_m.shape[1], patch.col),
        ))  # fmt: skip
        assert max(row, col) <= 4096 * 2**patch.lod, "detail falls only with distance"


def test_a_map_finer_than_its_raster_reads_few_patches(gl, write_raster, make_scene, monkeypatch):
    """Over cells of 10 m, full detail would be read 80 m around pixels of 2 cm, and 300 m around pixels of 8 cm.

    Reduced detail leaves the shadows the same.
    """
    scene = make_scene(write_raster(hills(60, 60, 60), "EPSG:32633", 500_000, 6_000_600, 10.0), 200, 12)
    close_view, wide_view = (scene.view(bounds=(500_300, 6_000_300, 500_300 + m, 6_000_300 + m), size=(256, 256)) for m in (5, 20))
    reduced_detail = (
        len(casters(scene, close_view)[1].patches),
        render(scene, wide_view, algorithm="shadow_map", filter=1, map_size=1024),
    )
    monkeypatch.setattr("skugga.terrain.casters.reach.MAX_FULL_DETAIL_NODES_PER_CELL", 1e9)
    full_detail = (
        len(casters(scene, close_view)[1].patches),
        render(scene, wide_view, algorithm="shadow_map", filter=1, map_size=1024),
    )
    assert 1.5 * reduced_detail[0] < full_detail[0]
    assert 0.05 < (full_detail[1].visibility < 0.5).mean() < 0.95
    assert ((reduced_detail[1].visibility < 0.5) != (full_detail[1].visibility < 0.5)).mean() < 2e-3
