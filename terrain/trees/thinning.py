"""The order in which a stand is thinned out: whatever share is kept, every part of the stand keeps it."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.trees.scatter import pair_key


def thinning_ranks(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Ranks (n,) float32 in [0, 1) for trees at plane coordinates (n,): those below k are kept when a share k is.

    Trees are taken along a Z-order curve (G. M. Morton 1966), so that those that follow one another are neighbours. Of every
    2^m trees in turn exactly one is kept at k = 2^-m, each as likely as the others and whatever is kept beside them: a net
    scrambled in both of its coordinates (A. B. Owen, "Randomly permuted (t, m, s)-nets and (t, s)-sequences", 1995). Steps along
    the curve that are any more even leave trees in lines, and then it hangs on the directions of sun and view how much shade is
    thrown and seen.
    """
    if not len(x_m):
        return np.zeros(0, np.float32)
    side = max(float(np.ptp(x_m)), float(np.ptp(y_m)), 1e-9)
    curve = _morton(
        ((x_m - x_m.min()) / side * (2**21 - 1)).astype(np.uint64), ((y_m - y_m.min()) / side * (2**21 - 1)).astype(np.uint64)
    )
    rank = np.empty(len(x_m), np.float32)
    rank[np.argsort(curve, kind="stable")] = _scrambled(len(x_m))
    return rank


@compiled
def _scrambled(count):
    """Ranks (count,) float32 of numbers in turn: their binary digits in reverse, each turned over or not by a hash of the higher
    digits of the number and of those of the rank before it. Up to 2^23 of them are exact, and so are below 1 and all different.
    """
    digits = 0
    while 2**digits < count:
        digits += 1
    out = np.empty(count, np.float32)
    for n in range(count):
        rank = 0
        for digit in range(digits):
            turned = np.int64(pair_key(digit, n >> (digit + 1), rank) & np.uint64(1))
            rank = 2 * rank + ((n >> digit) & 1 ^ turned)
        out[n] = (rank + 0.5) / 2**digits
    return out


@compiled
def _morton(a, b):
    """Numbers whose bits are those of a and b in turn (21 bits each)."""
    out = np.zeros(a.size, np.uint64)
    for n in range(a.size):
        for bit in range(21):
            one = np.uint64(1)
            out[n] |= ((a[n] >> np.uint64(bit)) & one) << np.uint64(2 * bit)
            out[n] |= ((b[n] >> np.uint64(bit)) & one) << np.uint64(2 * bit + 1)
    return out
