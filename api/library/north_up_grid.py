"""Convert DataArrays of heights to north-up grids: rows from north to south, columns from west to east, NaN without ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import rioxarray  # noqa: F401  # registers ``da.rio``
import xarray
from affine import Affine
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.errors import RasterioError
from rioxarray.exceptions import RioXarrayError

from skugga.api.library.grids import GRID_BYTES_PER_CELL, grid_of_heights
from skugga.api.library.memory import check_memory
from skugga.api.library.opened_level import ARRAY_NAME, OpenLevel, level_of_heights
from skugga.terrain.errors import ArrayError, InputError, Problem, SourceError
from skugga.terrain.ground.vertical import VerticalAxis, axis_of_band, positive_word
from skugga.terrain.level.level_source import parse_positive
from skugga.terrain.level.parts import METRES_PER_UNIT

SPACING_TOLERANCE_CELLS = 0.1
"""Tolerance of evenly spaced coordinates, in cells. Coordinates in float32 are rounded."""

NODATA_ATTRIBUTES = "_FillValue", "missing_value", "fill_value", "nodata", "nodatavals"
"""Attributes in which rioxarray looks for the nodata value, in this order."""

ROTATED_POLE_NAMES = "grid_latitude", "grid_longitude"
"""Standard names of the coordinates of a rotated pole (CF conventions, appendix F). rioxarray does not know them."""

CHUNKS_REMEDY = "Use fewer cells, or chunks: da.chunk({'y': 2048, 'x': 2048}), rioxarray.open_rasterio(FILE, chunks=2048)"


@dataclass(frozen=True, eq=False)
class NorthUpGrid:
    """Heights of an array in north-up order.

    Attributes
    ----------
    heights
        Heights (y, x), metres upwards, NaN without ground.
    transform
        The geotransform.
    crs
        The CRS.
    flip_slices
        Slices by dimension that restore the original order of rows and columns.
    """

    heights: xarray.DataArray
    transform: Affine
    crs: CRS
    flip_slices: dict[Any, slice]

    def level(self) -> OpenLevel:
        """Read the heights into memory and open them as a level. Raises ``InputError``."""
        return level_of_heights(grid_of_heights(self.heights.to_numpy(), ARRAY_NAME), self.transform, self.crs)


def north_up_grid(array: xarray.DataArray) -> NorthUpGrid:
    """Return the heights of an array as a north-up grid.

    It follows rioxarray's conventions for dimensions, CRS, geotransform and nodata, and the attributes ``scale_factor``,
    ``add_offset``, ``units`` and ``positive``.

    Raises
    ------
    ArrayError
        If the array is not a grid of real numbers.
    InputError
        If the array is not georeferenced, its cells are not evenly spaced, or an attribute is wrong.
    """
    if array.ndim != 2:
        remedy = "Reduce them to two, y and x, by da.squeeze() or da.isel(...)"
        raise ArrayError(ARRAY_NAME, Problem(f"its dimensions are {array.dims}"), remedy)
    if array.dtype.kind not in "biuf" or min(array.shape) < 1:
        problem = Problem(f"its shape is {array.shape} and its type {array.dtype}")
        raise ArrayError(ARRAY_NAME, problem, "Use real numbers, at least 1 x 1 cells")
    y_dim, x_dim = _spatial_dims(array)
    nodata = _nodata(array)  # transposed arrays lose that of ``rio.set_nodata``
    array = array.transpose(y_dim, x_dim)
    if array.chunks is None:
        rows, cols = array.shape
        check_memory(ARRAY_NAME, rows, cols, GRID_BYTES_PER_CELL + 2 * array.dtype.itemsize, CHUNKS_REMEDY)
    crs, declared, flip_slices = _crs(array), _declared_transform(array), {}
    for dim, step, direction in ((y_dim, declared.e, -1.0), (x_dim, declared.a, 1.0)):
        coordinates = array[dim].to_numpy() if dim in array.coords else None
        if (
            step if coordinates is None or coordinates.size < 2 else _as_number(coordinates[-1]) - _as_number(coordinates[0])
        ) * direction < 0.0:
            flip_slices[dim] = slice(None, None, -1)
    upright = array.isel(flip_slices)
    y0, dy = _first_edge_and_step(upright, y_dim, declared.f, declared.e, y_dim in flip_slices)
    x0, dx = _first_edge_and_step(upright, x_dim, declared.c, declared.a, x_dim in flip_slices)
    return NorthUpGrid(_heights(upright, crs, nodata), Affine(dx, 0.0, x0, 0.0, dy, y0), crs, flip_slices)


def _spatial_dims(array: xarray.DataArray) -> tuple[Any, Any]:
    """Return the dimensions of rows and of columns.

    Raises ``ArrayError`` if neither rioxarray nor ``ROTATED_POLE_NAMES`` has them.
    """
    try:
        return array.rio.y_dim, array.rio.x_dim
    except RioXarrayError:
        dims = {array[dim].attrs.get("standard_name"): dim for dim in array.dims if dim in array.coords}
        if all(name in dims for name in ROTATED_POLE_NAMES):
            return dims[ROTATED_POLE_NAMES[0]], dims[ROTATED_POLE_NAMES[1]]
    raise ArrayError(
        ARRAY_NAME,
        Problem(f"its dimensions are {array.dims}"),
        "Name them y and x by da.rename(...) or da.rio.set_spatial_dims(...)",
    )


def _nodata(array: xarray.DataArray) -> float | None:
    """Return an array's nodata value, or ``None``. Raises ``InputError`` if it declares several."""
    try:
        nodata: float | None = array.rio.nodata
    except (ValueError, OverflowError):  # no cell can have a value beyond the array's type
        return None
    except TypeError:  # the value is a list
        values = [("_FillValue", array.encoding.get("_FillValue")), *((name, array.attrs.get(name)) for name in NODATA_ATTRIBUTES)]
        return next((_single_number(name, value) for name, value in values if value is not None), None)
    return nodata


