"""Rasters for tests, written from arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine

ENGINEERING = 'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'


def write_geotiff(
    path: Path, heights: np.ndarray, crs: str, x0: float, y0: float, cell: float | tuple[float, float], **options: Any
) -> Path:
    """Write heights (rows, cols), or bands (n, rows, cols), whose north-west corner is (x0, y0)."""
    dx, dy = cell if isinstance(cell, tuple) else (cell, cell)
    transform = options.pop("transform", Affine(dx, 0, x0, 0, -dy, y0))
    bands = heights if heights.ndim == 3 else heights[None]
    with rasterio.open(
        path, "w", driver="GTiff", height=bands.shape[1], width=bands.shape[2], count=bands.shape[0], dtype=bands.dtype,
        crs=crs, transform=transform, **options,
    ) as dataset:  # fmt: skip
        dataset.write(bands)
    return path
