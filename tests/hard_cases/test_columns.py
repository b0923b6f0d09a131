"""Upright walls: a raster of cells as columns (``terrain.surface: blocks``), against counts and rays over cells."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio

from benchmarks.symmetry import SIDES, azimuth_of, moved, moved_back
from skugga.shadows.attached import attached
from skugga.shadows.truth.metrics import MetricCoverage
from skugga.shadows.truth.truth import ALL_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from tests.hard_cases.cases import SHADOWING, Trial, hard_case
from tests.hard_cases.test_every_side import grounds
from tests.rasters import ENGINEERING

CELL_M = 8.0

ALGORITHMS = (*SHADOWING, "truth")

EXACT = ("sweep", "truth")
"""Algorithms that follow each column's own ray."""

TIE_M = 1e-3
"""A ray this near to the top of a column may be blocked or not: rays of truth start higher by as much."""


def dark_at(trial: Trial, heights: np.ndarray, sun: tuple[float, float], pixels_a_cell: int = 1) -> np.ndarray:
    """Return the shadow of columns in a flat world, all in the view, with some pixels a side to a cell."""
    rows, cols = heights.shape
    path = trial.raster(np.ascontiguousarray(heights, np.float32), ENGINEERING, 0.0, rows * CELL_M, CELL_M)
    scene = trial.scene({"source": str(path), "surface": "blocks"}, sun)
    view = scene.view(bounds=(0.0, 0.0, cols * CELL_M, rows * CELL_M), size=(cols * pixels_a_cell, rows * pixels_a_cell))
    if trial.algorithm == "truth":
        buffer = geometry_buffer(scene, view)
        rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_KINDS)
        return buffer.valid & (attached(buffer, scene) | ~lit_mask(buffer, scene, "sun", rays))
    return trial.see(scene, view, map_size=4096 if trial.thorough else 1024).dark


def cells_on_the_way(azimuth_deg: float, reach: int) -> Iterator[tuple[int, int, float]]:
    """Return the cells (row and column offsets) on the ray from a cell's middle, in order, and their distances in cells.

    The ray crosses the cells' borders as in J. Amanatides and A. Woo 1987, "A fast voxel traversal algorithm for ray tracing".
    """
    away = -np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    step = [0 if abs(way) < 1e-12 else int(np.sign(way)) for way in away]
    place = [0, 0]
    while max(map(abs, place)) <= reach:
        far = [(abs(place[k]) + 0.5) / abs(away[k]) if step[k] else np.inf for k in (0, 1)]
        axis = int(far[1] < far[0])
        place[axis] += step[axis]
        yield place[0], place[1], far[axis]


