"""Detect collars: undeclared nodata cells round the data, such as the zeros that warping leaves behind.

A collar consists of connected cells at the raster's border that all have one value, such as 0 or -9999. The sea, lakes and dammed
rivers do so, too. The height step across the rim, where the value's cells meet the ground, tells collar and water apart:

* A shore slopes down to the water. Heights change across the rim about as much as they do one cell farther inland.
* A collar cuts through ground of any height. Heights change far more across the rim than farther inland, and the ground at the rim
  stands about as high above the value as the ground elsewhere.

A value counts as a collar if all these conditions hold:

* The value fills at least ``MIN_COLLAR_BORDER_SHARE`` of the border's cells. If it lies above the ground, as no sea does, it fills
  at least ``MIN_HIGH_COLLAR_BORDER_SHARE``.
* At most ``MAX_GROUND_BEYOND_VALUE_SHARE`` of the ground is on the other side of the value: below a low value, or above a high one.
* The largest connected piece of ground has at least half of all ground cells and ``MIN_GROUND_SHARE`` of all cells.
* At least ``MIN_CLIFF_SHARE`` of the rim is a cliff. A cliff is at least ``MIN_CLIFF_M`` high and ``MIN_CLIFF_RATIO`` times as high
  as the next step inland.
* The cliffs' median height is at least ``MIN_CLIFF_HEIGHT_SHARE`` of the ground's median height above the value. No quay or dam is
  as high.

The rule comes from measurements. Collars were made round nine real rasters (plains, hills, coastal towns, mountains): 31 to 100 %
of their rims was cliff. Of the rims of coasts (cells of 7 m to 1 degree), lakes and rivers at most 15 % was cliff.

Known limits: the rule misses collars less than ``MIN_CLIFF_M`` below the ground, and rasters that are mostly collar. It also misses
rasters whose ground along the rim is nearly all at sea level. It mistakes a long ice front or a coast that is mostly cliffs for a
collar.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.level_source import option_remedy

MIN_COLLAR_BORDER_SHARE, MIN_HIGH_COLLAR_BORDER_SHARE = 0.05, 0.25
MAX_GROUND_BEYOND_VALUE_SHARE = 0.05
MIN_GROUND_SHARE = 0.2
"""Minimum share of the cells that is ground."""

MIN_CLIFF_M, MIN_CLIFF_RATIO = 10.0, 8.0
MIN_CLIFF_SHARE = 0.25
MIN_CLIFF_HEIGHT_SHARE = 0.4

MIN_RIM_CELLS = 16
"""Minimum number of height steps across the rim that a decision needs."""

MAX_RIM_WINDOWS = 64
"""Approximate number of windows along the rim that are read at full resolution, from a raster larger than its overview."""

BORDER_STRIP_CELLS = 32
"""Width in cells of the strips along the border that are read at full resolution: the overview does not show a thin collar."""

MAX_STRIP_SAMPLES = 4096
"""Maximum number of samples in a strip's direction along the border."""

_MAX_CANDIDATE_VALUES = 2
_EIGHT_NEIGHBOURS = np.ones((3, 3), bool)


@dataclass(frozen=True)
class Collar:
    """A value that appears to be undeclared nodata.

    Attributes
    ----------
    value
        The cells' value, as stored in the file.
    border_share
        Share of the border that the value fills, in [0, 1].
    cliff_m
        Median height of the cliff between the value and the ground, metres.
    """

    value: float
    border_share: float
    cliff_m: float

    @property
    def warning(self) -> str:
        """The problem and its remedy, as a sentence."""
        value = f"{self.value:.9g}"
        return (
            f"{100 * self.border_share:.0f} % of the raster's border is {value}, {self.cliff_m:.0f} m from the ground beside it. "
            f"If that means no data, {option_remedy('nodata', value)}"
        )


@dataclass(frozen=True, eq=False)
class _StoredCells:
    """Cells as stored in the file.

    Attributes
    ----------
    values
        Stored values (rows, cols).
    has_height
        bool (rows, cols): whether a cell holds a height.
    is_raster_edge
        Whether the raster ends at the top, bottom, left and right side.
    """

    values: np.ndarray
    has_height: np.ndarray
    is_raster_edge: tuple[bool, bool, bool, bool] = (True, True, True, True)

    def border(self, array: np.ndarray) -> np.ndarray:
        """Return an array's cells (n,) at the sides where the raster ends."""
        sides = array[0], array[-1], array[:, 0], array[:, -1]
        return np.concatenate([side for side, end in zip(sides, self.is_raster_edge, strict=True) if end])


