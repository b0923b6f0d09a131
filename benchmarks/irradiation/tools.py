"""The beam of a day and of a year without air by several tools, beside rays.

Each tool has a sun's light of its own, and all of them can leave out the air. Then a cell's beam, as a share of that of open level
ground by the same tool, depends on geometry alone: on the suns, on slopes and on shadows. This share is compared with that of rays
to NREL's suns every five or ten minutes. A cell's plane is fitted to its neighbours as the tool does it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.irradiation.constant_light import BEAM_W_M2
from benchmarks.irradiation.figures import ToolRow
from benchmarks.irradiation.hill_raster import view_of_cells
from benchmarks.irradiation.rays import SampledCells, SlopeFit, beam_errors, sample_cells
from benchmarks.peers.tools import ToolRun, run_process
from benchmarks.sun_questions.commands_and_rasters import SKUGGA_PYTHON, QuestionDem, write_question_dem
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import windows_between
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

PROGRAMS_FILE = Path(__file__).with_name("programs.py")

PERIODS = {
    "21 March": (date(2023, 3, 21), date(2023, 3, 21)),
    "21 December": (date(2023, 12, 21), date(2023, 12, 21)),
    "2023": (date(2023, 1, 1), date(2023, 12, 31)),
}
"""First and last date of each period."""

DAYS = ("21 March", "21 December")
"""The periods that are days."""

TRUTH_STEP_MINUTES = {"21 March": 5.0, "21 December": 5.0, "2023": 10.0}
"""Minutes between two rays of truth."""

LEVEL_SIDE_CELLS = 31
"""Side of the raster of open level ground."""

MAX_OPEN_ERROR = 0.12
"""Maximum error of the beam on open level ground, as a share. Some tools know the eccentricity of the earth's orbit."""


@dataclass(frozen=True, eq=False)
class BeamTool:
    """A tool with its settings.

    Attributes
    ----------
    name, is_skugga
        Name with the settings, and whether it is Skugga.
    command
        Returns its command for a raster, an output file, and the first and last date.
    fit
        How it fits planes to cells.
    suffix
        Suffix of its output file.
    kwh
        A unit of its output in kWh/m2 of a beam of 1000 W/m2, about.
    periods
        The periods that it computes.
    """

    name: str
    is_skugga: bool
    command: Callable[[QuestionDem, Path, date, date], list[str]]
    fit: SlopeFit = "central"
    suffix: str = ".tif"
    kwh: float = 1.0
    periods: tuple[str, ...] = tuple(PERIODS)

    def run(self, dem: QuestionDem, period: str) -> tuple[np.ndarray, ToolRun]:
        """Run the tool. Return the beam (rows, cols), about kWh/m2, and the cost. Raises ``RuntimeError`` if it fails."""
        out = dem.path.with_name(f"beam{self.suffix}")
        run = run_process(self.command(dem, out, *PERIODS[period]), out)
        if self.suffix == ".npy":
            return np.load(out) * self.kwh, run
        with rasterio.open(out) as source:
            return source.read(1) * self.kwh, run


def beam_tools(python: str) -> list[BeamTool]:
    """Return all tools with their settings. Python packages are those of the interpreter ``python``."""
    programs = str(PROGRAMS_FILE)
    solar_constant = 1.0 / 1.367

    def r_sun(name: str, fit: SlopeFit, *options: str) -> BeamTool:
        return BeamTool(
            f"GRASS r.sun, {name}", False,
            lambda dem, out, first, last: ["grass", "--tmp-location", str(dem.path), "--exec", sys.executable, programs, "r.sun",
                                           str(dem.path), str(out), str(first.timetuple().tm_yday), *options],
            fit, kwh=1e-3 * solar_constant, periods=DAYS,
        )  # fmt: skip

    def saga(name: str, shadow: str, hours: str, periods: tuple[str, ...]) -> BeamTool:
        return BeamTool(
            f"SAGA ta_lighting, {name}", False,
            lambda dem, out, first, last: [sys.executable, programs, "saga", str(dem.path), str(out), first.isoformat(),
                                           last.isoformat(), f"{dem.lon_lat[1]:.6f}", shadow, hours],
            kwh=solar_constant, periods=periods,
        )  # fmt: skip

    def insolation_command(dem: QuestionDem, out: Path, first: date, last: date) -> list[str]:
        suns, file = hourly_suns(dem, first, last), out.with_name("suns.npy")
        np.save(file, np.stack([suns.azimuth_deg, suns.altitude_deg, suns.hours]))
        return [python, programs, "insolation", str(dem.path), str(out), str(file)]

    def skugga(minutes: int, periods: tuple[str, ...]) -> BeamTool:
        return BeamTool(
            f"Skugga, {minutes} min", True,
            lambda dem, out, first, last: [*SKUGGA_PYTHON, programs, "skugga", str(dem.path), str(out), first.isoformat(),
                                           last.isoformat(), str(minutes)],
            suffix=".npy", periods=periods,
        )  # fmt: skip

    return [
        skugga(60, tuple(PERIODS)),
        skugga(10, DAYS),
        r_sun("own walk, 30 min", "horn", "0.5", "ground"),
        r_sun("own walk, level planes, 30 min", "level", "0.5", "level"),
        r_sun("own walk, level planes, 5 min", "level", "0.0833333", "level"),
        r_sun("horizons every 5°, 30 min", "horn", "0.5", "ground", "5"),
        r_sun("the same, none negative", "horn", "0.5", "ground", "5", "clamped"),
        saga("slim, 30 min", "0", "0.5", DAYS),
        saga("fat, 30 min", "1", "0.5", DAYS),
        BeamTool("insolation, Skugga's suns", False, insolation_command, "quad", ".npy"),
    ]  # fmt: skip


