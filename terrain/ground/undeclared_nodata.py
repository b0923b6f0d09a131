"""Detect cells that cannot be heights, although the file does not declare them as nodata.

Such cells hold undeclared sentinels (values that stand for missing data), or heights in another unit. Cells with values beyond all
heights on earth are left out as holes. A sentinel within the range of heights, such as -9999, would be drawn as a pit or a tower.
Three signs show it: it is the lowest or the highest value, many cells have it, and hardly any other value is near it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from skugga.terrain.ground.vertical import VerticalAxis
from skugga.terrain.level.level_source import option_remedy
from skugga.terrain.level.parts import METRES_PER_UNIT

SENTINELS = (
    -9999.0, -99999.0, -999.0, -32768.0, -32767.0, 9999.0, 32767.0, 65535.0, -2147483648.0, 2147483647.0,
)  # fmt: skip
"""Values that programs write for missing data."""

MIN_SENTINEL_MAGNITUDE = 1e9
"""Absolute value from which a number, such as 1e38, is a sentinel: no unit gives such heights."""

NEAR_DISTANCE_SHARE = 0.25
"""Other values count as near a sentinel within this share of its distance to their mean."""

MIN_NEAR_DISTANCE_M = 50.0
"""Distance from a sentinel, metres, within which other values always count as near.

A sentinel this close to the mean is harmless, as it looks like ground.
"""


@dataclass
class UndeclaredNodata:
    """Counts of cells that look like nodata but are not declared as such. Each cell must be added once.

    Attributes
    ----------
    cell_count
        Number of cells read.
    has_implausible
        Whether any undeclared cell cannot be a height, including cells that are not finite.
    implausible_count
        Number of undeclared finite cells that are neither plausible heights nor known sentinels.
    min_implausible_m, max_implausible_m
        Lowest and highest height of the cells that ``implausible_count`` counts, metres.
    """

    cell_count: int = 0
    has_implausible: bool = False
    implausible_count: int = 0
    min_implausible_m: float = np.inf
    max_implausible_m: float = -np.inf
    _implausible_sentinels: Counter[float] = field(default_factory=Counter)
    _plausible_sentinels: Counter[float] = field(default_factory=Counter)
    _near_counts: Counter[float] = field(default_factory=Counter)
    _implausible_value: float = np.nan

    def add(self, stored_values: np.ndarray, height_m: np.ndarray, is_nodata: np.ndarray, is_plausible: np.ndarray) -> None:
        """Count cells, given as stored values, heights in metres, and two masks: declared empty, and plausible as heights."""
        self.cell_count += stored_values.size
        has_height = is_plausible & ~is_nodata
        if not (is_nodata | is_plausible).all():
            self.has_implausible = True
            self._add_implausible(stored_values, height_m, ~is_nodata & ~is_plausible & np.isfinite(height_m))
        if has_height.any():
            heights = stored_values if has_height.all() else stored_values[has_height]
            for end in {float(heights.min()), float(heights.max())} & set(SENTINELS):
                self._add_sentinel(end, stored_values, height_m, has_height)

    def _add_implausible(self, stored_values: np.ndarray, height_m: np.ndarray, is_implausible: np.ndarray) -> None:
        """Count the cells in the mask ``is_implausible``: sentinels by their values, other cells by their range of heights."""
        values = stored_values[is_implausible]
        is_sentinel = np.isin(values, SENTINELS) | (np.abs(values.astype(np.float64)) >= MIN_SENTINEL_MAGNITUDE)
        for value, count in zip(*np.unique(values[is_sentinel], return_counts=True), strict=True):
            self._implausible_sentinels[float(value)] += int(count)
        others_m = height_m[is_implausible][~is_sentinel]
        if others_m.size:
            self.implausible_count += others_m.size
            self.min_implausible_m, self.max_implausible_m = (
                min(self.min_implausible_m, float(others_m.min())),
                max(self.max_implausible_m, float(others_m.max())),
            )
            self._implausible_value = float(values[~is_sentinel][0])

    def _add_sentinel(self, value: float, stored_values: np.ndarray, height_m: np.ndarray, has_height: np.ndarray) -> None:
        """Count the cells with the plausible value ``value``, a sentinel, and the other cells whose heights are near it.

        ``has_height`` is the mask of the cells that are plausible and not declared empty.
        """
        is_sentinel = has_height & (stored_values == value)
        others_m = height_m[has_height & ~is_sentinel]
        self._plausible_sentinels[value] += int(is_sentinel.sum())
        if others_m.size:
            sentinel_m = float(height_m[is_sentinel][0])
            near_m = max(NEAR_DISTANCE_SHARE * abs(float(others_m.mean()) - sentinel_m), MIN_NEAR_DISTANCE_M)
            self._near_counts[value] += int((np.abs(others_m - sentinel_m) < near_m).sum())

    @property
    def sentinels(self) -> dict[float, int]:
        """Undeclared values that appear to mean "no height", with the number of their cells."""
        within = {value: n for value, n in self._plausible_sentinels.items() if self._near_counts[value] < n < self.cell_count}
        return {**within, **self._implausible_sentinels}

    def warnings(self, axis: VerticalAxis, except_value: float | None = None) -> tuple[str, ...]:
        """Return the warnings, each with its remedy. ``except_value`` is a value that another warning covers."""
        messages = [
            self._sentinel_warning(value, count) for value, count in sorted(self.sentinels.items()) if value != except_value
        ]
        if self.implausible_count:
            nodata_advice = (
                f"mean no data, {option_remedy('nodata', _shortest_text(self._implausible_value))}; if they "
                if self.min_implausible_m == self.max_implausible_m
                else ""
            )
            messages.append(
                f"{_percent_text(self.implausible_count, self.cell_count)} of the raster's cells have impossible heights and are "
                f"left out as holes: {self.implausible_range(axis)}. If they {nodata_advice}are in another unit, "
                f"{option_remedy('units', 'UNIT')}. UNIT is one of {', '.join(METRES_PER_UNIT)}"
            )
        return tuple(messages)

    def implausible_range(self, axis: VerticalAxis) -> str:
        """Return the range of the implausible heights, with the unit and direction of the raster's numbers, as a phrase."""
        ends = dict.fromkeys((f"{self.min_implausible_m:,.0f} m", f"{self.max_implausible_m:,.0f} m"))
        return f"{' to '.join(ends)}, read as {axis.statement}"

    def _sentinel_warning(self, value: float, count: int) -> str:
        """Return the warning about an undeclared sentinel that ``count`` cells have."""
        effect = "far from all other heights" if value in self._plausible_sentinels else "an impossible height, left out as a hole"
        value_text = _shortest_text(value)
        problem = f"{_percent_text(count, self.cell_count)} of the raster's cells are {value_text}, {effect}"
        return f"{problem}. If that means no data, {option_remedy('nodata', value_text)}"


def _percent_text(count: int, cell_count: int) -> str:
    """Return the share ``count`` / ``cell_count`` as a text in per cent."""
    return f"{100 * count / max(cell_count, 1):.3g} %"


def _shortest_text(value: float) -> str:
    """Return a cell's value with the fewest digits that identify it, such as 1e+38 for a float32."""
    if abs(value) < MIN_SENTINEL_MAGNITUDE and value.is_integer():
        return f"{value:.0f}"
    texts = (f"{value:.{digits}g}" for digits in range(1, 18))
    with np.errstate(over="ignore"):
        return next(text for text in texts if value in (float(text), float(np.float32(float(text)))))
