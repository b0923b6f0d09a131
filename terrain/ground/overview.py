"""Read a coarse overview of a whole raster, for its reach and relief, and check which overviews a file needs for that.

The maximum of a cell casts far shadows: a mean over kilometres misses peaks. Rasters of up to ``EXACT_HIGH_CELLS`` cells are read
cell by cell. Of larger ones as many means are read, so a peak is smoothed over a few raster cells, not over hundreds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skugga.terrain.errors import SourceError, printable
from skugga.terrain.ground.open_raster import EXACT_HIGH_CELLS

OVERVIEW_CELLS = 512
"""Longest side, in cells, of the overview that provides reach and relief."""

MAX_CELLS_READ = 1_000_000_000
"""Maximum cells read for that overview if the file has no overview near its level.

Reading them takes some ten seconds, and as long for a zoomed-out tile.
"""

MAX_OVERVIEW_RATIO = 4
"""Maximum ratio between successive overviews of a file: a coarse window then reads 16 cells for one."""

FINE_LEVEL, MAX_FINE_CELLS = 5, 16_000_000
"""Level whose maxima are kept besides those of a coarser overview, and the maximum cells of these.

The level is a coarser one if ``FINE_LEVEL`` itself has more cells.
"""

MEANS_ROWS = 64
"""Rows of means read at a time in the search for a large raster's maxima."""


@dataclass(frozen=True, eq=False)
class Overview:
    """A whole raster at a coarse level: (m, n) cells of 2**level raster cells a side, NaN in holes.

    For rasters over ``EXACT_HIGH_CELLS`` cells, extremes are estimated from about as many finer means: the maximum of a mean's
    neighbourhood plus half the neighbourhood's range.

    Attributes
    ----------
    heights_m
        Mean heights, metres, (m, n).
    high_m
        Maximum height of the ground in each cell, metres, (m, n).
    level
        Level of the cells.
    lowest_m
        Minimum height of all ground, metres, also under water.
    fine_high_m
        Maximum heights of the cells of ``fine_level``, metres, of those within the overview's cells; ``None`` if the overview is no
        coarser than ``FINE_LEVEL``.
    fine_level
        Level of ``fine_high_m``.
    """

    heights_m: np.ndarray
    high_m: np.ndarray
    level: int
    lowest_m: float
    fine_high_m: np.ndarray | None = None
    fine_level: int = 0


class LevelReader(Protocol):
    """Reads the ground of a raster by levels, whose cells are 2**level raster cells a side."""

    def level_shape(self, level: int) -> tuple[int, int]:
        """Return the number of whole cells of a level: rows, columns."""
        ...

    def read(self, level: int, row0: int, row1: int, col0: int, col1: int) -> np.ndarray:
        """Return heights of a window of a level's cells, metres, NaN in holes: single cells until ``settle``, means afterwards."""
        ...

    def settle(self) -> None:
        """Switch to means, unless sentinels among the cells read so far would spoil them."""
        ...


def overview_level(rows: int, cols: int) -> int:
    """Return the level of a raster's overview."""
    return max(int(np.ceil(np.log2(max(rows, cols) / OVERVIEW_CELLS))), 0)


def lacks_overviews(rows: int, cols: int, factors: Sequence[int]) -> bool:
    """Return whether coarse windows of a raster would read far more cells than they show, given the factors of its overviews."""
    if rows * cols <= EXACT_HIGH_CELLS:
        return False
    steps = [1, *sorted(factors), 2 ** overview_level(rows, cols)]
    return any(after > MAX_OVERVIEW_RATIO * before for before, after in zip(steps, steps[1:], strict=False))


def overviews_command(source: str) -> str:
    """Return the command that makes a raster's overviews."""
    return printable(f"skugga overviews {source}")


def check_overviews(source: str, rows: int, cols: int, factors: Sequence[int]) -> None:
    """Raise ``SourceError`` if a raster's overview would read too many cells. The message names the command that helps."""
    level = overview_level(rows, cols)
    coarsest = max((factor for factor in factors if factor <= 2**level), default=1)
    if rows * cols > MAX_CELLS_READ * coarsest**2:
        had = f"it has {cols} x {rows} cells and " + ("no overviews" if coarsest == 1 else f"overviews of {coarsest} cells at most")
        needed = f"a raster of more than {MAX_CELLS_READ / 1e6:,.0f} million cells needs coarse overviews"
        raise SourceError(source, f"{had}; {needed}", f"Make overviews beside it with '{overviews_command(source)}' or gdaladdo")


