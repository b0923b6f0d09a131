"""Tools that compute shadows: commands that run them as processes, functions that read their output, and checks of the tools."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

PROGRAMS_FILE = Path(__file__).with_name("programs.py")

CRS = "EPSG:32616"
"""CRS of the rasters, a UTM zone in which north is up on the central meridian."""
MIDDLE_XY_M = (500_000.0, 0.0)
"""Middle of the rasters, on the central meridian and the equator. There grid north is true north, which r.horizon uses."""

FLOOR_SIDE_CELLS, POLE_WIDTH_CELLS, POLE_HEIGHT_M, FLOOR_CELL_M, FLOOR_HEIGHT_M = 201, 5, 150.0, 10.0, 100.0
"""Geometry of the check of conventions: a square floor with a block (the pole) in its middle."""

POLE_SUN_ANGLES_DEG = [(azimuth, 10.0) for azimuth in (315.0, 202.0, 113.0, 67.0)]
"""Azimuths and altitudes of the suns over the pole."""
POLE_TOLERANCE_CELLS = 2.0
"""The tolerance of a pole's shadow in length and position, in cells."""


@dataclass(frozen=True)
class ToolJob:
    """A job for a tool: a raster of heights, the sun's azimuth (clockwise from north) and altitude in degrees, and the output."""

    dem: Path
    azimuth_deg: float
    altitude_deg: float
    out: Path

    @property
    def sun_arguments(self) -> list[str]:
        """Azimuth and altitude in degrees, as words of a command."""
        return [f"{self.azimuth_deg:g}", f"{self.altitude_deg:g}"]


@dataclass(frozen=True)
class ToolRun:
    """The cost of a process.

    Attributes
    ----------
    wall_s
        Wall time of the process, seconds.
    compute_s
        Seconds of computing that the process itself reports; ``None`` if it reports none.
    peak_mb
        Peak memory, MB.
    cores
        CPU time divided by wall time.
    """

    wall_s: float
    compute_s: float | None
    peak_mb: float
    cores: float

    @property
    def cpu_s(self) -> float:
        """CPU time of the process and of its children."""
        return self.cores * self.wall_s


@dataclass(frozen=True, eq=False)
class Tool:
    """A tool and how to run it.

    Attributes
    ----------
    name
        Name.
    algorithm
        Description of its algorithm in a few words.
    version_command
        Command that prints its version, and fails if the tool is absent.
    command
        Returns the command for a job.
    decode_mask
        Function of the values that the tool wrote and of the job. It returns the mask (rows, cols) of cells that see the sun.
        ``None`` if the tool casts no shadows.
    is_skugga
        Whether it is part of Skugga.
    """

    name: str
    algorithm: str
    version_command: list[str]
    command: Callable[[ToolJob], list[str]]
    decode_mask: Callable[[np.ndarray, ToolJob], np.ndarray] | None
    is_skugga: bool = False

    def installed_version(self) -> str | None:
        """Return the tool's version, or ``None`` if it is absent."""
        return installed_version(self.version_command)

    def run(self, job: ToolJob) -> ToolRun:
        """Run the tool. Raises the errors of ``run_process``."""
        return run_process(self.command(job), job.out)

    def read_mask(self, job: ToolJob) -> np.ndarray:
        """Read the tool's output, and return where the sun is visible, bool (rows, cols)."""
        assert self.decode_mask is not None
        with rasterio.open(job.out) as dataset:
            return self.decode_mask(dataset.read(1), job)


def installed_version(command: list[str]) -> str | None:
    """Return the first version number in a command's output; ``None`` if the command is missing or fails."""
    if shutil.which(command[0]) is None:
        return None
    process = subprocess.run(command, capture_output=True, text=True)
    number = re.search(r"\d+(\.\w+)+", process.stdout + process.stderr if process.returncode == 0 else "")
    return number[0] if number else None


