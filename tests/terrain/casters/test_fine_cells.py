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


def relief_heights() -> np.ndarray:
    """Return heights of hills in metres (``SIDE``, ``SIDE``)."""
    row, col = np.mgrid[:SIDE, :SIDE]
    hills = 400.0 * np.sin(col / 17.0) * np.cos(row / 23.0) + 250.0 * np.sin((row + 2 * col) / 7.0)
    return (1500.0 + hills).astype(np.float32)


@pytest.fixture
def results_by_raster(write_raster, make_scene, monkeypatch):
    """Return the number of caster patches and the shadow (rows, cols) of a block at full detail, for three rasters.

    One is the raster as it is. The other two count as big: one with and one without the finer cells of its overview.
    """
    raster = write_raster(relief_heights(), "EPSG:32633", WEST_M, NORTH_M, CELL_M, tiled=True)

    def count_and_shadow() -> tuple[int, np.ndarray]:
        scene = make_scene(raster, 200.0, 8.0)
        x, y = WEST_M + 15_000.0, NORTH_M - 14_000.0
        view = scene.view(bounds=(x, y, x + 256 * 7.5, y + 256 * 7.5), crs="EPSG:32633", size=(256, 256))
        buffer = map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))
        return len(find_sun_casters(scene, buffer)), shadow(render_points(scene, view, algorithm="sweep"))

    results = {"small": count_and_shadow()}
    monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", 256 * 256)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 256 * 256)
    monkeypatch.setattr(overview, "OVERVIEW_SIDE_CELLS", 8)
    monkeypatch.setattr(overview, "FINE_LOD", 3)
    results["big"] = count_and_shadow()
    monkeypatch.setattr(overview, "FINE_LOD", 7)
    results["big, coarse cells alone"] = count_and_shadow()
    return results


def test_fine_cells_keep_shadows_and_reduce_patches(results_by_raster):
    _, small_raster_shadow = results_by_raster["small"]
    assert 0.1 < small_raster_shadow.mean() < 0.9
    np.testing.assert_array_equal(results_by_raster["big"][1], results_by_raster["big, coarse cells alone"][1])
    assert (
        results_by_raster["big"][1] != small_raster_shadow
    ).sum() <= 4  # the level's height range is estimated: points on a shadow's edge differ
    counts = {name: count for name, (count, _) in results_by_raster.items()}
    assert 0 < counts["small"] <= counts["big"] < 2 * counts["small"], counts
    assert counts["big"] < 0.6 * counts["big, coarse cells alone"], counts


def test_fine_cells_nest_in_the_overview_cells(write_raster, make_scene, monkeypatch):
    monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", 256 * 256)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 256 * 256)
    monkeypatch.setattr(overview, "OVERVIEW_SIDE_CELLS", 8)
    monkeypatch.setattr(overview, "FINE_LOD", 4)
    raster_overview = make_scene(
        write_raster(relief_heights(), "EPSG:32633", WEST_M, NORTH_M, CELL_M, tiled=True)
    ).elevation.overview
    assert raster_overview.lod == 7 and raster_overview.fine_lod == 4 and raster_overview.fine_max_heights_m is not None
    np.testing.assert_array_equal(
        raster_overview.fine_max_heights_m.reshape(8, 8, 8, 8).max(axis=(1, 3)), raster_overview.max_heights_m
    )
    highest = relief_heights().reshape(64, 16, 64, 16).max(axis=(1, 3))
    assert (raster_overview.fine_max_heights_m >= highest - 60.0).all()
