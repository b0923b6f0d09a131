"""How a grid is turned (rotated and mirrored) so that the sun stands before row 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled

BAND_ROWS = 16
"""Rows that ``copy_values`` copies at a time between an array stored by rows and one stored by columns: few enough for the CPU's
write buffers.
"""


@dataclass(frozen=True)
class GridOrientation:
    """How a grid is turned so that the sun stands before row 0.

    Attributes
    ----------
    axes_swapped
        Whether rows and columns are swapped first.
    rows_reversed
        Whether the order of the rows is reversed then.
    cols_reversed
        Whether the order of the columns is reversed then.
    """

    axes_swapped: bool
    rows_reversed: bool
    cols_reversed: bool

    def sun_aligned_cuts(self, is_cut_nw_se: np.ndarray) -> np.ndarray:
        """Return which quads of the sun-aligned grid are cut into triangles from (i, j) to (i + 1, j + 1), bool.

        ``is_cut_nw_se`` is the same mask for the grid before turning.
        """
        return self.sun_aligned_view(is_cut_nw_se) != (self.rows_reversed != self.cols_reversed)

    def to_sun_aligned(self, row: np.ndarray, col: np.ndarray, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Convert rows and columns of a grid (``rows``, ``cols``) to those of the sun-aligned grid.

        Fractions and positions outside of the grid are allowed.
        """
        i, j, n, m = (col, row, cols, rows) if self.axes_swapped else (row, col, rows, cols)
        return (n - 1 - i if self.rows_reversed else i), (m - 1 - j if self.cols_reversed else j)

    def to_sun_aligned_in_place(self, row: np.ndarray, col: np.ndarray, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Convert as ``to_sun_aligned`` does, but overwrite ``row`` and ``col``.

        The results are these arrays, in the order of the sun-aligned grid. New memory for many points would cost more time than the
        arithmetic.
        """
        i, j, n, m = (col, row, cols, rows) if self.axes_swapped else (row, col, rows, cols)
        for is_reversed, index, last in ((self.rows_reversed, i, n - 1), (self.cols_reversed, j, m - 1)):
            if is_reversed:
                np.subtract(last, index, out=index)
        return i, j

    def from_sun_aligned(self, i: np.ndarray, j: np.ndarray, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Convert rows and columns of the sun-aligned grid to those of the grid (``rows``, ``cols``).

        This is the inverse of ``to_sun_aligned``. ``i`` and ``j`` are the rows and the columns of the sun-aligned grid.
        """
        n, m = (cols, rows) if self.axes_swapped else (rows, cols)
        i, j = (n - 1 - i if self.rows_reversed else i), (m - 1 - j if self.cols_reversed else j)
        return (j, i) if self.axes_swapped else (i, j)

    def sun_aligned_view(self, values: np.ndarray) -> np.ndarray:
        """Return a view of a grid's values (rows, cols) in the order of the sun-aligned grid."""
        return (values.T if self.axes_swapped else values)[self._index_slices]

    def grid_order_view(self, values: np.ndarray) -> np.ndarray:
        """Return a view of the sun-aligned grid's values (n, m) in the order of the grid, the inverse of ``sun_aligned_view``."""
        values = values[self._index_slices]
        return values.T if self.axes_swapped else values

    def grid_order_copy(self, values: np.ndarray, window: tuple[slice, slice]) -> np.ndarray:
        """Return a contiguous copy of a window of ``grid_order_view``."""
        view = self.grid_order_view(values)[window]
        out = np.empty(view.shape, view.dtype)
        copy_values(view, out)
        return out

    @property
    def _index_slices(self) -> tuple[slice, slice]:
        """Slices that reverse rows and columns, where needed, once the axes are swapped."""
        return slice(None, None, -1 if self.rows_reversed else 1), slice(None, None, -1 if self.cols_reversed else 1)


def orientation_towards(rows: float, cols: float) -> GridOrientation:
    """Return the orientation for a sun in the direction of ``rows`` rows down and ``cols`` columns to the right on a grid."""
    swapped = abs(cols) > abs(rows)
    main, cross = (cols, rows) if swapped else (rows, cols)
    return GridOrientation(swapped, main > 0, cross > 0)


def copy_values(values: np.ndarray, out: np.ndarray) -> None:
    """Copy values (rows, cols) to ``out``, in bands where one array is stored by rows and the other by columns."""
    along = [int(np.argmin(np.abs(array.strides))) for array in (values, out)]
    if along[0] == along[1]:
        np.copyto(out, values)
    else:
        _copy_in_bands(values, out)


@compiled
def _copy_in_bands(values, out):
    """Copy values (rows, cols) to ``out`` in bands of ``BAND_ROWS`` rows.

    Of one array a band takes that many values in sequence from each column, of the other one it follows as many rows at once.
    """
    rows, cols = values.shape
    for first in range(0, rows, BAND_ROWS):
        last = min(first + BAND_ROWS, rows)
        for c in range(cols):
            for r in range(first, last):
                out[np.uintp(r), np.uintp(c)] = values[np.uintp(r), np.uintp(c)]