def run_process(command: list[str], out: Path) -> ToolRun:
    """Run a command that writes the file ``out``, and return its cost.

    Its seconds of computing are the last line of its output that is only a number. Raises ``RuntimeError`` with the last line of
    its output if it fails.
    """
    out.unlink(missing_ok=True)
    process = subprocess.run([sys.executable, "-I", "-S", "-c", LAUNCHER, *command], capture_output=True, text=True)
    usage = json.loads(process.stdout or "{}")
    output = usage.get("output", process.stderr)
    if usage.get("code", process.returncode) or not out.exists():
        raise RuntimeError(([line for line in output.splitlines() if line.strip()] or ["no output"])[-1].strip())
    seconds = re.findall(r"^\d+\.\d+(?:e-\d+)?$", output, re.MULTILINE)
    return ToolRun(usage["wall_s"], float(seconds[-1]) if seconds else None, usage["peak_mb"], usage["cpu_s"] / usage["wall_s"])


LAUNCHER = """
import json, os, subprocess, sys, tempfile, time
with tempfile.TemporaryFile("w+") as output:
    start = time.perf_counter()
    child = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
    _, status, usage = os.wait4(child.pid, 0)
    wall_s = time.perf_counter() - start
    output.seek(0)
    print(json.dumps({"wall_s": wall_s, "cpu_s": usage.ru_utime + usage.ru_stime, "peak_mb": usage.ru_maxrss * 1024 / 1e6,
                      "code": os.waitstatus_to_exitcode(status), "output": output.read()}))
"""
"""Program of the parent process of a tool. The parent must be small, because a process's peak memory begins with its parent's."""


def make_tools(python: str) -> list[Tool]:
    """Return all tools. Python packages are those of the interpreter ``python``."""
    programs_file = str(PROGRAMS_FILE)

    def package(name: str, algorithm: str, program: str, distribution: str, module: str) -> Tool:
        return Tool(
            name,
            algorithm,
            [python, programs_file, "--version", distribution, module],
            lambda job: [python, programs_file, program, str(job.dem), *job.sun_arguments, str(job.out)],
            lambda values, job: values > 0,
        )

    def sweep(lines: int) -> Tool:
        return Tool(
            f"Skugga sweep, {lines} line{'s' * (lines > 1)}",
            "running maximum on lines along the sun's azimuth, between cells",
            [sys.executable, programs_file, "--version", "skugga", "skugga.shadows.sweep.grid"],
            lambda job: [sys.executable, programs_file, "sweep", str(job.dem), *job.sun_arguments, str(job.out), str(lines)],
            lambda values, job: values > 0,
            is_skugga=True,
        )

    return [
        *(sweep(lines) for lines in (1, 2, 8, 16)),
        package("insolation", "running maximum on lines, nearest cell", "insolation", "insolation", "insolation.insolf"),
        package("topocalc", "horizons on skewed rows", "topocalc", "topocalc", "topocalc.horizon"),
        package("solweig", "shifted terrain and its maximum, nearest cell", "solweig", "solweig", "solweig"),
        package("Whitebox Workflows", "horizons by rays from grid line to grid line", "whitebox", "whitebox-workflows",
                "whitebox_workflows"),
        Tool(
            "GRASS r.horizon",
            "horizons by a walk from each cell, nearest cell",
            ["grass", "--version"],
            lambda job: ["grass", "--tmp-location", str(job.dem), "--exec", sys.executable, programs_file, "r.horizon",
                         str(job.dem), *job.sun_arguments, str(job.out)],
            lambda values, job: ~(values > job.altitude_deg),
        ),
        Tool(
            "SAGA ta_lighting",
            "a walk from each cell, nearest cell",
            ["saga_cmd", "--version"],
            lambda job: ["saga_cmd", "-f=s", "ta_lighting", "0", "-ELEVATION", str(job.dem), "-SHADE", str(job.out), "-METHOD", "3",
                         "-SHADOW", "0", "-UNIT", "1", "-AZIMUTH", job.sun_arguments[0], "-DECLINATION", job.sun_arguments[1]],
            lambda values, job: values < 0,
        ),
        Tool(
            "pktools pkdsm2shadow",
            "a shadow thrown from each cell, nearest cell",
            ["pkdsm2shadow", "--version"],
            lambda job: ["pkdsm2shadow", "-i", str(job.dem), "-o", str(job.out), "-sza", f"{90.0 - job.altitude_deg:g}",
                         "-saa", job.sun_arguments[0], "-f", "1"],
            lambda values, job: values == 0,
        ),
        Tool(
            "gdaldem hillshade",
            "slopes of 3 x 3 cells: casts no shadows, and is what a process costs",
            ["gdalinfo", "--version"],
            lambda job: ["gdaldem", "hillshade", "-q", str(job.dem), str(job.out), "-az", job.sun_arguments[0],
                         "-alt", job.sun_arguments[1]],
            None,
        ),
    ]  # fmt: skip


