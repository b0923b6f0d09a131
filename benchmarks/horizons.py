"""Horizons of whole rasters: time, accuracy, and how well a mask from stored horizons agrees with the sweep of the sun itself.

    python -m benchmarks.horizons DATA [--write]

DATA is the folder of sample rasters. With ``--write`` the report goes to docs/reports/horizons.md, else it is printed. It takes
two minutes on one core. Times are CPU seconds of one core, the least of three runs; the sweep of one sun is timed beside them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.report_pages import REPORTS, format_provenance, measured_here
from benchmarks.selection.synthetic import fractal_noise
from skugga.shadows.horizons.azimuths import SKY_VIEW_KINDS, evenly_spaced_azimuths_deg
from skugga.shadows.horizons.grid import HorizonGrid, grid_of_array
from skugga.shadows.horizons.scan import horizon_angles_deg, horizons_towards
from skugga.shadows.horizons.sky_view import sky_view_factor
from skugga.shadows.sweep.grid import sunlit_nodes
from skugga.shadows.sweep.horizon import horizon_deg

REPORT = REPORTS / "horizons.md"

RASTERS = {
    "mountains, 30 m (Big Tujunga)": "mountain/bigtujunga_30m_utm11.tif",
    "city, 1 m (Essen)": "urban/essen_dom1_32_356_5699_1_nw_2020.tif",
    "forest, 1 m (Quebec)": "forest/quebec_DSM.tif",
}
"""Rasters by what they show."""

FRACTAL_SIDE, FRACTAL_CELL_M, FRACTAL_RELIEF_M = 2048, 30.0, 300.0
"""Side of the fractal in nodes, side of a cell in metres, and standard deviation of its heights in metres."""

TIMED_AZIMUTHS_DEG = np.array([7.0, 40.0, 83.0, 130.0, 171.0, 222.0, 261.0, 318.0])
"""Azimuths of the timing, one for each orientation of the grid."""

CHECKED_AZIMUTHS_DEG = np.arange(3.0, 360.0, 24.0)
"""Azimuths at which horizons are compared with the exact ones."""

SUNS = [(azimuth, altitude) for altitude in (4.0, 12.0, 25.0) for azimuth in (67.3, 111.9, 181.4, 238.6, 291.2)]
"""Azimuth and altitude, degrees, of the suns of masks; none is at a stored azimuth."""


def least_cpu_s(function: Callable[[], object], repeats: int = 3) -> float:
    """Return the least CPU time of some calls in seconds, after a call that compiles."""
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def read_heights(path: Path) -> tuple[np.ndarray, float]:
    """Return a raster's heights, float32 with holes at the lowest height, and the side of a cell in metres."""
    with rasterio.open(path) as dataset:
        heights = dataset.read(1, masked=True).astype(np.float32)
        return heights.filled(float(heights.min())), float(dataset.transform.a)


def fractal_heights() -> np.ndarray:
    """Return the fractal's heights, float32, metres."""
    noise = fractal_noise((FRACTAL_SIDE, FRACTAL_SIDE), 1.8, np.random.default_rng(1))
    return (FRACTAL_RELIEF_M * noise).astype(np.float32)


def speed_rows(grids: dict[str, HorizonGrid]) -> list[str]:
    """Return table rows of millions of cells a second, core and azimuth."""
    rows = []
    for name, grid in grids.items():
        count = len(TIMED_AZIMUTHS_DEG)
        cell_m = abs(float(grid.east_north_of_cell_m[0, 1]))
        tasks: list[tuple[Callable[[], object], int]] = [(partial(_all_horizons, grid), count)]
        tasks += [(partial(sky_view_factor, grid, kind, count), count) for kind in SKY_VIEW_KINDS]
        tasks += [(partial(sunlit_nodes, grid.eye_heights_m, cell_m, 222.0, 20.0), 1)]
        rates = [grid.eye_heights_m.size * azimuths / 1e6 / least_cpu_s(task) for task, azimuths in tasks]
        rows.append(f"| {name} | " + " | ".join(f"{rate:.0f}" for rate in rates) + " |")
    return rows


def _all_horizons(grid: HorizonGrid) -> None:
    """Compute the horizons of a grid towards all timed azimuths, and keep none."""
    for _ in horizons_towards(grid, TIMED_AZIMUTHS_DEG):
        pass


