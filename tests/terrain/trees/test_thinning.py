"""Thinning: whatever share is kept, every part of a stand keeps it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from skugga.terrain.trees.thinning import thinning_ranks

SHARES = (1 / 16, 0.1, 0.25, 0.5, 0.77, 0.95)


def z_order(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Indices along the Z-order curve of coordinates in [0, 1), by quarters: south-west, south-east, north-west, north-east."""
    if len(x) <= 1 or (np.ptp(x) == 0.0 and np.ptp(y) == 0.0):
        return np.arange(len(x))
    quarter = (x >= 0.5).astype(int) + 2 * (y >= 0.5).astype(int)
    parts = []
    for number in range(4):
        its = np.flatnonzero(quarter == number)
        parts.append(its[z_order(2 * x[its] % 1.0, 2 * y[its] % 1.0)])
    return np.concatenate(parts)


def scattered(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A stand over a square of 1 km, its corners occupied."""
    rng = np.random.default_rng(seed)
    x, y = rng.random((2, count)) * 1000.0
    x[:2], y[:2] = (0.0, 1000.0), (0.0, 1000.0)
    return x, y


@settings(deadline=None)  # the first call compiles
@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), max_size=60))
def test_ranks_are_shares_below_one_and_all_different(places):
    """Of any stand, with trees in one place too."""
    x, y = np.array(places, float).reshape(-1, 2).T
    rank = thinning_ranks(x, y)
    assert rank.shape == x.shape and rank.dtype == np.float32
    assert (rank >= 0.0).all() and (rank < 1.0).all() and len(set(rank.tolist())) == len(rank)


def test_no_rank_rounds_up_to_one():
    """Float32 has no number between: where the sequence comes nearest to 1, a share of 1 still keeps the tree."""
    x, y = np.random.default_rng(1).random((2, 3_000_000))
    rank = thinning_ranks(x, y)
    assert rank.max() < 1.0 and rank.min() >= 0.0
    np.testing.assert_allclose(np.histogram(rank, 64, (0, 1))[0] / len(rank), 1 / 64, rtol=1e-3)


@pytest.mark.parametrize("digits", [1, 2, 4])
def test_of_every_few_trees_in_turn_one_is_kept_whichever(digits):
    """Of 2^m at a share of 2^-m; each as often as another, and no more often beside one kept in the same place of its own few."""
    col, row = (v.ravel().astype(float) for v in np.meshgrid(np.arange(256), np.arange(256)))
    kept = (thinning_ranks(col, row)[z_order(col / 256, row / 256)] < 2.0**-digits).reshape(-1, 2**digits)
    assert (kept.sum(axis=1) == 1).all()
    which, many = kept.argmax(axis=1), 2**digits
    for found in (which, (which[1:] - which[:-1]) % many, (which[2:] - which[:-2]) % many):
        expected = len(found) / many
        assert ((np.bincount(found, minlength=many) - expected) ** 2 / expected).sum() < chi2.isf(1e-6, many - 1)


@pytest.mark.parametrize("count", [1000, 20_000])
def test_any_run_along_the_curve_keeps_its_share(count):
    """Of m trees in succession k m are kept but for a few: off by no more than 2 + log2(m) / 2."""
    x, y = scattered(count)
    scale = (1 - 2**-22) / 1000.0
    rank = thinning_ranks(x, y)[z_order(x * scale, y * scale)]
    for share in SHARES:
        kept = np.concatenate([[0], np.cumsum(rank < share)])
        for m in (1, 2, 5, 17, 100, 631, count // 2):
            off = kept[m:] - kept[:-m] - share * m
            assert np.abs(off).max() <= 2.0 + 0.5 * np.log2(m), (share, m)
            assert m == 1 or np.abs(off).max() >= 0.2  # the runs are not trivially right


@pytest.mark.parametrize("clumped", [False, True])
def test_any_window_keeps_its_share(clumped):
    """Squares anywhere: off by far less than chance would be, in even stands and in clumps."""
    rng = np.random.default_rng(7)
    if clumped:
        middles = rng.random((60, 2)) * 1000
        x, y = np.clip((middles[rng.integers(0, 60, 40_000)] + rng.normal(0, 30, (40_000, 2))).T, 0, 1000)
    else:
        x, y = scattered(40_000, 3)
    rank = thinning_ranks(x, y)
    for share in (1 / 16, 0.25, 0.5):
        found, by_chance = [], []
        for _ in range(300):
            side = rng.uniform(100, 400)
            west, south = rng.uniform(0, 1000 - side, 2)
            inside = (x >= west) & (x < west + side) & (y >= south) & (y < south + side)
            if inside.sum() > 100:
                found.append((rank[inside] < share).mean() - share)
                by_chance.append(np.sqrt(share * (1 - share) / inside.sum()))
        found, by_chance = np.array(found), np.array(by_chance)
        assert np.sqrt(np.mean((found / by_chance) ** 2)) < 0.6
        assert np.abs(found).max() < 0.05 and abs(found.mean()) < 0.004


def test_every_small_plot_keeps_a_tree():
    """Of 10,000 trees a quarter is kept: no plot of 6 x 6 trees is bare, as some are by chance."""
    col, row = (v.ravel().astype(float) for v in np.meshgrid(np.arange(100), np.arange(100)))
    for share, side in ((0.25, 6), (1 / 16, 12)):
        kept = (thinning_ranks(col, row) < share).reshape(100, 100)
        plots = np.lib.stride_tricks.sliding_window_view(kept, (side, side)).sum(axis=(2, 3))
        assert plots.min() >= 1 and plots.max() <= 2.2 * share * side * side


def test_a_stand_of_none_and_of_one():
    assert thinning_ranks(np.zeros(0), np.zeros(0)).shape == (0,)
    assert 0.0 <= thinning_ranks(np.array([5.0]), np.array([-3.0]))[0] < 1.0


def test_a_row_of_trees_is_thinned_evenly():
    """Trees along a road, whichever way it runs: no gap longer than a few kept trees' distance."""
    along = np.linspace(0.0, 5000.0, 2000)
    for x, y in ((along, np.zeros(2000)), (np.full(2000, 7.0), -along), (along, along)):
        kept = np.flatnonzero(thinning_ranks(x, y) < 0.25)
        assert len(kept) == pytest.approx(500, abs=4) and np.diff(kept).max() <= 12
