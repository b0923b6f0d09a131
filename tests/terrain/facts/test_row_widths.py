"""Widths of the rows of a map across the sun's rays, by arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.api.raster_view import raster_view
from skugga.terrain.facts.row_widths import MAX_ROW_WIDTH_RATIO, row_width_ratio

CELL_DEG = 1e-4


@pytest.mark.parametrize(
    ("north_deg", "azimuth_deg", "ratio"),
    [
        # The block has the rows 0 to 1023, whose widths are proportional to their distances from the pole.
        (89.9, 180.0, (0.1 + 1023.5 * CELL_DEG) / (0.1 + 0.5 * CELL_DEG)),
        (89.9, 0.0, (0.1 + 1023.5 * CELL_DEG) / (0.1 + 0.5 * CELL_DEG)),
        (89.99, 180.0, (0.01 + 1023.5 * CELL_DEG) / (0.01 + 0.5 * CELL_DEG)),
        (90.0, 180.0, 1023.5 / 0.5),
        (90.002, 180.0, MAX_ROW_WIDTH_RATIO),  # the block folds at the pole
        (89.99, 90.0, 1.0),  # the lines are meridians, which have one length
        (0.05, 180.0, 1.0),
    ],
)
def test_row_width_ratio_is_that_of_distances_from_the_pole(write_raster, make_scene, north_deg, azimuth_deg, ratio):
    scene = make_scene(write_raster(np.ones((61, 61), np.float32), "EPSG:4326", 15.0, north_deg, CELL_DEG), azimuth_deg, 30.0)
    view = raster_view(scene, None, None, None, None).view
    assert row_width_ratio(scene, view.grid, view) == pytest.approx(ratio, rel=1e-3)


def test_row_width_ratio_is_one_on_a_plane(write_raster, make_scene):
    scene = make_scene(write_raster(np.ones((61, 61), np.float32), "EPSG:32633", 5e5, 5e6, 10.0), 200.0, 30.0)
    view = raster_view(scene, None, None, None, None).view
    assert row_width_ratio(scene, view.grid, view) == pytest.approx(1.0, abs=1e-4)
