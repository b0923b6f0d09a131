"""Thinning: every part of a stand keeps the requested share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from skugga.terrain.trees.thinning import thinning_ranks

SHARES = (1 / 16, 0.1, 0.25, 0.5, 0.77, 0.95)


def z_order(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return indices along the Z-order curve of coordinates in [0, 1), with quadrants in the order SW, SE, NW, NE."""
    if len(x) <= 1 or (np.ptp(x) == 0.0 and np.ptp(y) == 0.0):
        return np.arange(len(x))
    quarter = (x >= 0.5).astype(int) + 2 * (y >= 0.5).astype(int)
    parts = []
    for number in range(4):
        members = np.flatnonzero(quarter == number)
        parts.append(members[z_order(2 * x[members] % 1.0, 2 * y[members] % 1.0)])
    return np.concatenate(parts)


def scattered(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a stand on a square of 1 km with trees in two opposite corners."""
    rng = np.random.default_rng(seed)
    x, y = rng.random((2, count)) * 1000.0
    x[:2], y[:2] = (0.0, 1000.0), (0.0, 1000.0)
    return x, y


@settings(deadline=None)  # the first call compiles
@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), max_size=60))
def test_ranks_are_distinct_shares_below_one(places):
    """Any stand, also with several trees in one position."""
    x, y = np.array(places, float).reshape(-1, 2).T
    rank = thinning_ranks(x, y)
    assert rank.shape == x.shape and rank.dtype == np.float32
    assert (rank >= 0.0).all() and (rank < 1.0).all() and len(set(rank.tolist())) == len(rank)


def test_no_rank_rounds_up_to_one():
    """Where the sequence comes closest to 1, float32 must not round up: a share of 1 still keeps the tree."""
    x, y = np.random.default_rng(1).random((2, 3_000_000))
    rank = thinning_ranks(x, y)
    assert rank.max() < 1.0 and rank.min() >= 0.0
    np.testing.assert_allclose(np.histogram(rank, 64, (0, 1))[0] / len(rank), 1 / 64, rtol=1e-3)


@pytest.mark.parametrize("digits", [1, 2, 4])
def test_each_run_of_2_to_the_m_trees_keeps_exactly_one(digits):
    """At a share of 2^-m, each aligned run of 2^m trees keeps one tree.

    Each position in the run is equally frequent, and so is each difference from the positions in the two runs before.
    """
    col, row = (v.ravel().astype(float) for v in np.meshgrid(np.arange(256), np.arange(256)))
    is_kept = (thinning_ranks(col, row)[z_order(col / 256, row / 256)] < 2.0**-digits).reshape(-1, 2**digits)
    assert (is_kept.sum(axis=1) == 1).all()
    kept_index, run_length = is_kept.argmax(axis=1), 2**digits
    for indices in (kept_index, (kept_index[1:] - kept_index[:-1]) % run_length, (kept_index[2:] - kept_index[:-2]) % run_length):
        expected = len(indices) / run_length
        assert ((np.bincount(indices, minlength=run_length) - expected) ** 2 / expected).sum() < chi2.isf(1e-6, run_length - 1)


@pytest.mark.parametrize("count", [1000, 20_000])
def test_any_run_along_the_curve_keeps_its_share(count):
    """At share k, m consecutive trees keep k m trees, with an error of at most 2 + log2(m) / 2."""
    x, y = scattered(count)
    scale = (1 - 2**-22) / 1000.0
    rank = thinning_ranks(x, y)[z_order(x * scale, y * scale)]
    for share in SHARES:
        kept_before = np.concatenate([[0], np.cumsum(rank < share)])
        for m in (1, 2, 5, 17, 100, 631, count // 2):
            error = kept_before[m:] - kept_before[:-m] - share * m
            assert np.abs(error).max() <= 2.0 + 0.5 * np.log2(m), (share, m)
            assert m == 1 or np.abs(error).max() >= 0.2  # the runs are not trivially right


@pytest.mark.parametrize("clumped", [False, True])
def test_any_window_keeps_its_share(clumped):
    """In squares at random positions, the error is much smaller than in random thinning, for even and for clumped stands."""
    rng = np.random.default_rng(7)
    if clumped:
        middles = rng.random((60, 2)) * 1000
        x, y = np.clip((middles[rng.integers(0, 60, 40_000)] + rng.normal(0, 30, (40_000, 2))).T, 0, 1000)
    else:
        x, y = scattered(40_000, 3)
    rank = thinning_ranks(x, y)
    for share in (1 / 16, 0.25, 0.5):
        errors, random_errors = [], []
        for _ in range(300):
            side = rng.uniform(100, 400)
            west, south = rng.uniform(0, 1000 - side, 2)
            inside = (x >= west) & (x < west + side) & (y >= south) & (y < south + side)
            if inside.sum() > 100:
                errors.append((rank[inside] < share).mean() - share)
                random_errors.append(np.sqrt(share * (1 - share) / inside.sum()))
        errors, random_errors = np.array(errors), np.array(random_errors)
        assert np.sqrt(np.mean((errors / random_errors) ** 2)) < 0.6
        assert np.abs(errors).max() < 0.05 and abs(errors.mean()) < 0.004


def test_every_small_plot_keeps_a_tree():
    """At a quarter of 10,000 trees, no plot of 6 x 6 trees is empty, which happens in random thinning."""
    col, row = (v.ravel().astype(float) for v in np.meshgrid(np.arange(100), np.arange(100)))
    for share, side in ((0.25, 6), (1 / 16, 12)):
        is_kept = (thinning_ranks(col, row) < share).reshape(100, 100)
        plots = np.lib.stride_tricks.sliding_window_view(is_kept, (side, side)).sum(axis=(2, 3))
        assert plots.min() >= 1 and plots.max() <= 2.2 * share * side * side


def test_stands_of_no_tree_and_of_one_tree():
    assert thinning_ranks(np.zeros(0), np.zeros(0)).shape == (0,)
    assert 0.0 <= thinning_ranks(np.array([5.0]), np.array([-3.0]))[0] < 1.0


def test_row_of_trees_is_thinned_evenly():
    """Trees along a road in any direction: no gap is longer than the spacing of a few kept trees."""
    distance = np.linspace(0.0, 5000.0, 2000)
    for x, y in ((distance, np.zeros(2000)), (np.full(2000, 7.0), -distance), (distance, distance)):
        kept_indices = np.flatnonzero(thinning_ranks(x, y) < 0.25)
        assert len(kept_indices) == pytest.approx(500, abs=4) and np.diff(kept_indices).max() <= 12
