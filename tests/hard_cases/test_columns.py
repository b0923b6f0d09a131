"""Upright walls: a raster of cells as columns (``terrain.surface: blocks``), against counts and rays over cells."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio

from benchmarks.symmetry import SYMMETRIES, invert_grid, transform_azimuth, transform_grid
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.truth.metrics import MetricCoverage
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from tests.hard_cases.cases import SHADOW_ALGORITHMS, Trial, hard_case
from tests.hard_cases.test_every_side import grounds
from tests.rasters import ENGINEERING

CELL_M = 8.0

ALGORITHMS = (*SHADOW_ALGORITHMS, "truth")

EXACT_ALGORITHMS = ("sweep", "truth")
"""Algorithms that follow each column's own ray."""

TIE_M = 1e-3
"""A ray this near to the top of a column may be blocked or not: rays of truth start higher by as much."""


def column_shadow(trial: Trial, heights: np.ndarray, sun: tuple[float, float], pixels_per_cell: int = 1) -> np.ndarray:
    """Return the shadow of columns in a flat world, all in the view, with some pixels a side to a cell."""
    rows, cols = heights.shape
    path = trial.raster(np.ascontiguousarray(heights, np.float32), ENGINEERING, 0.0, rows * CELL_M, CELL_M)
    scene = trial.scene({"source": str(path), "surface": "blocks"}, sun)
    view = scene.view(bounds=(0.0, 0.0, cols * CELL_M, rows * CELL_M), size=(cols * pixels_per_cell, rows * pixels_per_cell))
    if trial.algorithm == "truth":
        buffer = geometry_buffer(scene, view)
        rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
        return buffer.valid & (attached_shadow_mask(buffer, scene) | ~lit_mask(buffer, scene, "sun", rays))
    return trial.render_view(scene, view, map_size=4096 if trial.thorough else 512).dark


def cells_along_ray(azimuth_deg: float, reach: int) -> Iterator[tuple[int, int, float]]:
    """Return the cells (row and column offsets) on the ray from a cell's middle, in order, and their distances in cells.

    The ray crosses the cells' borders as in J. Amanatides and A. Woo 1987, "A fast voxel traversal algorithm for ray tracing".
    """
    direction = -np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    step = [0 if abs(component) < 1e-12 else int(np.sign(component)) for component in direction]
    offset = [0, 0]
    while max(map(abs, offset)) <= reach:
        exit_distance = [(abs(offset[k]) + 0.5) / abs(direction[k]) if step[k] else np.inf for k in (0, 1)]
        axis = int(exit_distance[1] < exit_distance[0])
        offset[axis] += step[axis]
        yield offset[0], offset[1], exit_distance[axis]


