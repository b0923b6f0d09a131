"""Collars: cells round the data that mean nothing, and that the file does not declare, as the zeros that warping leaves behind.

A collar is one value, as 0 or -9999, in connected cells at the raster's border. So are the sea, lakes and dammed rivers. What tells
them apart is how the ground meets them. A shore is where ground comes down to the water: across it heights change about as much
as they do one cell farther inland. A collar is cut through ground of any height: across its rim heights change by far more, and
the ground that is cut stands about as high above the value as all the ground does. So a value is taken for a collar's where

* it fills at least ``BORDER_SHARE`` of the border's cells (``HIGH_BORDER_SHARE``, where it lies above the ground as no sea does);
* hardly any ground lies on its far side (``BEYOND_SHARE``), and the ground is one piece, for the most part, and not just a thing
  that stands on a plain;
* at least ``CLIFF_SHARE`` of the rim is a cliff: ``CLIFF_M`` high, and ``CLIFF_STEPS`` times the step behind it;
* and those cliffs are at least ``CUT_SHARE`` as high as the ground usually stands above the value, as no quay nor dam is.

The rule was found by measuring. Of collars made round nine real rasters, plain, hills, coastal towns and mountains, the rim was
cliffs for 31 to 100 %; of coasts from 7 m to 1 degree a cell, of lakes and of rivers for 15 % at most. It misses collars less than
``CLIFF_M`` below the ground, where nearly all ground at the rim lies at sea level, and where most of a raster is collar. It would
take a long ice front, or a coast of cliffs by far, for one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.level_source import remedy

BORDER_SHARE, HIGH_BORDER_SHARE = 0.05, 0.25
BEYOND_SHARE = 0.05
LEAST_DATA = 0.2
"""Share of the cells that is ground, at least."""

CLIFF_M, CLIFF_STEPS = 10.0, 8.0
CLIFF_SHARE = 0.25
CUT_SHARE = 0.4

LEAST_RIM = 16
"""Places on the rim by which it can be judged."""

RIM_WINDOWS = 64
"""Windows at full detail in which the rim of a raster that is larger than its overview is looked at."""

BORDER_CELLS = 32
"""Depth of the strips along the border that are read at full detail: a thin collar is not in the overview."""

BORDER_PLACES = 4096
"""Most places along a strip that are looked at."""

_CANDIDATES = 2
_EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True)
class Collar:
    """A value that seems to mean nothing: the cells' ``value`` as the file has it, the share of the border that it fills, and the
    usual height of the cliff between it and the ground, metres.
    """

    value: float
    border_share: float
    cliff_m: float

    @property
    def warning(self) -> str:
        """What is noticed and what to write, as a sentence."""
        value = f"{self.value:.9g}"
        return (
            f"{100 * self.border_share:.0f} % of the raster's border is {value}, {self.cliff_m:.0f} m from the ground beside it: "
            f"if that means no data, {remedy('nodata', value)}"
        )


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells as the file has them (rows, cols), where they are heights, and on which sides the raster ends (top, bottom, left,
    right).
    """

    values: np.ndarray
    known: np.ndarray
    ends: tuple[bool, bool, bool, bool] = (True, True, True, True)

    def border(self, of: np.ndarray) -> np.ndarray:
        """An array's cells (n,) where the raster ends."""
        sides = of[0], of[-1], of[:, 0], of[:, -1]
        return np.concatenate([side for side, end in zip(sides, self.ends, strict=True) if end])


@dataclass(frozen=True, eq=False)
class _Region:
    """The cells of a value at the border (bool), the ground that they may surround (bool), and the share of the border."""

    cells: np.ndarray
    ground: np.ndarray
    border_share: float