def shaded_by_columns(heights: np.ndarray, sun: tuple[float, float], cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells' middles columns shadow, and for which the answer depends on less than ``TIE_M``: bool (rows, cols)."""
    heights = heights.astype(np.float64)
    rows, cols = heights.shape
    azimuth_deg, slope = sun[0], np.tan(np.radians(sun[1]))
    dark, tie = np.zeros(heights.shape, bool), np.zeros(heights.shape, bool)
    for down, right, far in cells_on_the_way(azimuth_deg, max(rows, cols)):
        if abs(down) >= rows or abs(right) >= cols:
            break
        here = slice(max(-down, 0), rows - max(down, 0)), slice(max(-right, 0), cols - max(right, 0))
        target = slice(max(down, 0), rows + min(down, 0)), slice(max(right, 0), cols + min(right, 0))
        above_m = heights[target] - (heights[here] + far * cell_m * slope)
        dark[here] |= above_m > 0.0
        tie[here] |= np.abs(above_m) < TIE_M
    return dark, tie


CELLS = 64

SOLIDS = {"box": slice(22, 42), "pillar": slice(31, 32)}
"""Rows and columns of the box on level ground."""

HEIGHT_CELLS = 10.25


@hard_case(
    "Y6",
    "Columns: a box of cells throws the shadow of an upright box whose sides are the cells' borders, and its roof is lit",
    "a box of 20 x 20 cells and a pillar of one, 10.25 cells high, under suns from the eight directions of the compass, 1 high per "
    "cell passed",
    {"dark roof cells": 0.0, "wrong cells on the ground": 0.0},
    algorithms=ALGORITHMS,
    thorough=False,
)
def test_a_box_under_eight_suns(trial: Trial) -> dict[str, float]:
    """A wall is half a cell from the middles beside it: there the ray has risen by 0.5, a cell farther away by 1.5, and so on.
    Behind each of the roof's cells, along the shadow, ten middles lie below 10.25. Along the diagonals the two rays that
    pass beside the solid touch it, along the edges of its walls: either answer is right for them.
    """
    row, col = np.indices((CELLS, CELLS))
    dark_roof, wrong = 0, 0
    for solid in SOLIDS.values():
        roof = np.zeros((CELLS, CELLS), bool)
        roof[solid, solid] = True
        for octant, (down, right) in enumerate(((1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1))):
            rise = 0.5**0.5 if down and right else 1.0
            dark = dark_at(trial, roof * HEIGHT_CELLS * CELL_M, (45.0 * octant, float(np.degrees(np.arctan(rise)))))
            expected = np.logical_or.reduce([np.roll(roof, (far * down, far * right), (0, 1)) for far in range(1, 11)]) & ~roof
            across = row * abs(right) - col * down * (right or down)
            beside = (across == across[roof].min() - 1) | (across == across[roof].max() + 1)
            touched = beside if down and right else np.zeros_like(roof)
            dark_roof += int(dark[roof].sum())
            ground = ~roof & ~touched
            off, cast = int((dark != expected)[ground].sum()), int(expected[ground].sum())
            wrong += off
            trial.saw("wrong cells on the ground", MetricCoverage(cast, cast, off, int((dark | expected)[ground].sum())))
    return {"dark roof cells": dark_roof, "wrong cells on the ground": wrong}


SUNS = ((113.0, 30.0), (202.0, 10.0), (67.0, 20.0), (341.0, 45.0), (19.0, 3.0))
"""Azimuth and altitude, degrees: off the axes and diagonals."""

MAY_DIFFER = {"sweep": 0.0, "truth": 0.0, "shadow_volume": 3e-3, "hybrid": 3e-3, "shadow_map": 1e-2}
"""Share of the cells. Rasterisers snap corners to a grid, and so move rays across them; maps have texels."""


def share_over(share: float, most: float) -> float:
    """Return a share divided by its bound; infinite if the bound is 0 and the share is not."""
    return share / most if most else (np.inf if share else 0.0)


@hard_case(
    "Y7",
    "Columns: a cell is dark if the ray from the middle of its top meets another column",
    "random heights, and a pillar 40 cells high, under five suns off the axes; as a share of what may differ from a walk over the "
    "cells: nothing of the sweep and of rays, 0.3 % of volumes, 1 % of maps; with three pixels to a cell all have its class",
    {"cells": 1.0, "pixels of one class": 0.0},
    algorithms=ALGORITHMS,
)
def test_rays_over_cells(trial: Trial) -> dict[str, float]:
    cells = 96 if trial.thorough else 40
    random = np.random.default_rng(5).uniform(0.0, 40.0, (cells, cells)).astype(np.float32)
    pillar = np.zeros((cells, cells), np.float32)
    pillar[cells // 2, cells // 2] = 40.0 * CELL_M
    found = {"cells": 0.0, "pixels of one class": 0.0}
    for heights in (random, pillar):
        for sun in SUNS if trial.thorough else SUNS[:3]:
            expected, tie = shaded_by_columns(heights, sun, CELL_M)
            dark = dark_at(trial, heights, sun)
            differ = float(((dark != expected) & ~tie).mean())
            found["cells"] = max(found["cells"], share_over(differ, MAY_DIFFER.get(trial.algorithm, 0.0)))
            fine = dark_at(trial, heights, sun, 3)
            apart = (fine != dark.repeat(3, axis=0).repeat(3, axis=1)).mean()
            found["pixels of one class"] = max(found["pixels of one class"], apart * (trial.algorithm in EXACT))
    return found


@hard_case(
    "Y8",
    "Columns: mirrored or turned cells under a sun mirrored or turned alike have the mirrored or turned shadow",
    "random heights, a city and a canopy, eight ways; as a share of what may differ: 0.001 % by the sweep and rays, else 0.3 %",
    {"cells": 1.0},
    algorithms=ALGORITHMS,
)
def test_eight_symmetries(trial: Trial) -> dict[str, float]:
    most, worst = 1e-5 if trial.algorithm in EXACT else 3e-3, 0.0
    suns = {"random heights": (90.0, 45.0), "city": (113.0, 30.0), "canopy": (67.0, 20.0)}
    for ground, (azimuth, altitude) in suns.items():
        heights = grounds(80 if trial.thorough else 32)[ground]
        seen = [
            moved_back(dark_at(trial, moved(heights, side), (azimuth_of(azimuth, side), altitude)), side)
            for side in (SIDES if trial.thorough else (SIDES[0], SIDES[1], SIDES[6]))
        ]
        assert 0.02 < seen[0].mean() < 0.98
        worst = max(worst, *(float((other != seen[0]).mean()) for other in seen[1:]))
    return {"cells": worst / most}


@pytest.mark.parametrize("sun", SUNS)
def test_a_city_by_the_sweep_is_that_of_a_walk_over_its_cells(shared_data: Path, tmp_path: Path, sun: tuple[float, float]):
    with rasterio.open(shared_data / "urban/goteborg_1m/DSM.tif") as dataset:
        heights = CELL_M * dataset.read(1).astype(np.float32)  # in cells of this size, with the city's proportions unchanged
    expected, tie = shaded_by_columns(heights, sun, CELL_M)
    dark = dark_at(Trial("sweep", False, tmp_path), heights, sun)
    assert 0.2 < dark.mean() < 0.95
    assert tie.mean() < 0.02
    assert not ((dark != expected) & ~tie).any()
