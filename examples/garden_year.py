"""Compute what a garden between a house and a tree row receives in each month of a year, kWh/m2, and what the house takes of it."""

import numpy as np
import rioxarray  # noqa: F401  # registers ``.rio``
import xarray

import skugga  # noqa: F401  # registers the accessor ``.skugga`` of DataArrays

CELL_M, SIDE = 0.5, 160
WEST, NORTH = 674_000.0, 6_580_000.0  # Stockholm


def yard(*blocks: tuple[slice, slice, float]) -> xarray.DataArray:
    """Return level ground with blocks of a height: rows, columns, metres."""
    heights = np.zeros((SIDE, SIDE), np.float32)
    for rows, cols, height in blocks:
        heights[rows, cols] = height
    x, y = WEST + CELL_M * (np.arange(SIDE) + 0.5), NORTH - CELL_M * (np.arange(SIDE) + 0.5)
    return xarray.DataArray(heights, {"y": y, "x": x}, ("y", "x")).rio.write_crs("EPSG:3006")


garden = np.s_[:, 60:80, 60:100]  # 10 m of ground, 5 m north of the house
house, trees = (slice(90, 110), slice(60, 100), 7.0), (slice(50, 90), slice(40, 44), 12.0)
open_yard, built_yard = (
    heights.skugga.irradiation(year=2023, days="mean", per="month", plane="level").to_numpy()[garden].mean(axis=(1, 2))
    for heights in (yard(), yard(house, trees))
)
for month, (before, after) in enumerate(zip(open_yard, built_yard, strict=True), 1):
    print(f"2023-{month:02d}  open {before:6.1f}  with house and trees {after:6.1f} kWh/m2, {1.0 - after / before:4.0%} less")
print(f"year     open {open_yard.sum():6.0f}  with house and trees {built_yard.sum():6.0f} kWh/m2")
