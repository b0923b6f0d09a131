"""Trees as data: positions, sizes and variants, independent of any view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Trees:
    """The n trees of a scene. They depend on the level and its seeds, not on the view.

    Attributes
    ----------
    base_earth_m
        float64 (n, 3), foot of the stem, earth-fixed metres.
    height_m, crown_diameter_m
        float32 (n,), height of the tree and diameter of its crown, metres.
    yaw_deg
        float32 (n,), rotation of the crossed quads about the stem, degrees counter-clockwise from east.
    variant
        uint8 (n,), index into ``skugga.terrain.trees.foliage.TREE_VARIANTS``.
    thinning_rank
        float32 (n,) in [0, 1), thinning order: a thinned stand keeps the trees whose rank is below the kept share
        (``skugga.terrain.trees.thinning``).
    """

    base_earth_m: np.ndarray
    height_m: np.ndarray
    crown_diameter_m: np.ndarray
    yaw_deg: np.ndarray
    variant: np.ndarray
    thinning_rank: np.ndarray