def accuracy_rows(grids: dict[str, HorizonGrid]) -> list[str]:
    """Return table rows of the deviation from the exact horizon of the sweep, in degrees, at all cells."""
    rows = []
    for name, grid in grids.items():
        heights, cell_m = grid.eye_heights_m, abs(float(grid.east_north_of_cell_m[0, 1]))
        found = horizon_angles_deg(grid, CHECKED_AZIMUTHS_DEG)
        exact = np.array([horizon_deg(heights, cell_m, azimuth, lines=16) for azimuth in CHECKED_AZIMUTHS_DEG])
        wrong = np.abs(found - exact)[exact > -89.0]
        rows.append(
            f"| {name} | {wrong.mean():.3f} | {np.percentile(wrong, 99):.3f} | {np.mean(wrong < 0.3):.2%} | "
            f"{(found - exact)[exact > -89.0].mean():+.3f} |"
        )
    return rows


def mask_rows(grids: dict[str, HorizonGrid]) -> list[str]:
    """Return table rows of the share of cells where a mask from stored horizons differs from the sweep of the sun."""
    rows = []
    for name, grid in grids.items():
        heights, cell_m = grid.eye_heights_m, abs(float(grid.east_north_of_cell_m[0, 1]))
        swept = [sunlit_nodes(heights, cell_m, *sun, lines=16) for sun in SUNS]
        cells = []
        for count in (72, 180, 360):
            angles = horizon_angles_deg(grid, evenly_spaced_azimuths_deg(count))
            wrong = [
                np.mean(lit != (altitude > interpolated_angle(angles, azimuth)))
                for lit, (azimuth, altitude) in zip(swept, SUNS, strict=True)
            ]
            cells.append(f"{np.mean(wrong):.2%}")
        at_sun = horizon_angles_deg(grid, np.array([azimuth for azimuth, _ in SUNS]))
        own = [np.mean(lit != (sun[1] > angles)) for lit, sun, angles in zip(swept, SUNS, at_sun, strict=True)]
        rows.append(f"| {name} | " + " | ".join([*cells, f"{np.mean(own):.2%}"]) + " |")
    return rows


def interpolated_angle(angles: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Return horizon angles (rows, cols) towards an azimuth, linear between those of two stored azimuths (azimuths, rows, cols)."""
    position = azimuth_deg / 360.0 * len(angles)
    before = int(position)
    share = np.float32(position - before)
    interpolated: np.ndarray = angles[before] + share * (angles[(before + 1) % len(angles)] - angles[before])
    return interpolated


def main() -> None:
    """Measure, and print or write the report."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.horizons", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    grids = {name: _grid(*read_heights(arguments.data / path)) for name, path in RASTERS.items()}
    fractal = {f"fractal, {FRACTAL_SIDE} x {FRACTAL_SIDE}": _grid(fractal_heights(), FRACTAL_CELL_M)}
    parts = [
        "# Report: horizons and sky view of whole rasters",
        format_provenance(measured_here("python -m benchmarks.horizons DATA --write")),
        "`DATA` is the folder of sample rasters.",
        "Millions of cells a second, core and azimuth:",
        "| ground | horizon | " + " | ".join(SKY_VIEW_KINDS) + " | the sweep of one sun |",
        "| --- |" + " --- |" * (len(SKY_VIEW_KINDS) + 2), *speed_rows(fractal | grids), "",
        "Degrees by which horizons differ from exact ones (`skugga.horizon`, 16 lines a column), all cells, 15 azimuths:",
        "| ground | mean | 99 of 100 within | within 0.3 | bias |", "| --- | --- | --- | --- | --- |", *accuracy_rows(grids), "",
        f"Share of cells where a mask from stored horizons differs from the sweep of the sun itself, mean of {len(SUNS)} suns:",
        "| ground | 72 azimuths | 180 | 360 | at the sun's own azimuth |", "| --- | --- | --- | --- | --- |", *mask_rows(grids),
    ]  # fmt: skip
    text = "\n".join(part if part.startswith("|") or not part else f"{part}\n" for part in parts) + "\n"
    if arguments.write:
        REPORT.write_text(text, encoding="utf-8")
    else:
        print(text)


def _grid(height_m: np.ndarray, cell_m: float) -> HorizonGrid:
    """Return the grid of an array with square cells."""
    return grid_of_array(height_m, (cell_m, cell_m))


if __name__ == "__main__":
    main()
