"""Interpolation functions: equal results for arrays and in compiled loops."""

import numpy as np
import pytest

from skugga.terrain.compiled import compiled
from skugga.terrain.interpolation import bilinear, smoothstep
from skugga.terrain.interpolation_loops import blend_corners, cell_interval, lerp_corners, smoothstep_value


@compiled
def _smooth_all(shares, out):
    """Write the smoothstep of shares (n,) to ``out``."""
    for n in range(shares.size):
        out[n] = smoothstep_value(shares[n])


@compiled
def _look_up_all(values, row, col, by_steps, out):
    """Write interpolated values at fractional rows and columns (n,) to ``out``, in steps or in one call."""
    rows, cols = values.shape
    for n in range(row.size):
        r0, r1, row_share = cell_interval(row[n], rows)
        c0, c1, col_share = cell_interval(col[n], cols)
        corners = values[r0, c0], values[r0, c1], values[r1, c0], values[r1, c1]
        if by_steps:
            out[n] = lerp_corners(corners[0], corners[1], corners[2], corners[3], row_share, col_share)
        else:
            out[n] = blend_corners(corners[0], corners[1], corners[2], corners[3], row_share, col_share)


def test_smoothstep_is_flat_at_both_ends_and_clamped():
    np.testing.assert_array_equal(smoothstep(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0.0, 0.0, 0.5, 1.0, 1.0])
    assert smoothstep(0.25) == 0.15625


def test_smoothstep_of_arrays_and_loops_is_equal_bit_for_bit():
    shares = np.random.default_rng(1).uniform(-0.5, 1.5, 1000)
    out = np.empty_like(shares)
    _smooth_all(shares, out)
    np.testing.assert_array_equal(out, smoothstep(shares))


@pytest.mark.parametrize("shape", [(5, 7), (1, 7), (5, 1), (1, 1)])
def test_bilinear_of_arrays_and_loops_agree(shape):
    rng = np.random.default_rng(2)
    values = rng.uniform(-100.0, 4000.0, shape).astype(np.float32)
    row, col = (rng.uniform(0.0, 1.0, 500) * (size - 1) for size in shape)
    row[:2], col[:2] = (0, shape[0] - 1), (0, shape[1] - 1)
    expected, blended, interpolated = bilinear(values, row, col), np.empty(500), np.empty(500)
    _look_up_all(values, row, col, False, blended)
    _look_up_all(values, row, col, True, interpolated)
    np.testing.assert_array_equal(blended, expected)
    # Differences of float32 corners up to 4,000 are exact to half a unit in the last place, 2.4e-4 / 2, in each of three steps.
    np.testing.assert_allclose(interpolated, expected, rtol=0.0, atol=1e-3)
    assert expected[0] == values[0, 0] and expected[1] == values[-1, -1]


def test_bilinear_reproduces_a_plane():
    row, col = np.random.default_rng(3).uniform(0.0, 1.0, (2, 200)) * [[4.0], [6.0]]
    plane = 2.0 * np.arange(5.0)[:, None] + 3.0 * np.arange(7.0)
    blended, interpolated = np.empty(200), np.empty(200)
    _look_up_all(plane, row, col, False, blended)
    _look_up_all(plane, row, col, True, interpolated)
    for values in (bilinear(plane, row, col), blended, interpolated):
        np.testing.assert_allclose(values, 2.0 * row + 3.0 * col, rtol=0.0, atol=1e-12)


def test_bilinear_uses_the_layer_of_each_point():
    layers = np.arange(12.0).reshape(3, 2, 2)
    values = bilinear(layers, np.array([0.5, 0.5]), np.array([0.5, 0.5]), np.array([0, 2]))
    np.testing.assert_array_equal(values, [1.5, 9.5])