def write_dem(path: Path, height_m: np.ndarray, cell_m: float, crs: str = CRS, middle_m: tuple[float, float] = MIDDLE_XY_M) -> None:
    """Write heights, float32 (rows, cols) in metres, as a GeoTIFF with square cells. ``middle_m`` is the position of its middle."""
    rows, cols = height_m.shape
    corner = middle_m[0] - cols * cell_m / 2, middle_m[1] + rows * cell_m / 2
    transform = Affine(cell_m, 0, corner[0], 0, -cell_m, corner[1])
    with rasterio.open(
        path, "w", driver="GTiff", width=cols, height=rows, count=1, dtype="float32", crs=crs, transform=transform
    ) as target:
        target.write(height_m, 1)


def check_pole(tool: Tool, folder: Path) -> list[ToolRun]:
    """Check that a tool's shadow of a block on a flat floor has the right direction and length. Return the costs of the runs.

    Raises ``RuntimeError`` if a shadow differs by more than ``POLE_TOLERANCE_CELLS`` cells, or if the tool fails.
    """
    height_m = np.full((FLOOR_SIDE_CELLS, FLOOR_SIDE_CELLS), FLOOR_HEIGHT_M, np.float32)
    middle, half = FLOOR_SIDE_CELLS // 2, POLE_WIDTH_CELLS // 2
    height_m[middle - half : middle + half + 1, middle - half : middle + half + 1] += POLE_HEIGHT_M
    dem = folder / "pole.tif"
    write_dem(dem, height_m, FLOOR_CELL_M)
    runs = []
    for azimuth_deg, altitude_deg in POLE_SUN_ANGLES_DEG:
        job = ToolJob(dem, azimuth_deg, altitude_deg, folder / "pole_mask.tif")
        runs.append(tool.run(job))
        if tool.decode_mask is not None:
            _check_shadow(tool.read_mask(job), azimuth_deg, altitude_deg)
    return runs


def _check_shadow(lit: np.ndarray, azimuth_deg: float, altitude_deg: float) -> None:
    """Check the mask of cells that see the sun, bool (rows, cols), of the pole's floor under a sun.

    Raises ``RuntimeError`` if the pole's shadow has the wrong direction or length.
    """
    dark = np.argwhere(~lit) - FLOOR_SIDE_CELLS // 2
    if not len(dark):
        raise RuntimeError(f"azimuth {azimuth_deg:g}: the pole casts no shadow")
    azimuth = np.radians(azimuth_deg)
    distance, sideways = (
        dark @ np.array(direction) for direction in ((np.cos(azimuth), -np.sin(azimuth)), (np.sin(azimuth), np.cos(azimuth)))
    )
    corner = (POLE_WIDTH_CELLS // 2) * (abs(np.sin(azimuth)) + abs(np.cos(azimuth)))
    expected = corner + POLE_HEIGHT_M / np.tan(np.radians(altitude_deg)) / FLOOR_CELL_M
    if abs(distance.max() - expected) > POLE_TOLERANCE_CELLS:
        raise RuntimeError(
            f"azimuth {azimuth_deg:g}: the pole's shadow is {distance.max():.1f} cells long instead of {expected:.1f}"
        )
    if np.abs(sideways).max() > corner + POLE_TOLERANCE_CELLS:
        raise RuntimeError(
            f"azimuth {azimuth_deg:g}: the pole's shadow deviates from its direction by {np.abs(sideways).max():.1f} cells"
        )
