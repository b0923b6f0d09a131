"""Compute the light that a glacier absorbs in its melting season, with the mountains around, and the ice that it could melt.

The sum of absorbed shortwave light is an upper bound of what it melts: clouds, and the light that ice sends out, are left out.
"""

import numpy as np
import rioxarray  # noqa: F401  # registers ``.rio``
import xarray

import skugga  # noqa: F401  # registers the accessor ``.skugga`` of DataArrays

CELL_M, SIDE = 25.0, 121
WEST, NORTH = 440_000.0, 5_155_000.0  # in the Alps, EPSG:32632
ICE_ALBEDO, SNOW_ALBEDO = 0.35, 0.75
KWH_PER_METRE_OF_ICE = 334e3 * 900.0 / 3.6e6  # latent heat of fusion, J/kg, times the density of ice, kg/m3

row, col = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2.0
distance_m = CELL_M * np.hypot(row, col)
cirque = 2600.0 + 500.0 / (1.0 + np.exp((900.0 - distance_m) / 120.0))  # a ring of rock round the ice
cirque -= 0.12 * CELL_M * np.where(distance_m < 900.0, -row, 0.0)  # ice that falls to the north
heights = xarray.DataArray(
    cirque.astype(np.float32),
    {"y": NORTH - CELL_M * (np.arange(SIDE) + 0.5), "x": WEST + CELL_M * (np.arange(SIDE) + 0.5)},
    ("y", "x"),
).rio.write_crs("EPSG:32632")
season = {"date": "2023-06-01", "to": "2023-09-30", "days": "mean"}
light = heights.skugga.irradiation(**season, albedo=SNOW_ALBEDO).to_numpy()
ice = distance_m < 800.0
south_wall, north_wall = ice & (row > 20), ice & (row < -20)
for name, cells in (("whole glacier", ice), ("below the south wall", south_wall), ("below the north wall", north_wall)):
    absorbed = (1.0 - ICE_ALBEDO) * light[cells].mean()
    print(f"{name:20}  {light[cells].mean():5.0f} kWh/m2, up to {absorbed / KWH_PER_METRE_OF_ICE:4.1f} m of ice")
