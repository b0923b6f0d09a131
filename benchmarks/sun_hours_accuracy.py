"""Accuracy of sun hours against rays, in minutes, on surfaces of mountains, cities and forests; and their time in seconds.

    python -m benchmarks.sun_hours_accuracy FOLDER [--date 2024-03-21] [--steps auto,15,5,2,1] [--cells 3000] [--seconds]
        [--markdown FILE]

FOLDER has the folders `mountain`, `urban` and `forest`, each with rasters of heights. Truth is traced for random cells of each
raster, away from its rim and holes. Every 10 seconds of the day a ray is traced from each cell to the sun, against the same
triangles as the sweep. `--seconds` instead measures the time for 4.2 million cells of generated mountains, on all cores that the
process may use (with `taskset -c 0` on one core). Figures belong in docs/reports/sun-hours.md, with date, commit and device.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, date
from pathlib import Path
from typing import NoReturn

import numpy as np
import rasterio
from affine import Affine
from scipy.ndimage import binary_erosion

from benchmarks.sweep_speed import CELL_M, fractal_heights_m
from skugga.api.raster_view import raster_view
from skugga.shadows.sun_hours.sun_hours import SunHours, SunRules, sun_hours
from skugga.shadows.sun_hours.suns import WindowSun, window_suns
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.gbuffer.bare_nodes import HALO_NODES, bare_nodes
from skugga.terrain.geo.daily_windows import daily_window
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

RASTERS_BY_FOLDER = {
    "mountain": ("bigtujunga_30m_utm11.tif", "sierra_30m_albers.tif", "zion_srtm_4326.tif"),
    "urban": ("essen_dom1_32_356_5699_1_nw_2020.tif", "goteborg_1m/DSM.tif"),
    "forest": ("quebec_DSM.tif", "kootenay_CHM_025m.tif"),
}
"""Rasters of each folder: surface models, which include buildings and trees."""

RAY_STEP_MIN = 10.0 / 60.0
"""Minutes between two rays of truth."""

HOLE_MARGIN_CELLS = 3
"""The least distance of a sampled cell from the rim and from any hole, in cells."""

SUNS_PER_BATCH = 100
"""Number of suns per batch of rays."""


@dataclass(frozen=True)
class ErrorMinutes:
    """The error of a quantity over cells in minutes: the mean, and the 99th percentile."""

    mean: float
    p99: float


@dataclass(frozen=True)
class AccuracyRow:
    """Errors for a raster at a time step.

    Attributes
    ----------
    folder, raster
        Names of the folder and of the raster.
    step_min
        Minutes between two suns; ``None`` for the automatic step.
    hours_error, first_sun_error, last_sun_error
        Errors of the hours of sun, of the time of the first sun and of the last sun.
    """

    folder: str
    raster: str
    step_min: float | None
    hours_error: ErrorMinutes
    first_sun_error: ErrorMinutes
    last_sun_error: ErrorMinutes


def _reject_planning(scene: Scene) -> NoReturn:
    """Fail, because sun hours of bare ground must not ask for a plan."""
    raise AssertionError("bare ground needs no plan")


def _sun_of_day(scene: Scene, day: date) -> WindowSun:
    """Return the sun's positions from midnight to midnight, by true solar time at the scene's anchor."""
    return window_suns(scene.world, [daily_window(day, 0.0, 1440.0, UTC, scene.world)])[0]


def _compute_sun_hours(scene: Scene, view: MapView, day: WindowSun, step_min: float | None) -> SunHours:
    """Return the sun hours of a day in all pixels of a map. ``step_min`` is the time between two suns; ``None`` is automatic."""
    return sun_hours(scene, view, [day], SunRules(step_minutes=step_min), _reject_planning)


class CellRays:
    """Rays from cells (n,) of the surface ``sheet``, in a frame in metres.

    ``start`` (n, 3) are the cells' points on the surface. ``upwards`` (n, 3) are the unit vectors of the vertical at these points.
    """

    def __init__(self, sheet: Sheet, start: np.ndarray, upwards: np.ndarray) -> None:
        self._rays = RayScene([sheet])
        self._start, self._upwards = start + 2.0 * self._rays.offset_m * upwards, upwards

    @staticmethod
    def from_cells(scene: Scene, view: MapView, row: np.ndarray, col: np.ndarray) -> CellRays:
        """Return rays from cells of a map's block against the triangles of the sweep, in the frame of ``bare_nodes``."""
        nodes = bare_nodes(scene, view, 1)
        window = int(view.row0) - HALO_NODES, int(view.col0) - HALO_NODES, view.rows + 2 * HALO_NODES, view.cols + 2 * HALO_NODES
        surface = scene.surface(view.grid).window(*window, nodes.frame)  # includes the rim that casts
        start = surface.position_frame_m[row + HALO_NODES, col + HALO_NODES]
        upwards = start - scene.world.up_origin(nodes.frame)
        return CellRays(surface.with_rim.sheet, start, upwards / np.linalg.norm(upwards, axis=1, keepdims=True))

    def sun_visible(self, direction: np.ndarray, min_sine: float = 0.0) -> np.ndarray:
        """Return which cells see the sun, bool (n,). ``direction`` (3,) is the unit vector to the sun.

        A sun counts only if the sine of its altitude at the cell exceeds ``min_sine``.
        """
        above = np.flatnonzero(self._upwards @ direction > min_sine)
        visible = np.zeros(len(self._start), bool)
        visible[above] = ~self._rays.is_blocked(self._start[above], direction) if len(above) else False
        return visible