def collar_of(elevation: Elevation) -> Collar | None:
    """The collar that a raster seems to have, if any. Reads its cells coarsely, and its border and the rim at full detail."""
    factor = 2**elevation.overview.level
    shape = max(elevation.rows // factor, 1), max(elevation.cols // factor, 1)
    whole = slice(0, elevation.rows), slice(0, elevation.cols)
    seen = _Cells(*elevation.stored(*whole, shape))
    unit_m = elevation.metres_per_count
    for value, region in _candidates(seen):
        across, behind = _steps(seen.values, region.cells, region.ground, value)
        if factor > 1:
            across, behind = _steps_at_full_detail(elevation, region, value, factor)
        if found := _judged(seen, region, value, across * abs(unit_m), behind * abs(unit_m), unit_m):
            return found
    if factor == 1:
        return None
    for strip in _strips(elevation):
        for value, region in _candidates(strip):
            across, behind = _steps(strip.values, region.cells, region.ground, value)
            if found := _judged(strip, region, value, across * abs(unit_m), behind * abs(unit_m), unit_m):
                return found
    return None


def _candidates(seen: _Cells) -> Iterator[tuple[np.generic, _Region]]:
    """The commonest values of the border, with their cells that hang together with it."""
    border = seen.border(seen.values)[seen.border(seen.known)]
    values, count = np.unique(border, return_counts=True)
    for index in np.argsort(count)[::-1][:_CANDIDATES]:
        if count[index] < BORDER_SHARE * max(len(seen.border(seen.known)), 1):
            return
        from scipy.ndimage import label  # a quarter of a second, which rasters without such a value need not pay

        parts, _ = label(seen.known & (seen.values == values[index]), _EIGHT)
        at_border = seen.border(parts)
        cells = np.isin(parts, np.unique(at_border[at_border > 0]))
        pieces, number = label(seen.known & ~cells)
        if number == 0:
            continue
        sizes = np.bincount(pieces.ravel())[1:]
        ground = pieces == sizes.argmax() + 1
        if sizes.max() >= sizes.sum() / 2 and sizes.max() >= LEAST_DATA * pieces.size:
            yield values[index], _Region(cells, ground, float((at_border > 0).mean()))


def _judged(
    seen: _Cells, region: _Region, value: np.generic, across_m: np.ndarray, behind_m: np.ndarray, unit_m: float
) -> Collar | None:
    """The collar, if the steps (n,) across a region's rim and behind it are those of one."""
    if len(across_m) < LEAST_RIM:
        return None
    above_m = (seen.values[region.ground].astype(np.float64) - float(value)) * unit_m
    below = bool(np.mean(above_m < 0.0) <= BEYOND_SHARE)
    if not below and (np.mean(above_m > 0.0) > BEYOND_SHARE or region.border_share < HIGH_BORDER_SHARE):
        return None
    cliff = (across_m >= CLIFF_M) & (across_m >= CLIFF_STEPS * behind_m)
    if cliff.mean() < CLIFF_SHARE:
        return None
    height_m = float(np.median(across_m[cliff]))
    if height_m < CUT_SHARE * np.median(np.abs(above_m)):
        return None
    return Collar(float(value), region.border_share, height_m)


def _steps(values: np.ndarray, cells: np.ndarray, ground: np.ndarray, value: np.generic) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n,) of the file's values across a region's rim, in all four directions, and from the first cell of ground to the
    second.
    """
    across, behind = [], []
    for turns in range(4):
        heights, inside, outside = (np.rot90(array, turns) for array in (values, cells, ground))
        rim = inside[:-2] & outside[1:-1] & outside[2:]
        first, second = heights[1:-1][rim].astype(np.float64), heights[2:][rim].astype(np.float64)
        across.append(np.abs(first - float(value)))
        behind.append(np.abs(second - first))
    return np.concatenate(across), np.concatenate(behind)


def _steps_at_full_detail(elevation: Elevation, region: _Region, value: np.generic, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """The same steps in windows along a rim that was seen in cells of ``factor`` raster cells a side."""
    rows, cols = region.cells.shape
    beside = np.zeros_like(region.cells)
    for axis in (0, 1):
        for step in (1, -1):
            beside |= np.roll(region.ground, step, axis)
    found = np.argwhere(region.cells & beside)
    across, behind = [np.empty(0)], [np.empty(0)]
    for row, col in found[:: max(len(found) // RIM_WINDOWS, 1)]:
        window = (
            slice(max(int(row) - 1, 0) * factor, min((int(row) + 2) * factor, elevation.rows)),
            slice(max(int(col) - 1, 0) * factor, min((int(col) + 2) * factor, elevation.cols)),
        )
        values, known = elevation.stored(*window)
        cells = known & (values == value)
        steps = _steps(values, cells, known & ~cells, value)
        across.append(steps[0])
        behind.append(steps[1])
    return np.concatenate(across), np.concatenate(behind)


def _strips(elevation: Elevation) -> Iterator[_Cells]:
    """The cells along the four sides, at full detail across."""
    rows, cols = elevation.shape
    deep, wide = min(BORDER_CELLS, rows), min(BORDER_CELLS, cols)
    along_row, along_col = min(cols, BORDER_PLACES), min(rows, BORDER_PLACES)
    for ends, row, col, shape in (
        ((True, False, False, False), slice(0, deep), slice(0, cols), (deep, along_row)),
        ((False, True, False, False), slice(rows - deep, rows), slice(0, cols), (deep, along_row)),
        ((False, False, True, False), slice(0, rows), slice(0, wide), (along_col, wide)),
        ((False, False, False, True), slice(0, rows), slice(cols - wide, cols), (along_col, wide)),
    ):
        yield _Cells(*elevation.stored(row, col, shape), ends)
