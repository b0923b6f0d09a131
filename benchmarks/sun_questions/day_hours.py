"""The first question: hours of sun on 21 March, on a mountain raster and a city's surface model, by several tools and by rays."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, date
from functools import cached_property
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.peers.tools import ToolRun, run_process
from benchmarks.sun_hours_accuracy import CellRays, ray_truth
from benchmarks.sun_questions.commands_and_rasters import (
    DATE,
    PROGRAMS_FILE,
    SKUGGA_COMMAND,
    SKUGGA_PYTHON,
    QuestionDem,
    write_question_dem,
)
from benchmarks.sun_questions.figures import ConventionCheck, SunAnswer
from benchmarks.sun_questions.sun_paths import (
    R_SUN_DAY_NUMBER,
    SUNCALC_DAY_NUMBER,
    SUNCALC_MIN_ALTITUDE_DEG,
    hours_before_cliff,
    r_sun_path,
    suncalc_path,
)
from skugga.api.raster_view import raster_view
from skugga.shadows.sun_hours.suns import WindowSun, window_suns
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.geo.daily_windows import daily_window
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.ground.sheet import sheet_of
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

HOURS_QUESTION = "hours of a day"

RAY_STEP_S = 10.0
"""Seconds between rays."""

MARGIN_CELLS = 3
"""Width of the margin of a raster without sampled cells."""

CLIFF_HEIGHT_M, CLIFF_CELL_M, CLIFF_SHAPE = 300.0, 10.0, (161, 241)
"""Geometry of the check of conventions, a level floor with a cliff in the east: height of the cliff, side of a cell, rows and
columns."""

CLIFF_COL, CHECKED_COLS = 160, slice(60, 150, 10)
"""First column on the cliff, and the columns of the floor that are compared with the closed form."""


@dataclass(frozen=True, eq=False)
class HoursTool:
    """A tool with its settings.

    Attributes
    ----------
    name, tool_name
        Name with the settings, and name of the tool.
    sun_model
        Name of the solar position algorithm that it uses: ``astronomy``, ``solar day`` or ``suncalc``.
    command
        Returns its command for a raster and an output file.
    read_hours
        Reads its output file into hours (rows, cols).
    suffix
        Suffix of its output file.
    compute_command
        Returns a command that prints its seconds of computing; ``None`` if ``command`` prints them.
    """

    name: str
    tool_name: str
    sun_model: str
    command: Callable[[QuestionDem, Path], list[str]]
    read_hours: Callable[[Path, QuestionDem], np.ndarray]
    suffix: str = ".tif"
    compute_command: Callable[[QuestionDem, Path], list[str]] | None = None

    @property
    def is_skugga(self) -> bool:
        """Whether the tool is part of Skugga."""
        return self.tool_name == "Skugga"

    def run(self, dem: QuestionDem) -> tuple[np.ndarray, ToolRun, float | None]:
        """Run the tool. Return hours (rows, cols), the cost of the process, and seconds of computing.

        Raises ``RuntimeError`` if the tool fails.
        """
        out = dem.path.with_name(f"hours{self.suffix}")
        compute_s = None
        if self.compute_command is not None:
            array_file = dem.path.with_name("hours.npy")
            compute_s = run_process(self.compute_command(dem, array_file), array_file).compute_s
        run = run_process(self.command(dem, out), out)
        return self.read_hours(out, dem), run, run.compute_s if compute_s is None else compute_s


class HoursTruth:
    """Ray-traced hours of sun in n sampled cells of a raster, for each solar position algorithm of the tools.

    ``row`` and ``col`` (n,) are the sampled cells.
    """

    def __init__(self, dem: QuestionDem, cells: int) -> None:
        self._dem = dem
        rows, cols = dem.height_m.shape
        row_and_col_ranges = (np.arange(MARGIN_CELLS, length - MARGIN_CELLS) for length in (rows, cols))
        row, col = (indices.ravel() for indices in np.meshgrid(*row_and_col_ranges, indexing="ij"))
        sample = np.random.default_rng(1).choice(len(row), min(cells, len(row)), replace=False)
        self.row, self.col = row[sample], col[sample]

    @cached_property
    def astronomy_hours(self) -> np.ndarray:
        """Hours (n,) by NREL's sun with refraction, on the round earth, above the level plane. This is Skugga's definition."""
        scene = build_scene(load_level(self._dem.path))
        view = raster_view(scene).view.with_pixels_as_nodes()
        hours = ray_truth(scene, view, self.row, self.col, astronomical_day(scene), RAY_STEP_S / 60.0)[0]
        scene.close()
        return hours

    @cached_property
    def solar_day_hours(self) -> np.ndarray:
        """Hours (n,) by GRASS's sun without refraction, on the round earth, above the level plane."""
        scene = build_scene(load_level(self._dem.path))
        view = raster_view(scene).view.with_pixels_as_nodes()
        rays, frame = CellRays.from_cells(scene, view, self.row, self.col), bare_nodes(scene, view, 1).frame
        azimuth, altitude = r_sun_path(self._dem.lon_lat[1], RAY_STEP_S)
        enu = np.stack([direction_enu(a, h) for a, h in zip(azimuth, altitude, strict=True) if h > -1.0])
        hours = _sunlit_hours(rays, frame.directions_from_earth(enu @ scene.world.earth_from_anchor.T), 0.0)
        scene.close()
        return hours

    @cached_property
    def suncalc_hours(self) -> np.ndarray:
        """Hours (n,) by Whitebox's sun without refraction, on a flat earth.

        The sun counts from half a degree below the level plane.
        """
        dem = self._dem
        rows, cols = dem.height_m.shape
        nodes = np.empty((rows, cols, 3))
        nodes[..., 0], nodes[..., 1] = np.arange(cols) * dem.cell_m, -np.arange(rows)[:, None] * dem.cell_m
        nodes[..., 2] = dem.height_m
        start = nodes[self.row, self.col]
        rays = CellRays(sheet_of(nodes), start, np.broadcast_to(np.array([0.0, 0.0, 1.0]), start.shape))
        azimuth, altitude = suncalc_path(*dem.lon_lat, RAY_STEP_S)
        enu = np.stack([direction_enu(a, h) for a, h in zip(azimuth, altitude, strict=True) if h > SUNCALC_MIN_ALTITUDE_DEG])
        return _sunlit_hours(rays, enu, np.sin(np.radians(SUNCALC_MIN_ALTITUDE_DEG)))

    def hours_by_sun_model(self, sun_model: str) -> np.ndarray:
        """Return the hours (n,) by the name of the solar position algorithm."""
        return {"astronomy": self.astronomy_hours, "solar day": self.solar_day_hours, "suncalc": self.suncalc_hours}[sun_model]


