"""Open rasters of any content with rasterio, and detect which files are rasters."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skugga.terrain.errors import SourceError
from skugga.terrain.level.data_files import check_geodata

if TYPE_CHECKING:
    import rasterio

LEVEL_SUFFIXES = ".yaml", ".yml"


def open_raster(source: str, **options: Any) -> rasterio.DatasetReader:
    """Open a raster with options of its driver.

    Raises ``SourceError`` if ``check_geodata`` forbids the file, and ``RasterioError`` or ``OSError`` if it cannot be opened.
    """
    import rasterio  # imported here because level files alone do not need it

    check_geodata(source)
    return rasterio.open(source, **options)


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
