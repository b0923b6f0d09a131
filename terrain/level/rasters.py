"""Rasters as they are opened, whatever is in them; and which files are rasters."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import rasterio
from rasterio.errors import RasterioError

from terrain.errors import SourceError
from terrain.level.data_files import check_geodata


def open_raster(source: str, **options: Any) -> rasterio.DatasetReader:
    """A raster that is open, with options of its driver. Raises ``SourceError`` for what must not be opened (``check_geodata``),
    ``RasterioError`` and ``OSError`` for what cannot.
    """
    check_geodata(source)
    return rasterio.open(source, **options)


def is_raster(source: Path | str) -> bool:
    """Whether GDAL reads a file as a raster."""
    try:
        with warnings.catch_warnings(action="ignore"), open_raster(str(source)) as dataset:
            return bool(dataset.count > 0)
    except (RasterioError, SourceError):
        return False