@dataclass(frozen=True, eq=False)
class _BorderRegion:
    """The border cells of one value and the ground beside them.

    Attributes
    ----------
    value_mask
        bool (rows, cols): the value's cells that are connected to the border.
    ground_mask
        bool (rows, cols): the largest connected piece of the other cells with heights.
    border_share
        Share of the border that ``value_mask`` fill, in [0, 1].
    """

    value_mask: np.ndarray
    ground_mask: np.ndarray
    border_share: float


def detect_collar(elevation: Elevation) -> Collar | None:
    """Return the collar that a raster appears to have, or ``None``.

    Reads the cells at the overview's resolution, and the border and the rim at full resolution.
    """
    factor = 2**elevation.overview.lod
    shape = max(elevation.rows // factor, 1), max(elevation.cols // factor, 1)
    all_cells = slice(0, elevation.rows), slice(0, elevation.cols)
    overview_cells = _StoredCells(*elevation.stored_values(*all_cells, shape))
    unit_m = elevation.metres_per_stored_unit
    for value, region in _candidates(overview_cells):
        rim_steps, inner_steps = _height_steps(overview_cells.values, region.value_mask, region.ground_mask, value)
        if factor > 1:
            rim_steps, inner_steps = _full_resolution_steps(elevation, region, value, factor)
        if collar := _collar_from_steps(overview_cells, region, value, rim_steps * abs(unit_m), inner_steps * abs(unit_m), unit_m):
            return collar
    if factor == 1:
        return None
    for strip in _border_strips(elevation):
        for value, region in _candidates(strip):
            rim_steps, inner_steps = _height_steps(strip.values, region.value_mask, region.ground_mask, value)
            if collar := _collar_from_steps(strip, region, value, rim_steps * abs(unit_m), inner_steps * abs(unit_m), unit_m):
                return collar
    return None


def _candidates(stored_cells: _StoredCells) -> Iterator[tuple[np.generic, _BorderRegion]]:
    """Yield the most common values of the border's cells, each with the region of this value along the border."""
    border = stored_cells.border(stored_cells.values)[stored_cells.border(stored_cells.has_height)]
    values, count = np.unique(border, return_counts=True)
    for index in np.argsort(count)[::-1][:_MAX_CANDIDATE_VALUES]:
        if count[index] < MIN_COLLAR_BORDER_SHARE * max(len(stored_cells.border(stored_cells.has_height)), 1):
            return
        from scipy.ndimage import label  # here: the import takes 0.25 s, and most rasters have no candidate

        parts, _ = label(stored_cells.has_height & (stored_cells.values == values[index]), _EIGHT_NEIGHBOURS)
        at_border = stored_cells.border(parts)
        cells = np.isin(parts, np.unique(at_border[at_border > 0]))
        pieces, number = label(stored_cells.has_height & ~cells)
        if number == 0:
            continue
        sizes = np.bincount(pieces.ravel())[1:]
        ground = pieces == sizes.argmax() + 1
        if sizes.max() >= sizes.sum() / 2 and sizes.max() >= MIN_GROUND_SHARE * pieces.size:
            yield values[index], _BorderRegion(cells, ground, float((at_border > 0).mean()))


def _collar_from_steps(
    stored_cells: _StoredCells,
    region: _BorderRegion,
    value: np.generic,
    rim_steps_m: np.ndarray,
    inner_steps_m: np.ndarray,
    unit_m: float,
) -> Collar | None:
    """Return the collar if a region meets the module's conditions, else ``None``.

    ``rim_steps_m`` (n,) are the height steps from the value's cells to the first ground cell, ``inner_steps_m`` (n,) those from
    there to the second ground cell. ``unit_m`` is the height in metres of a step of 1 in the stored values.
    """
    if len(rim_steps_m) < MIN_RIM_CELLS:
        return None
    above_m = (stored_cells.values[region.ground_mask].astype(np.float64) - float(value)) * unit_m
    below = bool(np.mean(above_m < 0.0) <= MAX_GROUND_BEYOND_VALUE_SHARE)
    if not below and (np.mean(above_m > 0.0) > MAX_GROUND_BEYOND_VALUE_SHARE or region.border_share < MIN_HIGH_COLLAR_BORDER_SHARE):
        return None
    cliff = (rim_steps_m >= MIN_CLIFF_M) & (rim_steps_m >= MIN_CLIFF_RATIO * inner_steps_m)
    if cliff.mean() < MIN_CLIFF_SHARE:
        return None
    height_m = float(np.median(rim_steps_m[cliff]))
    if height_m < MIN_CLIFF_HEIGHT_SHARE * np.median(np.abs(above_m)):
        return None
    return Collar(float(value), region.border_share, height_m)


def _height_steps(values: np.ndarray, cells: np.ndarray, ground: np.ndarray, value: np.generic) -> tuple[np.ndarray, np.ndarray]:
    """Return the absolute steps of stored values across a region's rim (n,), and one cell farther inland (n,).

    The first is from ``value`` to the first ground cell, the second from there to the next ground cell. All four directions of the
    rim are covered.
    """
    rim_steps, inner_steps = [], []
    for quarter_turns in range(4):
        heights, inside, outside = (np.rot90(array, quarter_turns) for array in (values, cells, ground))
        rim = inside[:-2] & outside[1:-1] & outside[2:]
        first, second = heights[1:-1][rim].astype(np.float64), heights[2:][rim].astype(np.float64)
        rim_steps.append(np.abs(first - float(value)))
        inner_steps.append(np.abs(second - first))
    return np.concatenate(rim_steps), np.concatenate(inner_steps)


def _full_resolution_steps(
    elevation: Elevation, region: _BorderRegion, value: np.generic, factor: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps of ``_height_steps`` from full-resolution windows along a region's rim.

    The region's cells are ``factor`` raster cells a side.
    """
    rows, cols = region.value_mask.shape
    is_beside_ground = np.zeros_like(region.value_mask)
    for axis in (0, 1):
        for step in (1, -1):
            is_beside_ground |= np.roll(region.ground_mask, step, axis)
    rim_cells = np.argwhere(region.value_mask & is_beside_ground)
    rim_steps, inner_steps = [np.empty(0)], [np.empty(0)]
    for row, col in rim_cells[:: max(len(rim_cells) // MAX_RIM_WINDOWS, 1)]:
        window = (
            slice(max(int(row) - 1, 0) * factor, min((int(row) + 2) * factor, elevation.rows)),
            slice(max(int(col) - 1, 0) * factor, min((int(col) + 2) * factor, elevation.cols)),
        )
        values, has_height = elevation.stored_values(*window)
        cells = has_height & (values == value)
        steps = _height_steps(values, cells, has_height & ~cells, value)
        rim_steps.append(steps[0])
        inner_steps.append(steps[1])
    return np.concatenate(rim_steps), np.concatenate(inner_steps)


def _border_strips(elevation: Elevation) -> Iterator[_StoredCells]:
    """Yield a strip of cells along each of the raster's four sides.

    Strips have full resolution across, and are decimated to at most ``MAX_STRIP_SAMPLES`` cells along the side.
    """
    rows, cols = elevation.shape
    strip_rows, strip_cols = min(BORDER_STRIP_CELLS, rows), min(BORDER_STRIP_CELLS, cols)
    along_row, along_col = min(cols, MAX_STRIP_SAMPLES), min(rows, MAX_STRIP_SAMPLES)
    for ends, row, col, shape in (
        ((True, False, False, False), slice(0, strip_rows), slice(0, cols), (strip_rows, along_row)),
        ((False, True, False, False), slice(rows - strip_rows, rows), slice(0, cols), (strip_rows, along_row)),
        ((False, False, True, False), slice(0, rows), slice(0, strip_cols), (along_col, strip_cols)),
        ((False, False, False, True), slice(0, rows), slice(cols - strip_cols, cols), (along_col, strip_cols)),
    ):
        yield _StoredCells(*elevation.stored_values(row, col, shape), ends)
