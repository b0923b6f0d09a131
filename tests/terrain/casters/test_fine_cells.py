"""Blocks small beside a big raster's overview cells have as few caster patches as on a small raster, and the same shadows."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.casters.reach import find_sun_casters
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.ground import overview
from tests.render import render_points, shadow

SIDE, CELL_M = 1024, 30.0
WEST_M, NORTH_M = 500_000.0, 5_200_000.0


def relief() -> np.ndarray:
    row, col = np.mgrid[:SIDE, :SIDE]
    hills = 400.0 * np.sin(col / 17.0) * np.cos(row / 23.0) + 250.0 * np.sin((row + 2 * col) / 7.0)
    return (1500.0 + hills).astype(np.float32)


@pytest.fixture
def seen(write_raster, make_scene, monkeypatch):
    """Return the number of caster patches and the shadow (rows, cols) of a block at full detail, for three rasters.

    One is the raster as it is. The other two count as big: one with and one without the finer cells of its overview.
    """
    raster = write_raster(relief(), "EPSG:32633", WEST_M, NORTH_M, CELL_M, tiled=True)

    def look() -> tuple[int, np.ndarray]:
        scene = make_scene(raster, 200.0, 8.0)
        x, y = WEST_M + 15_000.0, NORTH_M - 14_000.0
        view = scene.view(bounds=(x, y, x + 256 * 7.5, y + 256 * 7.5), crs="EPSG:32633", size=(256, 256))
        buffer = map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))
        return len(find_sun_casters(scene, buffer)), shadow(render_points(scene, view, algorithm="sweep"))

    found = {"small": look()}
    monkeypatch.setattr(overview, "EXACT_HIGH_CELLS", 256 * 256)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.EXACT_HIGH_CELLS", 256 * 256)
    monkeypatch.setattr(overview, "OVERVIEW_CELLS", 8)
    monkeypatch.setattr(overview, "FINE_LEVEL", 3)
    found["big"] = look()
    monkeypatch.setattr(overview, "FINE_LEVEL", 7)
    found["big, coarse cells alone"] = look()
    return found


def test_fine_cells_keep_shadows_and_reduce_patches(seen):
    _, small = seen["small"]
    assert 0.1 < small.mean() < 0.9
    np.testing.assert_array_equal(seen["big"][1], seen["big, coarse cells alone"][1])
    assert (seen["big"][1] != small).sum() <= 4  # the level's height range is estimated: points on a shadow's edge differ
    counts = {name: count for name, (count, _) in seen.items()}
    assert 0 < counts["small"] <= counts["big"] < 2 * counts["small"], counts
    assert counts["big"] < 0.6 * counts["big, coarse cells alone"], counts


def test_fine_cells_nest_in_the_overview_cells(write_raster, make_scene, monkeypatch):
    monkeypatch.setattr(overview, "EXACT_HIGH_CELLS", 256 * 256)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.EXACT_HIGH_CELLS", 256 * 256)
    monkeypatch.setattr(overview, "OVERVIEW_CELLS", 8)
    monkeypatch.setattr(overview, "FINE_LEVEL", 4)
    found = make_scene(write_raster(relief(), "EPSG:32633", WEST_M, NORTH_M, CELL_M, tiled=True)).elevation.overview
    assert found.level == 7 and found.fine_level == 4 and found.fine_high_m is not None
    np.testing.assert_array_equal(found.fine_high_m.reshape(8, 8, 8, 8).max(axis=(1, 3)), found.high_m)
    highest = relief().reshape(64, 16, 64, 16).max(axis=(1, 3))
    assert (found.fine_high_m >= highest - 60.0).all()
