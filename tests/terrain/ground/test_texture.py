"""The texture of heightfields: closed forms, symmetries and seams."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.ground.texture import (
    EXPONENT,
    KERNEL_SCALE,
    RADIUS_NODES,
    max_texture_per_slope,
    relief_texture,
    texture_kernel,
)


def padded_grid(rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of nodes with the surroundings that the filter needs; (0, 0) is the first node of the result."""
    row, col = np.mgrid[-RADIUS_NODES : rows + RADIUS_NODES, -RADIUS_NODES : cols + RADIUS_NODES]
    return row.astype(np.float64), col.astype(np.float64)


@pytest.mark.parametrize(("wavelength", "azimuth_deg"), [(4.0, 0.0), (8.0, 30.0), (12.0, 77.0), (16.0, 45.0)])
def test_wave_is_scaled_by_its_frequency_to_the_exponent(wavelength: float, azimuth_deg: float):
    row, col = padded_grid(40, 50)
    direction = np.radians(azimuth_deg)
    wave = np.sin(2.0 * np.pi / wavelength * (np.cos(direction) * col + np.sin(direction) * row) + 0.3)
    texture = relief_texture((100.0 * wave).astype(np.float32), 0.01)
    expected = 100.0 * wave[RADIUS_NODES:-RADIUS_NODES, RADIUS_NODES:-RADIUS_NODES] * wavelength**-EXPONENT
    assert np.abs(texture - expected).max() < 0.02 * np.abs(expected).max()


def test_plane_has_no_texture():
    row, col = padded_grid(20, 30)
    assert np.abs(relief_texture((3000.0 + 0.7 * col - 0.2 * row).astype(np.float32), 2.0**-10)).max() < 1e-3


def test_ridge_is_positive_and_valley_negative():
    _, col = padded_grid(9, 41)
    ridge = relief_texture((-np.abs(col - 20.0)).astype(np.float32), 2.0**-7)
    assert ridge[4].argmax() == 20
    assert 0.5 < ridge[4, 20] < max_texture_per_slope()
    np.testing.assert_allclose(relief_texture(np.abs(col - 20.0).astype(np.float32), 2.0**-7), -ridge, atol=1e-5)


def test_bound_per_slope_holds_for_a_pit():
    """At the bottom of a pit with sides of 45 degrees all opposite nodes are as high as their distance."""
    row, col = padded_grid(3, 3)
    pit = relief_texture(np.hypot(row - 1.0, col - 1.0).astype(np.float32), 2.0**-7)
    assert 0.7 * max_texture_per_slope() < -pit[1, 1] <= max_texture_per_slope()


def test_kernel_is_symmetric_and_adds_up_to_0():
    kernel = texture_kernel()
    np.testing.assert_array_equal(kernel, kernel.T)
    np.testing.assert_array_equal(kernel, kernel[::-1])
    assert kernel.sum() == 0.0
    np.testing.assert_array_equal(kernel, np.rint(kernel))
    assert kernel.max() == kernel[RADIUS_NODES, RADIUS_NODES] < 0.5 * KERNEL_SCALE


def test_windows_agree_to_the_bit():
    """Integers are exact, so that windows of other sizes, and ground beyond the radius, change no bit. A hole is far from 0."""
    heights = np.random.default_rng(5).normal(1500.0, 200.0, (260, 330)).cumsum(axis=0).astype(np.float32) / 50.0
    heights[120:125, 200:210] = np.nan
    whole = relief_texture(heights, 30.0 / 128.0)
    halves = [relief_texture(heights[:, start:stop], 30.0 / 128.0) for start, stop in ((0, 190), (190 - 2 * RADIUS_NODES, 330))]
    np.testing.assert_array_equal(np.concatenate(halves, axis=1), whole)
    heights[:, -1] += 77.0
    np.testing.assert_array_equal(relief_texture(heights, 30.0 / 128.0)[:, : -1 - RADIUS_NODES], whole[:, : -1 - RADIUS_NODES])


def test_missing_ground_counts_as_level():
    """Half of a plain is missing: the rest has no texture; a step at its edge would have one."""
    heights = np.full((2 * RADIUS_NODES + 20, 2 * RADIUS_NODES + 20), 900.0, np.float32)
    heights[:, RADIUS_NODES + 8 :] = np.nan
    texture = relief_texture(heights, 0.1)
    assert np.isfinite(texture).all() and np.abs(texture).max() < 1e-3
    assert not relief_texture(np.full_like(heights, np.nan), 0.1).any()
