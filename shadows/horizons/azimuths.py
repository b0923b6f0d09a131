"""The azimuths towards which horizons of rasters are computed, and the kinds of sky view factors. It is quick to import."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

SkyViewKind = Literal["solid_angle", "cosine", "tilted", "openness", "negative_openness"]
"""The definitions of a sky view factor (``skugga.shadows.horizons.sky_view``)."""

SKY_VIEW_KINDS: tuple[SkyViewKind, ...] = get_args(SkyViewKind)

MIN_AZIMUTHS, MAX_AZIMUTHS, DEFAULT_AZIMUTHS = 8, 360, 72
"""Limits of the number of azimuths, and the default: one every 5 degrees."""


def evenly_spaced_azimuths_deg(count: int) -> np.ndarray:
    """Return ``count`` azimuths (count,) in degrees, evenly spaced from north, clockwise."""
    return 360.0 * np.arange(count) / count
