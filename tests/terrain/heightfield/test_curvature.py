"""The drop by the earth's curvature against its closed form."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.geo.world import EARTH_RADIUS_M
from skugga.terrain.heightfield.walks import curvature_drop_m, loop_curvature_drop_m

DISTANCES_M = np.array([0.0, 100.0, 1e3, 1e4, 1e5])


@compiled
def _drops_m(distance_m, curvature_per_m):  # type: ignore[no-untyped-def]
    """Return the drops (n,) at distances (n,), as loops compute them."""
    out = np.empty(len(distance_m))
    for n in range(len(distance_m)):
        out[n] = loop_curvature_drop_m(distance_m[n], curvature_per_m)
    return out


def test_the_drop_is_that_of_a_circle() -> None:
    angle = DISTANCES_M / EARTH_RADIUS_M
    exact_m = 2.0 * EARTH_RADIUS_M * np.sin(angle / 2.0) ** 2
    drop_m = curvature_drop_m(DISTANCES_M, 1.0 / EARTH_RADIUS_M)
    assert (np.abs(drop_m - exact_m) <= exact_m * angle**2 / 11.9 + 1e-9).all()
    assert 0.015 < drop_m[-1] - exact_m[-1] < 0.017  # as its docstring says


def test_a_flat_world_has_no_drop() -> None:
    assert not curvature_drop_m(DISTANCES_M, 0.0).any()


def test_loops_and_arrays_have_the_same_drop() -> None:
    curvature_per_m = 1.0 / EARTH_RADIUS_M
    assert (_drops_m(DISTANCES_M, curvature_per_m) == curvature_drop_m(DISTANCES_M, curvature_per_m)).all()
