"""The drop of the ground by the earth's curvature, for Python and for compiled loops."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from skugga.terrain.compiled import internal

Metres = TypeVar("Metres", float, np.ndarray)


def curvature_drop_m(distance_m: Metres, curvature_per_m: float) -> Metres:
    """Return how far level ground lies below the horizontal plane of an eye, metres.

    ``distance_m`` is the distance from the eye, and ``curvature_per_m`` is 1 over the earth's radius R, 0 in a flat world. The drop
    is d^2 / 2R, the first term of the series of R (1 - cos(d / R)): too large by 16 mm in 100 km. It is the correction for
    curvature in levelling (C. D. Ghilani and P. R. Wolf, *Elementary Surveying*), without that for refraction.
    """
    return 0.5 * curvature_per_m * distance_m * distance_m


loop_curvature_drop_m = internal(curvature_drop_m)
"""``curvature_drop_m`` for compiled loops."""
