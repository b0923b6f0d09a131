"""The form in which a raster holds its values: type, bands, nodata and scale. It is quick to import."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RasterProfile:
    """The form in which rasters of a product hold its values.

    Attributes
    ----------
    dtype
        The type of the stored numbers.
    bands
        The number of bands.
    nodata
        The stored number of cells without data; ``None`` for none.
    scale
        Factor from stored numbers to values in the product's unit, GDAL's scale of a band.
    band_names
        Descriptions of the bands; empty: that of the product for one band, else colours.
    """

    dtype: str = "float32"
    bands: int = 1
    nodata: float | None = float("nan")
    scale: float = 1.0
    band_names: tuple[str, ...] = ()

    def empty_array(self, rows: int, cols: int) -> np.ndarray:
        """Return an array (rows, cols) or (rows, cols, bands) of cells without data."""
        shape: Sequence[int] = (rows, cols) if self.bands == 1 else (rows, cols, self.bands)
        return np.full(shape, 0 if self.nodata is None else self.nodata, self.dtype)