def hourly_suns(dem: QuestionDem, first: date, last: date, step_minutes: float = 60.0) -> SunIntervals:
    """Return the suns of dates at the middle of a raster."""
    scene = build_scene(load_level(dem.path))
    suns = sun_intervals(_windows(scene, first, last), step_minutes, *dem.lon_lat)
    scene.close()
    return suns


def _windows(scene: Scene, first: date, last: date) -> list:
    """Return whole days by true solar time."""
    return windows_between(scene.world, first, last, 1, (0.0, 1440.0), SOLAR)


class ToolTruth:
    """The beam of rays without air at n random cells of a raster, and that of open level ground, kWh/m2."""

    def __init__(self, dem: QuestionDem, cells: int) -> None:
        self._dem = dem
        scene = build_scene(load_level(dem.path))
        self.cells: SampledCells = sample_cells(scene, view_of_cells(scene), cells)
        scene.close()
        self._suns: dict[str, SunIntervals] = {}
        self._beam: dict[tuple[str, SlopeFit], np.ndarray] = {}

    def suns(self, period: str) -> SunIntervals:
        """Return the suns of a period."""
        if period not in self._suns:
            self._suns[period] = hourly_suns(self._dem, *PERIODS[period], TRUTH_STEP_MINUTES[period])
        return self._suns[period]

    def open_level(self, period: str) -> float:
        """Return the beam on open level ground."""
        suns = self.suns(period)
        return float(np.sin(np.radians(suns.altitude_deg)) @ suns.hours) * BEAM_W_M2 / 1000.0

    def beam(self, period: str, fit: SlopeFit) -> np.ndarray:
        """Return the beam (n,) on planes of the cells."""
        if (period, fit) not in self._beam:
            suns = self.suns(period)
            power = np.broadcast_to(BEAM_W_M2, (len(self.cells.row), len(suns)))
            self._beam[period, fit] = self.cells.beam_kwh(suns, power, fit)
        return self._beam[period, fit]


def measure_tools(
    tools: list[BeamTool], dem: QuestionDem, cells: int, periods: list[str], left_out: dict[str, str]
) -> Iterator[ToolRow]:
    """Measure tools on a raster, and yield their rows. Tools that fail are added to ``left_out`` with the reason.

    The run on open level ground, which is not timed, compiles loops before.
    """
    truth = ToolTruth(dem, cells)
    level_m = np.full((LEVEL_SIDE_CELLS, LEVEL_SIDE_CELLS), np.float32(dem.height_m.mean()))
    level = write_question_dem(f"{dem.name} level", level_m, dem.cell_m, dem.crs, dem.middle_m[1], dem.path.parent)
    for period in periods:
        for tool in tools:
            if period not in tool.periods:
                continue
            try:
                open_level = float(tool.run(level, period)[0][LEVEL_SIDE_CELLS // 2, LEVEL_SIDE_CELLS // 2])
                true_level = truth.open_level(period)
                if abs(open_level / true_level - 1.0) > MAX_OPEN_ERROR:
                    raise RuntimeError(f"open level ground receives {open_level:.3g} kWh/m2 instead of {true_level:.3g}")
                beam, run = tool.run(dem, period)
            except RuntimeError as error:
                left_out[f"{tool.name}, {dem.name}, {period}"] = str(error)
                continue
            found, true = beam[truth.cells.row, truth.cells.col] / open_level * true_level, truth.beam(period, tool.fit)
            yield ToolRow(
                dem.name, period, tool.name, tool.is_skugga, run.compute_s, run.wall_s, run.cpu_s, run.peak_mb, float(true.mean()),
                beam_errors(found, true),
            )  # fmt: skip


def missing_tools(python: str, dem: QuestionDem) -> dict[str, str]:
    """Return the reasons why other tools are not compared. That of SurtGIS is measured behind a wall on a slope."""
    reasons = {
        "solweig (SEBE)": "the Python package has no SEBE; it computes SOLWEIG's mean radiant temperature",
        "Whitebox Workflows": "has the share of the day in light, but no irradiation",
        "xarray-spatial": "has no irradiation",
    }
    out, day = dem.path.with_name("surtgis.npy"), date(2023, 12, 21)
    row, col = np.mgrid[:61, :61]
    values = []
    for wall_m in (0.0, 60.0):
        height_m = (100.0 - 0.1 * row + np.where((row >= 28) & (row < 33) & (col >= 20) & (col < 41), wall_m, 0.0)).astype(
            np.float32
        )
        wall = write_question_dem("wall", height_m, 10.0, "EPSG:32632", 5_200_000.0, dem.path.parent)
        try:
            arguments = [str(wall.path), str(out), f"{wall.lon_lat[1]:.6f}", str(day.timetuple().tm_yday)]
            run_process([python, str(PROGRAMS_FILE), "surtgis", *arguments], out)
        except RuntimeError as error:
            return reasons | {"SurtGIS solar_radiation": str(error)}
        values.append(float(np.load(out)[24, 30]))
    if values[0] == values[1]:
        reasons["SurtGIS solar_radiation"] = (
            "casts no shadows: ground 40 m north of a wall of 60 m receives in December what it receives without; and it returns "
            "only the sum of direct and diffuse light"
        )
    else:
        reasons["SurtGIS solar_radiation"] = "returns only the sum of direct and diffuse light, under its own air"
    return reasons
