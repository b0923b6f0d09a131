"""Compute shadows of plain arrays of heights, in a flat world, without files, levels or OpenGL."""

from __future__ import annotations

import datetime
from typing import Any, cast

import numpy as np
from affine import Affine

from skugga.api.library.argument_types import (
    AltitudeDeg,
    AzimuthCount,
    AzimuthDeg,
    CellSides,
    CoreCount,
    Date,
    LatitudeDeg,
    LineCount,
    LongitudeDeg,
    validate_arguments,
)
from skugga.api.library.grids import HORIZON_BYTES_PER_CELL, Heights, HorizonHeights, ShadowHeights
from skugga.api.library.memory import check_memory
from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, SkyViewKind, evenly_spaced_azimuths_deg
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
def horizons(height_m: HorizonHeights, cell_m: CellSides, azimuths: AzimuthCount = DEFAULT_AZIMUTHS) -> np.ndarray:
    """Return the horizon angles of all nodes of a heightfield towards many azimuths, on all cores.

    Each ray is followed on its own line to the end of the heightfield; there is no radius. The ground extends by one cell beyond
    the outermost nodes, as for shadows. In mountains the angles are within 0.003
    degrees of those of the triangulated heightfield in the mean, and within 0.05 at 99 of 100 nodes. ``horizon`` gives them without
    this deviation for one azimuth, many times slower.

    Parameters
    ----------
    height_m, cell_m
        As in ``shadow``.
    azimuths
        The number of azimuths, 8 to 360, evenly spaced from north, clockwise.

    Returns
    -------
    numpy.ndarray
        float32 (azimuths, rows, cols), degrees; -90 if no ground lies towards the azimuth, NaN without ground.

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.

    Examples
    --------
    >>> import numpy as np
    >>> import skugga
    >>> heights = np.zeros((3, 6))
    >>> heights[:, 3] = 30.0
    >>> skugga.horizons(heights, 30.0, azimuths=8)[2, 1]  # towards the east
    array([ 18.434948,  26.56505 ,  45.      , -18.434948,   0.      ,
             0.      ], dtype=float32)
    """
    from skugga.shadows.horizons.grid import grid_of_array
    from skugga.shadows.horizons.scan import horizon_angles_deg

    heights, sides = cast(np.ndarray, height_m), cast(tuple[float, float], cell_m)
    rows, cols = heights.shape
    check_memory("azimuths", rows, cols, HORIZON_BYTES_PER_CELL + 4.0 * azimuths, "Use fewer azimuths, or a part of the heights")
    return horizon_angles_deg(grid_of_array(heights, sides), evenly_spaced_azimuths_deg(azimuths))


@validate_arguments
def sky_view(
    height_m: HorizonHeights,
    cell_m: CellSides,
    kind: SkyViewKind = "solid_angle",
    azimuths: AzimuthCount = DEFAULT_AZIMUTHS,
) -> np.ndarray:
    """Return the sky view factor of all nodes of a heightfield, on all cores.

    Parameters
    ----------
    height_m, cell_m
        As in ``shadow``.
    kind
        The definition, with h the horizon angle or 0, whichever is larger. ``solid_angle``: 1 - mean sin h, the visible share of
        the sky. ``cosine``: mean cos2 h, the share of a uniform sky's light on a level plane. ``tilted``: the same on the ground's
        own plane, which hides the sky, too. ``openness`` and ``negative_openness``: mean zenith angles of the horizon in degrees,
        also above 90, of the ground and of the ground turned upside down.
    azimuths
        The number of azimuths, 8 to 360.

    Returns
    -------
    numpy.ndarray
        float32 (rows, cols), 0 to 1 or degrees; NaN without ground.

    Raises
    ------
    SkuggaError
        For a wrong argument, and for arrays that do not fit into memory.

    Examples
    --------
    >>> import numpy as np
    >>> import skugga
    >>> ramp = np.tile(np.arange(9.0), (9, 1))  # 45 degrees steep
    >>> skugga.sky_view(ramp, 1.0)[4, 4].round(2), skugga.sky_view(ramp, 1.0, kind="tilted")[4, 4].round(3)
    (np.float32(0.75), np.float32(0.854))
    """
    from skugga.shadows.horizons.grid import grid_of_array
    from skugga.shadows.horizons.sky_view import sky_view_factor

    heights, sides = cast(np.ndarray, height_m), cast(tuple[float, float], cell_m)
    return sky_view_factor(grid_of_array(heights, sides), kind, azimuths)


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
