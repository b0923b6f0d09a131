"""Checks of a canopy height raster before planting: shares of height classes, and whether heights count from the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.errors import SourceError

MAX_PLAUSIBLE_HEIGHT_M = 150.0
"""Upper bound of plausible canopy heights."""

MIN_GIANT_HEIGHT_M = 80.0
"""Height from which on trees are rare. The highest known tree measures 116 m."""

MIN_TREE_HEIGHT_M, MIN_SHRUB_HEIGHT_M = 2.0, 0.5
"""Minimum heights of trees, and of hedges and vines, if the level sets no minimum."""

MIN_SHRUB_SHARE = 0.5
"""Share of shrubs among the cells with trees or shrubs above which a canopy counts as mostly shrubs.

Undergrowth of trees has a smaller share.
"""

MAX_SHRUBS = 1_000_000
"""Shrubs are left out if there are more than this, unless the level sets ``least_height``."""

SURFACE_MODEL_HEIGHT_RANGE_M = (-5.0, 100.0)
"""Heights above the ground that a surface model has in at least the share ``MIN_SURFACE_MODEL_CELL_SHARE`` of its cells."""

MIN_SURFACE_MODEL_CELL_SHARE = 0.95

MIN_GROUND_STD_M, ABOVE_SEA_SLOPE_RANGE = 3.0, (0.7, 1.3)
"""Minimum standard deviation of the ground's heights for a regression, and slopes that mean heights above sea level.

Heights above sea level rise with the ground, metre by metre.
"""

MIN_ABOVE_SEA_PERCENTILE_M = 30.0
"""5th percentile of heights over flatter ground from which on they count as heights above sea level.

Heights above ground have a lower one, since all canopies have gaps with shrubs in them.
"""

MIN_TESTED_CELLS = 20
"""Minimum number of cells with a height of the canopy and of the ground for the test."""


@dataclass(frozen=True)
class HeightClassShares:
    """Shares of a canopy's cells by height class, in [0, 1].

    Attributes
    ----------
    nodata_share
        Nodata.
    bare_share
        Lower than ``MIN_SHRUB_HEIGHT_M``.
    shrub_share
        From ``MIN_SHRUB_HEIGHT_M`` to ``MIN_TREE_HEIGHT_M``.
    tree_share
        From ``MIN_TREE_HEIGHT_M`` to ``MAX_PLAUSIBLE_HEIGHT_M``.
    implausible_share
        Higher than ``MAX_PLAUSIBLE_HEIGHT_M``.
    giant_share
        Higher than ``MIN_GIANT_HEIGHT_M``, implausible heights included.
    """

    nodata_share: float
    bare_share: float
    shrub_share: float
    tree_share: float
    implausible_share: float
    giant_share: float

    @property
    def is_mostly_giant(self) -> bool:
        """Whether most cells with trees are giant: the heights are probably in another unit, such as decimetres."""
        return self.giant_share > self.tree_share + self.implausible_share - self.giant_share

    @property
    def is_mostly_shrubs(self) -> bool:
        """Whether the canopy is mostly shrubs, not only undergrowth of trees."""
        return self.shrub_share > MIN_SHRUB_SHARE * (self.shrub_share + self.tree_share)

    def omission_text(self, min_height_m: float) -> str:
        """Return a text that lists the shares of cells without trees."""
        shares = {
            f"lower than {MIN_SHRUB_HEIGHT_M:g} m": self.bare_share,
            f"of {MIN_SHRUB_HEIGHT_M:g} m to {MIN_TREE_HEIGHT_M:g} m (set least_height to include them)": self.shrub_share
            if min_height_m == MIN_TREE_HEIGHT_M
            else 0.0,
            "without a height": self.nodata_share,
            f"higher than {MAX_PLAUSIBLE_HEIGHT_M:g} m": self.implausible_share,
        }
        phrases = [f"{100.0 * share:.3g} % {condition}" for condition, share in shares.items() if share]
        return ", ".join(
            [*phrases, *([] if min_height_m in (MIN_SHRUB_HEIGHT_M, MIN_TREE_HEIGHT_M) else [f"all lower than {min_height_m:g} m"])]
        )


def height_class_shares(heights_m: np.ndarray) -> HeightClassShares:
    """Return the shares by height class of heights (n,), NaN for nodata."""
    edges = (
        heights_m < MIN_SHRUB_HEIGHT_M,
        heights_m < MIN_TREE_HEIGHT_M,
        heights_m <= MAX_PLAUSIBLE_HEIGHT_M,
        heights_m > MAX_PLAUSIBLE_HEIGHT_M,
    )
    nodata_share, *cumulative_shares = (float(np.mean(mask)) for mask in (np.isnan(heights_m), *edges))
    giant_share = float(np.mean(heights_m > MIN_GIANT_HEIGHT_M))
    return HeightClassShares(
        nodata_share,
        cumulative_shares[0],
        cumulative_shares[1] - cumulative_shares[0],
        cumulative_shares[2] - cumulative_shares[1],
        cumulative_shares[3],
        giant_share,
    )


def check_above_ground(source: str, heights_m: np.ndarray, ground_m: np.ndarray) -> None:
    """Raise ``SourceError`` if canopy heights (n,) are heights above sea level, like the ground heights (n,) at the same cells."""
    valid = np.isfinite(heights_m) & np.isfinite(ground_m)
    if valid.sum() < MIN_TESTED_CELLS:
        return
    heights_m, ground_m = heights_m[valid], ground_m[valid]
    above_m = heights_m - ground_m
    share = np.mean((above_m >= SURFACE_MODEL_HEIGHT_RANGE_M[0]) & (above_m <= SURFACE_MODEL_HEIGHT_RANGE_M[1]))
    if share < MIN_SURFACE_MODEL_CELL_SHARE:
        return
    if np.std(ground_m) >= MIN_GROUND_STD_M:
        rise = np.cov(ground_m, heights_m)[0, 1] / np.var(ground_m, ddof=1)
        is_above_sea = ABOVE_SEA_SLOPE_RANGE[0] <= rise <= ABOVE_SEA_SLOPE_RANGE[1]
    else:
        is_above_sea = np.percentile(heights_m, 5.0) >= MIN_ABOVE_SEA_PERCENTILE_M
    if is_above_sea:
        low_m, high_m = np.percentile(above_m, [5.0, 95.0])
        problem = f"it has heights above the sea, {low_m:.0f} to {high_m:.0f} m above the terrain"
        raise SourceError(source, problem, "Use heights above ground: the canopy's surface minus the ground")
