"""Where a point is on a level's ground: also on the raster's very borders, and not in its holes."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows.point.place import place_at
from skugga.terrain.errors import InputError
from tests.rasters import ENGINEERING

SIDE, CELL_M = 20, 10.0


@pytest.fixture
def scene(write_raster, make_scene):
    heights = np.full((SIDE, SIDE), 7.0, np.float32)
    heights[10, 10] = -9999.0
    return make_scene(write_raster(heights, ENGINEERING, 0, CELL_M * SIDE, CELL_M, nodata=-9999.0))


@pytest.mark.parametrize("east_m", [-100.0, -96.0, 0.0, 96.0, 100.0])
@pytest.mark.parametrize("north_m", [-100.0, -96.0, 96.0, 100.0])
def test_the_outermost_cells_have_ground_up_to_their_borders(scene, east_m, north_m):
    assert place_at(scene, (east_m, north_m)).ground_m == 7.0


@pytest.mark.parametrize("at", [(-100.1, 0.0), (0.0, 100.1), (100.1, -100.1)])
def test_there_is_no_ground_beyond_them(scene, at):
    with pytest.raises(InputError, match="a place on the level's data"):
        place_at(scene, at)


def test_a_hole_is_no_ground_though_it_is_filled_for_casting(scene):
    with pytest.raises(InputError, match="a place on the level's data"):
        place_at(scene, (5.0, -5.0))
