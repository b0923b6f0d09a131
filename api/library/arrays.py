"""Plain arrays of heights: no file, no level, no OpenGL. Shadows are those of a flat world."""

from __future__ import annotations

import datetime
from typing import Any, cast

import numpy as np
from affine import Affine

from skugga.api.library.checked import AltitudeDeg, AzimuthDeg, CellSides, Cores, Date, LatitudeDeg, Lines, LongitudeDeg, checked
from skugga.api.library.grids import Heights, HorizonHeights, SweptHeights
from skugga.shadows.sweep import grid as sweep
from skugga.shadows.sweep.horizon import horizon_deg


@checked
def shadow(
    height_m: SweptHeights,
    cell_m: CellSides,
    azimuth_deg: AzimuthDeg,
    altitude_deg: AltitudeDeg,
    lines: Lines = 8,
    cores: Cores = 1,
) -> np.ndarray:
    """Return which nodes of a heightfield lie in shadow, cast or their own.

    Parameters
    ----------
    height_m
        Heights (rows, cols), metres, row 0 north. There is no ground where they are masked, not finite, or beyond a million.
    cell_m
        The side of a cell, or its (row, column) sides, metres, more than 0.
    azimuth_deg, altitude_deg
        Where the sun stands: clockwise from north, and above the horizon. Below it everything lies in shadow.
    lines
        Lines of sight to a column of nodes. More are more exact: 8 are wrong at 1 node in 10,000 of mountains.
    cores
        Threads.

    Returns
    -------
    numpy.ndarray
        bool (rows, cols), False where there is no ground.

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.
    """
    heights = cast(np.ndarray, height_m)
    there = np.isfinite(heights)
    if altitude_deg <= 0.0:
        return there
    return there & ~sweep.sunlit(heights, cast(tuple[float, float], cell_m), azimuth_deg, altitude_deg, lines, cores)


@checked
def sunlit(
    height_m: SweptHeights,
    cell_m: CellSides,
    azimuth_deg: AzimuthDeg,
    altitude_deg: AltitudeDeg,
    lines: Lines = 8,
    cores: Cores = 1,
) -> np.ndarray:
    """Return which nodes of a heightfield see the sun, as ``shadow`` without a rule for the night: bool (rows, cols).

    Parameters and errors are those of ``shadow``. Quads are cut along their higher diagonals.
    """
    heights, sides = cast(np.ndarray, height_m), cast(tuple[float, float], cell_m)
    return sweep.sunlit(heights, sides, azimuth_deg, altitude_deg, lines, cores)


@checked
def horizon(height_m: HorizonHeights, cell_m: CellSides, azimuth_deg: AzimuthDeg, lines: Lines = 4, cores: Cores = 1) -> np.ndarray:
    """Return the altitude above which a sun of an azimuth is seen from the nodes of a heightfield: degrees (rows, cols).

    It is -90 where no ground lies towards the sun, and NaN where there is no ground. Parameters and errors are those of ``shadow``.
    """
    return horizon_deg(cast(np.ndarray, height_m), cast(tuple[float, float], cell_m), azimuth_deg, lines, cores)


@checked
def sun_hours_of_array(
    height_m: Heights,
    cell_m: CellSides,
    date: Date,
    lat_deg: LatitudeDeg,
    lon_deg: LongitudeDeg = 0.0,
    **rules: Any,
) -> np.ndarray:
    """Return how long the sun is seen on a heightfield round a place.

    Parameters
    ----------
    height_m, cell_m
        As in ``shadow``; north is up in the middle.
    date
        The date, or the first of many.
    lat_deg, lon_deg
        Where the middle of the heightfield lies.
    **rules
        Those of ``OpenLevel.sun_hours``.

    Returns
    -------
    numpy.ndarray
        float32 (rows, cols), hours unless ``rules`` say otherwise, NaN where there is no ground.

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.
    """
    from skugga.api.library.opened_level import open_heights

    heights, (down_m, right_m) = cast(np.ndarray, height_m), cast(tuple[float, float], cell_m)
    rows, cols = heights.shape
    transform = Affine(right_m, 0.0, -cols * right_m / 2.0, 0.0, -down_m, rows * down_m / 2.0)
    crs = {"proj": "aeqd", "lat_0": lat_deg, "lon_0": lon_deg, "datum": "WGS84", "units": "m"}
    with open_heights(heights, transform, crs) as level:
        return level.sun_hours(cast(datetime.date, date), **rules)