def _sunlit_hours(rays: CellRays, directions: np.ndarray, min_sine: float) -> np.ndarray:
    """Return hours of sun (n,) of cells. ``directions`` (times, 3) lead to the sun at steps of ``RAY_STEP_S`` seconds.

    ``min_sine`` is the sine of the least altitude of a visible sun.
    """
    return np.asarray(
        sum(rays.sun_visible(direction, min_sine).astype(np.float64) for direction in directions) * RAY_STEP_S / 3600.0
    )


def astronomical_day(scene) -> WindowSun:  # noqa: ANN001
    """Return the sun's positions during ``DATE`` by true solar time."""
    return window_suns(scene.world, [daily_window(date.fromisoformat(DATE), 0.0, 1440.0, UTC, scene.world)])[0]


def day_length_h(sun_model: str, dem: QuestionDem) -> float:
    """Return the hours from sunrise to sunset over a level horizon, by a tool's solar position algorithm.

    In Whitebox the sun rises and sets half a degree below the horizon.
    """
    if sun_model == "suncalc":
        return float((suncalc_path(*dem.lon_lat, RAY_STEP_S)[1] >= SUNCALC_MIN_ALTITUDE_DEG).mean() * 24.0)
    return float((_sun_path(sun_model, dem)[1] > 0.0).mean() * 24.0)


