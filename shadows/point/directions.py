"""Directions from a point, sorted by azimuth, so that the directions towards an object are found without a test of all others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import internal

AZIMUTH_BINS = 3600
"""Number of bins into which azimuths are sorted. A bin is a tenth of a degree wide."""


class Directions(NamedTuple):
    """Directions sorted by azimuth.

    Attributes
    ----------
    azimuth_deg
        (n,) degrees, ascending in [0, 360).
    sine, cosine
        (n,): sine and cosine of the azimuths.
    first_in_bin
        int (AZIMUTH_BINS + 1,): the index of the first direction at or after the start of each bin.
    input_index
        int (n,): the index of each direction in the caller's order.
    """

    azimuth_deg: np.ndarray
    sine: np.ndarray
    cosine: np.ndarray
    first_in_bin: np.ndarray
    input_index: np.ndarray


def sort_directions(azimuth_deg: np.ndarray) -> Directions:
    """Sort azimuths (n,) in degrees, and return them as directions."""
    azimuth = np.asarray(azimuth_deg, np.float64) % 360.0
    order = np.argsort(azimuth, kind="stable")
    azimuth = azimuth[order]
    angle = np.radians(azimuth)
    first = np.searchsorted(azimuth, np.arange(AZIMUTH_BINS + 1) * (360.0 / AZIMUTH_BINS))
    return Directions(azimuth, np.sin(angle), np.cos(angle), first, order)


@internal
def direction_range(directions, low_deg, high_deg):
    """Return a range [begin, end) of indices that contains all directions with azimuths from ``low_deg`` to ``high_deg`` degrees.

    ``low_deg`` lies in [0, 360). The caller takes indices modulo the number of directions, since a range may include north. The
    range may contain a few directions outside of the interval.
    """
    count = len(directions.azimuth_deg)
    if high_deg - low_deg >= 360.0:
        return 0, count
    begin = directions.first_in_bin[int(low_deg * (AZIMUTH_BINS / 360.0))]
    revolutions = int(high_deg // 360.0)
    last = min(int((high_deg - 360.0 * revolutions) * (AZIMUTH_BINS / 360.0)) + 1, AZIMUTH_BINS)
    return begin, directions.first_in_bin[last] + count * revolutions
