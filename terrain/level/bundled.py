"""Bundled data sets: rasters of measured heights, read from files of installed Python packages. They need no download."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.crs import CRS
from rasterio.io import MemoryFile
from rasterio.warp import Resampling, calculate_default_transform, reproject

from skugga.terrain.cache import MIB, cached


def _write_to_memory(heights: np.ndarray, crs: CRS, transform: Affine, nodata: float | None) -> MemoryFile:
    """Return a GeoTIFF in memory with the heights (rows, cols), north row first.

    ``nodata`` is the value of cells without a height.
    """
    rows, cols = heights.shape
    memory = MemoryFile(ext=".tif")
    with memory.open(
        driver="GTiff", width=cols, height=rows, count=1, dtype=heights.dtype, crs=crs, transform=transform, nodata=nodata,
        tiled=True, blockxsize=256, blockysize=256,
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
    return memory


def _sample_data_path(name: str) -> Path:
    """Return the path of a file of matplotlib's sample data.

    The file is first looked up in the package's folder, without importing matplotlib, which takes a fifth of a second. If it is not
    there, matplotlib is imported to find it.
    """
    package = find_spec("matplotlib")
    for folder in () if package is None else package.submodule_search_locations or ():
        file = Path(folder) / "mpl-data" / "sample_data" / name
        if file.is_file():
            return file
    from matplotlib.cbook import get_sample_data

    return Path(get_sample_data(name, asfileobj=False))


@cached("process", 64 * MIB, size_of=len)
def _jacksboro() -> MemoryFile:
    """Return SRTM heights around the Jacksboro fault, 3 arc seconds, from matplotlib's sample data."""
    with np.load(_sample_data_path("jacksboro_fault_dem.npz")) as data:
        # "ymax" is the raster's north edge. Row 0 is the northernmost row: with this edge the highest cell is Cross Mountain
        # (36.1983 N). "ymin" is not an edge: it lies as far north of "ymax" as the raster extends south of it. "xmin" and "ymax"
        # are cell edges, not centres: cell centres are then multiples of 3 arc seconds, where SRTM has its heights.
        transform = Affine(float(data["dx"]), 0, float(data["xmin"]), 0, -float(data["dy"]), float(data["ymax"]))
        return _write_to_memory(data["elevation"], CRS.from_epsg(4326), transform, None)


@cached("process", 64 * MIB, size_of=len)
def _jacksboro_utm() -> MemoryFile:
    """Return the heights of ``_jacksboro`` resampled to 30 m in UTM zone 16N, bicubic."""
    with _jacksboro().open() as source:
        crs = CRS.from_epsg(32616)
        transform, cols, rows = calculate_default_transform(
            source.crs, crs, source.width, source.height, *source.bounds, resolution=30
        )
        heights = np.full((rows, cols), np.nan, np.float32)
        reproject(
            rasterio.band(source, 1), heights, dst_transform=transform, dst_crs=crs, dst_nodata=np.nan,
            resampling=Resampling.cubic,
        )  # fmt: skip
    return _write_to_memory(heights, crs, transform, np.nan)


BUNDLED: dict[str, Callable[[], MemoryFile]] = {"jacksboro": _jacksboro, "jacksboro_utm": _jacksboro_utm}
"""Name of a data set -> function that returns the raster in memory, cached per process."""