def expected_shadow(heights: np.ndarray, sun: tuple[float, float], cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells' middles columns shadow, and for which the answer depends on less than ``TIE_M``: bool (rows, cols)."""
    heights = heights.astype(np.float64)
    rows, cols = heights.shape
    azimuth_deg, slope = sun[0], np.tan(np.radians(sun[1]))
    dark, tie = np.zeros(heights.shape, bool), np.zeros(heights.shape, bool)
    for down, right, distance in cells_along_ray(azimuth_deg, max(rows, cols)):
        if abs(down) >= rows or abs(right) >= cols:
            break
        receivers = slice(max(-down, 0), rows - max(down, 0)), slice(max(-right, 0), cols - max(right, 0))
        occluders = slice(max(down, 0), rows + min(down, 0)), slice(max(right, 0), cols + min(right, 0))
        above_m = heights[occluders] - (heights[receivers] + distance * cell_m * slope)
        dark[receivers] |= above_m > 0.0
        tie[receivers] |= np.abs(above_m) < TIE_M
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
    dark_roof, wrong_count = 0, 0
    for solid in SOLIDS.values():
        roof = np.zeros((CELLS, CELLS), bool)
        roof[solid, solid] = True
        for octant, (down, right) in enumerate(((1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1))):
            rise = 0.5**0.5 if down and right else 1.0
            dark = column_shadow(trial, roof * HEIGHT_CELLS * CELL_M, (45.0 * octant, float(np.degrees(np.arctan(rise)))))
            expected = np.logical_or.reduce([np.roll(roof, (far * down, far * right), (0, 1)) for far in range(1, 11)]) & ~roof
            diagonal_index = row * abs(right) - col * down * (right or down)
            is_beside = (diagonal_index == diagonal_index[roof].min() - 1) | (diagonal_index == diagonal_index[roof].max() + 1)
            touched = is_beside if down and right else np.zeros_like(roof)
            dark_roof += int(dark[roof].sum())
            ground = ~roof & ~touched
            octant_wrong_count, expected_count = int((dark != expected)[ground].sum()), int(expected[ground].sum())
            wrong_count += octant_wrong_count
            trial.record_coverage(
                "wrong cells on the ground",
                MetricCoverage(expected_count, expected_count, octant_wrong_count, int((dark | expected)[ground].sum())),
            )
    return {"dark roof cells": dark_roof, "wrong cells on the ground": wrong_count}


SUNS = ((113.0, 30.0), (202.0, 10.0), (67.0, 20.0), (341.0, 45.0), (19.0, 3.0))
"""Azimuth and altitude, degrees: off the axes and diagonals."""

MAX_DIFFERING_SHARE = {"sweep": 0.0, "truth": 0.0, "shadow_volume": 3e-3, "hybrid": 3e-3, "shadow_map": 1e-2}
"""Share of the cells. Rasterisers snap corners to a grid, and so move rays across them; maps have texels."""


def share_of_bound(share: float, bound: float) -> float:
    """Return a share divided by its bound; infinite if the bound is 0 and the share is not."""
    return share / bound if bound else (np.inf if share else 0.0)


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
    result = {"cells": 0.0, "pixels of one class": 0.0}
    for heights in (random, pillar):
        for sun in SUNS if trial.thorough else SUNS[:2]:
            expected, tie = expected_shadow(heights, sun, CELL_M)
            dark = column_shadow(trial, heights, sun)
            differ = float(((dark != expected) & ~tie).mean())
            result["cells"] = max(result["cells"], share_of_bound(differ, MAX_DIFFERING_SHARE.get(trial.algorithm, 0.0)))
            fine_shadow = column_shadow(trial, heights, sun, 3)
            mixed_share = (fine_shadow != dark.repeat(3, axis=0).repeat(3, axis=1)).mean()
            result["pixels of one class"] = max(result["pixels of one class"], mixed_share * (trial.algorithm in EXACT_ALGORITHMS))
    return result


@hard_case(
    "Y8",
    "Columns: mirrored or turned cells under a sun mirrored or turned alike have the mirrored or turned shadow",
    "random heights, a city and a canopy, eight ways; as a share of what may differ: 0.001 % by the sweep and rays, else 0.3 %",
    {"cells": 1.0},
    algorithms=ALGORITHMS,
)
def test_eight_symmetries(trial: Trial) -> dict[str, float]:
    max_share, worst = 1e-5 if trial.algorithm in EXACT_ALGORITHMS else 3e-3, 0.0
    suns = {"random heights": (90.0, 45.0), "city": (113.0, 30.0), "canopy": (67.0, 20.0)}
    for ground, (azimuth, altitude) in suns.items():
        heights = grounds(80 if trial.thorough else 32)[ground]
        shadows = [
            invert_grid(column_shadow(trial, transform_grid(heights, side), (transform_azimuth(azimuth, side), altitude)), side)
            for side in (SYMMETRIES if trial.thorough else (SYMMETRIES[0], SYMMETRIES[1], SYMMETRIES[6]))
        ]
        assert 0.02 < shadows[0].mean() < 0.98
        worst = max(worst, *(float((other != shadows[0]).mean()) for other in shadows[1:]))
    return {"cells": worst / max_share}


@pytest.mark.parametrize("sun", SUNS)
def test_a_city_by_the_sweep_is_that_of_a_walk_over_its_cells(shared_data: Path, tmp_path: Path, sun: tuple[float, float]):
    with rasterio.open(shared_data / "urban/goteborg_1m/DSM.tif") as dataset:
        heights = CELL_M * dataset.read(1).astype(np.float32)  # in cells of this size, with the city's proportions unchanged
    expected, tie = expected_shadow(heights, sun, CELL_M)
    dark = column_shadow(Trial("sweep", False, tmp_path), heights, sun)
    assert 0.2 < dark.mean() < 0.95
    assert tie.mean() < 0.02
    assert not ((dark != expected) & ~tie).any()
