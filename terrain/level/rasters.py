"""Rasters as they are opened, whatever is in them; and which files are rasters."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skugga.terrain.errors import SourceError
from skugga.terrain.level.data_files import check_geodata

if TYPE_CHECKING:
    import rasterio

LEVEL_SUFFIXES = ".yaml", ".yml"
"""Of level files."""


def open_raster(source: str, **options: Any) -> rasterio.DatasetReader:
    """A raster that is open, with options of its driver. Raises ``SourceError`` for what must not be opened (``check_geodata``),
    ``RasterioError`` and ``OSError`` for what cannot.
    """
    import rasterio  # here: level files alone need none of it

    check_geodata(source)
    return rasterio.open(source, **options)


def is_raster(source: Path | str) -> bool:
    """Whether GDAL reads a file as a raster."""
    from rasterio.errors import RasterioError

    try:
        with warnings.catch_warnings(action="ignore"), open_raster(str(source)) as dataset:
            return bool(dataset.count > 0)
    except (RasterioError, SourceError):
        return False


def is_level_raster(path: Path) -> bool:
    """Whether a file is no level file but a raster, which is a level by itself."""
    return path.suffix.lower() not in LEVEL_SUFFIXES and is_raster(path)
