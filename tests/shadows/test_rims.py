"""Ground casts as far as its cells reach, also along a raster's border."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import skugga
from tests.rasters import ENGINEERING

ALGORITHMS = [None, "sweep", "shadow_map", "shadow_volume", "hybrid", "truth"]
"""``None``: the algorithm that the engine chooses."""

WALL_M, ALTITUDE, CELL_M = 60.0, 30.0, 10.0
SHADOW_CELLS = int(WALL_M / np.tan(np.radians(ALTITUDE)) / CELL_M)

SIDE_CELLS = 101
WALL_ROWS = slice(50, 53)


def wall_heights(azimuth: float) -> np.ndarray:
    """Return a plain with a wall from border to border, roughly perpendicular to the sun's direction."""
    heights = np.zeros((SIDE_CELLS, SIDE_CELLS), np.float32)
    heights[WALL_ROWS] = WALL_M
    return heights if abs(azimuth - 180.0) < 45.0 else heights.T


def shadow_mask(raster, azimuth: float, altitude: float, algorithm: str | None) -> np.ndarray:
    """Return the mask of cells in shadow, computed by the library."""
    options = {} if algorithm is None else {"algorithm": algorithm}
    with skugga.open_level(str(raster)) as level:
        return level.shade("mask", azimuth=azimuth, altitude=altitude, **options) == 0


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("azimuth", [180.0, 179.999, 180.001, 90.0, 89.999, 200.0])
def test_a_wall_shades_its_outermost_lines(gl, write_raster, azimuth, algorithm):
    """Behind the wall each line whose rays pass over the raster's cells has as many dark cells as the middle line."""
    dark = shadow_mask(write_raster(wall_heights(azimuth), ENGINEERING, 0, 10 * SIDE_CELLS, CELL_M), azimuth, ALTITUDE, algorithm)
    behind_wall = (dark if abs(azimuth - 180.0) < 45.0 else dark.T[:, ::-1])[: WALL_ROWS.start]
    shadow_cells = behind_wall.sum(axis=0)
    sideways_cells = SHADOW_CELLS * np.abs(np.tan(np.radians(azimuth - 180.0 if abs(azimuth - 180.0) < 45.0 else azimuth - 90.0)))
    fully_shaded = slice(
        int(np.ceil(sideways_cells - 0.5)), None
    )  # from there on rays run over cells up to the wall, which lies west of north
    expected_cells = int(SHADOW_CELLS * np.cos(np.radians(azimuth - 180.0))) if azimuth == 200.0 else SHADOW_CELLS
    assert shadow_cells[SIDE_CELLS // 2] == expected_cells
    np.testing.assert_array_equal(shadow_cells[fully_shaded], shadow_cells[SIDE_CELLS // 2])


def test_border_cells_are_as_near_to_rays_as_others(gl, write_raster):
    """On rough ground border cells differ from rays as rarely as other cells, under suns from all sides."""
    noise = np.random.default_rng(3).normal(size=(96, 96))
    heights = 25.0 * gaussian_filter(noise, 1.2) + 150.0 * gaussian_filter(noise, 6.0)
    raster = write_raster(heights.astype(np.float32), ENGINEERING, 0, 960, CELL_M)
    border = np.ones((96, 96), bool)
    border[1:-1, 1:-1] = False
    for azimuth, altitude in ((180.0, 20.0), (33.0, 12.0), (271.0, 35.0), (140.0, 45.0)):
        traced_mask = shadow_mask(raster, azimuth, altitude, "truth")
        assert traced_mask[border].any()
        for algorithm, share in (("sweep", 0.0), ("shadow_volume", 0.0), ("shadow_map", 0.02)):
            mismatch = shadow_mask(raster, azimuth, altitude, algorithm) != traced_mask
            assert mismatch[border].mean() <= share + mismatch[~border].mean(), (azimuth, algorithm)
        from_memory = skugga.shadow(heights.astype(np.float32), CELL_M, azimuth, altitude)
        assert (from_memory != traced_mask)[border].mean() <= 0.005
