"""Read a coarse overview of a whole raster: mean and maximum heights. Check which overviews a file needs for that.

The overview shows how far shadows may reach, and the relief. Each of its cells has a maximum, since a mean over kilometres misses
the peaks that cast far shadows. Maxima of rasters of up to ``MAX_EXACT_MAXIMA_CELLS`` cells come from all cells. Those of larger
rasters come from about that many means, so a peak is smoothed over a few raster cells, not over hundreds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skugga.terrain.errors import SourceError, printable
from skugga.terrain.ground.open_raster import MAX_EXACT_MAXIMA_CELLS

OVERVIEW_SIDE_CELLS = 512
"""Maximum length of the overview's longer side, in cells."""

MAX_CELLS_READ = 1_000_000_000
"""Maximum number of cells that are read for the overview, if the file itself has no overview of a similar resolution.

Reading them takes some ten seconds, as does reading a zoomed-out tile of such a file.
"""

MAX_OVERVIEW_FACTOR_RATIO = 4
"""Maximum ratio between the factors of successive overviews of a file. A coarse window then reads at most 16 cells for each."""

FINE_LOD, MAX_FINE_CELLS = 5, 16_000_000
"""Level of detail whose maxima are stored too, if the overview is coarser, and the maximum number of its cells.

If ``FINE_LOD`` has more cells than that, a coarser level of detail is used.
"""

MEAN_ROWS_PER_READ = 64
"""Rows of means read at a time in the search for a large raster's maxima."""


@dataclass(frozen=True, eq=False)
class Overview:
    """A whole raster at a coarse level of detail: (m, n) cells of ``2**lod`` raster cells a side, NaN in holes.

    For rasters over ``MAX_EXACT_MAXIMA_CELLS`` cells, extremes are estimated from means over fewer raster cells. The estimate of a
    maximum is the highest mean in a neighbourhood plus half the range of the means there.

    Attributes
    ----------
    mean_heights_m
        Mean heights, metres, (m, n).
    max_heights_m
        Maximum height of the ground in each cell, metres, (m, n).
    lod
        Level of detail of the cells.
    lowest_ground_m
        Minimum height of all ground, metres, also under water.
    fine_max_heights_m
        Maximum heights, metres, of the cells of level of detail ``fine_lod`` that lie within the overview's cells. ``None`` if all
        maxima are exact, or if the overview is no coarser than ``fine_lod``.
    fine_lod
        Level of detail of ``fine_max_heights_m``.
    """

    mean_heights_m: np.ndarray
    max_heights_m: np.ndarray
    lod: int
    lowest_ground_m: float
    fine_max_heights_m: np.ndarray | None = None
    fine_lod: int = 0


class LodReader(Protocol):
    """Reads the ground of a raster at a level of detail ``lod``, whose cells are ``2**lod`` raster cells a side."""

    def lod_shape(self, lod: int) -> tuple[int, int]:
        """Return the number of whole cells of a level of detail: rows, columns."""
        ...

    def read(self, lod: int, row0: int, row1: int, col0: int, col1: int) -> np.ndarray:
        """Return the heights, metres, of the cells in rows [row0, row1) and columns [col0, col1), NaN in holes.

        Before ``choose_resampling`` these are the heights of single raster cells, after it averages.
        """
        ...

    def choose_resampling(self) -> None:
        """Read averages from now on, unless the cells read so far have sentinels that would spoil them.

        A sentinel is a value that stands for missing data.
        """
        ...


def overview_lod(rows: int, cols: int) -> int:
    """Return the level of detail of a raster's overview."""
    return max(int(np.ceil(np.log2(max(rows, cols) / OVERVIEW_SIDE_CELLS))), 0)


def lacks_overviews(rows: int, cols: int, factors: Sequence[int]) -> bool:
    """Return whether coarse windows of a raster would read far more cells than they show.

    ``factors`` are those by which the file's overviews are coarser than its cells.
    """
    if rows * cols <= MAX_EXACT_MAXIMA_CELLS:
        return False
    steps = [1, *sorted(factors), 2 ** overview_lod(rows, cols)]
    return any(after > MAX_OVERVIEW_FACTOR_RATIO * before for before, after in zip(steps, steps[1:], strict=False))


def overviews_command(source: str) -> str:
    """Return the command that makes a raster's overviews."""
    return printable(f"skugga overviews {source}")


def check_overviews(source: str, rows: int, cols: int, factors: Sequence[int]) -> None:
    """Raise ``SourceError`` if a raster's overview would read too many cells. The message names the command that helps."""
    lod = overview_lod(rows, cols)
    coarsest = max((factor for factor in factors if factor <= 2**lod), default=1)
    if rows * cols > MAX_CELLS_READ * coarsest**2:
        cell_count_text = f"it has {cols} x {rows} cells and " + (
            "no overviews" if coarsest == 1 else f"no overviews that are coarser than {coarsest} cells a pixel side"
        )
        requirement = f"a raster of more than {MAX_CELLS_READ / 1e6:,.0f} million cells needs coarse overviews"
        raise SourceError(
            source, f"{cell_count_text}; {requirement}", f"Make overviews beside it with '{overviews_command(source)}' or gdaladdo"
        )


