"""Convert arrays of heights in memory to grids: float32 (rows, cols), NaN in cells without ground."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import PlainValidator

from skugga.api.library.memory import check_memory
from skugga.terrain.errors import ArrayError, Problem

MAX_HEIGHT_M = 1e6
"""Largest height, as in engineering CRSs. Values beyond it are undeclared nodata values, such as -3.4e38."""

GRID_BYTES_PER_CELL, SHADOW_BYTES_PER_CELL, HORIZON_BYTES_PER_CELL = 10, 15, 42
"""Bytes per cell to make a raster in memory, to compute shadows, and to compute horizons.

They include the grid. They were measured on 25, 36 and 16 million cells.
"""

MEMORY_REMEDY = (
    "Use fewer cells, a GeoTIFF, which skugga.open_level reads in parts and `skugga shade` writes whole, or a dask array with the "
    "accessor `.skugga` of xarray"
)
"""Remedy for heights that do not fit into memory."""


def grid_of_heights(
    values: Any, name: str = "height_m", min_side_cells: int = 1, bytes_per_cell: float = GRID_BYTES_PER_CELL
) -> np.ndarray:
    """Return an array of heights as float32 (rows, cols), NaN without ground.

    Cells are without ground if they are masked, not finite, or beyond ``MAX_HEIGHT_M``. A float32 array without such cells is not
    copied.

    Parameters
    ----------
    values
        The heights in metres.
    name
        The name of the parameter, for errors.
    min_side_cells
        The smallest number of rows and of columns.
    bytes_per_cell
        Bytes of memory that the work takes for each cell.

    Raises
    ------
    ArrayError
        If it is not a grid of real numbers.
    InputError
        If the work does not fit into memory.
    """
    shape = getattr(values, "shape", None)
    if isinstance(shape, tuple) and len(shape) == 2 and all(isinstance(count, int) for count in shape):
        check_memory(name, *shape, bytes_per_cell, MEMORY_REMEDY)
    try:
        array = np.ma.asanyarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
    except Exception as error:  # objects that cannot become arrays raise any error
        problem = Problem(f"numpy cannot convert {type(values).__name__}: {error}")
        raise ArrayError(name, problem, "Use an array of heights (rows, cols)") from None
    if array.dtype.kind == "O":
        try:
            array = array.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
    if array.ndim != 2 or min(array.shape) < min_side_cells:
        raise ArrayError(
            name, Problem(f"its shape is {array.shape}"), f"Use (rows, cols), at least {min_side_cells} x {min_side_cells}"
        )
    if array.dtype.kind not in "biuf":
        raise ArrayError(name, Problem(f"its type is {array.dtype}"), "Use real numbers, metres")
    mask = np.ma.getmask(array)
    with np.errstate(over="ignore"):  # values beyond float32 are not heights
        heights = np.ma.getdata(array).astype(np.float32, copy=mask is not np.ma.nomask)
    if mask is not np.ma.nomask:
        heights[mask] = np.nan
    with np.errstate(invalid="ignore"):
        invalid = ~(np.abs(heights) <= MAX_HEIGHT_M)
    return np.where(invalid, np.float32(np.nan), heights) if (invalid != np.isnan(heights)).any() else heights


Heights = Annotated[ArrayLike, PlainValidator(grid_of_heights)]
"""An array of heights in metres. The function receives a grid (``grid_of_heights``)."""

ShadowHeights = Annotated[ArrayLike, PlainValidator(partial(grid_of_heights, bytes_per_cell=SHADOW_BYTES_PER_CELL))]
HorizonHeights = Annotated[
    ArrayLike, PlainValidator(partial(grid_of_heights, min_side_cells=2, bytes_per_cell=HORIZON_BYTES_PER_CELL))
]
