"""External overviews of a raster: means of 2 x 2, 4 x 4, ... cells in a file with the raster's name and the suffix ``.ovr``.

The raster itself is only read. An overview cell is the mean of the valid heights below it, and is empty if there are none. Invalid
cells are the nodata cells and the cells with implausible values.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import rasterio
from rasterio.enums import MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetWriter
from rasterio.windows import Window

from skugga.api.raster_file import check_raster
from skugga.terrain.atomic_files import atomic_path, write_error
from skugga.terrain.compiled import compiled
from skugga.terrain.errors import InputError, SourceError
from skugga.terrain.ground.elevation import plausible_heights_m
from skugga.terrain.ground.georeference import checked_crs
from skugga.terrain.ground.open_raster import GTIFF_VERTICAL_CRS_OPTIONS
from skugga.terrain.ground.overview import lacks_overviews, overview_lod
from skugga.terrain.ground.vertical import vertical_axis
from skugga.terrain.level.parts import Positive, Units
from skugga.terrain.level.rasters import open_raster

TILE_SIDE_CELLS = 512
"""Side of a tile of the file, cells."""

TILES_PER_WINDOW = 8
"""Number of adjacent tiles that are computed from one window of the raster."""

GDALADDO_REMEDY = "Use gdaladdo for such a raster"


def reason_against_overviews(raster: Path) -> str | None:
    """Return why a raster needs no further overviews, as text; ``None`` if it needs some.

    Raises ``SourceError``.
    """
    with _open_raster(raster) as dataset:
        rows, cols, factors = dataset.height, dataset.width, dataset.overviews(1)
        if lacks_overviews(rows, cols, factors):
            return None
        if factors and lacks_overviews(rows, cols, []):
            return f"{raster.name} has overviews with the factors {', '.join(map(str, factors))}, and needs no others"
        return f"{raster.name} needs no overviews: {cols} x {rows} cells are few enough to be read as they are"


def make_overviews(
    raster: Path,
    nodata: float | None = None,
    units: Units | None = None,
    positive: Positive | None = None,
    on_part: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the external overviews of a height raster atomically, and return their file.

    Parameters
    ----------
    raster
        Raster of heights.
    nodata
        A further nodata value, besides the declared one.
    units, positive
        Unit and direction of the heights. They override the raster's own metadata.
    on_part
        Called as ``on_part(done, total)`` after each window of cells, with the number of finished windows and their total.

    Raises
    ------
    SourceError
        The raster cannot be read, or cannot have external overviews.
    InputError
        No cell can have the ``nodata`` value.
    OSError
        The file cannot be written.
    """
    target = raster.with_name(f"{raster.name}.ovr")
    with ExitStack() as stack:
        stack.enter_context(rasterio.Env())
        stack.enter_context(warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning))  # overviews have none
        dataset = stack.enter_context(_open_raster(raster))
        _check_supported(raster, target, dataset, nodata)
        dtype, limits = np.dtype(dataset.dtypes[0]), _plausible_range(dataset, units, positive)
        overview_nodata = _nodata_value(dtype, limits, dataset.nodata if nodata is None else nodata)
        rows, cols = (-(-size // 2) for size in dataset.shape)
        parts = [*_tile_windows(rows, cols)]
        total = len(parts) + max(len(parts) // 3, 1)  # the coarser overviews have a third of the cells
        with atomic_path(target) as partial_path:
            with rasterio.open(
                partial_path, "w", driver="GTiff", width=cols, height=rows, count=1, dtype=dtype, nodata=overview_nodata,
                tiled=True, blockxsize=TILE_SIDE_CELLS, blockysize=TILE_SIDE_CELLS, compress="deflate", zlevel=1,
                num_threads="ALL_CPUS", predictor=3 if dtype.kind == "f" else 2, bigtiff="if_safer", sparse_ok=True,
            ) as first_overview:  # fmt: skip
                for done, window in enumerate(parts, start=1):
                    _write_window(
                        first_overview, _read_first_overview(dataset, window, limits, nodata, overview_nodata), window, partial_path
                    )
                    if on_part is not None:
                        on_part(done, total)
                factors = [2**n for n in range(1, overview_lod(*dataset.shape))]
                if factors:
                    _build_coarser_overviews(first_overview, factors, partial_path)
            check_raster(partial_path)
    if on_part is not None:
        on_part(total, total)
    with _open_raster(raster) as dataset:
        if lacks_overviews(dataset.height, dataset.width, dataset.overviews(1)):
            target.unlink()
            raise SourceError(str(raster), f"GDAL looks for no external overviews of a {dataset.driver} file", GDALADDO_REMEDY)
    return target


def _write_window(half_raster: DatasetWriter, values: np.ndarray, window: Window, path: Path) -> None:
    """Write the cells of a window of the first overview. Raises ``OSError``, which names the file ``path``."""
    try:
        half_raster.write(values, 1, window=window)
    except RasterioError as error:
        raise write_error(path, "the overviews", error) from error


def _build_coarser_overviews(half_raster: DatasetWriter, factors: list[int], path: Path) -> None:
    """Add overviews of the first overview, each with cells ``factors`` times as long. Raises ``OSError``, which names ``path``."""
    try:
        half_raster.build_overviews(factors, Resampling.average)
    except Exception as error:  # GDAL's own errors, for which rasterio has no public base class
        raise write_error(path, "the overviews", error) from error


def _open_raster(raster: Path) -> rasterio.DatasetReader:
    """Open a raster of heights, with the axes that its vertical CRS declares. Raises ``SourceError``."""
    try:
        with rasterio.Env(**GTIFF_VERTICAL_CRS_OPTIONS), warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning):
            return open_raster(str(raster))
    except RasterioError:
        raise SourceError(str(raster), "cannot be opened", "Use a raster that GDAL reads") from None


def _check_supported(raster: Path, target: Path, dataset: rasterio.DatasetReader, nodata: float | None) -> None:
    """Raise ``SourceError`` for rasters that cannot have external overviews, and ``InputError`` for an impossible ``nodata``."""
    flags = dataset.mask_flag_enums[0] if dataset.count else []
    reasons = {
        f"{dataset.count} bands": dataset.count != 1,
        f"cells of type {dataset.dtypes[0] if dataset.count else None}": bool(dataset.count)
        and np.dtype(dataset.dtypes[0]).kind not in "iuf",
        "a mask band": MaskFlags.per_dataset in flags or MaskFlags.alpha in flags,
        "overviews in the file itself, which hide external ones": bool(
            dataset.count and dataset.overviews(1) and not target.is_file()
        ),
    }
    for reason, applies in reasons.items():
        if applies:
            raise SourceError(str(raster), reason, f"Only one band of heights without overviews is supported. {GDALADDO_REMEDY}")
    dtype = np.dtype(dataset.dtypes[0])
    if nodata is not None and dtype.kind in "iu":
        limits = np.iinfo(dtype)
        if not (float(nodata).is_integer() and limits.min <= nodata <= limits.max):
            raise InputError("--nodata", f"{nodata:g}", f"a value of the raster's cell type, {dtype}")


def _plausible_range(dataset: rasterio.DatasetReader, units: Units | None, positive: Positive | None) -> tuple[float, float]:
    """Return the lowest and the highest cell value that count as plausible heights, in the raster's own unit."""
    scale, offset = dataset.scales[0], dataset.offsets[0]
    unit_m = vertical_axis(dataset.name, dataset, units, positive).metres_per_stored_unit
    low, high = sorted((limit / unit_m - offset) / scale for limit in plausible_heights_m(checked_crs(dataset.name, dataset)))
    return low, high


def _nodata_value(dtype: np.dtype, plausible_range: tuple[float, float], nodata: float | None) -> float | None:
    """Return the overviews' nodata value, which no valid height has; ``None`` if all values of the type are plausible heights.

    ``dtype`` is the type of the cells, and ``nodata`` is the raster's own nodata value; ``None`` without one.
    """
    if nodata is not None:
        return nodata
    if dtype.kind == "f":
        return float("nan")
    bounds = np.iinfo(dtype).min, np.iinfo(dtype).max
    return next((float(value) for value in bounds if not plausible_range[0] <= value <= plausible_range[1]), None)


def _tile_windows(rows: int, cols: int) -> Iterator[Window]:
    """Yield windows that cover an overview of ``rows`` x ``cols`` cells.

    Each window is one tile high and up to ``TILES_PER_WINDOW`` tiles wide.
    """
    window_cols = TILE_SIDE_CELLS * TILES_PER_WINDOW
    for row in range(0, rows, TILE_SIDE_CELLS):
        for col in range(0, cols, window_cols):
            yield Window(col, row, min(window_cols, cols - col), min(TILE_SIDE_CELLS, rows - row))


def _read_first_overview(
    dataset: rasterio.DatasetReader,
    window: Window,
    plausible_range: tuple[float, float],
    nodata: float | None,
    empty_value: float | None,
) -> np.ndarray:
    """Return a window of the first overview, computed from twice as many rows and columns of the raster.

    ``window`` counts cells of the overview. ``nodata`` is a further nodata value of the raster, and ``empty_value`` is the
    overview's nodata value; both may be ``None``. Cells outside ``plausible_range`` are invalid.
    """
    row, col = 2 * window.row_off, 2 * window.col_off
    source_window = Window(col, row, min(2 * window.width, dataset.width - col), min(2 * window.height, dataset.height - row))
    try:
        values = dataset.read(1, window=source_window)
    except RasterioError:
        raise SourceError(dataset.name, "a part cannot be read", "Use an undamaged file") from None
    nodata_values = [value for value in (dataset.nodata, nodata) if value is not None and not np.isnan(value)]
    first, second = (nodata_values * 2)[:2] if nodata_values else (np.nan, np.nan)
    means = _means(
        values, plausible_range[0], plausible_range[1], first, second, np.nan if empty_value is None else float(empty_value)
    )
    return (np.rint(means) if values.dtype.kind in "iu" else means).astype(values.dtype)


@compiled
def _means(values, low, high, nodata, other_nodata, empty):
    """Return the means of the valid cells of each 2 x 2 cells, of fewer at the border; ``empty`` where none is valid.

    ``values`` are the raster's cells, (rows, cols). Valid cells lie from ``low`` to ``high`` and are neither ``nodata`` nor
    ``other_nodata``.
    """
    rows, cols = values.shape
    out = np.empty(((rows + 1) // 2, (cols + 1) // 2))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total, count = 0.0, 0
            for y in range(2 * i, min(2 * i + 2, rows)):
                for x in range(2 * j, min(2 * j + 2, cols)):
                    value = np.float64(values[y, x])
                    if value >= low and value <= high and value != nodata and value != other_nodata:
                        total += value
                        count += 1
            out[i, j] = total / count if count > 0 else empty
    return out
