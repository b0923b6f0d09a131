"""Compiled loops of ``Elevation``: transform positions to a level of detail, and interpolate heights between its cells."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.ground.extremes import update_ranges


@compiled
def convert_to_lod(row, col, factor, rows, cols):
    """Convert rows and columns of a raster to a level of detail of ``rows`` x ``cols`` cells.

    A cell is ``factor`` raster cells a side. Returns rows and columns, NaN off the raster. Also returns their minima and maxima
    (2, 2), rows first, which are infinite if no position is on the raster. If columns wrap round the earth, ``cols`` is infinite
    and ``col`` already holds columns of the level of detail.
    """
    out_row, out_col = np.empty(row.shape), np.empty(row.shape)
    ends = np.empty((4, row.shape[1]))  # minima and maxima by column
    ends[0], ends[1], ends[2], ends[3] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(row.shape[0]):
        _row_at_lod(row[i], col[i], factor, rows, cols, out_row[i], out_col[i])
        update_ranges(out_row[i], ends[0], ends[1])
        update_ranges(out_col[i], ends[2], ends[3])
    bounds = np.empty((2, 2))
    for axis in range(2):
        bounds[axis, 0], bounds[axis, 1] = np.inf, -np.inf
        for j in range(row.shape[1]):
            bounds[axis, 0] = min(bounds[axis, 0], ends[2 * axis, j])
            bounds[axis, 1] = max(bounds[axis, 1], ends[2 * axis + 1, j])
    return out_row, out_col, bounds


# The next loops are written so that they compile to vector instructions. Comparisons with NaN are false.


@internal
def _row_at_lod(row, col, factor, rows, cols, out_row, out_col):
    """Write the rows and columns, at a level of detail, of one row of positions; NaN for positions off the raster.

    The parameters are those of ``convert_to_lod``. ``row``, ``col``, ``out_row`` and ``out_col`` are (n,).
    """
    wraps = cols == np.inf
    for j in range(out_row.size):
        r, c = (row[j] + 0.5) / factor - 0.5, col[j] if wraps else (col[j] + 0.5) / factor - 0.5
        is_inside = np.isfinite(c) & (r >= -0.5) & (r <= rows - 0.5) & (wraps | ((c >= -0.5) & (c <= cols - 0.5)))
        out_row[j], out_col[j] = r if is_inside else np.nan, c if is_inside else np.nan


@compiled
def bilinear(values, cell_valid, all_valid, row, col, row0, col0):
    """Return bilinear heights float32 at positions (``row``, ``col``), and the valid mask of the cells nearest to them.

    ``values`` are the heights of a window of cells, of which (row0, col0) is the first. ``cell_valid`` is their valid mask, and
    ``all_valid`` whether all of them are valid. Positions beyond the outermost centres are clamped.
    """
    rows, cols = values.shape
    out = np.empty(row.shape, np.float32)
    valid = np.empty(row.shape, np.bool_)
    corner, nearest = np.empty((2, row.shape[1]), np.int32), np.empty((2, row.shape[1]), np.int32)
    fraction, corner_values = np.empty((2, row.shape[1])), np.empty((4, row.shape[1]), np.float32)
    for i in range(row.shape[0]):
        _locate_cells(row[i], row0, rows, corner[0], nearest[0], fraction[0])
        _locate_cells(col[i], col0, cols, corner[1], nearest[1], fraction[1])
        _gather_corners(values, corner[0], corner[1], corner_values)
        _interpolate(corner_values[0], corner_values[1], corner_values[2], corner_values[3], fraction[0], fraction[1], out[i])
        if all_valid:
            for j in range(row.shape[1]):
                valid[i, j] = not np.isnan(row[i, j])
        else:
            for j in range(row.shape[1]):
                valid[i, j] = not np.isnan(row[i, j]) and cell_valid[nearest[0, j], nearest[1, j]]
    return out, valid


@internal
def _locate_cells(position, first, count, previous, nearest, fraction):
    """Write the indices of the cell before each position and of the nearest cell into ``previous`` and ``nearest``.

    The axis has ``count`` cells, the first of which is cell ``first``. Positions are clamped to their centres. ``fraction`` becomes
    the fraction of the way to the next cell. It is NaN for a position that is NaN, whose cells are arbitrary.
    """
    last = max(count - 2.0, 0.0)
    for j in range(position.size):
        offset = position[j] - first
        clamped_offset = min(max(offset if offset == offset else 0.0, 0.0), count - 1.0)
        previous[j] = np.int32(min(clamped_offset, last))
        nearest[j] = np.int32(min(clamped_offset + 0.5, count - 1.0))
        fraction[j] = (clamped_offset if offset == offset else np.nan) - previous[j]


@internal
def _gather_corners(values, row, col, out):
    """Write the values of n cells and of their neighbours to the east, south and south-east into ``out`` (4, n)."""
    rows, cols = values.shape
    for j in range(row.size):
        r, c = row[j], col[j]
        below, right = min(r + 1, rows - 1), min(c + 1, cols - 1)
        out[0, j], out[1, j], out[2, j], out[3, j] = values[r, c], values[r, right], values[below, c], values[below, right]


@internal
def _interpolate(north_west, north_east, south_west, south_east, row_fraction, col_fraction, out):
    """Write the bilinear means of four cells each to ``out`` (n,). A neighbour of weight 0 is ignored, even if it is NaN.

    ``row_fraction`` and ``col_fraction`` (n,) run from 0 to 1 southwards and eastwards. The other parameters are the cells' heights
    (n,).
    """
    for j in range(out.size):
        north, south = np.float64(north_west[j]), np.float64(south_west[j])
        north_east_m, south_east_m = np.float64(north_east[j]), np.float64(south_east[j])
        north = north + (north_east_m - north) * col_fraction[j] if col_fraction[j] > 0.0 else north
        south = south + (south_east_m - south) * col_fraction[j] if col_fraction[j] > 0.0 else south
        height = north + (south - north) * row_fraction[j] if row_fraction[j] > 0.0 else north
        out[j] = height if row_fraction[j] == row_fraction[j] else np.nan