def read_overview(ground: LevelReader, rows: int, cols: int) -> Overview:
    """Return the overview of a raster's ground without water. Calls ``LevelReader.settle``, so later reads may be means."""
    level = overview_level(rows, cols)
    shape = ground.level_shape(level)
    if level == 0:
        single = ground.read(level, 0, shape[0], 0, shape[1])
        ground.settle()
        return Overview(single, single, level, _lowest(single))
    if rows * cols > EXACT_HIGH_CELLS:
        ground.read(level, 0, shape[0], 0, shape[1])  # single cells, to find undeclared sentinels
        ground.settle()
        fine_level = max(_finest_level(rows, cols, level, MAX_FINE_CELLS), min(FINE_LEVEL, level))
        fine, lowest_m = _estimated_maxima(ground, fine_level, _finest_level(rows, cols, fine_level, EXACT_HIGH_CELLS), level)
        high = _block_maxima(fine, 2 ** (level - fine_level))
        means = ground.read(level, 0, shape[0], 0, shape[1])
        return Overview(means, high, level, lowest_m, *((fine, fine_level) if fine_level < level else ()))
    high, lowest_m = _exact_maxima(ground, level, rows, cols)
    ground.settle()
    return Overview(ground.read(level, 0, shape[0], 0, shape[1]), high, level, lowest_m)


def _exact_maxima(ground: LevelReader, level: int, rows: int, cols: int) -> tuple[np.ndarray, float]:
    """Return the maxima (m, n) of a level's cells and the minimum of all, from the raster's own cells."""
    (m, n), factor = ground.level_shape(level), 2**level
    high, lowest_m = np.full((m, n), np.nan, np.float32), np.nan
    deep, wide = min(factor, rows), min(factor, cols)
    for row in range(m):
        strip = ground.read(0, row * deep, row * deep + deep, 0, n * wide)
        top = np.nan_to_num(strip, nan=-np.inf).reshape(deep, n, wide).max(axis=(0, 2))
        high[row] = np.where(np.isfinite(top), top, np.nan)
        lowest_m = float(np.fmin(lowest_m, _lowest(strip)))
    return high, lowest_m


def _finest_level(rows: int, cols: int, level: int, most: int) -> int:
    """Return the finest level of at most ``most`` cells, or ``level`` if all finer ones have more."""
    return next((finer for finer in range(level) if (rows >> finer) * (cols >> finer) <= most), level)


def _estimated_maxima(ground: LevelReader, fine_level: int, finer: int, level: int) -> tuple[np.ndarray, float]:
    """Estimate the maxima of cells of the level ``fine_level``, and the minimum of all ground.

    The cells are those within whole cells of the coarser ``level``. Extremes come from the means of a ``finer`` level: the ground
    varies within a cell about as much as from cell to cell.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    block, rows = 2 ** (fine_level - finer), ground.level_shape(finer)[0]
    m, n = (count * 2 ** (level - fine_level) for count in ground.level_shape(level))
    high, lowest_m = np.full((m, n), np.nan, np.float32), np.nan
    count = max(MEANS_ROWS // block, 1)
    for first in range(0, m, count):
        last = min(first + count, m)
        top, bottom = max(first * block - 1, 0), min(last * block + 1, rows)
        mean = ground.read(finer, top, bottom, 0, ground.level_shape(finer)[1])
        above = maximum_filter(np.nan_to_num(mean, nan=-np.inf), size=3, mode="nearest")
        below = minimum_filter(np.nan_to_num(mean, nan=np.inf), size=3, mode="nearest")
        half_range = np.where(np.isfinite(above), above - below, 0.0) / 2
        own = slice(first * block - top, last * block - top), slice(0, n * block)
        high[first:last] = _block_maxima((above + half_range)[own], block)
        lowest_m = float(np.fmin(lowest_m, _lowest(np.where(np.isfinite(below), below - half_range, np.nan))))
    return high, lowest_m


def _block_maxima(high_m: np.ndarray, block: int) -> np.ndarray:
    """Return the maximum of each block of ``block`` x ``block`` cells, NaN where no cell is finite."""
    rows, cols = high_m.shape
    top = np.where(np.isfinite(high_m), high_m, -np.inf).reshape(rows // block, block, cols // block, block).max(axis=(1, 3))
    return np.where(np.isfinite(top), top, np.nan).astype(np.float32)


def _lowest(height_m: np.ndarray) -> float:
    """Return the minimum of heights, NaN if all are NaN."""
    return float(np.fmin.reduce(height_m, axis=None))
