"""The xarray accessor ``da.skugga``: shadows, sun, horizons and sky view factors of a DataArray of heights, on its coordinates.

CRS and geotransform follow rioxarray's conventions. A dask array stays lazy: the whole array is never in memory. Its heights are
written once, chunk by chunk, to a temporary raster. Each chunk of the result is computed from that raster, with all casters within
reach.
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

from skugga.api.library.argument_types import AltitudeDeg, AzimuthCount, AzimuthDeg, Date, Time, validate_arguments
from skugga.api.library.grids import grid_of_heights
from skugga.api.library.north_up_grid import NorthUpGrid, north_up_grid
from skugga.api.library.opened_level import ARRAY_NAME, OpenLevel, level_of_source
from skugga.api.products import product_named
from skugga.api.products.irradiation import IrradiationOptions
from skugga.api.raster_file import TILE_SIDE_CELLS
from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, SkyViewKind, evenly_spaced_azimuths_deg
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.errors import InputError
from skugga.terrain.level.level_source import LevelSource

MIN_OVERVIEW_CELLS = 512
"""Minimum cells along the longer side of an overview of a temporary raster."""

CPU_ALGORITHM = next(
    name
    for name, algorithm in ALGORITHMS.items()
    if not algorithm.needs_opengl and any(algorithm.lit_nodes_finder(settings()) for settings in algorithm.settings_types)
)
"""Algorithm for dask arrays, which needs no OpenGL: dask computes chunks in threads, and OpenGL works in one thread."""


class SkuggaAccessor:
    """Accessor for shadows and sun of heights (y, x) in metres, with a CRS set by ``rio.write_crs``.

    Cells are without ground if their height is NaN, masked, or the array's nodata (``rio.nodata``). The attributes
    ``scale_factor``, ``add_offset``, ``units``, ``positive`` and ``standard_name`` have the same meaning as in a file. Rows and
    columns may run in either direction. Results have the same order as the array. Heights that look wrong, for example an
    undeclared nodata value, cause a ``UserWarning``.
    """

    def __init__(self, array: xarray.DataArray) -> None:
        self._array = array

    @validate_arguments
    def shadow(
        self,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        **shadows: Any,
    ) -> xarray.DataArray:
        """Return which cells lie in shadow, cast or self-shadow.

        Parameters
        ----------
        time
            The time of the sun, with an offset from UTC, or datetime64 in UTC.
        azimuth, altitude
            The direction of the sun in degrees, clockwise from north and above the horizon. They replace ``time``.
        **shadows
            Keys of a level's ``shadows``, as ``algorithm="shadow_map"``.

        Returns
        -------
        xarray.DataArray
            bool, False without ground.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for an array that is not a grid of heights.
        """
        if time is None and azimuth is None and altitude is None:
            raise InputError.missing("time", "Give a time, or an azimuth and an altitude")

        def compute_array(level: OpenLevel, **cells: Any) -> np.ndarray:
            settings_by_key = {**({"algorithm": CPU_ALGORITHM} if cells else {}), **shadows}
            visibility = level.shade("visibility", time=time, azimuth=azimuth, altitude=altitude, **cells, **settings_by_key)
            return visibility < 0.5  # False for NaN, which are cells without ground

        return self._compute_data_array("shadow", compute_array, np.bool_)

    @validate_arguments
    def sun_hours(self, date: Date, **rules: Any) -> xarray.DataArray:
        """Return the hours of direct sun, or another quantity of direct sun.

        Parameters
        ----------
        date
            The date, or the first of several dates.
        **rules
            ``to``, ``window``, ``clock``, ``quantity`` and other parameters of ``OpenLevel.sun_hours``.

        Returns
        -------
        xarray.DataArray
            float32, NaN without ground.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for an array that is not a grid of heights.
        """

        def compute_array(level: OpenLevel, **cells: Any) -> np.ndarray:
            return level.sun_hours(date, **cells, **rules)

        return self._compute_data_array("sun_hours", compute_array, np.float32)

    @validate_arguments
    def irradiation(self, date: Date | None = None, **options: Any) -> xarray.DataArray:
        """Return the energy of sunlight and skylight over dates, kWh/m2.

        Parameters
        ----------
        date
            The date, or the first of several dates.
        **options
            ``to``, ``year``, ``per``, ``part``, ``tilt`` and other parameters of ``OpenLevel.irradiation``.

        Returns
        -------
        xarray.DataArray
            float32, NaN without ground. With several periods or parts the first dimension is ``band``, their names.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for an array that is not a grid of heights.
        """
        options_model = product_named("irradiation").options_of({"date": date, **options})
        assert isinstance(options_model, IrradiationOptions)
        names = options_model.band_names

        def compute_array(level: OpenLevel, **cells: Any) -> np.ndarray:
            return level.irradiation(date, **cells, **options)

        bands = xarray.DataArray(list(names), dims="band", name="band") if len(names) > 1 else None
        return self._compute_data_array("irradiation", compute_array, np.float32, bands)

    @validate_arguments
    def sky_view(self, kind: SkyViewKind = "solid_angle", azimuths: AzimuthCount = DEFAULT_AZIMUTHS) -> xarray.DataArray:
        """Return the sky view factor.

        Parameters
        ----------
        kind
            The definition, as in ``skugga.sky_view``: ``solid_angle``, ``cosine``, ``tilted``, ``openness`` or
            ``negative_openness``.
        azimuths
            The number of azimuths, 8 to 360.

        Returns
        -------
        xarray.DataArray
            float32, 0 to 1 or degrees; NaN without ground.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for an array that is not a grid of heights.
        """

        def compute_array(level: OpenLevel, **cells: Any) -> np.ndarray:
            return level.sky_view(kind, azimuths=azimuths, **cells)

        return self._compute_data_array("sky_view", compute_array, np.float32)

    @validate_arguments
    def horizons(self, azimuths: AzimuthCount = DEFAULT_AZIMUTHS) -> xarray.DataArray:
        """Return the horizons of all cells.

        Parameters
        ----------
        azimuths
            The number of azimuths, 8 to 360.

        Returns
        -------
        xarray.DataArray
            Horizon angles in degrees, float32: -90 where no ground lies towards an azimuth, NaN without ground. The first dimension
            is ``azimuth``, in degrees clockwise from true north.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for an array that is not a grid of heights.
        """

        def compute_array(level: OpenLevel, **cells: Any) -> np.ndarray:
            return level.horizons(azimuths, **cells)

        azimuth = xarray.DataArray(evenly_spaced_azimuths_deg(azimuths), dims="azimuth", name="azimuth")
        return self._compute_data_array("horizons", compute_array, np.float32, azimuth)

    @validate_arguments
    def horizon(self, x: float, y: float, height: float = 0.0) -> xarray.DataArray:
        """Return the horizon profile of a point. A dask array is read into memory.

        Parameters
        ----------
        x, y
            The point, in the coordinates of the array.
        height
            Metres above the ground.

        Returns
        -------
        xarray.DataArray
            Horizon angles in degrees, by ``azimuth`` in degrees clockwise from true north.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for an array that is not a grid of heights.
        """
        with north_up_grid(self._array).level() as level:
            profile = level.horizon(x, y, height=height, crs=level.crs)
        return xarray.DataArray(profile.elevation_deg, dims="azimuth", coords={"azimuth": profile.azimuth_deg}, name="horizon")

    def _compute_data_array(
        self, name: str, compute_array: Callable[..., np.ndarray], dtype: type, bands: xarray.DataArray | None = None
    ) -> xarray.DataArray:
        """Return a DataArray with the name ``name`` and values of the type ``dtype``, on the coordinates of the array.

        ``compute_array`` computes the values, (rows, cols) in north-up order, from an open level. They are (bands, rows, cols) with
        ``bands``, the coordinate of a further dimension.
        """
        grid = north_up_grid(self._array)
        if grid.heights.chunks is None:
            with grid.level() as level:
                values: Any = compute_array(level)
        else:
            values = _compute_by_chunk(grid, compute_array, dtype, () if bands is None else (bands.size,))
        dims, coords = grid.heights.dims, dict(grid.heights.coords)
        if bands is not None:
            dims, coords = (bands.name, *dims), {**coords, bands.name: bands}
        answer = xarray.DataArray(values, dims=dims, coords=coords, name=name).isel(grid.flip_slices)
        leading_dims = dims[: len(dims) - grid.heights.ndim]
        return answer.transpose(*leading_dims, *self._array.dims).rio.write_grid_mapping(self._array.rio.grid_mapping)


class _StagedRaster:
    """A temporary raster. Dask first writes all chunks to it; its tasks then open it as a level."""

    def __init__(self, grid: NorthUpGrid) -> None:
        folder = tempfile.mkdtemp(prefix="skugga-")
        self._cleanup = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.path = Path(folder) / "heights.tif"
        self._lock, self._levels = threading.Lock(), threading.local()
        rows, cols = grid.heights.shape
        self._dataset = rasterio.open(
            self.path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype="float32", nodata=float("nan"),
            crs=grid.crs.to_wkt(), transform=grid.transform, tiled=True, blockxsize=TILE_SIDE_CELLS, blockysize=TILE_SIDE_CELLS,
            compress="lzw", bigtiff="if_safer", sparse_ok=True,
        )  # fmt: skip

    def __setitem__(self, slices: tuple[slice, slice], chunk: np.ndarray) -> None:
        """Write a chunk of heights to the cells of the raster that ``slices``, of rows and of columns, select. Dask calls it."""
        rows, cols = slices
        window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        with self._lock:
            if self._dataset.closed:  # the result is computed a second time
                return
            self._dataset.write(grid_of_heights(chunk), 1, window=window)

    def finish(self, *_: Any) -> _StagedRaster:
        """Build the raster's overviews and close it after all chunks are written. Return self."""
        with self._lock:
            if not self._dataset.closed:
                steps = [2**n for n in range(1, 20) if max(self._dataset.shape) / 2**n >= MIN_OVERVIEW_CELLS]
                if steps:
                    self._dataset.build_overviews(steps, Resampling.average)
                self._dataset.close()
        return self

    def level(self) -> OpenLevel:
        """Return the raster as an open level. Each thread gets a level of its own."""
        opened: OpenLevel | None = getattr(self._levels, "opened", None)
        if opened is None:
            source = LevelSource(path=self.path, units="m", positive="up")  # as for arrays in memory
            opened = self._levels.opened = level_of_source(source, ARRAY_NAME)
        return opened


