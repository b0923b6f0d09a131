"""Irradiation beside truth and beside other tools: Gaussian hills, rays on real rasters, and the beam by several tools.

    python -m benchmarks.irradiation DATA [--python PATH] [--only hills,rays,tools] [--side 300] [--cells 300] [--write]

DATA is the folder of sample rasters. ``--python`` is the interpreter of the package `insolation` and of SurtGIS. GRASS is Debian's
`grass-core`, SAGA its `saga`. Tools that are missing or fail are reported and skipped. With ``--write`` the figures go into
irradiation.json and the report to docs/reports/irradiation.md, else it is printed. ``--only`` measures some tables again; figures
of the others are kept. It takes about half an hour on two idle cores.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, replace
from datetime import date
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.irradiation.figures import HillRow, RayRow, Results, ToolRow
from benchmarks.irradiation.hill_raster import HillRaster, open_hills
from benchmarks.irradiation.hills import hills_irradiation
from benchmarks.irradiation.page import format_report, hill_table, ray_table, tool_table
from benchmarks.irradiation.rays import beam_errors, sample_cells
from benchmarks.irradiation.tools import PERIODS, beam_tools, measure_tools, missing_tools
from benchmarks.peers.tools import run_process
from benchmarks.report_pages import REPORTS, head_commit
from benchmarks.sun_questions.commands_and_rasters import RASTERS, SKUGGA_COMMAND, WHOLE_RASTERS, read_dem, tool_versions
from benchmarks.sweep_speed import processor_name
from skugga.api.raster_view import raster_view
from skugga.shadows.irradiation.irradiation import IrradiationRules
from skugga.shadows.irradiation.light import Part
from skugga.shadows.irradiation.suns import sun_intervals
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import DailyWindow, windows_between
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

FIGURES_FILE = Path(__file__).with_name("irradiation.json")
REPORT = REPORTS / "irradiation.md"

YEAR = 2023

PARTS: tuple[Part, ...] = ("total", "beam", "circumsolar", "sky", "horizon_band", "reflected")

ALBEDO = 0.2

FINE_STEP_MINUTES = 5.0
"""Minutes between two suns of the truth that tells the error of hourly suns."""

HILL_DAYS, FINE_HILL_DAYS = 10, 30
"""Days between two dates of the hills, and of the truth of their hourly suns."""

HILL_CELLS, FINE_HILL_CELLS = 800, 300
"""Cells of the hills that are compared, and those of the truth of their hourly suns."""


def dates_of_year(scene: Scene, every_days: int = 1) -> list[DailyWindow]:
    """Return whole days of the year by true solar time."""
    return windows_between(scene.world, date(YEAR, 1, 1), date(YEAR, 12, 31), every_days, (0.0, 1440.0), SOLAR)


def measure_hills() -> list[HillRow]:
    """Measure the irradiation of Gaussian hills by part."""
    with tempfile.TemporaryDirectory() as folder, open_hills(Path(folder)) as raster:
        windows = dates_of_year(raster.scene, HILL_DAYS)
        row, col = np.random.default_rng(1).integers(1, raster.view.rows - 1, (2, HILL_CELLS))
        truth = hills_irradiation(
            raster.hills, *raster.positions_m(row, col), *raster.suns_and_light(windows, IrradiationRules()), ALBEDO
        )
        step_errors = _hill_step_errors(raster, row[:FINE_HILL_CELLS], col[:FINE_HILL_CELLS])
        rows = []
        for part in PARTS:
            values = raster.irradiation(windows, IrradiationRules((part,), albedo=ALBEDO))[row, col]
            mean = abs(float(truth[part].mean()))
            error = (values - truth[part]) / mean
            rows.append(
                HillRow(
                    part, float(truth[part].mean()), float(np.abs(error).mean()), float(np.percentile(np.abs(error), 99)),
                    float(error.mean()), *step_errors[part],
                )
            )  # fmt: skip
    return rows


def _hill_step_errors(raster: HillRaster, row: np.ndarray, col: np.ndarray) -> dict[Part, tuple[float, float]]:
    """Return the mean error without sign and the bias of hourly suns at cells (n,), by part, as shares of the mean."""
    windows = dates_of_year(raster.scene, FINE_HILL_DAYS)
    position = raster.positions_m(row, col)
    hourly, fine = (
        hills_irradiation(raster.hills, *position, *raster.suns_and_light(windows, IrradiationRules(step_minutes=step)), ALBEDO, 90)
        for step in (60.0, FINE_STEP_MINUTES)
    )
    errors = {part: (hourly[part] - fine[part]) / abs(float(fine[part].mean())) for part in PARTS}
    return {part: (float(np.abs(error).mean()), float(error.mean())) for part, error in errors.items()}


def measure_rays(data: Path, cells: int) -> Iterator[RayRow]:
    """Measure the beam of a year on whole rasters beside rays. Missing rasters are skipped."""
    for name, (file, _, _) in WHOLE_RASTERS.items():
        path = data / file
        if not path.exists():
            print(f"{path}: missing, skipped", flush=True)
            continue
        scene = build_scene(load_level(path))
        windows = dates_of_year(scene)
        sampled = sample_cells(scene, raster_view(scene).view.with_pixels_as_nodes(), cells)
        scene.close()
        beams = []
        for step in (60.0, FINE_STEP_MINUTES):
            suns = sun_intervals(windows, step, sampled.lon_deg, sampled.lat_deg, begin_later_each_day=step == 60.0)
            beams.append(sampled.beam_kwh(suns, sampled.clear_sky_beam(suns)))
        suns = sun_intervals(windows, 60.0, sampled.lon_deg, sampled.lat_deg, begin_later_each_day=True)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "beam.tif"
            run = run_process(
                [*SKUGGA_COMMAND, "irradiation", str(path), "--year", str(YEAR), "--part", "beam", "-o", str(out)], out
            )
            with rasterio.open(out) as source:
                values = source.read(1)
        found = values[sampled.row, sampled.col]
        yield RayRow(
            name, values.size, len(suns), float(beams[0].mean()), run.wall_s, run.cpu_s, run.peak_mb,
            beam_errors(found, beams[0]), beam_errors(found, beams[1]), beam_errors(beams[0], beams[1]),
        )  # fmt: skip


def compare_tools(data: Path, python: str, side: int, cells: int, left_out: dict[str, str]) -> Iterator[ToolRow]:
    """Measure the tools on the middles of rasters. Tools that are skipped are added to ``left_out``."""
    with tempfile.TemporaryDirectory() as folder:
        for name in RASTERS:
            dem = read_dem(data, name, side, Path(folder))
            if dem is None:
                print(f"{name}: missing, skipped", flush=True)
                continue
            yield from measure_tools(beam_tools(python), dem, cells, list(PERIODS), left_out)
            left_out |= missing_tools(python, dem)


def stored_results() -> Results:
    """Return the stored results, or empty ones."""
    if FIGURES_FILE.exists():
        return Results.read(json.loads(FIGURES_FILE.read_text("utf-8")))
    return Results("", 0.0, 0.0, {}, {}, [], [], [])


def measure(arguments: argparse.Namespace) -> Results:
    """Measure the tables of ``--only``, and keep the others."""
    only, begin = arguments.only.split(","), time.perf_counter()

    def progress(lines: list[str]) -> None:
        print(f"{time.perf_counter() - begin:5.0f} s  {lines[-1]}", flush=True)

    results = replace(
        stored_results(), where=f"{processor_name()}, {os.cpu_count()} cores", load_before=os.getloadavg()[0],
        versions=tool_versions(arguments.python),
    )  # fmt: skip
    if "hills" in only:
        results = replace(results, hills=measure_hills())
        progress(hill_table(results.hills))
    if "rays" in only:
        rays = []
        for ray_row in measure_rays(arguments.data, arguments.cells):
            rays.append(ray_row)
            progress(ray_table([ray_row]))
        results = replace(results, rays=rays)
    if "tools" in only:
        tools, left_out = [], dict[str, str]()
        for tool_row in compare_tools(arguments.data, arguments.python, arguments.side, arguments.cells, left_out):
            tools.append(tool_row)
            progress(tool_table([tool_row]))
        results = replace(results, tools=tools, left_out=left_out)
    used = [name for name in ("Skugga", "GRASS", "SAGA", "SurtGIS") if name in results.versions]
    return replace(
        results, load_after=os.getloadavg()[0], versions={name: results.versions[name] for name in used},
        date=date.today().isoformat(), commit=head_commit(),
    )  # fmt: skip


def main() -> None:
    """Measure, and print or write the report."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.irradiation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--python", default=sys.executable, metavar="PATH")
    parser.add_argument("--only", default="hills,rays,tools")
    parser.add_argument("--side", type=int, default=300, help="side of the rasters' middles for other tools, cells")
    parser.add_argument("--cells", type=int, default=300, help="cells that are compared with rays")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    if not set(arguments.only.split(",")) <= {"hills", "rays", "tools"}:
        parser.error(f"--only {arguments.only} is invalid. Allowed: hills, rays, tools.")
    warnings.filterwarnings("ignore", message="DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop
    results = measure(arguments)
    text = format_report(results)
    if arguments.write:
        FIGURES_FILE.write_text(json.dumps(asdict(results), indent=1) + "\n", "utf-8")
        REPORT.write_text(text, "utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
