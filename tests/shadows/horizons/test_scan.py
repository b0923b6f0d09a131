"""Horizons of whole grids: against rays that are walked crossing by crossing, closed forms, and symmetries."""

import numpy as np
import pytest

from skugga.shadows.horizons import turned
from skugga.shadows.horizons.azimuths import evenly_spaced_azimuths_deg
from skugga.shadows.horizons.grid import HorizonGrid, north_up_cell
from skugga.shadows.horizons.march import write_blocks
from skugga.shadows.horizons.scan import horizon_angles_deg
from tests.shadows.horizons.walk import walked_tangent

AZIMUTHS_DEG = np.array([0.0, 17.0, 45.0, 61.0, 90.0, 123.4, 180.0, 203.0, 225.0, 287.0, 315.0, 341.0])


def rough_ground(rows, cols, seed=1):
    """Return heights (rows, cols) with steps, smooth slopes and noise of several cells, float32."""
    random = np.random.default_rng(seed)
    row, col = np.mgrid[:rows, :cols]
    smooth = 40.0 * np.sin(row / 9.0) * np.cos(col / 13.0)
    steps = 25.0 * (random.random((rows // 6 + 1, cols // 6 + 1)) > 0.7).repeat(6, 0).repeat(6, 1)[:rows, :cols]
    return (300.0 + smooth + steps + random.random((rows, cols))).astype(np.float32)


def walked_angles_deg(grid, azimuths_deg, nodes):
    """Return the walked horizon angles (azimuths, nodes) in degrees."""
    tangents = [
        [walked_tangent(grid.height_m, grid.east_north_of_cell_m, row, col, azimuth, grid.curvature_per_m) for row, col in nodes]
        for azimuth in azimuths_deg
    ]
    return np.degrees(np.arctan(tangents))


@pytest.mark.parametrize(
    ("cell", "curvature_per_m"),
    [
        (north_up_cell(30.0, 30.0), 0.0),
        (north_up_cell(12.0, 31.0), 0.0),
        (np.array([[4.0, 24.0], [-26.0, 5.0]]), 0.0),  # a grid that is turned and sheared against true north
        (north_up_cell(400.0, 300.0), 1.0 / 6371e3),
    ],
)
def test_angles_are_those_of_walked_rays(cell, curvature_per_m, monkeypatch):
    monkeypatch.setattr(turned, "MAX_CHORD_ERROR", 0.0)
    grid = HorizonGrid(rough_ground(90, 170), cell, curvature_per_m)
    nodes = [(row, col) for row in (0, 3, 45, 88, 89) for col in (0, 7, 64, 80, 127, 128, 169)]
    angles = horizon_angles_deg(grid, AZIMUTHS_DEG)
    found = np.array([[band[node] for node in nodes] for band in angles])
    np.testing.assert_allclose(found, walked_angles_deg(grid, AZIMUTHS_DEG, nodes), atol=2e-3)


def test_crossings_that_are_left_out_change_angles_by_less_than_the_bound():
    grid = HorizonGrid(rough_ground(200, 230, seed=5), north_up_cell(20.0, 20.0))
    nodes = [(row, col) for row in range(2, 200, 19) for col in range(3, 230, 19)]
    walked = walked_angles_deg(grid, AZIMUTHS_DEG[::3], nodes)
    found = np.array([[band[node] for node in nodes] for band in horizon_angles_deg(grid, AZIMUTHS_DEG[::3])])
    lost = np.where(walked > -89.0, walked - found, 0.0)
    assert lost.min() > -2e-3  # samples lie on the surface, so an angle is never too large
    assert lost.max() < np.degrees(np.arctan(turned.MAX_CHORD_ERROR))


@pytest.mark.parametrize("raster", ["bigtujunga", "essen", "quebec"])
def test_angles_of_real_ground_hold_their_accuracy(raster, data_heights):
    height_m, cell_m = data_heights(raster)
    grid = HorizonGrid(height_m, north_up_cell(cell_m, cell_m))
    random = np.random.default_rng(7)
    nodes = list(zip(*(random.integers(0, side, 120) for side in height_m.shape), strict=True))
    walked = walked_angles_deg(grid, AZIMUTHS_DEG[1::3], nodes)
    found = np.array([[band[node] for node in nodes] for band in horizon_angles_deg(grid, AZIMUTHS_DEG[1::3])])
    wrong = np.abs(walked - found)[walked > -89.0]
    assert wrong.mean() < 0.05
    assert np.mean(wrong < 0.3) > 0.99


def test_the_eight_turns_of_a_grid_have_the_same_angles(monkeypatch):
    monkeypatch.setattr(turned, "MAX_CHORD_ERROR", 0.0)  # blocks begin elsewhere on a turned grid
    height_m = rough_ground(70, 150, seed=3)
    plain = horizon_angles_deg(HorizonGrid(height_m, north_up_cell(30.0, 30.0)), evenly_spaced_azimuths_deg(8))
    for mirrored in (False, True):
        for turns in range(4):
            turned_m = np.rot90(height_m[:, ::-1] if mirrored else height_m, turns)  # counterclockwise, by 90 degrees each
            numbers = (np.arange(8) * (-1 if mirrored else 1) - 2 * turns) % 8
            bands = horizon_angles_deg(HorizonGrid(turned_m, north_up_cell(30.0, 30.0)), evenly_spaced_azimuths_deg(8))
            for number in range(8):
                expected = np.rot90(plain[number][:, ::-1] if mirrored else plain[number], turns)
                np.testing.assert_allclose(bands[numbers[number]], expected, atol=1e-4)


def test_a_tower_far_away_forms_the_horizon():
    height_m = np.zeros((3, 5000), np.float32)
    height_m[:, 4990] = 500.0
    angles = horizon_angles_deg(HorizonGrid(height_m, north_up_cell(30.0, 30.0)), np.array([90.0]))[0]
    np.testing.assert_allclose(angles[1, 10], np.degrees(np.arctan(500.0 / (30.0 * 4980))), atol=1e-4)


def test_the_level_falls_with_the_curvature():
    height_m = np.full((2, 3000), 100.0, np.float32)
    grid = HorizonGrid(height_m, north_up_cell(30.0, 30.0), 1.0 / 6.4e6)
    angles = horizon_angles_deg(grid, np.array([90.0]))[0]
    np.testing.assert_allclose(angles[0, 0], -np.degrees(30.0 / 2.0 / 6.4e6), rtol=1e-4)  # the next node is the highest


def test_nodes_without_ground_hide_nothing_and_have_no_angle():
    height_m = np.zeros((5, 40), np.float32)
    height_m[:, 20] = 90.0
    height_m[:, 30] = np.nan
    angles = horizon_angles_deg(HorizonGrid(height_m, north_up_cell(10.0, 10.0)), np.array([270.0, 90.0]))
    assert np.isnan(angles[:, :, 30]).all()
    np.testing.assert_allclose(angles[0, 2, 29], 45.0, atol=1e-4)
    assert angles[1, 2, 39] == -90.0
    np.testing.assert_allclose(angles[1, 2, 29], 0.0, atol=1e-4)  # beyond the hole


def test_roughness_bounds_the_ground_above_a_chord():
    height_m = np.full((9, 192), 0.0, np.float32)
    height_m[3, 5] = 8.0  # a quad's twist is 8, a row's bend 16
    highest_m, roughness_m = np.empty((2, 6), np.float32), np.empty((2, 6), np.float32)
    write_blocks(0, 2, height_m, highest_m, roughness_m)
    assert highest_m[0, 0] == 8.0 and np.count_nonzero(highest_m) == 1
    assert roughness_m[0, 0] == 0.25 * 8.0 + 0.125 * 16.0 and np.count_nonzero(roughness_m) == 1
