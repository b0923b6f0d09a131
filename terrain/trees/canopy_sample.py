"""A look at a raster of canopy heights before it is planted: what its cells hold, and whether they count from the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.errors import SourceError

MAX_HEIGHT_M = 150.0
"""Canopy above is none."""

GIANT_HEIGHT_M = 80.0
"""Single trees grow higher than this (the highest one to 116 m), but not most of a wood."""

TREE_HEIGHT_M, SHRUB_HEIGHT_M = 2.0, 0.5
"""Canopy from which cells are trees, and hedges or vines, where the level names no other height."""

LOW_SHARE = 0.5
"""A canopy of which more than this share of the cells with trees or shrubs are shrubs is low: undergrowth is less."""

MAX_SHRUBS = 1_000_000
"""More shrubs than this are left out, where the level does not ask for them."""

SURFACE_ABOVE_M = (-5.0, 100.0)
"""Heights above the sea lie so far above the ground, at least nearly everywhere (``SURFACE_SHARE``)."""

SURFACE_SHARE = 0.95

RISING_M, RISE = 3.0, (0.7, 1.3)
"""Where the ground's heights vary by this (standard deviation), heights above the sea rise with it, metre by metre."""

LEAST_ABOVE_SEA_M = 30.0
"""On flatter ground 95 of 100 cells have to be higher than this: there are gaps in all canopies, and shrubs in them."""

MIN_PLACES = 20
"""Cells that have to be known to tell heights above the sea."""


@dataclass(frozen=True)
class CanopyCells:
    """Shares of a canopy's cells, 0 to 1.

    Attributes
    ----------
    unknown
        Without a height.
    bare
        Lower than ``SHRUB_HEIGHT_M``.
    low
        From there to ``TREE_HEIGHT_M``.
    tall
        From there to ``MAX_HEIGHT_M``.
    absurd
        Higher than that.
    giant
        Higher than ``GIANT_HEIGHT_M``, absurd ones among them.
    """

    unknown: float
    bare: float
    low: float
    tall: float
    absurd: float
    giant: float

    @property
    def is_mostly_giant(self) -> bool:
        """Whether most cells with trees are higher than woods are: in another unit, as decimetres."""
        return self.giant > self.tall + self.absurd - self.giant

    @property
    def is_low(self) -> bool:
        """Whether shrubs are more than the undergrowth of trees."""
        return self.low > LOW_SHARE * (self.low + self.tall)

    def left_out(self, least_m: float) -> str:
        """Which cells bear nothing, in words."""
        shares = {
            f"lower than {SHRUB_HEIGHT_M:g} m": self.bare,
            f"of {SHRUB_HEIGHT_M:g} m to {TREE_HEIGHT_M:g} m (least_height takes them)": self.low
            if least_m == TREE_HEIGHT_M
            else 0.0,
            "without a height": self.unknown,
            f"higher than {MAX_HEIGHT_M:g} m": self.absurd,
        }
        said = [f"{100.0 * share:.3g} % {why}" for why, share in shares.items() if share]
        return ", ".join([*said, *([] if least_m in (SHRUB_HEIGHT_M, TREE_HEIGHT_M) else [f"all lower than {least_m:g} m"])])


def cells_of(heights_m: np.ndarray) -> CanopyCells:
    """Return the shares of heights (n,), NaN where there are none."""
    edges = (heights_m < SHRUB_HEIGHT_M, heights_m < TREE_HEIGHT_M, heights_m <= MAX_HEIGHT_M, heights_m > MAX_HEIGHT_M)
    unknown, *upto = (float(np.mean(each)) for each in (np.isnan(heights_m), *edges))
    giant = float(np.mean(heights_m > GIANT_HEIGHT_M))
    return CanopyCells(unknown, upto[0], upto[1] - upto[0], upto[2] - upto[1], upto[3], giant)


def check_above_ground(source: str, heights_m: np.ndarray, ground_m: np.ndarray) -> None:
    """Raise ``SourceError`` for a canopy's heights (n,) that count from the sea, as those of the ground (n,) at its cells do."""
    known = np.isfinite(heights_m) & np.isfinite(ground_m)
    if known.sum() < MIN_PLACES:
        return
    heights_m, ground_m = heights_m[known], ground_m[known]
    above_m = heights_m - ground_m
    share = np.mean((above_m >= SURFACE_ABOVE_M[0]) & (above_m <= SURFACE_ABOVE_M[1]))
    if share < SURFACE_SHARE:
        return
    if np.std(ground_m) >= RISING_M:
        rise = np.cov(ground_m, heights_m)[0, 1] / np.var(ground_m, ddof=1)
        above_sea = RISE[0] <= rise <= RISE[1]
    else:
        above_sea = np.percentile(heights_m, 5.0) >= LEAST_ABOVE_SEA_M
    if above_sea:
        low, high = np.percentile(above_m, [5.0, 95.0])
        said = f"heights above the sea: they lie {low:.0f} to {high:.0f} m above the terrain's own"
        raise SourceError(source, said, "heights above ground: the canopy's surface less the ground")
