"""The whole of a raster, coarsely: what reach and relief are read from. And which overviews a file needs for that.

The highest ground of a cell is what casts far shadows: a mean over kilometres knows nothing of a peak. Rasters of up to
``EXACT_HIGH_CELLS`` cells are read cell by cell; of larger ones as many means are read, so that a peak is smoothed over a few cells
of the raster and not over hundreds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skugga.terrain.errors import SourceError, printable
from skugga.terrain.ground.open_raster import EXACT_HIGH_CELLS

OVERVIEW_CELLS = 512
"""Longest side of the overview that reach and relief are read from."""

MOST_CELLS_READ = 1_000_000_000
"""Cells that are read for that overview where the file has none near it: some ten seconds, and as many for a zoomed-out tile."""

LARGEST_STEP = 4
"""How many times coarser a file's next overview may be: a coarse window then reads 16 cells for one."""

FINE_LEVEL, MOST_FINE_CELLS = 5, 16_000_000
"""The level of which the highest ground is kept besides that of a coarser overview, or the finest of so many cells."""

MEANS_ROWS = 64
"""Rows of means that are read at a time where a large raster's highest ground is looked for."""


@dataclass(frozen=True, eq=False)
class Overview:
    """The whole raster, coarsely: (m, n) cells of 2**level raster cells a side, NaN in holes.

    ``heights_m`` are means; ``high_m`` is the highest ground of each cell (for rasters over ``EXACT_HIGH_CELLS`` cells estimated
    from about as many finer means: the highest of a mean's neighbourhood plus half its range). ``lowest_m`` is the lowest ground
    of all, under water too (estimated likewise). Of a raster whose overview is coarser than ``FINE_LEVEL``, ``fine_high_m`` is the
    highest ground of the cells of ``fine_level``, as many as lie in the overview's; else ``None``.
    """

    heights_m: np.ndarray
    high_m: np.ndarray
    level: int
    lowest_m: float
    fine_high_m: np.ndarray | None = None
    fine_level: int = 0


class LevelReader(Protocol):
    """Ground of a raster by levels, each of cells of 2**level raster cells a side."""

    def level_shape(self, level: int) -> tuple[int, int]:
        """Whole cells of a level: rows, columns."""
        ...

    def read(self, level: int, row0: int, row1: int, col0: int, col1: int) -> np.ndarray:
        """Heights of a window of a level's cells, metres, NaN in holes: until ``settle`` those of single cells, then means."""
        ...

    def settle(self) -> None:
        """Means from now on, unless what was read makes them wrong."""
        ...


def overview_level(rows: int, cols: int) -> int:
    """The level of a raster's overview."""
    return max(int(np.ceil(np.log2(max(rows, cols) / OVERVIEW_CELLS))), 0)


def lacks_overviews(rows: int, cols: int, factors: Sequence[int]) -> bool:
    """Whether coarse windows of a raster whose file has overviews by these factors would read far more cells than they show."""
    if rows * cols <= EXACT_HIGH_CELLS:
        return False
    steps = [1, *sorted(factors), 2 ** overview_level(rows, cols)]
    return any(after > LARGEST_STEP * before for before, after in zip(steps, steps[1:], strict=False))


def command_for(source: str) -> str:
    """The command that makes a raster's overviews."""
    return printable(f"skugga overviews {source}")


def check_overviews(source: str, rows: int, cols: int, factors: Sequence[int]) -> None:
    """Raise ``SourceError`` for a raster of which too much would be read for its overview; it names the command that helps."""
    level = overview_level(rows, cols)
    ready = max((factor for factor in factors if factor <= 2**level), default=1)
    if rows * cols > MOST_CELLS_READ * ready**2:
        had = f"{cols} x {rows} cells and no overview of them" if ready == 1 else f"overviews of {ready} cells at most"
        needed = f"overviews of a raster of more than {MOST_CELLS_READ / 1e6:,.0f} million cells"
        raise SourceError(source, had, f"{needed}; '{command_for(source)}' makes them beside it, as does gdaladdo")


def read_overview(ground: LevelReader, rows: int, cols: int) -> Overview:
    """The overview of a raster's ground, without its water. It settles how coarser levels are read (``LevelReader.settle``)."""
    level = overview_level(rows, cols)
    shape = ground.level_shape(level)
    if level == 0:
        single = ground.read(level, 0, shape[0], 0, shape[1])
        ground.settle()
        return Overview(single, single, level, _lowest(single))
    if rows * cols > EXACT_HIGH_CELLS:
        ground.read(level, 0, shape[0], 0, shape[1])  # single cells: is there a sentinel among them?
        ground.settle()
        kept = max(_finest_level(rows, cols, level, MOST_FINE_CELLS), min(FINE_LEVEL, level))
        fine, lowest_m = _estimated_high(ground, kept, _finest_level(rows, cols, kept, EXACT_HIGH_CELLS), level)
        high = _highest_below(fine, 2 ** (level - kept))
        means = ground.read(level, 0, shape[0], 0, shape[1])
        return Overview(means, high, level, lowest_m, *((fine, kept) if kept < level else ()))
    high, lowest_m = _exact_high(ground, level, rows, cols)
    ground.settle()
    return Overview(ground.read(level, 0, shape[0], 0, shape[1]), high, level, lowest_m)


def _exact_high(ground: LevelReader, level: int, rows: int, cols: int) -> tuple[np.ndarray, float]:
    """The highest ground of a level's cells, and the lowest of all, from the raster's own."""
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
    """The finest level of at most so many cells, up to one that there is."""
    return next((finer for finer in range(level) if (rows >> finer) * (cols >> finer) <= most), level)


def _estimated_high(ground: LevelReader, kept: int, finer: int, level: int) -> tuple[np.ndarray, float]:
    """The highest ground of the cells of the level ``kept`` that lie in whole ones of the coarser ``level``, and the lowest of all,
    from the means of a ``finer`` level: ground varies within a cell about as it does from cell to cell.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    per, rows = 2 ** (kept - finer), ground.level_shape(finer)[0]
    m, n = (count * 2 ** (level - kept) for count in ground.level_shape(level))
    high, lowest_m = np.full((m, n), np.nan, np.float32), np.nan
    count = max(MEANS_ROWS // per, 1)
    for first in range(0, m, count):
        last = min(first + count, m)
        top, bottom = max(first * per - 1, 0), min(last * per + 1, rows)
        mean = ground.read(finer, top, bottom, 0, ground.level_shape(finer)[1])
        above = maximum_filter(np.nan_to_num(mean, nan=-np.inf), size=3, mode="nearest")
        below = minimum_filter(np.nan_to_num(mean, nan=np.inf), size=3, mode="nearest")
        half_range = np.where(np.isfinite(above), above - below, 0.0) / 2
        own = slice(first * per - top, last * per - top), slice(0, n * per)
        high[first:last] = _highest_below((above + half_range)[own], per)
        lowest_m = float(np.fmin(lowest_m, _lowest(np.where(np.isfinite(below), below - half_range, np.nan))))
    return high, lowest_m


def _highest_below(high_m: np.ndarray, per: int) -> np.ndarray:
    """The highest of each ``per`` x ``per`` cells, NaN where none is finite."""
    rows, cols = high_m.shape
    top = np.where(np.isfinite(high_m), high_m, -np.inf).reshape(rows // per, per, cols // per, per).max(axis=(1, 3))
    return np.where(np.isfinite(top), top, np.nan).astype(np.float32)


def _lowest(height_m: np.ndarray) -> float:
    """The lowest of some heights, NaN without any."""
    return float(np.fmin.reduce(height_m, axis=None))
