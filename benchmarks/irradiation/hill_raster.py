"""The raster of Gaussian hills, its irradiation by Skugga, and its suns and light, to compare with truth by quadrature."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.irradiation.hills import GaussianHills, four_hills
from benchmarks.peers.tools import write_dem
from skugga.shadows.irradiation.dates import all_dates
from skugga.shadows.irradiation.irradiation import IrradiationRules, irradiation
from skugga.shadows.irradiation.light import SkyLight, clear_sky_light
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.terrain.geo.daily_windows import DailyWindow
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

CRS, NORTHING_M, MERIDIAN_SCALE = "EPSG:32632", 5_200_000.0, 0.9996
"""CRS of the raster, a UTM zone; northing of its middle, on the central meridian at 47 degrees north; and the map's scale there."""

SIGMA_M, CELLS_PER_SIGMA = 400.0, 20
"""Standard deviation of the hills, and cells of the raster to each."""

LIGHT_STEP_M = 10.0
"""Metres between two heights at which the light of truth is computed."""


@dataclass(frozen=True, eq=False)
class HillRaster:
    """A level whose ground are Gaussian hills.

    Attributes
    ----------
    scene
        Its scene.
    hills
        The hills.
    cell_m
        Side of a cell on the ground, metres.
    """

    scene: Scene
    hills: GaussianHills
    cell_m: float

    @property
    def view(self) -> MapView:
        """The map of the raster with one pixel per cell."""
        return view_of_cells(self.scene)

    def positions_m(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return east and north (n,) of cells (n,) from the middle of the hills, metres."""
        rows, cols = self.view.rows, self.view.cols
        return (col + 0.5 - cols / 2.0) * self.cell_m, (rows / 2.0 - row - 0.5) * self.cell_m

    def irradiation(self, windows: Sequence[DailyWindow], rules: IrradiationRules) -> np.ndarray:
        """Return Skugga's irradiation (rows, cols), kWh/m2."""
        (values,) = irradiation(self.scene, self.view, all_dates(windows), rules)
        return values

    def suns_and_light(self, windows: Sequence[DailyWindow], rules: IrradiationRules) -> tuple[SunIntervals, np.ndarray, SkyLight]:
        """Return the suns at the middle of the raster, and their light with the heights (k,) for which it is given."""
        lon, lat = lon_lat_of_middle(self.scene)
        suns = sun_intervals(windows, rules.step_minutes, lon, lat)
        top_m = self.hills.top_m
        heights_m = np.linspace(0.0, top_m, int(np.ceil(top_m / LIGHT_STEP_M)) + 1)
        return suns, heights_m, clear_sky_light(suns, lon, lat, heights_m, rules.linke_turbidity)


def view_of_cells(scene: Scene) -> MapView:
    """Return the map of a north-up raster of square cells, with one pixel per cell."""
    elevation = scene.elevation
    (x0, x1), (y0, _) = elevation.xy(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    return MapView(Grid(elevation.crs, float(x0), float(y0), float(x1 - x0)), 0.0, 0.0, 1.0, 1.0, elevation.rows, elevation.cols)


def lon_lat_of_middle(scene: Scene) -> tuple[float, float]:
    """Return longitude and latitude of the middle of a raster, degrees."""
    view = view_of_cells(scene)
    row, col = view.centre_node
    lon, lat = scene.world.lon_lat(view.grid.crs, view.grid.x(col), view.grid.y(row))
    return float(lon), float(lat)


@contextmanager
def open_hills(folder: Path) -> Iterator[HillRaster]:
    """Write the raster of the four hills into a folder, and open it."""
    hills, cell_m = four_hills(SIGMA_M), SIGMA_M / CELLS_PER_SIGMA
    side = round(2.0 * hills.half_side_m / cell_m)
    offset_m = (np.arange(side) + 0.5 - side / 2.0) * cell_m
    path = folder / "hills.tif"
    height_m = hills.heights_m(offset_m[None, :], -offset_m[:, None]).astype(np.float32)
    write_dem(path, height_m, cell_m * MERIDIAN_SCALE, CRS, (500_000.0, NORTHING_M))
    scene = build_scene(load_level(path))
    yield HillRaster(scene, four_hills(SIGMA_M, scene.world.curvature), cell_m)
    scene.close()
