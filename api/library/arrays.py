"""Compute shadows of plain arrays of heights, in a flat world, without files, levels or OpenGL."""

from __future__ import annotations

import datetime
from typing import Any, cast

import numpy as np
from affine import Affine

from skugga.api.library.argument_types import (
    AltitudeDeg,
    AzimuthDeg,
    CellSides,
    CoreCount,
    Date,
    LatitudeDeg,
    LineCount,
    LongitudeDeg,
    validate_arguments,
)
from skugga.api.library.grids import Heights, HorizonHeights, ShadowHeights
from skugga.shadows.sweep import grid as sweep
from skugga.shadows.sweep.horizon import horizon_deg


@validate_arguments
def shadow(
    height_m: ShadowHeights,
    cell_m: CellSides,
    azimuth_deg: AzimuthDeg,
    altitude_deg: AltitudeDeg,
    lines: LineCount = 8,
    cores: CoreCount = 1,
) -> np.ndarray:
    """Return which nodes of a heightfield lie in shadow, cast or self-shadow.

    Parameters
    ----------
    height_m
        Heights (rows, cols) in metres, row 0 in the north. Nodes are without ground if they are masked, not finite, or beyond a
        million metres.
    cell_m
        The side of a cell, 1e-6 to 1e6 metres, or its (row, column) sides.
    azimuth_deg, altitude_deg
        The direction of the sun: clockwise from north, and above the horizon. At or below the horizon all ground is in shadow.
    lines
        Lines of sight per column of nodes. More lines are more exact: 8 are wrong at 1 node in 10,000 in mountains.
    cores
        The number of threads.

    Returns
    -------
    numpy.ndarray
        bool (rows, cols), False without ground.

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.

    Examples
    --------
    >>> import numpy as np
    >>> import skugga
    >>> heights = np.zeros((3, 6))
    >>> heights[:, 3] = 50.0
    >>> skugga.shadow(heights, 30.0, azimuth_deg=90.0, altitude_deg=45.0)[1]
    array([False, False,  True, False, False, False])
    """
    heights = cast(np.ndarray, height_m)
    valid = np.isfinite(heights)
    if altitude_deg <= 0.0:
        return valid
    return valid & ~sweep.sunlit_nodes(heights, cast(tuple[float, float], cell_m), azimuth_deg, altitude_deg, lines, cores)


@validate_arguments
def sunlit(
    height_m: ShadowHeights,
    cell_m: CellSides,
    azimuth_deg: AzimuthDeg,
    altitude_deg: AltitudeDeg,
    lines: LineCount = 8,
    cores: CoreCount = 1,
) -> np.ndarray:
    """Return which nodes of a heightfield see the sun.

    A sun below the horizon counts as any other sun; ``shadow`` treats it as night.
    Quads of the heightfield are split along their higher diagonals.

    Parameters
    ----------
    height_m, cell_m, azimuth_deg, altitude_deg, lines, cores
        As in ``shadow``.

    Returns
    -------
    numpy.ndarray
        bool (rows, cols).

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.
    """
    heights, sides = cast(np.ndarray, height_m), cast(tuple[float, float], cell_m)
    return sweep.sunlit_nodes(heights, sides, azimuth_deg, altitude_deg, lines, cores)


@validate_arguments
def horizon(
    height_m: HorizonHeights, cell_m: CellSides, azimuth_deg: AzimuthDeg, lines: LineCount = 4, cores: CoreCount = 1
) -> np.ndarray:
    """Return the horizon angle of each node of a heightfield towards an azimuth.

    A sun at that azimuth is visible above the horizon angle.

    Parameters
    ----------
    height_m, cell_m, azimuth_deg, lines, cores
        As in ``shadow``.

    Returns
    -------
    numpy.ndarray
        Degrees (rows, cols); -90 if only nodes without ground lie towards the sun, NaN without ground.

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.
    """
    return horizon_deg(cast(np.ndarray, height_m), cast(tuple[float, float], cell_m), azimuth_deg, lines, cores)


@validate_arguments
def sun_hours_of_array(
    height_m: Heights,
    cell_m: CellSides,
    date: Date,
    lat_deg: LatitudeDeg,
    lon_deg: LongitudeDeg = 0.0,
    **rules: Any,
) -> np.ndarray:
    """Return the hours of direct sun on a heightfield around a place, or another quantity of direct sun.

    Parameters
    ----------
    height_m, cell_m
        As in ``shadow``. Columns run north-south in the middle of the heightfield.
    date
        The date, or the first of several dates.
    lat_deg, lon_deg
        The middle of the heightfield, in degrees.
    **rules
        Other parameters of ``OpenLevel.sun_hours``.

    Returns
    -------
    numpy.ndarray
        float32 (rows, cols), NaN without ground; hours, or the unit of the ``quantity``.

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
