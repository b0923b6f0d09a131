"""Trees as data: where each stands and how it looks, independent of any view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Trees:
    """The trees of a scene, one row each; the same for a seed whatever is looked at.

    Attributes
    ----------
    base_earth_m
        float64 (n, 3), the foot of the stem, earth-fixed metres.
    height_m, crown_m
        float32 (n,), height and diameter of the crown.
    turn_deg
        float32 (n,), how the crossed quads are turned about the stem, counter-clockwise from east.
    look
        uint8 (n,), index into ``skugga.terrain.trees.foliage.TREE_VARIANTS``.
    rank
        float32 (n,) in [0, 1): which trees a thinned stand keeps (those below the kept share); see
        ``skugga.terrain.trees.thinning``.
    """

    base_earth_m: np.ndarray
    height_m: np.ndarray
    crown_m: np.ndarray
    turn_deg: np.ndarray
    variant: np.ndarray
    rank: np.ndarray