def _single_number(name: str, value: object) -> float:
    """Return the number of the attribute ``name``: a number, or a list of equal numbers. Raises ``InputError``."""
    try:
        (number,) = np.unique(np.asarray(value, np.float64))
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{ARRAY_NAME}: {name}", value, "one number") from None
    return float(number)


def _heights(array: xarray.DataArray, crs: CRS, nodata: float | None) -> xarray.DataArray:
    """Return heights (y, x) in metres upwards, NaN for nodata. A dask array stays lazy. Raises ``InputError``.

    ``nodata`` is the stored value of cells without ground; ``None`` without one. ``crs`` may define the unit and the direction.
    """
    heights = array.astype(np.promote_types(array.dtype, np.float32))
    if nodata is not None and not np.isnan(nodata):
        with np.errstate(over="ignore", invalid="ignore"):
            heights = heights.where(array != (array.dtype.type(nodata) if array.dtype.kind == "f" else nodata))
    scale, offset = (
        _single_number(name, array.attrs.get(name, default)) for name, default in (("scale_factor", 1.0), ("add_offset", 0.0))
    )
    if (scale, offset) != (1.0, 0.0):
        heights = heights * scale + offset
    unit_m = _vertical_axis(array, crs).metres_per_stored_unit
    return heights if unit_m == 1.0 else heights * unit_m


def _vertical_axis(array: xarray.DataArray, crs: CRS) -> VerticalAxis:
    """Return the unit and the direction of an array's heights, from its attributes and its CRS. Raises ``InputError``."""
    unit, positive = array.attrs.get("units"), parse_positive(f"{ARRAY_NAME}: positive", positive_word(array.attrs))
    try:
        return axis_of_band(ARRAY_NAME, unit if isinstance(unit, str) else "", array.attrs, crs, positive=positive)
    except SourceError:
        raise InputError(f"{ARRAY_NAME}: units", unit, f"{', '.join(METRES_PER_UNIT)}, or their long names") from None


def _crs(array: xarray.DataArray) -> CRS:
    """Return the CRS that an array declares. Raises ``InputError`` without one, and for a vertical CRS."""
    try:
        crs = None if array.rio.crs is None else CRS.from_user_input(array.rio.crs.to_wkt())
    except (CRSError, RasterioError, ValueError):
        raise InputError(
            "crs", Problem(f"PROJ does not know the CRS of {ARRAY_NAME}"), "Set one by da.rio.write_crs(...)"
        ) from None
    if crs is None:
        raise InputError("crs", Problem(f"{ARRAY_NAME} has no CRS"), "Set one by da.rio.write_crs(...)")
    if crs.type_name == "Vertical CRS":  # a GeoTIFF of GDAL would make a flat world of it
        problem = Problem(f"{ARRAY_NAME} has the vertical CRS {crs.name}")
        raise InputError("crs", problem, "Set one with x and y by da.rio.write_crs(...)")
    return crs


def _declared_transform(array: xarray.DataArray) -> Affine:
    """Return the geotransform that an array declares. Raises ``InputError`` if it has neither a geotransform nor coordinates."""
    try:
        transform: Affine = array.rio.transform(recalc=False)
    except (TypeError, ValueError, RioXarrayError):  # the coordinates are not numbers
        transform = Affine.identity()
    if np.isfinite(tuple(transform)).all() and (transform.b or transform.d):
        raise InputError(ARRAY_NAME, Problem("its grid is rotated"), "Align its rows with x by da.rio.reproject(da.rio.crs)")
    if transform.is_identity:
        for dim in array.dims:
            if dim not in array.coords:
                remedy = "Give coordinates y and x, or a geotransform by da.rio.write_transform(...)"
                raise InputError(ARRAY_NAME, Problem("its cells have no coordinates"), remedy)
            if array.sizes[dim] < 2:
                problem = Problem("one coordinate gives no cell size")
                raise InputError(f"{ARRAY_NAME}: {dim}", problem, "Use at least 2 x 2 cells")
    return transform


def _as_number(value: Any) -> float:
    """Return a value as a number; 0 if it is not one."""
    return float(value) if np.asarray(value).dtype.kind in "iuf" else 0.0


def _first_edge_and_step(array: xarray.DataArray, dim: Any, start: float, step: float, is_flipped: bool) -> tuple[float, float]:
    """Return the coordinate of the first cell's outer edge along a dimension, and the step to the next cell.

    ``start`` and ``step`` are the values that the array declared before it was flipped. Raises ``InputError``.
    """
    start, step = (start + array.sizes[dim] * step, -step) if is_flipped else (start, step)
    if dim not in array.coords:
        return start, step
    name, coordinates = f"{ARRAY_NAME}: {dim}", array[dim].to_numpy()
    if coordinates.dtype.kind not in "iuf" or not np.isfinite(coordinates).all():
        problem = Problem(f"coordinates of the type {coordinates.dtype} are not all finite numbers")
        raise InputError(name, problem, "Use numbers in units of the CRS")
    coordinates = coordinates.astype(np.float64)
    if coordinates.size > 1:
        step = float(coordinates[-1] - coordinates[0]) / (coordinates.size - 1)
        if step == 0.0 or np.abs(
            coordinates - (coordinates[0] + step * np.arange(coordinates.size))
        ).max() > SPACING_TOLERANCE_CELLS * abs(step):
            raise InputError(name, Problem("uneven steps"), "Use evenly spaced coordinates, as da.interp(...) makes them")
    return float(coordinates[0]) - step / 2.0, step
