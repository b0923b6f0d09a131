"""Find where the sun is seen at each of many moments, from horizons that are computed once.

The result of a dask array is a dask array, computed chunk by chunk.

Needs ``pip install 'skugga[xarray]'``.
"""

import numpy as np
import xarray

import skugga  # noqa: F401  # registers the accessor ``.skugga`` of DataArrays

HILLS_M, CELL_M = 400.0, 30.0
SUNS = ((120.0, 4.0), (150.0, 8.0), (180.0, 11.0), (210.0, 8.0), (240.0, 4.0))  # azimuth and altitude, degrees

y, x = (np.arange(count) * CELL_M for count in (200, 300))
dem = xarray.DataArray(
    HILLS_M * np.abs(np.sin(x[None, :] / 2000.0) * np.cos(y[:, None] / 1500.0)),
    dims=("y", "x"),
    coords={"y": 5_200_000.0 - y, "x": 500_000.0 + x},
).rio.write_crs("EPSG:32633")

horizons = dem.chunk({"y": 100, "x": 150}).skugga.horizons(azimuths=72).compute()
print(f"horizons: {' x '.join(map(str, horizons.shape))} numbers, {horizons.nbytes / 1e6:.0f} MB")
for azimuth, altitude in SUNS:
    sunlit = horizons.sel(azimuth=azimuth) < altitude
    agreement = (sunlit == ~dem.skugga.shadow(azimuth=azimuth, altitude=altitude)).mean()
    print(f"azimuth {azimuth:.0f}, altitude {altitude:2.0f}: {sunlit.mean():5.1%} in the sun, {agreement:.2%} as by skugga.shadow")
