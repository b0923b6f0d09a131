"""Arrays in memory as grids of heights: what anybody passes as (rows, cols) becomes float32 with NaN where there is no ground."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import PlainValidator

from skugga.api.library.memory import check_memory
from skugga.terrain.errors import ArrayError, Problem

MAX_HEIGHT_M = 1e6
"""As in engineering CRSs: what lies beyond is an unmarked sentinel, as -3.4e38."""

GRID_BYTES, SWEEP_BYTES, HORIZON_BYTES = 10, 15, 42
"""Of a cell, while an array becomes a raster in memory, and while shadows and horizons are computed of one: its grid, and what was
measured on 25, 36 and 16 million cells.
"""

SMALLER = (
    "fewer cells; or a GeoTIFF, of which skugga.open_level reads what it needs and `skugga shade` writes all; or an array of dask "
    "with the accessor `.skugga` of xarray"
)
"""How heights are shaded that do not fit into memory."""


def grid_of_heights(values: Any, name: str = "height_m", least: int = 1, bytes_a_cell: float = GRID_BYTES) -> np.ndarray:
    """Return an array of heights as float32 (rows, cols), at least so many, NaN where there is no ground: where it is masked, not
    finite, or beyond ``MAX_HEIGHT_M``. Heights that are all right are not copied.

    Raises
    ------
    ArrayError
        Where it is no grid of real numbers.
    InputError
        Where the work, which takes some bytes a cell, does not fit into memory.
    """
    shape = getattr(values, "shape", None)
    if isinstance(shape, tuple) and len(shape) == 2 and all(isinstance(count, int) for count in shape):
        check_memory(name, *shape, bytes_a_cell, SMALLER)
    try:
        array = np.ma.asanyarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
    except Exception as error:  # what an object raises that cannot be an array
        raise ArrayError(name, Problem(f"{type(values).__name__}, {error}"), "an array of heights (rows, cols)") from None
    if array.dtype.kind == "O":
        try:
            array = array.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
    if array.ndim != 2 or min(array.shape) < least:
        raise ArrayError(name, Problem(f"an array of the shape {array.shape}"), f"(rows, cols), at least {least} x {least}")
    if array.dtype.kind not in "biuf":
        raise ArrayError(name, Problem(f"an array of the type {array.dtype}"), "real numbers, metres")
    mask = np.ma.getmask(array)
    with np.errstate(over="ignore"):  # more than float32 holds is no height
        heights = np.ma.getdata(array).astype(np.float32, copy=mask is not np.ma.nomask)
    if mask is not np.ma.nomask:
        heights[mask] = np.nan
    with np.errstate(invalid="ignore"):
        beyond = ~(np.abs(heights) <= MAX_HEIGHT_M)
    return np.where(beyond, np.float32(np.nan), heights) if (beyond != np.isnan(heights)).any() else heights


Heights = Annotated[ArrayLike, PlainValidator(grid_of_heights)]
"""An array of heights, metres; a function gets a grid (``grid_of_heights``)."""

SweptHeights = Annotated[ArrayLike, PlainValidator(partial(grid_of_heights, least=2, bytes_a_cell=SWEEP_BYTES))]
HorizonHeights = Annotated[ArrayLike, PlainValidator(partial(grid_of_heights, least=2, bytes_a_cell=HORIZON_BYTES))]