def read_overview(ground: LodReader, rows: int, cols: int) -> Overview:
    """Return the overview of a raster's ground without water.

    Calls ``LodReader.choose_resampling``, so later reads may be means.
    """
    lod = overview_lod(rows, cols)
    shape = ground.lod_shape(lod)
    if lod == 0:
        heights_m = ground.read(lod, 0, shape[0], 0, shape[1])
        ground.choose_resampling()
        return Overview(heights_m, heights_m, lod, _lowest(heights_m))
    if rows * cols > MAX_EXACT_MAXIMA_CELLS:
        ground.read(lod, 0, shape[0], 0, shape[1])  # single cells, to find undeclared sentinels
        ground.choose_resampling()
        fine_lod = max(_finest_lod(rows, cols, lod, MAX_FINE_CELLS), min(FINE_LOD, lod))
        fine_maxima_m, lowest_m = _estimated_maxima(
            ground, fine_lod, _finest_lod(rows, cols, fine_lod, MAX_EXACT_MAXIMA_CELLS), lod
        )
        high = _block_maxima(fine_maxima_m, 2 ** (lod - fine_lod), shape)
        means = ground.read(lod, 0, shape[0], 0, shape[1])
        return Overview(means, high, lod, lowest_m, *((fine_maxima_m, fine_lod) if fine_lod < lod else ()))
    high, lowest_m = _exact_maxima(ground, lod, rows, cols)
    ground.choose_resampling()
    return Overview(ground.read(lod, 0, shape[0], 0, shape[1]), high, lod, lowest_m)


def _exact_maxima(ground: LodReader, lod: int, rows: int, cols: int) -> tuple[np.ndarray, float]:
    """Return the maximum heights (m, n) in the cells of a level of detail, and the minimum of all ground, metres.

    They are exact: every cell of the raster is read. Cells of the raster beyond the last whole cell belong to the last one.
    """
    (m, n), factor = ground.lod_shape(lod), 2**lod
    high, lowest_m = np.full((m, n), np.nan, np.float32), np.nan
    for row in range(m):
        strip = ground.read(0, row * factor, rows if row == m - 1 else (row + 1) * factor, 0, cols)
        high[row] = _block_maxima(strip, factor, (1, n))[0]
        lowest_m = float(np.fmin(lowest_m, _lowest(strip)))
    return high, lowest_m


def _finest_lod(rows: int, cols: int, lod: int, max_cells: int) -> int:
    """Return the finest level of detail with at most ``max_cells`` cells, or ``lod`` if all finer ones have more."""
    return next((finer for finer in range(lod) if (rows >> finer) * (cols >> finer) <= max_cells), lod)


def _estimated_maxima(ground: LodReader, fine_lod: int, mean_lod: int, lod: int) -> tuple[np.ndarray, float]:
    """Estimate the maximum heights in cells of the level of detail ``fine_lod``, and the minimum of all ground, metres.

    The cells are those within whole cells of the coarser level of detail ``lod``. Extremes come from the means of the level of
    detail ``mean_lod``. The estimate assumes that the ground varies within a cell about as much as from cell to cell.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    block, rows = 2 ** (fine_lod - mean_lod), ground.lod_shape(mean_lod)[0]
    m, n = (count * 2 ** (lod - fine_lod) for count in ground.lod_shape(lod))
    high, lowest_m = np.full((m, n), np.nan, np.float32), np.nan
    count = max(MEAN_ROWS_PER_READ // block, 1)
    for first in range(0, m, count):
        last = min(first + count, m)
        top, bottom = max(first * block - 1, 0), rows if last == m else last * block + 1
        mean = ground.read(mean_lod, top, bottom, 0, ground.lod_shape(mean_lod)[1])
        above = maximum_filter(np.nan_to_num(mean, nan=-np.inf), size=3, mode="nearest")
        below = minimum_filter(np.nan_to_num(mean, nan=np.inf), size=3, mode="nearest")
        half_range = np.where(np.isfinite(above), above - below, 0.0) / 2
        inner = slice(first * block - top, None if last == m else last * block - top)
        high[first:last] = _block_maxima((above + half_range)[inner], block, (last - first, n))
        lowest_m = float(np.fmin(lowest_m, _lowest(np.where(np.isfinite(below), below - half_range, np.nan))))
    return high, lowest_m


def _block_maxima(heights_m: np.ndarray, block_side: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the maximum of each of (m, n) blocks of ``block_side`` x ``block_side`` cells, NaN where no cell is finite.

    The last blocks include the cells beyond them.
    """
    known = np.where(np.isfinite(heights_m), heights_m, -np.inf)
    of_rows = np.maximum.reduceat(known, np.arange(shape[0]) * block_side, axis=0)
    top = np.maximum.reduceat(of_rows, np.arange(shape[1]) * block_side, axis=1)
    return np.where(np.isfinite(top), top, np.nan).astype(np.float32)


def _lowest(height_m: np.ndarray) -> float:
    """Return the minimum of heights, NaN if all are NaN."""
    return float(np.fmin.reduce(height_m, axis=None))
