"""``da.skugga`` of xarray: shade of a DataArray of heights, on its own coordinates.

Its CRS and geotransform follow rioxarray's conventions. An array of dask stays one: it is written once, chunk by chunk, into a
temporary raster, and each chunk of the answer is made from there, with casters as far as they reach; never is all of it in memory.
"""

from __future__ import annotations

import datetime
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rioxarray  # noqa: F401  # registers ``da.rio``
import xarray
from affine import Affine
from rasterio.enums import Resampling
from rasterio.windows import Window

from api.library.opened_level import OpenLevel, Time, open_heights, open_level
from api.raster_file import TILE
from shadows.registry import ALGORITHMS
from terrain.errors import InputError

MOST_OVERVIEW_CELLS = 512
"""Of the coarsest overview of a temporary raster, a side."""

WITHOUT_OPENGL = next(
    name
    for name, algorithm in ALGORITHMS.items()
    if not algorithm.needs_opengl and any(algorithm.node_fill(settings()) for settings in algorithm.settings)
)
"""The algorithm that heights alone suffice for: chunks are made in threads of dask's, and OpenGL has one thread."""


class SkuggaAccessor:
    """Questions of sun to heights (y, x), metres, with a CRS by ``rio.write_crs``."""

    def __init__(self, array: xarray.DataArray) -> None:
        self._array = array

    def shadow(
        self, time: Time | None = None, azimuth: float | None = None, altitude: float | None = None, **shadows: Any
    ) -> xarray.DataArray:
        """Where there is shadow, cast or the ground's own: bool, False where there is no ground.

        The sun is that of a ``time`` (with an offset from UTC, or datetime64 in UTC), or of ``azimuth`` (clockwise from north) and
        ``altitude``, degrees. Raises ``SkuggaError``, and ``ValueError`` for arrays that are no grid of heights.
        """
        if time is None and azimuth is None and altitude is None:
            raise InputError("time", None, "a time, or an azimuth and an altitude")

        def made(level: OpenLevel, **where: Any) -> np.ndarray:
            asked = {**({"algorithm": WITHOUT_OPENGL} if where else {}), **shadows}
            visibility = level.shade("visibility", time=time, azimuth=azimuth, altitude=altitude, **where, **asked)
            return visibility < 0.5  # NaN, where there is no ground, is not

        return self._answer("shadow", made, np.bool_)

    def sun_hours(self, date: datetime.date | str, **rules: Any) -> xarray.DataArray:
        """How long the sun is seen: float32, NaN where there is no ground. ``rules`` are ``to``, ``window``, ``clock``,
        ``quantity`` and others of ``OpenLevel.sun_hours``. Raises as ``shadow``.
        """

        def made(level: OpenLevel, **where: Any) -> np.ndarray:
            return level.sun_hours(date, **where, **rules)

        return self._answer("sun_hours", made, np.float32)

    def horizon(self, x: float, y: float, height: float = 0.0) -> xarray.DataArray:
        """The horizon of a point, ``height`` metres above the ground, in the array's own coordinates: elevation angles, degrees, by
        ``azimuth``, degrees clockwise from true north. Raises as ``shadow``; an array of dask is read at once.
        """
        upright = _upright(self._array)
        with open_heights(upright.to_numpy(), upright.rio.transform(recalc=True), _crs(upright)) as level:
            found = level.horizon(x, y, height=height, crs=level.crs)
        return xarray.DataArray(found.elevation_deg, dims="azimuth", coords={"azimuth": found.azimuth_deg}, name="horizon")

    def _answer(self, name: str, made: Callable[..., np.ndarray], dtype: type) -> xarray.DataArray:
        """A DataArray like the heights of what is made of an open level."""
        upright = _upright(self._array)
        if upright.chunks is None:
            with open_heights(upright.to_numpy(), upright.rio.transform(recalc=True), _crs(upright)) as level:
                values: Any = made(level)
        else:
            values = _by_chunk(upright, made, dtype)
        answer = xarray.DataArray(values, dims=upright.dims, coords=upright.coords, name=name)
        y = upright.rio.y_dim
        return answer.isel({y: slice(None, None, -1)}) if _is_flipped(self._array) else answer


def _upright(array: xarray.DataArray) -> xarray.DataArray:
    """Heights as (y, x), the northern row first. Raises ``ValueError``."""
    if array.ndim != 2:
        raise ValueError(f"the array has the dimensions {array.dims}; it must have two, y and x")
    array = array.transpose(array.rio.y_dim, array.rio.x_dim)
    return array.isel({array.rio.y_dim: slice(None, None, -1)}) if _is_flipped(array) else array


def _is_flipped(array: xarray.DataArray) -> bool:
    y = array[array.rio.y_dim].to_numpy()
    return bool(y.size > 1 and y[0] < y[-1])


def _crs(array: xarray.DataArray) -> str:
    if array.rio.crs is None:
        raise InputError("crs", None, "an array with a CRS: da.rio.write_crs(...)")
    return str(array.rio.crs.to_wkt())


class _Staged:
    """A temporary raster that chunks are written to, and read from once all are there."""

    def __init__(self, array: xarray.DataArray) -> None:
        folder = tempfile.mkdtemp(prefix="skugga-")
        self._gone = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.path = Path(folder) / "heights.tif"
        self._lock, self._levels = threading.Lock(), threading.local()
        self.transform: Affine = array.rio.transform(recalc=True)
        rows, cols = array.shape
        self._nodata = array.rio.nodata
        self._dataset = rasterio.open(
            self.path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype="float32", nodata=float("nan"),
            crs=_crs(array), transform=self.transform, tiled=True, blockxsize=TILE, blockysize=TILE, compress="lzw",
            bigtiff="if_safer", sparse_ok=True,
        )  # fmt: skip

    def __setitem__(self, where: tuple[slice, slice], chunk: np.ndarray) -> None:
        rows, cols = where
        window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        with self._lock:
            if self._dataset.closed:  # the answer is computed once more
                return
            self._dataset.write(np.asarray(chunk, np.float32), 1, window=window)

    def finished(self, *_: Any) -> _Staged:
        """Itself, once all is written."""
        with self._lock:
            if not self._dataset.closed:
                steps = [2**n for n in range(1, 20) if max(self._dataset.shape) / 2**n >= MOST_OVERVIEW_CELLS]
                if steps:
                    self._dataset.build_overviews(steps, Resampling.average)
                self._dataset.close()
        return self

    def level(self) -> OpenLevel:
        """The raster as an open level, one for each thread."""
        opened: OpenLevel | None = getattr(self._levels, "opened", None)
        if opened is None:
            opened = self._levels.opened = open_level(self.path, units="m", positive="up")  # as arrays in memory
        return opened


def _by_chunk(array: xarray.DataArray, made: Callable[..., np.ndarray], dtype: type) -> Any:
    import dask.array
    from dask.delayed import delayed

    staged = _Staged(array)
    stored = dask.array.store(array.data, staged, lock=False, compute=False)  # type: ignore[arg-type]
    ready = delayed(staged.finished)(stored)

    def chunk(ready: _Staged, block_info: Any = None) -> np.ndarray:
        (top, bottom), (left, right) = block_info[None]["array-location"]
        at = ready.transform
        bounds = at.c + at.a * left, at.f + at.e * bottom, at.c + at.a * right, at.f + at.e * top
        return made(ready.level(), bounds=bounds).astype(dtype)

    return dask.array.map_blocks(  # type: ignore[no-untyped-call]
        chunk, ready=ready, chunks=array.chunks, dtype=dtype, meta=np.empty((0, 0), dtype)
    )
