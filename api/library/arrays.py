"""Plain arrays of heights: no file, no level, no OpenGL. Shadows are those of a flat world."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np

from shadows.sweep.grid import CellSize, sunlit


def shadow(
    height_m: np.ndarray, cell_m: CellSize, azimuth_deg: float, altitude_deg: float, lines: int = 8, cores: int = 1
) -> np.ndarray:
    """Which nodes of a heightfield lie in shadow, cast or their own: bool (rows, cols), False where there is no ground.

    ``height_m`` (rows, cols), row 0 north, NaN where there is no ground; ``cell_m`` is the side of a cell, or its (row, column)
    sides, metres; the azimuth is clockwise from north, and the sun below the horizon leaves everything in shadow. More ``lines``
    are more exact: 8 are wrong at 1 node in 10,000 of mountains. Raises ``ValueError`` for heights that are no grid.
    """
    height_m = np.asarray(height_m, np.float32)
    if height_m.ndim != 2 or min(height_m.shape) < 2:
        raise ValueError(f"height_m has the shape {height_m.shape}; it must be (rows, cols), at least 2 x 2")
    there = np.isfinite(height_m)
    if altitude_deg <= 0.0:
        return there
    return there & ~sunlit(height_m, cell_m, azimuth_deg, altitude_deg, lines, cores)


def sun_hours_of_array(
    height_m: np.ndarray, cell_m: CellSize, date: datetime.date | str, lat_deg: float, lon_deg: float = 0.0, **rules: Any
) -> np.ndarray:
    """How long the sun is seen on a heightfield round a place: float32 (rows, cols), hours unless ``rules`` say otherwise, NaN
    where there is no ground.

    ``height_m`` and ``cell_m`` are as in ``shadow``, and north is up in the middle; ``rules`` are those of ``OpenLevel.sun_hours``.
    Raises ``SkuggaError``, and ``ValueError`` for heights that are no grid.
    """
    from affine import Affine

    from api.library.opened_level import open_heights

    height_m = np.asarray(height_m, np.float32)
    if height_m.ndim != 2:
        raise ValueError(f"height_m has the shape {height_m.shape}; it must be (rows, cols)")
    (rows, cols), (down_m, right_m) = height_m.shape, cell_m if isinstance(cell_m, tuple) else (cell_m, cell_m)
    transform = Affine(right_m, 0.0, -cols * right_m / 2.0, 0.0, -down_m, rows * down_m / 2.0)
    crs = {"proj": "aeqd", "lat_0": lat_deg, "lon_0": lon_deg, "datum": "WGS84", "units": "m"}
    with open_heights(height_m, transform, crs) as level:
        return level.sun_hours(date, **rules)
