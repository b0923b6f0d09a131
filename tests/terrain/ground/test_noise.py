"""Noise values: stable across versions, because ground, clouds and meadows depend on them, and equal for one place or many."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.ground.noise import noise_along, noise_at

EXPECTED_NOISE = {
    (0.25, 0.5, 1): 0.041015625,
    (-3.7, 12.1, 71): 0.23998877184000014,
    (100000.3, -199999.3, 5): -0.4696694049585789,
    (-0.01, 0.99, 1234567): 0.005000000047546749,
}


@pytest.mark.parametrize("place", EXPECTED_NOISE)
def test_noise_of_a_place_and_seed_never_changes(place):
    assert noise_at(*place) == EXPECTED_NOISE[place]


@given(st.lists(st.tuples(*[st.floats(-1e9, 1e9)] * 2), min_size=1, max_size=40), st.integers(0, 2**31))
def test_noise_along_equals_noise_at_bit_for_bit(places, seed):
    x, y = np.array(places).T.copy()
    out = np.empty(len(x))
    noise_along(x, y, seed, out)
    np.testing.assert_array_equal(out, [noise_at(*place, seed) for place in places])


def test_noise_is_zero_with_a_slope_of_a_half_to_one_at_whole_coordinates():
    x, y = (axis.ravel() for axis in np.mgrid[-6:7, -6:7].astype(float))
    node_noise, nearby_noise = np.empty(x.size), np.empty(x.size)
    noise_along(x, y, 9, node_noise)
    noise_along(x + 1e-6, y, 9, nearby_noise)
    assert not node_noise.any()
    assert (np.abs(nearby_noise) <= 1.01e-6).all() and (
        np.abs(nearby_noise) >= 0.49e-6
    ).all()  # gradients are 1 or 1/2 along an axis
