"""DataArrays of heights as upright grids: rows from north to south, columns from west to east, NaN where there is no ground."""

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

from skugga.api.library.grids import GRID_BYTES, grid_of_heights
from skugga.api.library.memory import check_memory
from skugga.api.library.opened_level import OpenLevel, level_of_heights
from skugga.terrain.errors import ArrayError, InputError, Problem, SourceError
from skugga.terrain.ground.vertical import VerticalAxis, axis_of_band
from skugga.terrain.level.parts import METRES_PER_UNIT

ARRAY = "the array"

MAX_UNEVEN_CELLS = 0.1
"""How far coordinates may be from even ones, in cells: those in float32 are rounded."""

CHUNKED = "fewer cells; or chunks, as of da.chunk({'y': 2048, 'x': 2048}) and of rioxarray.open_rasterio(FILE, chunks=2048)"


@dataclass(frozen=True, eq=False)
class UprightGrid:
    """Heights (y, x), metres upwards, where they lie, and what turns an answer back to how the array lies."""

    heights: xarray.DataArray
    transform: Affine
    crs: CRS
    flips: dict[Any, slice]

    def level(self) -> OpenLevel:
        """The heights in memory as an open level. Raises ``InputError``."""
        return level_of_heights(grid_of_heights(self.heights.to_numpy(), ARRAY), self.transform, self.crs)


def upright_grid(array: xarray.DataArray) -> UprightGrid:
    """Return the heights of an array.

    What rioxarray tells of it is heeded: dimensions, CRS and geotransform, nodata, ``scale_factor``, ``add_offset``, ``units`` and
    ``positive``.

    Raises
    ------
    ArrayError
        Where the array is no grid of real numbers.
    InputError
        Where it does not say where it lies, or its cells are not even.
    """
    if array.ndim != 2:
        raise ArrayError(ARRAY, Problem(f"the dimensions {array.dims}"), "two, y and x: da.squeeze(), da.isel(...) leave them")
    if array.dtype.kind not in "biuf" or min(array.shape) < 1:
        raise ArrayError(ARRAY, Problem(f"{array.shape} of the type {array.dtype}"), "real numbers, at least 1 x 1")
    try:
        y_dim, x_dim = array.rio.y_dim, array.rio.x_dim
    except RioXarrayError:
        raise ArrayError(
            ARRAY,
            Problem(f"the dimensions {array.dims}"),
            "y and x: da.rename(...) or da.rio.set_spatial_dims(...) names them",
        ) from None
    array = array.transpose(y_dim, x_dim)
    if array.chunks is None:
        rows, cols = array.shape
        check_memory(ARRAY, rows, cols, GRID_BYTES + 2 * array.dtype.itemsize, CHUNKED)
    crs, stated, flips = _crs(array), _stated(array), {}
    for dim, step, wanted in ((y_dim, stated.e, -1.0), (x_dim, stated.a, 1.0)):
        at = array[dim].to_numpy() if dim in array.coords else None
        if (step if at is None or at.size < 2 else _number(at[-1]) - _number(at[0])) * wanted < 0.0:
            flips[dim] = slice(None, None, -1)
    upright = array.isel(flips)
    y0, dy = _even(upright, y_dim, stated.f, stated.e, y_dim in flips)
    x0, dx = _even(upright, x_dim, stated.c, stated.a, x_dim in flips)
    return UprightGrid(_heights(upright, crs), Affine(dx, 0.0, x0, 0.0, dy, y0), crs, flips)


def _heights(array: xarray.DataArray, crs: CRS) -> xarray.DataArray:
    """Heights without nodata, in metres upwards; an array of dask stays one. Raises ``InputError``."""
    heights = array.astype(np.promote_types(array.dtype, np.float32))
    try:
        nodata = array.rio.nodata
    except (ValueError, OverflowError):  # no value of the array's type: no cell has it
        nodata = None
    if nodata is not None and not np.isnan(nodata):
        with np.errstate(over="ignore", invalid="ignore"):
            heights = heights.where(array != (array.dtype.type(nodata) if array.dtype.kind == "f" else nodata))
    scale, offset = (float(array.attrs.get(name, usual)) for name, usual in (("scale_factor", 1.0), ("add_offset", 0.0)))
    if (scale, offset) != (1.0, 0.0):
        heights = heights * scale + offset
    unit_m = _axis(array, crs).scale
    return heights if unit_m == 1.0 else heights * unit_m


def _axis(array: xarray.DataArray, crs: CRS) -> VerticalAxis:
    unit = array.attrs.get("units")
    try:
        return axis_of_band(ARRAY, unit if isinstance(unit, str) else "", array.attrs, crs)
    except SourceError:
        raise InputError(f"{ARRAY}: units", unit, f"{', '.join(METRES_PER_UNIT)} or their long names, as an attribute") from None


def _crs(array: xarray.DataArray) -> CRS:
    try:
        found = None if array.rio.crs is None else CRS.from_user_input(array.rio.crs.to_wkt())
    except (CRSError, RasterioError, ValueError):
        raise InputError("crs", Problem(f"{ARRAY} has a CRS that PROJ does not know"), "one by da.rio.write_crs(...)") from None
    if found is None:
        raise InputError("crs", Problem(f"{ARRAY} has none"), "an array with a CRS: da.rio.write_crs(...)")
    if found.type_name == "Vertical CRS":  # GDAL's GeoTIFFs make a flat world of it
        raise InputError("crs", Problem(f"{ARRAY} has {found.name}, of heights alone"), "one with x and y: da.rio.write_crs(...)")
    return found


def _stated(array: xarray.DataArray) -> Affine:
    """The geotransform that an array states, for cells without coordinates. Raises ``InputError`` where these have none."""
    try:
        stated: Affine = array.rio.transform(recalc=False)
    except (TypeError, ValueError, RioXarrayError):  # of coordinates that are no numbers
        stated = Affine.identity()
    if np.isfinite(tuple(stated)).all() and (stated.b or stated.d):
        raise InputError(ARRAY, Problem("a turned grid"), "rows from west to east; da.rio.reproject(da.rio.crs) makes them")
    if stated.is_identity and any(dim not in array.coords or array.sizes[dim] < 2 for dim in array.dims):
        raise InputError(
            ARRAY, Problem("its cells have no place"), "coordinates y and x; or a geotransform by da.rio.write_transform(...)"
        )
    return stated


def _number(value: Any) -> float:
    return float(value) if np.asarray(value).dtype.kind in "iuf" else 0.0


def _even(array: xarray.DataArray, dim: Any, start: float, step: float, is_flipped: bool) -> tuple[float, float]:
    """The outer edge of the first cell along a dimension, and the step to the next one; stated are those of the array before it was
    flipped. Raises ``InputError``.
    """
    start, step = (start + array.sizes[dim] * step, -step) if is_flipped else (start, step)
    if dim not in array.coords:
        return start, step
    name, at = f"{ARRAY}: {dim}", array[dim].to_numpy()
    if at.dtype.kind not in "iuf" or not np.isfinite(at).all():
        raise InputError(name, Problem(f"coordinates of the type {at.dtype}, not all finite"), "numbers in units of the CRS")
    at = at.astype(np.float64)
    if at.size > 1:
        step = float(at[-1] - at[0]) / (at.size - 1)
        if step == 0.0 or np.abs(at - (at[0] + step * np.arange(at.size))).max() > MAX_UNEVEN_CELLS * abs(step):
            raise InputError(name, Problem("uneven steps"), "coordinates in even steps, as da.interp(...) makes them")
    return float(at[0]) - step / 2.0, step