def _sun_path(sun_model: str, dem: QuestionDem) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and altitudes (n,) of a tool's sun, degrees, every ``RAY_STEP_S`` seconds of a day.

    ``sun_model`` is one of ``HoursTool.sun_model``.
    """
    if sun_model == "suncalc":
        return suncalc_path(*dem.lon_lat, RAY_STEP_S)
    if sun_model == "solar day":
        return r_sun_path(dem.lon_lat[1], RAY_STEP_S)
    scene = build_scene(load_level(dem.path))
    day = astronomical_day(scene)
    times = np.arange(RAY_STEP_S / 120.0, day.window.length_min, RAY_STEP_S / 60.0)
    enu = day.directions_at(times) @ scene.world.earth_from_anchor
    scene.close()
    return np.degrees(np.arctan2(enu[:, 0], enu[:, 1])) % 360.0, np.degrees(np.arcsin(enu[:, 2]))


def _read_raster(path: Path, dem: QuestionDem) -> np.ndarray:
    """Return the first band of a file (rows, cols).

    ``dem`` is the raster of heights, which ``HoursTool.read_hours`` passes to all readers. Only some of them need it.
    """
    with rasterio.open(path) as dataset:
        return dataset.read(1)


def hours_tools(python: str) -> list[HoursTool]:
    """Return all tools with their settings. Python packages are those of the interpreter ``python``."""
    programs_file = str(PROGRAMS_FILE)

    def skugga(minutes: int) -> HoursTool:
        return HoursTool(
            f"Skugga, steps of {minutes} min", "Skugga", "astronomy",
            lambda dem, out: [*SKUGGA_COMMAND, "sunhours", str(dem.path), "-o", str(out), "--date", DATE, "--step", f"{minutes}m"],
            _read_raster,
            compute_command=lambda dem, out: [
                *SKUGGA_PYTHON, programs_file, "sunhours", str(dem.path), str(out), DATE, str(minutes),
            ],
        )  # fmt: skip

    def whitebox(degrees: int) -> HoursTool:
        day = str(SUNCALC_DAY_NUMBER)
        return HoursTool(
            f"Whitebox time_in_daylight, {degrees}°", "Whitebox Workflows", "suncalc",
            lambda dem, out: [python, programs_file, "time_in_daylight", str(dem.path), str(out), day, str(degrees)],
            lambda path, dem: np.load(path) * day_length_h("suncalc", dem), ".npy",
        )  # fmt: skip

    def r_sun(minutes: int, degrees: str = "") -> HoursTool:
        method, extra_arguments = (f"horizons every {degrees}°", [degrees]) if degrees else ("own walk", [])
        return HoursTool(
            f"GRASS r.sun, {method}, {minutes} min", "GRASS", "solar day",
            lambda dem, out: ["grass", "--tmp-location", str(dem.path), "--exec", sys.executable, programs_file, "r.sun",
                              str(dem.path), str(out), str(R_SUN_DAY_NUMBER), str(minutes), *extra_arguments],
            _read_raster,
        )  # fmt: skip

    return [
        *(skugga(minutes) for minutes in (15, 5, 2)),
        *(whitebox(degrees) for degrees in (5, 2)),
        *(r_sun(minutes) for minutes in (30, 15, 5)),
        r_sun(5, "5"),
    ]


def convention_check(tool: HoursTool, folder: Path) -> ConventionCheck:
    """Compare a tool's hours on a level floor and before a cliff with those expected from its solar position algorithm.

    Raises ``RuntimeError`` if the tool fails.
    """
    floor = np.full(CLIFF_SHAPE, 100.0, np.float32)
    cliff = floor.copy()
    cliff[:, CLIFF_COL:] += CLIFF_HEIGHT_M
    middle, hours_along_middle_row = CLIFF_SHAPE[0] // 2, []
    for name, height_m in (("floor", floor), ("cliff", cliff)):
        dem = write_question_dem(name, height_m, CLIFF_CELL_M, "EPSG:32632", 5_200_000.0, folder)
        hours_along_middle_row.append(tool.run(dem)[0][middle])
    distance_m = (CLIFF_COL - np.arange(CLIFF_SHAPE[1])[CHECKED_COLS]) * CLIFF_CELL_M
    expected = hours_before_cliff(*_sun_path(tool.sun_model, dem), RAY_STEP_S, CLIFF_HEIGHT_M, distance_m)
    error_min = np.abs(hours_along_middle_row[1][CHECKED_COLS] - expected).mean() * 60.0
    return ConventionCheck(tool.name, float(hours_along_middle_row[0][middle]), day_length_h(tool.sun_model, dem), float(error_min))


def measure_hours(tools: list[HoursTool], dem: QuestionDem, case: str, cells: int, left_out: dict[str, str]) -> Iterator[SunAnswer]:
    """Measure tools on the raster ``case`` and yield their results, with errors in ``cells`` sampled cells.

    Tools that fail are added to ``left_out`` with the reason.
    """
    truth = HoursTruth(dem, cells)
    for tool in tools:
        try:
            hours, run, compute_s = tool.run(dem)
        except RuntimeError as error:
            left_out[tool.name] = str(error)
            continue
        sampled_hours = hours[truth.row, truth.col]
        error_min, error_as_is_min = (
            np.abs(sampled_hours - truth.hours_by_sun_model(sun)) * 60.0 for sun in (tool.sun_model, "astronomy")
        )
        yield SunAnswer(
            HOURS_QUESTION, case, tool.name, tool.is_skugga, compute_s, run.wall_s, run.cpu_s, float(error_min.mean()),
            float(np.percentile(error_min, 99)), float(error_as_is_min.mean()),
        )  # fmt: skip
