"""Compute hours of sun for a raster larger than memory. The result of a dask array is a dask array, computed chunk by chunk.

Needs ``pip install 'skugga[xarray]'``.
"""

import numpy as np
import rasterio
import rioxarray
import xarray

import skugga  # noqa: F401  # registers the accessor ``.skugga`` of DataArrays

HILLS_M, CELL_M = 400.0, 30.0

y, x = (np.arange(count) * CELL_M for count in (400, 600))
heights = HILLS_M * np.abs(np.sin(x[None, :] / 2000.0) * np.cos(y[:, None] / 1500.0))
with rasterio.open(
    "hills.tif", "w", driver="GTiff", height=y.size, width=x.size, count=1, dtype="float32", crs="EPSG:32633",
    transform=rasterio.Affine(CELL_M, 0.0, 500_000.0, 0.0, -CELL_M, 5_200_000.0), tiled=True,
) as out:  # fmt: skip
    out.write(heights.astype(np.float32), 1)

dem = rioxarray.open_rasterio("hills.tif", chunks={"y": 256, "x": 256}).squeeze("band", drop=True)
assert isinstance(dem, xarray.DataArray)
hours = dem.skugga.sun_hours("2024-12-21", step_min=10.0)  # nothing is computed yet
hours.rio.to_raster("hours.tif")

with rasterio.open("hours.tif") as dataset:
    print(f"hours.tif: {dataset.width} x {dataset.height} cells, {dataset.crs}, mean {np.nanmean(dataset.read(1)):.2f} h")