def _compute_by_chunk(
    grid: NorthUpGrid, compute_array: Callable[..., np.ndarray], dtype: type, leading_shape: tuple[int, ...] = ()
) -> Any:
    """Return a lazy dask array of the type ``dtype`` with the grid's chunks, whose tasks open the written raster as a level.

    ``compute_array`` computes the values of the cells that ``cells``, slices of rows and of columns, select. ``leading_shape``
    is the shape of dimensions before rows and columns, which are not divided.
    """
    import dask.array
    from dask.delayed import delayed

    staged = _StagedRaster(grid)
    stored = dask.array.store(grid.heights.data, staged, lock=False, compute=False)  # type: ignore[arg-type]
    staged_raster = delayed(staged.finish)(stored)

    def chunk(staged_raster: _StagedRaster, block_info: Any = None) -> np.ndarray:
        (top, bottom), (left, right) = block_info[None]["array-location"][-2:]
        return compute_array(staged_raster.level(), cells=(slice(top, bottom), slice(left, right))).astype(dtype)

    chunks = *((count,) for count in leading_shape), *(grid.heights.chunks or ())
    return dask.array.map_blocks(  # type: ignore[no-untyped-call]
        chunk, staged_raster=staged_raster, chunks=chunks, dtype=dtype, meta=np.empty((0,) * len(chunks), dtype)
    )