def ray_truth(
    scene: Scene, view: MapView, row: np.ndarray, col: np.ndarray, day: WindowSun, step_min: float = RAY_STEP_MIN
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trace the hours of sun, and the minutes of first and last sun after the window's start, for cells (n,).

    The minutes are NaN for cells without sun. ``step_min`` is the time between two rays.
    """
    rays, frame = CellRays.from_cells(scene, view, row, col), bare_nodes(scene, view, 1).frame
    times = np.arange(step_min / 2, day.window.length_min, step_min)
    lit_min = np.zeros(len(row))
    first, last = np.full(len(row), np.nan), np.full(len(row), np.nan)
    for begin in range(0, len(times), SUNS_PER_BATCH):
        directions = frame.directions_from_earth(day.directions_at(times[begin : begin + SUNS_PER_BATCH]))
        for minutes, direction in zip(times[begin : begin + SUNS_PER_BATCH], directions, strict=True):
            visible = np.flatnonzero(rays.sun_visible(direction))
            lit_min[visible] += step_min
            first[visible] = np.fmin(first[visible], minutes - step_min / 2)
            last[visible] = np.fmax(last[visible], minutes + step_min / 2)
    return lit_min / 60.0, first, last


def _error_minutes(measured_min: np.ndarray, true_min: np.ndarray) -> ErrorMinutes:
    """Return the error of times (n,) in minutes. Cells where either time is NaN do not count."""
    error_min = np.abs(measured_min - true_min)
    error_min = error_min[np.isfinite(error_min)]
    return ErrorMinutes(float(error_min.mean()), float(np.percentile(error_min, 99)))


def measure_raster(folder_name: str, path: Path, day: date, steps: list[float | None], cells: int) -> Iterator[AccuracyRow]:
    """Yield the errors for the raster ``path`` at each step, in ``cells`` random cells.

    ``steps`` are minutes between two suns; ``None`` is the automatic step.
    """
    scene = build_scene(load_level(path))
    view = raster_view(scene).view.with_pixels_as_nodes()
    valid = binary_erosion(bare_nodes(scene, view, 1).shows_ground, iterations=HOLE_MARGIN_CELLS)
    row, col = np.nonzero(valid)
    sample = np.random.default_rng(1).choice(len(row), min(cells, len(row)), replace=False)
    row, col = row[sample], col[sample]
    day_sun = _sun_of_day(scene, day)
    hours, first, last = ray_truth(scene, view, row, col, day_sun)
    for step in steps:
        answer = _compute_sun_hours(scene, view, day_sun, step)
        yield AccuracyRow(
            folder_name, path.stem, step, _error_minutes(60.0 * answer.hours[row, col], 60.0 * hours),
            _error_minutes(answer.first[row, col], first), _error_minutes(answer.last[row, col], last),
        )  # fmt: skip
    scene.close()


def write_mountains(folder: Path, side: int) -> Path:
    """Write a raster of fractal mountains of ``side`` x ``side`` cells into ``folder``, and return its file."""
    path = folder / "mountains.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=1, dtype="float32", crs="EPSG:32632",
        transform=Affine(CELL_M, 0.0, 480000.0, 0.0, -CELL_M, 5200000.0),
    ) as dataset:  # fmt: skip
        dataset.write(fractal_heights_m(side).astype(np.float32), 1)
    return path


def measure_seconds(day: date, steps: list[float | None]) -> None:
    """Print the seconds that 2048 x 2048 cells take in a second run, when loops are compiled and heights cached.

    ``steps`` are minutes between two suns; ``None`` is the automatic step.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = build_scene(load_level(write_mountains(Path(folder), 2048)))
        view, day_sun = raster_view(scene).view.with_pixels_as_nodes(), _sun_of_day(scene, day)
        _compute_sun_hours(scene, view, day_sun, 60.0)
        for step in steps:
            begin = time.perf_counter(), time.process_time()
            _compute_sun_hours(scene, view, day_sun, step)
            wall, computing = time.perf_counter() - begin[0], time.process_time() - begin[1]
            print(f"step {_format_step(step):>4} min: {wall:.1f} s wall time, {computing:.1f} s CPU time", flush=True)


def _format_step(step_min: float | None) -> str:
    """Format minutes between two suns; ``None`` as "auto"."""
    return "auto" if step_min is None else f"{step_min:g}"


def markdown_table(rows: list[AccuracyRow]) -> str:
    """Return the errors as a Markdown table."""
    lines = [
        "| surface | raster | step, min | hours: mean, 99 % | first sun | last sun |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        error_cells = " | ".join(
            f"{error.mean:.2f}, {error.p99:.1f}" for error in (row.hours_error, row.first_sun_error, row.last_sun_error)
        )
        lines.append(f"| {row.folder} | {row.raster} | {_format_step(row.step_min)} | {error_cells} |")
    return "\n".join(lines)


def main() -> None:
    """Measure by the arguments of the command line, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--date", type=date.fromisoformat, default=date(2024, 3, 21))
    parser.add_argument("--steps", default="auto,15,5,2,1")
    parser.add_argument("--cells", type=int, default=3000)
    parser.add_argument("--seconds", action="store_true")
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    steps = [None if step == "auto" else float(step) for step in args.steps.split(",")]
    if args.seconds:
        measure_seconds(args.date, steps)
    if args.folder is None:
        return
    rows = []
    for folder_name, names in RASTERS_BY_FOLDER.items():
        for path in (args.folder / folder_name / name for name in names):
            if not path.exists():
                print(f"{path}: missing, skipped")
                continue
            for row in measure_raster(folder_name, path, args.date, steps, args.cells):
                rows.append(row)
                print(markdown_table([row]).splitlines()[-1], flush=True)
    if args.markdown is not None:
        args.markdown.write_text(markdown_table(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
