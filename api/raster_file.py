"""Rasters of any size, written window by window and finished as cloud-optimised GeoTIFFs: whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from pyproj import CRS
from rasterio.io import DatasetWriter
from rasterio.shutil import copy
from rasterio.windows import Window

TILE = 512


@dataclass(frozen=True, eq=False)
class RasterCells:
    """The cells of a raster, whoever states them: ``name``, CRS, geotransform, rows and columns."""

    name: str
    crs: CRS
    transform: Affine
    rows: int
    cols: int


class RasterFile:
    """A raster that is being written."""

    def __init__(self, dataset: DatasetWriter) -> None:
        self._dataset = dataset

    def write(self, row: int, col: int, array: np.ndarray) -> None:
        """Write (rows, cols) or (rows, cols, bands) from a cell on."""
        bands = array[None] if array.ndim == 2 else np.moveaxis(array, -1, 0)
        self._dataset.write(bands, window=Window(col, row, array.shape[1], array.shape[0]))


@contextmanager
def cog(
    path: Path, crs: CRS, transform: Affine, shape: tuple[int, int], bands: int, dtype: str, nodata: float | None, smooth: bool
) -> Iterator[RasterFile]:
    """A COG to be written; ``smooth``: its overviews are means, else they repeat cells.

    It takes its place when all is written; where that fails, what lay there stays. Raises ``OSError`` and rasterio's errors.
    """
    rows, cols = shape
    with rasterio.Env(), tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        raw, done = Path(folder) / "raw.tif", Path(folder) / "cog.tif"
        with rasterio.open(
            raw, "w", driver="GTiff", width=cols, height=rows, count=bands, dtype=dtype, crs=crs.to_wkt(), transform=transform,
            nodata=nodata, tiled=True, blockxsize=TILE, blockysize=TILE, compress="lzw", bigtiff="if_safer", sparse_ok=True,
        ) as dataset:  # fmt: skip
            yield RasterFile(dataset)
        copy(
            raw, done, driver="COG", COMPRESS="DEFLATE", BLOCKSIZE=TILE, BIGTIFF="IF_SAFER",
            OVERVIEW_RESAMPLING="AVERAGE" if smooth else "NEAREST", NUM_THREADS="ALL_CPUS",
        )  # fmt: skip
        with suppress(OSError):
            done.chmod(0o666 & ~_umask())
        os.replace(done, path)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
