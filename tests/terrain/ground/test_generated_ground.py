"""Generated ground: nodes at the requested places, heights from 0 to the relief, reproducible by seed, and drained by rivers."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from pyproj import CRS
from scipy.ndimage import label

from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.erosion import drainage
from skugga.terrain.ground.generated_ground import _generate, generated_ground
from skugga.terrain.ground.noise import fractal_grid
from skugga.terrain.level.parts import Terrain

NOISE_DIGEST, RIDGES_DIGEST = "42dd4ab4a2276fcf", "ad3d9d1b926597a4"
"""Digests of every bit. Renew them only for an intended change of the generated ground."""


def read_generated_ground(**terrain) -> tuple[np.ndarray, tuple[float, ...], CRS]:
    """Return heights (rows, cols), geotransform and CRS of generated terrain."""
    with generated_ground(Terrain.model_validate(terrain)).open() as dataset:
        return dataset.read(1), tuple(dataset.transform)[:6], CRS.from_user_input(dataset.crs.to_wkt())


def generated_heights(kind: str, size=(2000, 2000), cell=20, relief=500, seed=1) -> np.ndarray:
    """Return the heights (rows, cols) of generated terrain of a kind; lengths in metres."""
    return read_generated_ground(generate={"kind": kind, "size": size, "cell": cell, "relief": relief, "seed": seed})[0]


def test_flat_ground_has_its_nodes_at_cell_centres():
    heights, transform, crs = read_generated_ground(flat={"size": [200, 100], "cells": [100, 20]})
    assert heights.shape == (21, 101) and not heights.any()
    dx, _, west, _, dy, north = transform
    assert (dx, dy) == (2.0, -5.0)
    assert (west + dx / 2, north + dy / 2) == (-100.0, 50.0)
    assert (west + 101 * dx - dx / 2, north + 21 * dy - dy / 2) == (100.0, -50.0)
    assert crs.is_engineering and crs.axis_info[0].unit_conversion_factor == 1.0


def test_elevation_opens_generated_ground():
    elevation = Elevation(
        "floor", raster_in_memory=generated_ground(Terrain.model_validate({"flat": {"size": [20, 20], "cells": [1, 1]}}))
    )
    assert elevation.flat and elevation.shape == (2, 2)
    np.testing.assert_allclose(elevation.ground_m(np.array([-10.0, 0.0, 10.0]), np.zeros(3)), 0)


@pytest.mark.parametrize("kind", ["ridges", "landscape"])
@pytest.mark.parametrize("size, cell", [((2000, 2000), 20), ((3000, 500), 10), ((400, 1000), 100), ((40, 40), 10)])
def test_heights_fill_the_relief_on_any_grid(kind, size, cell):
    heights = generated_heights(kind, size, cell, relief=750)
    assert heights.shape == (size[1] // cell + 1, size[0] // cell + 1) and heights.dtype == np.float32
    assert heights.min() == 0.0 and heights.max() == 750.0
    assert heights.std() > 20


@pytest.mark.parametrize("kind", ["ridges", "landscape"])
def test_seed_determines_the_ground(kind):
    first = generated_heights(kind, seed=7)
    assert not np.array_equal(first, generated_heights(kind, seed=8))
    _generate.cache.clear()
    np.testing.assert_array_equal(first, generated_heights(kind, seed=7))


def test_values_are_equal_on_any_machine():
    x = np.arange(64) / 7.0
    values = fractal_grid(x, x, 4, 12345)
    assert hashlib.sha256(values.tobytes()).hexdigest()[:16] == NOISE_DIGEST
    assert hashlib.sha256(generated_heights("ridges", seed=3).tobytes()).hexdigest()[:16] == RIDGES_DIGEST


def test_noise_is_balanced_and_continuous():
    x = np.linspace(0, 40, 801)
    values = fractal_grid(x, x, 1, 5)
    assert abs(values.mean()) < 0.03 and 0.15 < values.std() < 0.35 and np.abs(values).max() < 1
    assert np.abs(np.diff(values, axis=0)).max() < 0.15
    np.testing.assert_allclose(values[::20, ::20], 0, atol=1e-12)  # whole coordinates


def test_drainage_leads_downhill_to_the_rim_from_every_cell():
    height = fractal_grid(np.linspace(0, 5, 60), np.linspace(0, 4, 50), 4, 2)
    order, receiver = drainage(height)
    assert sorted(order) == list(range(height.size))
    rank = np.empty(height.size, int)
    rank[order] = np.arange(height.size)
    rim = np.ones(height.shape, bool)
    rim[1:-1, 1:-1] = False
    inner = ~rim.ravel()
    assert (receiver[~inner] == np.flatnonzero(~inner)).all()
    assert (rank[receiver[inner]] < rank[inner]).all()
    row, col = np.divmod(np.arange(height.size), 60)
    assert (np.maximum(np.abs(row[receiver] - row), np.abs(col[receiver] - col))[inner] == 1).all()


def test_ridges_have_long_valleys_and_few_pits():
    """Rivers carve the ridges: unlike noise, they have almost no pits, and the drainage area concentrates in streams."""
    heights = generated_heights("ridges", (4000, 4000), 20, 750, seed=3).astype(float)
    inner = heights[1:-1, 1:-1]
    neighbours = np.stack([heights[1 + a : 200 + a, 1 + b : 200 + b] for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b])
    pits = (inner < neighbours.min(axis=0)).mean()
    order, receiver = drainage(heights)
    area = np.ones(heights.size)
    for cell in order[::-1]:
        if receiver[cell] != cell:
            area[receiver[cell]] += area[cell]
    assert pits < 0.002
    assert area.max() > 0.05 * heights.size
    slope = np.hypot(*np.gradient(heights, 20.0))
    assert 15 < np.degrees(np.arctan(np.median(slope))) < 50


@pytest.mark.parametrize("seed", range(4))
def test_landscape_has_a_lake_gentle_ground_and_peaks(seed):
    heights = generated_heights("landscape", (7000, 7000), 100, 600, seed)
    assert heights.shape == (71, 71)  # 9,800 triangles
    lakes, _ = label(heights == 0.0)
    assert 0.01 < np.bincount(lakes.ravel())[1:].max() / heights.size <= 0.06
    assert np.median(heights) < 250 and (heights > 400).mean() < 0.15
