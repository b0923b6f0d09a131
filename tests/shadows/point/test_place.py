"""Place of a point on a level's ground: valid up to the raster's borders, and not in its holes."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows.point.place import place_at
from skugga.terrain.errors import InputError
from tests.rasters import ENGINEERING

SIDE, CELL_M = 20, 10.0


@pytest.fixture
def scene(write_raster, make_scene):
    """Scene of level ground with a hole of one cell."""
    heights = np.full((SIDE, SIDE), 7.0, np.float32)
    heights[10, 10] = -9999.0
    return make_scene(write_raster(heights, ENGINEERING, 0, CELL_M * SIDE, CELL_M, nodata=-9999.0))


@pytest.mark.parametrize("east_m", [-100.0, -96.0, 0.0, 96.0, 100.0])
@pytest.mark.parametrize("north_m", [-100.0, -96.0, 96.0, 100.0])
def test_place_at_accepts_the_raster_border(scene, east_m, north_m):
    assert place_at(scene, (east_m, north_m)).ground_m == 7.0


@pytest.mark.parametrize("at", [(-100.1, 0.0), (0.0, 100.1), (100.1, -100.1)])
def test_place_at_refuses_points_beyond_the_border(scene, at):
    with pytest.raises(InputError, match="a place on the level's data"):
        place_at(scene, at)


def test_place_at_refuses_a_hole(scene):
    with pytest.raises(InputError, match="a place on the level's data"):
        place_at(scene, (5.0, -5.0))
