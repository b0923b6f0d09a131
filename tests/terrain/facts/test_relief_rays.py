"""Rays over a raster's overview: walls in closed form, also at the raster's rim."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.facts.relief_rays import SKIP_BLOCK_CELLS, _trace_blocked
from skugga.terrain.heightfield.walks import write_tile_max

SIDE, WALL_M = 65, 100.0


def is_blocked(heights_m: np.ndarray, row: np.ndarray, col: np.ndarray, towards: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return whether ground blocks rays from 1 m above level 0: bool (n,).

    Rays start at rows and columns (n,). They cross ``towards`` (2, n) rows and columns, and rise by ``rise`` (n,), per metre.
    """
    block_max = np.empty([-(-count // SKIP_BLOCK_CELLS) for count in heights_m.shape], np.float32)
    write_tile_max(heights_m, block_max, SKIP_BLOCK_CELLS)
    start_m, bend, length_m = np.ones_like(row), np.zeros_like(row), np.full_like(row, np.inf)
    per_ray = (values[None] for values in (row, col, start_m, towards[0], towards[1], rise, bend, length_m))
    return np.asarray(_trace_blocked(heights_m, block_max, *per_ray)[0])


@pytest.mark.parametrize("wall", [0, 20, 32, SIDE - 1], ids=["first row", "inside", "border of blocks", "last row"])
@pytest.mark.parametrize("is_transposed", [False, True])
def test_walls_block_exactly_the_rays_below_their_crests(wall: int, is_transposed: bool) -> None:
    """A wall on a row of cells rises to ``WALL_M`` there. Rays end inside the raster, also at a wall on its rim."""
    rng = np.random.default_rng(3)
    heights_m = np.zeros((SIDE, SIDE), np.float32)
    heights_m[wall] = WALL_M
    row, col = rng.uniform(1.0, SIDE - 2.0, (2, 4000))
    far = np.abs(row - wall) > 1.5
    row, col = row[far], col[far]
    across = rng.uniform(1.0, SIDE - 2.0, len(row)) - col
    distance_m = np.hypot(row - wall, across) * 30.0
    towards = np.stack([wall - row, across]) / distance_m
    crest_m = rng.uniform(2.0, 2.0 * WALL_M, len(row))
    rise = (crest_m - 1.0) / distance_m
    swap = slice(None, None, -1) if is_transposed else slice(None)
    field = np.ascontiguousarray(heights_m.T) if is_transposed else heights_m
    blocked = is_blocked(field, *np.stack([row, col])[swap], towards[swap], rise)
    clear = np.abs(crest_m - WALL_M) > 1.0
    assert (blocked == (crest_m < WALL_M))[clear].all()


@pytest.mark.timeout(120, method="thread")
@pytest.mark.parametrize("across", [-1e-20, 1e-20, -1e-13, 1e-13])
@pytest.mark.parametrize("is_transposed", [False, True])
def test_rays_along_a_row_pass_many_cells(across: float, is_transposed: bool) -> None:
    """Rounding turns a ray along a row a little; it must not cross that row anew after each millionth of a cell."""
    heights_m = np.zeros((SKIP_BLOCK_CELLS + 2, 100_000), np.float32)
    heights_m[:, -2:] = WALL_M
    start, towards = np.array([[float(SKIP_BLOCK_CELLS)], [2.0]]), np.array([[across], [1.0]])
    swap = slice(None, None, -1) if is_transposed else slice(None)
    field = np.ascontiguousarray(heights_m.T) if is_transposed else heights_m
    for rise, meets_the_wall in ((98.0e-5, True), (101.0e-5, False)):
        assert is_blocked(field, *start[swap], towards[swap], np.array([rise])).tolist() == [meets_the_wall]


@pytest.mark.timeout(30, method="thread")
@pytest.mark.parametrize("is_transposed", [False, True])
def test_rays_along_the_first_row_pass_many_cells(is_transposed: bool) -> None:
    """A ray in the margin before the first row, which it slowly leaves, must not leave that row anew at every step."""
    heights_m = np.zeros((2, 4000), np.float32)
    heights_m[:, -2:] = WALL_M
    start, towards = np.array([[-1e-9], [2.0]]), np.array([[-2e-10], [1.0]])
    swap = slice(None, None, -1) if is_transposed else slice(None)
    field = np.ascontiguousarray(heights_m.T) if is_transposed else heights_m
    for rise, meets_the_wall in ((0.024, True), (0.026, False)):
        assert is_blocked(field, *start[swap], towards[swap], np.array([rise])).tolist() == [meets_the_wall]
