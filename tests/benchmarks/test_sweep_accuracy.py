"""Ray-traced truth at a grid's nodes: exact for the drawn triangulation (higher diagonals), decidable where the cut has no
effect.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.sweep_accuracy import GridRays, Raster, measure
from benchmarks.sweep_speed import fractal_heights_m

CELL_M = 10.0


def test_nodes_that_depend_on_the_cut_are_not_decidable():
    """A saddle 3 m high lies across the direction of the sun. Its higher diagonal is a ridge that shades four nodes behind
    it, 57 m / 14 m.
    """
    height = np.zeros((24, 24), np.float32)
    height[13, 11] = height[12, 12] = 3.0
    truth = GridRays(height, (CELL_M, CELL_M)).truth(135.0, 3.0)
    reach = 4  # the nodes lie 7.1, 21.2, 35.4, 49.5 and 63.6 m behind the ridge, whose shadow is 3 m / tan(3 degrees) = 57.2 m long
    shadow_nodes = np.array([(12, 11)]) - np.arange(5)[:, None]
    assert not truth.lit[*shadow_nodes[:reach].T].any() and truth.lit[*shadow_nodes[reach]]
    assert truth.certain[*shadow_nodes[:reach].T].all() and not truth.certain_for_any_cut[*shadow_nodes[:reach].T].any()
    assert not (truth.certain_for_any_cut & ~truth.certain).any()


@pytest.mark.parametrize("azimuth", [202.0, 113.0])
def test_the_sweep_is_compared_with_the_drawn_surface(azimuth):
    height = fractal_heights_m(200)
    raster = Raster("mountains", height, np.ones(height.shape, bool), (CELL_M, CELL_M))
    (figures,) = measure(raster, [(azimuth, 10.0)], 8)
    truth = GridRays(height, raster.cell_m).truth(azimuth, 10.0)
    assert figures.cells == truth.certain.sum() > truth.certain_for_any_cut.sum()
    assert figures.undecided == pytest.approx(1.0 - truth.certain.mean())
    assert figures.undecided < 1e-3 and figures.wrong < 5e-4 and 0.1 < figures.shadow < 0.9
