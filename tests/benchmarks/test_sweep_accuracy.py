"""Truth of a grid's nodes by rays: certain along the higher diagonals, and where the cut is no matter."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.sweep_accuracy import GridRays, Raster, measure
from benchmarks.sweep_speed import mountains

CELL_M = 10.0


def test_what_hangs_on_the_cut_is_certain_as_drawn_alone():
    """A saddle across the sun's way, 3 m high: along its higher diagonal a ridge that shades four nodes behind it, 57 m / 14 m."""
    height = np.zeros((24, 24), np.float32)
    height[13, 11] = height[12, 12] = 3.0
    truth = GridRays(height, (CELL_M, CELL_M)).truth(135.0, 3.0)
    reach = 4  # the nodes lie 7.1, 21.2, 35.4, 49.5 and 63.6 m behind the ridge, whose shadow is 3 m / tan(3 degrees) = 57.2 m long
    behind = np.array([(12, 11)]) - np.arange(5)[:, None]
    assert not truth.lit[*behind[:reach].T].any() and truth.lit[*behind[reach]]
    assert truth.drawn[*behind[:reach].T].all() and not truth.decidable[*behind[:reach].T].any()
    assert not (truth.decidable & ~truth.drawn).any()


@pytest.mark.parametrize("azimuth", [202.0, 113.0])
def test_the_sweep_is_held_against_what_is_drawn(azimuth):
    height = mountains(200)
    raster = Raster("mountains", height, np.ones(height.shape, bool), (CELL_M, CELL_M))
    (figures,) = measure(raster, [(azimuth, 10.0)], 8)
    truth = GridRays(height, raster.cell_m).truth(azimuth, 10.0)
    assert figures.cells == truth.drawn.sum() > truth.decidable.sum()
    assert figures.undecided == pytest.approx(1.0 - truth.drawn.mean())
    assert figures.undecided < 1e-3 and figures.wrong < 5e-4 and 0.1 < figures.shadow < 0.9
