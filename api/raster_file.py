"""Cloud-optimised GeoTIFFs of any size, written window by window and atomically."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from pyproj import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.io import DatasetWriter
from rasterio.shutil import copy
from rasterio.windows import Window

from skugga.api.raster_profile import RasterProfile
from skugga.terrain.atomic_files import atomic_path, write_error
from skugga.terrain.cache import MIB

TILE_SIDE_CELLS = 512
"""Side of a tile of the file, cells."""

MIN_TILE_SIDE_CELLS, MAX_TILE_BYTES = 64, 4 * MIB
"""Side of the tiles of files with many bands: at least so many cells, halved until a tile has at most so many bytes.

A tile holds all bands, and to read a cell is to read its tile.
"""


def tile_side_cells(profile: RasterProfile) -> int:
    """Return the side of the tiles of a file, cells."""
    side, cell_bytes = TILE_SIDE_CELLS, profile.bands * np.dtype(profile.dtype).itemsize
    while side > MIN_TILE_SIDE_CELLS and side * side * cell_bytes > MAX_TILE_BYTES:
        side //= 2
    return side


@dataclass(frozen=True, eq=False)
class RasterCells:
    """The cell grid of a raster.

    Attributes
    ----------
    name
        Name for messages: a path.
    crs
        Coordinate reference system.
    transform
        GDAL's geotransform, from columns and rows to coordinates.
    rows, cols
        Number of rows and columns.
    """

    name: str
    crs: CRS
    transform: Affine
    rows: int
    cols: int


@dataclass(frozen=True, eq=False)
class RasterMetadata:
    """Metadata of a raster.

    Attributes
    ----------
    description
        Description of the raster, one sentence.
    band_descriptions
        Descriptions of the bands.
    unit
        Unit of all bands.
    tags
        Further tags.
    """

    description: str
    band_descriptions: tuple[str, ...]
    unit: str = ""
    tags: dict[str, str] = field(default_factory=dict)

    def write(self, dataset: DatasetWriter) -> None:
        """Write the metadata into a raster."""
        dataset.update_tags(
            TIFFTAG_SOFTWARE=f"Skugga {version('skugga')}", TIFFTAG_IMAGEDESCRIPTION=self.description,
            **{name.upper(): text for name, text in self.tags.items() if text},
        )  # fmt: skip
        dataset.descriptions = self.band_descriptions
        dataset.units = [self.unit] * dataset.count
        dataset.colorinterp = (
            RGBA_INTERPRETATION
            if dataset.count == len(RGBA_INTERPRETATION) and dataset.dtypes[0] == "uint8"
            else [ColorInterp.gray] * dataset.count
        )


RGBA_INTERPRETATION = ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha


class RasterFile:
    """A raster file open for writing only: arrays can be written, but not read back, until ``open_cog`` has finished it."""

    def __init__(self, dataset: DatasetWriter) -> None:
        self._dataset = dataset

    def write(self, row: int, col: int, array: np.ndarray) -> None:
        """Write an array (rows, cols) or (rows, cols, bands) whose first cell lies at ``row`` and ``col`` of the raster.

        Raises ``OSError``.
        """
        bands = array[None] if array.ndim == 2 else np.moveaxis(array, -1, 0)
        try:
            self._dataset.write(bands, window=Window(col, row, array.shape[1], array.shape[0]))
        except RasterioError as error:
            raise write_error(Path(self._dataset.name), "the raster", error) from error


@contextmanager
def open_cog(
    path: Path,
    crs: CRS,
    transform: Affine,
    shape: tuple[int, int],
    profile: RasterProfile,
    is_smooth: bool,
    metadata: RasterMetadata | None = None,
) -> Iterator[RasterFile]:
    """Open a cloud-optimised GeoTIFF for writing.

    ``transform`` is GDAL's geotransform, and ``shape`` is (rows, cols). ``profile`` is the form of the cells. If ``is_smooth``,
    overviews are means; otherwise they take the nearest cell. The file replaces ``path`` after it has been written and read back. A
    failure leaves the previous file in place. Raises ``OSError``.
    """
    (rows, cols), side = shape, tile_side_cells(profile)
    with rasterio.Env(), atomic_path(path) as target:
        raw = target.parent / "cells" / "raw.tif"
        raw.parent.mkdir()
        with rasterio.open(
            raw, "w", driver="GTiff", width=cols, height=rows, count=profile.bands, dtype=profile.dtype, nodata=profile.nodata,
            crs=crs.to_wkt(), transform=transform, tiled=True, blockxsize=side, blockysize=side, compress="lzw",
            bigtiff="if_safer", sparse_ok=True,
        ) as dataset:  # fmt: skip
            if profile.scale != 1.0:
                dataset.scales = [profile.scale] * profile.bands
            if metadata is not None:
                metadata.write(dataset)
            yield RasterFile(dataset)
        try:
            copy(
                raw, target, driver="COG", COMPRESS="DEFLATE", BLOCKSIZE=side, BIGTIFF="IF_SAFER",
                OVERVIEW_RESAMPLING="AVERAGE" if is_smooth else "NEAREST", NUM_THREADS="ALL_CPUS",
            )  # fmt: skip
        except Exception as error:  # GDAL's own errors, for which rasterio has no public base class
            raise write_error(target, "the raster", error) from error
        check_raster(target)


def check_raster(path: Path) -> None:
    """Read every block of a written raster, because GDAL may close a file on a full disk without an error. Raises ``OSError``."""
    try:
        with rasterio.open(path) as dataset:
            for _, window in dataset.block_windows(1):
                dataset.read(window=window)
            overviews = len(dataset.overviews(1))
        for level in range(overviews):
            with rasterio.open(path, OVERVIEW_LEVEL=level) as dataset:
                for _, window in dataset.block_windows(1):
                    dataset.read(window=window)
    except RasterioError as error:
        raise write_error(path, "the raster", error) from error
