"""Which files are rasters."""

from __future__ import annotations

import warnings
from pathlib import Path

import rasterio
from rasterio.errors import RasterioError


def is_raster(source: Path | str) -> bool:
    """Whether GDAL reads a file as a raster."""
    try:
        with warnings.catch_warnings(action="ignore"), rasterio.open(source) as dataset:
            return bool(dataset.count > 0)
    except RasterioError:
        return False
