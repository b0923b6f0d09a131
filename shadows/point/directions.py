"""Directions from a point, in the order of their azimuths, so that those towards a thing are found without looking at the
others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import internal

AZIMUTH_BINS = 3600
"""Bins of azimuths, of a tenth of a degree."""


class Directions(NamedTuple):
    """Azimuths (n,) of directions, ascending in [0, 360), with their sines and cosines; the first one at or after each bin's
    beginning (``AZIMUTH_BINS`` + 1,); and the place of each among those that were given (n,).
    """

    azimuth: np.ndarray
    sine: np.ndarray
    cosine: np.ndarray
    first: np.ndarray
    given: np.ndarray


def directions_of(azimuth_deg: np.ndarray) -> Directions:
    """Azimuths (n,) in degrees, in order."""
    azimuth = np.asarray(azimuth_deg, np.float64) % 360.0
    order = np.argsort(azimuth, kind="stable")
    azimuth = azimuth[order]
    angle = np.radians(azimuth)
    first = np.searchsorted(azimuth, np.arange(AZIMUTH_BINS + 1) * (360.0 / AZIMUTH_BINS))
    return Directions(azimuth, np.sin(angle), np.cos(angle), first, order)


@internal
def ends_towards(directions, low, high):
    """The numbers [begin, end) of the directions with azimuths from ``low`` to ``high`` degrees, with low in [0, 360); numbers of
    a second turn are counted on from the first turn's. A few more may be among them.
    """
    count = len(directions.azimuth)
    if high - low >= 360.0:
        return 0, count
    begin = directions.first[int(low * (AZIMUTH_BINS / 360.0))]
    turn = int(high // 360.0)
    last = min(int((high - 360.0 * turn) * (AZIMUTH_BINS / 360.0)) + 1, AZIMUTH_BINS)
    return begin, directions.first[last] + count * turn
