"""The order in which a stand is thinned out: whatever share is kept, every part of the stand keeps it."""

from __future__ import annotations

import numpy as np

from terrain.compiled import compiled

GOLDEN = 0.6180339887498949


def thinning_ranks(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Ranks (n,) float32 in [0, 1) for trees at plane coordinates (n,): those below k are kept when a share k is.

    Trees are taken along a Z-order curve (G. M. Morton 1966), so that those that follow one another are neighbours, and get
    the multiples of the golden ratio: of any m in succession the share with a rank below k is k to within a few m-ths.
    """
    if not len(x_m):
        return np.zeros(0, np.float32)
    side = max(float(np.ptp(x_m)), float(np.ptp(y_m)), 1e-9)
    curve = _morton(
        ((x_m - x_m.min()) / side * (2**21 - 1)).astype(np.uint64), ((y_m - y_m.min()) / side * (2**21 - 1)).astype(np.uint64)
    )
    rank = np.empty(len(x_m))
    rank[np.argsort(curve, kind="stable")] = (np.arange(len(x_m)) + 0.5) * GOLDEN % 1.0
    return np.minimum(rank.astype(np.float32), np.nextafter(np.float32(1.0), np.float32(0.0)))


@compiled
def _morton(a, b):  # type: ignore[no-untyped-def]
    """Numbers whose bits are those of a and b in turn (21 bits each)."""
    out = np.zeros(a.size, np.uint64)
    for n in range(a.size):
        for bit in range(21):
            one = np.uint64(1)
            out[n] |= ((a[n] >> np.uint64(bit)) & one) << np.uint64(2 * bit)
            out[n] |= ((b[n] >> np.uint64(bit)) & one) << np.uint64(2 * bit + 1)
    return out
