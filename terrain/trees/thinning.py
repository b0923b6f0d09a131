"""Thinning order of a stand (level of detail): whatever share of trees is drawn, all parts of the stand keep that share."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.trees.scatter import pair_key


def thinning_ranks(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return ranks float32 (n,) in [0, 1) for trees at plane coordinates (n,). A share k keeps the trees with ranks below k.

    - A Z-order curve (G. M. Morton 1966) sorts the trees, so that successive trees are neighbours.
    - At k = 2^-m each group of 2^m successive trees keeps exactly one. Each tree is equally likely, independently of other groups:
      a net scrambled in both of its coordinates (A. B. Owen, "Randomly permuted (t, m, s)-nets and (t, s)-sequences", 1995).
    - More even steps along the curve would leave trees in lines. Then the amount of shade, cast and visible, would depend on the
      directions of sun and view.
    """
    if not len(x_m):
        return np.zeros(0, np.float32)
    side = max(float(np.ptp(x_m)), float(np.ptp(y_m)), 1e-9)
    curve = _morton_codes(
        ((x_m - x_m.min()) / side * (2**21 - 1)).astype(np.uint64), ((y_m - y_m.min()) / side * (2**21 - 1)).astype(np.uint64)
    )
    rank = np.empty(len(x_m), np.float32)
    rank[np.argsort(curve, kind="stable")] = _scrambled_van_der_corput(len(x_m))
    return rank


@compiled
def _scrambled_van_der_corput(count):
    """Return ranks float32 (count,) of the numbers 0 to count - 1: a scrambled van der Corput sequence.

    A rank has the binary digits of its number in reverse. A hash of the number's higher digits and the rank's preceding digits
    decides whether to flip each digit. Up to 2^23 ranks are exact, so they are distinct and below 1.
    """
    digits = 0
    while 2**digits < count:
        digits += 1
    out = np.empty(count, np.float32)
    for n in range(count):
        rank = 0
        for digit in range(digits):
            flip_bit = np.int64(pair_key(digit, n >> (digit + 1), rank) & np.uint64(1))
            rank = 2 * rank + ((n >> digit) & 1 ^ flip_bit)
        out[n] = (rank + 0.5) / 2**digits
    return out


@compiled
def _morton_codes(a, b):
    """Return Morton codes uint64 (n,): the interleaved bits of ``a`` and ``b`` (n,), 21 bits each."""
    out = np.zeros(a.size, np.uint64)
    for n in range(a.size):
        for bit in range(21):
            low_bit = np.uint64(1)
            out[n] |= ((a[n] >> np.uint64(bit)) & low_bit) << np.uint64(2 * bit)
            out[n] |= ((b[n] >> np.uint64(bit)) & low_bit) << np.uint64(2 * bit + 1)
    return out
