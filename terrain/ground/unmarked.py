"""Cells that can be no heights although nothing marks them: sentinels that a file does not declare, and heights in another unit.

Whatever is beyond all heights on earth is left out. A sentinel within them, as -9999, is ground to what draws it: a pit or a tower.
It gives itself away: it is the lowest or the highest value, the cells that have it are many, and hardly any others lie near it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from skugga.terrain.ground.vertical import VerticalAxis
from skugga.terrain.level.level_source import remedy
from skugga.terrain.level.parts import METRES_PER_UNIT

SENTINELS = (
    -9999.0, -99999.0, -999.0, -32768.0, -32767.0, 9999.0, 32767.0, 65535.0, -2147483648.0, 2147483647.0,
)  # fmt: skip
"""Values by which programs say that there is none."""

HUGE = 1e9
"""No number of any unit of heights: what is greater is a sentinel, as 1e38."""

NEAR_SHARE = 0.25
"""What lies nearer to a sentinel than this share of its distance to the mean of the others counts as its like."""

LEAST_DISTANCE_M = 50.0
"""From that mean: a sentinel that is no farther does no harm that could be told from ground."""


@dataclass
class UnmarkedCells:
    """A tally of the cells of a raster, read once.

    Attributes
    ----------
    cells
        How many were read.
    any_beyond
        Whether any of them, unmarked, can be no height, be it not finite.
    beyond
        How many are finite, no heights, and no known sentinels.
    low_m, high_m
        The lowest and the highest of these, metres.
    """

    cells: int = 0
    any_beyond: bool = False
    beyond: int = 0
    low_m: float = np.inf
    high_m: float = -np.inf
    _sentinels: Counter[float] = field(default_factory=Counter)
    _alike: Counter[float] = field(default_factory=Counter)
    _near: Counter[float] = field(default_factory=Counter)
    _value_beyond: float = np.nan

    def add(self, stored: np.ndarray, height_m: np.ndarray, marked: np.ndarray, plausible: np.ndarray) -> None:
        """Count some cells as the file has them: their heights, which of them are marked empty, and which can be heights."""
        self.cells += stored.size
        known = plausible & ~marked
        if not (marked | plausible).all():
            self.any_beyond = True
            self._add_beyond(stored, height_m, ~marked & ~plausible & np.isfinite(height_m))
        if known.any():
            heights = stored if known.all() else stored[known]
            for end in {float(heights.min()), float(heights.max())} & set(SENTINELS):
                self._add_alike(end, stored, height_m, known)

    def _add_beyond(self, stored: np.ndarray, height_m: np.ndarray, beyond: np.ndarray) -> None:
        values = stored[beyond]
        is_sentinel = np.isin(values, SENTINELS) | (np.abs(values.astype(np.float64)) >= HUGE)
        for value, count in zip(*np.unique(values[is_sentinel], return_counts=True), strict=True):
            self._sentinels[float(value)] += int(count)
        others_m = height_m[beyond][~is_sentinel]
        if others_m.size:
            self.beyond += others_m.size
            self.low_m, self.high_m = min(self.low_m, float(others_m.min())), max(self.high_m, float(others_m.max()))
            self._value_beyond = float(values[~is_sentinel][0])

    def _add_alike(self, value: float, stored: np.ndarray, height_m: np.ndarray, known: np.ndarray) -> None:
        alike = known & (stored == value)
        others_m = height_m[known & ~alike]
        self._alike[value] += int(alike.sum())
        if others_m.size:
            own_m = float(height_m[alike][0])
            near_m = max(NEAR_SHARE * abs(float(others_m.mean()) - own_m), LEAST_DISTANCE_M)
            self._near[value] += int((np.abs(others_m - own_m) < near_m).sum())

    @property
    def sentinels(self) -> dict[float, int]:
        """Values that seem to mean no height, and that nothing declares, with how many cells have them."""
        within = {value: n for value, n in self._alike.items() if self._near[value] < n < self.cells}
        return {**within, **self._sentinels}

    def warnings(self, axis: VerticalAxis, but: float | None = None) -> tuple[str, ...]:
        """What is noticed and what to write, as sentences; ``but``: a value of which another warning tells."""
        said = [self._of_sentinel(value, count) for value, count in sorted(self.sentinels.items()) if value != but]
        if self.beyond:
            means = (
                f"mean no data, {remedy('nodata', _shortest(self._value_beyond))}; if they " if self.low_m == self.high_m else ""
            )
            said.append(
                f"{_share(self.beyond, self.cells)} of the raster's cells are no heights on earth and left out as holes: "
                f"{self.range_beyond(axis)}. If they {means}are in another unit, {remedy('units', 'UNIT')}, one of "
                f"{', '.join(METRES_PER_UNIT)}"
            )
        return tuple(said)

    def range_beyond(self, axis: VerticalAxis) -> str:
        """From where to where the heights lie that are none, and as what they are taken."""
        ends = dict.fromkeys((f"{self.low_m:,.0f} m", f"{self.high_m:,.0f} m"))
        return f"{' to '.join(ends)}, taken as {axis.statement}"

    def _of_sentinel(self, value: float, count: int) -> str:
        effect = "far from all other heights" if value in self._alike else "no height on earth and left out"
        stated = _shortest(value)
        what = f"{_share(count, self.cells)} of the raster's cells are {stated}, {effect}"
        return f"{what}: if that means no data, {remedy('nodata', stated)}"


def _share(count: int, cells: int) -> str:
    return f"{100 * count / max(cells, 1):.3g} %"


def _shortest(value: float) -> str:
    """The fewest digits that give a cell's value, which may be of 32 bits: 1e+38."""
    if abs(value) < HUGE and value.is_integer():
        return f"{value:.0f}"
    texts = (f"{value:.{digits}g}" for digits in range(1, 18))
    with np.errstate(over="ignore"):
        return next(text for text in texts if value in (float(text), float(np.float32(float(text)))))
