"""``da.skugga`` of xarray: shade of a DataArray of heights, on its own coordinates.

Its CRS and geotransform follow rioxarray's conventions. An array of dask stays one: it is written once, chunk by chunk, into a
temporary raster, and each chunk of the answer is made from there, with casters as far as they reach; never is all of it in memory.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import xarray
from rasterio.enums import Resampling
from rasterio.windows import Window

from skugga.api.library.checked import AltitudeDeg, AzimuthDeg, Date, Time, checked
from skugga.api.library.grids import grid_of_heights
from skugga.api.library.opened_level import OpenLevel, open_level
from skugga.api.library.upright_grid import UprightGrid, upright_grid
from skugga.api.raster_file import TILE
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.errors import InputError

MOST_OVERVIEW_CELLS = 512
"""Of the coarsest overview of a temporary raster, a side."""

WITHOUT_OPENGL = next(
    name
    for name, algorithm in ALGORITHMS.items()
    if not algorithm.needs_opengl and any(algorithm.node_fill(settings()) for settings in algorithm.settings)
)
"""The algorithm that heights alone suffice for: chunks are made in threads of dask's, and OpenGL has one thread."""


class SkuggaAccessor:
    """Questions of sun to heights (y, x), metres, with a CRS by ``rio.write_crs``.

    There is no ground where heights are NaN, masked, or the array's nodata (``rio.nodata``). Its attributes ``scale_factor``,
    ``add_offset``, ``units``, ``positive`` and ``standard_name`` are heeded as those of a file. Rows and columns may run either
    way; answers have their order.
    """

    def __init__(self, array: xarray.DataArray) -> None:
        self._array = array

    @checked
    def shadow(
        self,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        **shadows: Any,
    ) -> xarray.DataArray:
        """Where there is shadow, cast or the ground's own: bool, False where there is no ground.

        The sun is that of a ``time`` (with an offset from UTC, or datetime64 in UTC), or of ``azimuth`` (clockwise from north) and
        ``altitude``, degrees. Raises ``SkuggaError``, also for arrays that are no grid of heights.
        """
        if time is None and azimuth is None and altitude is None:
            raise InputError("time", None, "a time, or an azimuth and an altitude")

        def made(level: OpenLevel, **cells: Any) -> np.ndarray:
            asked = {**({"algorithm": WITHOUT_OPENGL} if cells else {}), **shadows}
            visibility = level.shade("visibility", time=time, azimuth=azimuth, altitude=altitude, **cells, **asked)
            return visibility < 0.5  # NaN, where there is no ground, is not

        return self._answer("shadow", made, np.bool_)

    @checked
    def sun_hours(self, date: Date, **rules: Any) -> xarray.DataArray:
        """How long the sun is seen: float32, NaN where there is no ground. ``rules`` are ``to``, ``window``, ``clock``,
        ``quantity`` and others of ``OpenLevel.sun_hours``. Raises as ``shadow``.
        """

        def made(level: OpenLevel, **cells: Any) -> np.ndarray:
            return level.sun_hours(date, **cells, **rules)

        return self._answer("sun_hours", made, np.float32)

    @checked
    def horizon(self, x: float, y: float, height: float = 0.0) -> xarray.DataArray:
        """The horizon of a point, ``height`` metres above the ground, in the array's own coordinates: elevation angles, degrees, by
        ``azimuth``, degrees clockwise from true north. Raises as ``shadow``; an array of dask is read at once.
        """
        with upright_grid(self._array).level() as level:
            found = level.horizon(x, y, height=height, crs=level.crs)
        return xarray.DataArray(found.elevation_deg, dims="azimuth", coords={"azimuth": found.azimuth_deg}, name="horizon")

    def _answer(self, name: str, made: Callable[..., np.ndarray], dtype: type) -> xarray.DataArray:
        """A DataArray like the heights of what is made of an open level."""
        grid = upright_grid(self._array)
        if grid.heights.chunks is None:
            with grid.level() as level:
                values: Any = made(level)
        else:
            values = _by_chunk(grid, made, dtype)
        answer = xarray.DataArray(values, dims=grid.heights.dims, coords=grid.heights.coords, name=name)
        return answer.isel(grid.flips).transpose(*self._array.dims).rio.write_grid_mapping(self._array.rio.grid_mapping)


class _Staged:
    """A temporary raster that chunks are written to, and read from once all are there."""

    def __init__(self, grid: UprightGrid) -> None:
        folder = tempfile.mkdtemp(prefix="skugga-")
        self._gone = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.path = Path(folder) / "heights.tif"
        self._lock, self._levels = threading.Lock(), threading.local()
        rows, cols = grid.heights.shape
        self._dataset = rasterio.open(
            self.path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype="float32", nodata=float("nan"),
            crs=grid.crs.to_wkt(), transform=grid.transform, tiled=True, blockxsize=TILE, blockysize=TILE, compress="lzw",
            bigtiff="if_safer", sparse_ok=True,
        )  # fmt: skip

    def __setitem__(self, where: tuple[slice, slice], chunk: np.ndarray) -> None:
        rows, cols = where
        window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        with self._lock:
            if self._dataset.closed:  # the answer is computed once more
                return
            self._dataset.write(grid_of_heights(chunk), 1, window=window)

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


def _by_chunk(grid: UprightGrid, made: Callable[..., np.ndarray], dtype: type) -> Any:
    import dask.array
    from dask.delayed import delayed

    staged = _Staged(grid)
    stored = dask.array.store(grid.heights.data, staged, lock=False, compute=False)  # type: ignore[arg-type]
    ready = delayed(staged.finished)(stored)

    def chunk(ready: _Staged, block_info: Any = None) -> np.ndarray:
        (top, bottom), (left, right) = block_info[None]["array-location"]
        return made(ready.level(), cells=(slice(top, bottom), slice(left, right))).astype(dtype)

    return dask.array.map_blocks(  # type: ignore[no-untyped-call]
        chunk, ready=ready, chunks=grid.heights.chunks, dtype=dtype, meta=np.empty((0, 0), dtype)
    )
