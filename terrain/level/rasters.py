"""Open rasters of any content with rasterio, and detect which files are rasters."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skugga.terrain.errors import SourceError
from skugga.terrain.level.data_files import check_geodata

if TYPE_CHECKING:
    import rasterio

LEVEL_SUFFIXES = ".yaml", ".yml"

MIN_FREE_DESCRIPTORS = 4
"""Number of file descriptors that must be free after a failed open: of the raster, its side files and PROJ's database."""


def open_raster(source: str, **options: Any) -> rasterio.DatasetReader:
    """Open a raster with options of its driver.

    Raises ``SourceError`` if ``check_geodata`` forbids the file, and ``RasterioError`` or ``OSError`` if it cannot be opened. The
    ``OSError`` has an ``errno`` if the process has no file descriptor left.
    """
    import rasterio  # imported here because level files alone do not need it
    from rasterio.crs import CRS
    from rasterio.errors import CRSError, RasterioError

    check_geodata(source)
    try:
        # Opens PROJ's database, which stays open in this thread. If GDAL cannot open it later, it reports no error, but reads a
        # projected CRS as an engineering CRS.
        CRS.from_epsg(4326)
    except CRSError as error:
        _check_descriptors()
        raise SourceError(source, f"PROJ's database cannot be read ({error})", "Check the installation of PROJ") from None
    try:
        return rasterio.open(source, **options)
    except RasterioError:
        _check_descriptors()
        raise


def _check_descriptors() -> None:
    """Raise ``OSError`` if the process or the system has too few free file descriptors to open a raster."""
    descriptors: list[int] = []
    try:
        for _ in range(MIN_FREE_DESCRIPTORS):
            descriptors.append(os.open(os.devnull, os.O_RDONLY))
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def is_raster(source: Path | str) -> bool:
    """Return whether GDAL reads a file as a raster."""
    from rasterio.errors import RasterioError

    try:
        with warnings.catch_warnings(action="ignore"), open_raster(str(source)) as dataset:
            return bool(dataset.count > 0)
    except (RasterioError, SourceError):
        return False


def is_level_raster(path: Path) -> bool:
    """Return whether a file is a raster from which a level with default settings can be made, and not a level file."""
    return path.suffix.lower() not in LEVEL_SUFFIXES and is_raster(path)
