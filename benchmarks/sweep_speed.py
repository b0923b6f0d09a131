"""Speed and wrong cells of the line sweep on fractal mountains, compared with another implementation in Python.

    python -m benchmarks.sweep_speed [--side 4096] [--truth-side 2048] [--lines 8] [--repeats 5] [--markdown FILE]

The other implementation is `insolation.doshade` (Corripio's running maximum in numba). Without `pip install insolation` its rows
are omitted. Both process the same array under nine suns, off the 45-degree axes, in turns, each in a process of its own. Figures
are medians of one run. Rates per core and second use CPU time, which other load affects little. Memory is the growth of a process's
peak during the work.

Wrong cells are counted against rays on a smaller terrain of the same kind, since the rays' triangles take 0.5 GB per million cells.
Truth for the sweep cuts quads into triangles like the sweep. For the other implementation only those cells count whose truth is the
same for either diagonal.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numba
import numpy as np

from benchmarks.sweep_accuracy import GridRays, Raster, compare_with_truth
from skugga.shadows.sweep.grid import sunlit_nodes

CELL_M = 10.0
"""Side of a cell of the generated mountains."""
RELIEF_M = 2000.0
"""Height difference of the generated mountains."""
ROUGHNESS = 2.1
"""Amplitudes of the spectral synthesis decay with this power of the frequency: slopes of 16 degrees on average."""

SUN_ANGLES_DEG = [(azimuth, altitude) for azimuth in (202.0, 113.0, 67.0) for altitude in (30.0, 10.0, 3.0)]

MIN_CELLS_PER_S = 50e6
"""Target for cells per second on one core."""

MIN_WRONG_RATIO = 15.0
"""Target for insolation's share of wrong cells, as a multiple of the sweep's."""
MIN_TWO_CORE_SPEEDUP = 1.7
"""Target for the speed on two cores, as a multiple of that on one."""


@dataclass(frozen=True)
class SweepTool:
    """A tool: its name, its number of threads, and the number of lines per cell of the sweep (0 for `insolation`)."""

    name: str
    threads: int
    lines: int

    def compute_mask(self, height_m: np.ndarray, azimuth_deg: float, altitude_deg: float) -> np.ndarray:
        """Return the mask of cells that see the sun, bool (rows, cols)."""
        if self.lines:
            return sunlit_nodes(height_m, CELL_M, azimuth_deg, altitude_deg, lines=self.lines, cores=self.threads)
        from insolation import insolf

        numba.set_num_threads(self.threads)
        azimuth, altitude = np.radians([azimuth_deg, altitude_deg])
        to_sun_south = np.array(  # its y axis points south
            [np.sin(azimuth) * np.cos(altitude), -np.cos(azimuth) * np.cos(altitude), np.sin(altitude)]
        )
        return insolf.doshade(height_m, CELL_M, to_sun_south).view(bool)


def fractal_heights_m(side: int, seed: int = 42) -> np.ndarray:
    """Return fractal heights (side, side), float32, in metres, by spectral synthesis: white noise filtered by a power law."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).standard_normal((side, side)))
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    height = np.fft.irfft2(spectrum * frequency**-ROUGHNESS, s=(side, side))
    return ((height - height.min()) * (RELIEF_M / np.ptp(height))).astype(np.float32)


def check_convention(tool: SweepTool) -> None:
    """Check that a tool's shadow of a pole of 100 m on a flat floor has the right direction and length.

    Raises ``RuntimeError`` if it does not.
    """
    height = np.zeros((201, 201), np.float32)
    height[100, 100] = 100.0
    for azimuth, (down, right) in {0.0: (1, 0), 90.0: (0, -1), 180.0: (-1, 0), 270.0: (0, 1), 45.0: (1, -1)}.items():
        dark = np.argwhere(~tool.compute_mask(height, azimuth, 10.0)) - 100
        distance_cells = dark @ np.array([down, right]) / np.hypot(down, right)
        reach = 100.0 / np.tan(np.radians(10.0)) / CELL_M
        if abs(distance_cells.max() - reach) > 2.0 or abs(np.median(distance_cells) - reach / 2) > 3.0:
            raise RuntimeError(
                f"{tool.name}: at azimuth {azimuth:g} the pole's shadow ends {distance_cells.max():.1f} cells away, not {reach:.1f}"
            )


class SweepProcess:
    """A process that times several tools, one after another, on a terrain."""

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
        self.peak_bytes()  # starts the process now: its peak begins with that of its parent

    def load(self, path: Path) -> None:
        """Load a terrain (rows, cols) from a file."""
        self._pool.submit(_load_terrain, path).result()

    def measure_s(self, tool: SweepTool, sun: tuple[float, float]) -> tuple[float, float]:
        """Return the wall time of one computation of a mask, and the CPU time of all cores, in seconds."""
        return self._pool.submit(_measure_s, tool, sun).result()

    def peak_bytes(self) -> int:
        """Return the peak memory of the process so far."""
        return self._pool.submit(_peak_bytes).result()

    def close(self) -> None:
        """End the worker process."""
        self._pool.shutdown()


_terrain_m = np.zeros((0, 0), np.float32)


def _load_terrain(path: Path) -> None:
    """Load heights (rows, cols) from a NumPy file, for later calls in this process."""
    global _terrain_m
    _terrain_m = np.load(path)


def _measure_s(tool: SweepTool, sun: tuple[float, float]) -> tuple[float, float]:
    """Compute a mask of the loaded terrain under a sun (azimuth, altitude), and return wall and CPU seconds."""
    start, cpu_start = time.perf_counter(), time.process_time()
    tool.compute_mask(_terrain_m, *sun)
    return time.perf_counter() - start, time.process_time() - cpu_start


def _peak_bytes() -> int:
    """Return the peak memory of this process, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measure_times(tools: list[SweepTool], side: int, repeats: int) -> tuple[dict[SweepTool, np.ndarray], dict[SweepTool, int]]:
    """Return by tool wall and CPU seconds (repeats, suns, 2), and the growth of its process's peak memory in bytes.

    The terrain has ``side`` x ``side`` cells. The tools take turns.
    """
    workers = {tool: SweepProcess() for tool in tools}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "terrain.npy"
        np.save(path, fractal_heights_m(side))
        for worker in workers.values():
            worker.load(path)
    before = {tool: worker.peak_bytes() for tool, worker in workers.items()}
    for tool, worker in workers.items():  # compiles loops and starts threads before the timing
        worker.measure_s(tool, SUN_ANGLES_DEG[0])
    seconds = {tool: np.empty((repeats, len(SUN_ANGLES_DEG), 2)) for tool in tools}
    for repeat in range(repeats):
        for k, sun in enumerate(SUN_ANGLES_DEG):
            for tool, worker in workers.items():
                seconds[tool][repeat, k] = worker.measure_s(tool, sun)
        print(
            f"round {repeat + 1} of {repeats}: " + ", ".join(_format_speed(t, seconds[t][repeat], side) for t in tools), flush=True
        )
    memory = {tool: worker.peak_bytes() - before[tool] for tool, worker in workers.items()}
    for worker in workers.values():
        worker.close()
    return seconds, memory


def _format_speed(tool: SweepTool, seconds: np.ndarray, side: int) -> str:
    """Format a tool's cells per second. ``seconds`` (suns, 2) are wall and CPU times for ``side`` x ``side`` cells."""
    return f"{tool.name} {tool.threads}: {side**2 / np.median(seconds[:, 0]) / 1e6:.0f} Mcells/s"


def measure_wrong_shares(tools: list[SweepTool], side: int) -> dict[SweepTool, np.ndarray]:
    """Return by tool the shares of wrong, false, missed and interior cells among decided cells (suns, 4).

    The terrain has ``side`` x ``side`` cells. All tools are compared with the same rays.
    """
    terrain = Raster("mountains", fractal_heights_m(side), np.ones((side, side), bool), (CELL_M, CELL_M))
    rays = GridRays(terrain.height_m, terrain.cell_m)
    result = {tool: np.empty((len(SUN_ANGLES_DEG), 4)) for tool in tools}
    for k, sun in enumerate(SUN_ANGLES_DEG):
        truth = rays.truth(*sun)
        for tool in tools:
            certain = truth.certain if tool.lines else truth.certain_for_any_cut
            figures = compare_with_truth(terrain, tool.compute_mask(terrain.height_m, *sun), truth, certain, *sun)
            result[tool][k] = figures.wrong, figures.false_shadow, figures.missed_shadow, figures.interior
    return result


def format_report(
    side: int,
    seconds: dict[SweepTool, np.ndarray],
    memory: dict[SweepTool, int],
    truth_side: int,
    wrong_shares: dict[SweepTool, np.ndarray],
) -> list[str]:
    """Format Markdown: a row for each tool, its wrong cells by sun, and the targets.

    ``seconds`` and ``memory`` are the results of ``measure_times``, ``wrong_shares`` that of ``measure_wrong_shares``. ``side`` and
    ``truth_side`` are the sides of their terrains in cells.
    """
    rows = [
        f"# The line sweep on {side} x {side} fractal mountains, nine suns",
        "",
        f"Made by `benchmarks/sweep_speed.py` on {processor_name()}, {os.cpu_count()} cores. Medians; memory beside the terrain.",
        "",
        "| what | threads | ms | million cells/s: median | slowest sun | per core and s | memory MB |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for tool, tool_seconds in seconds.items():
        per_sun, core_s = np.median(tool_seconds, axis=0).T
        rows.append(
            f"| {tool.name} | {tool.threads} | {1000 * np.median(per_sun):.0f} | {side**2 / np.median(per_sun) / 1e6:.0f} | "
            f"{side**2 / per_sun.max() / 1e6:.0f} | {side**2 / np.median(core_s) / 1e6:.0f} | {memory[tool] / 1e6:.0f} |"
        )
    rows += [
        "",
        f"Wrong cells in per cent of the decided ones, {truth_side} x {truth_side}; azimuth / altitude; last: `interior`, mean.",
        "",
        "| what | " + " | ".join(f"{a:g} / {h:g}" for a, h in SUN_ANGLES_DEG) + " | mean | false | missed | interior |",
        "| --- |" + " --- |" * (len(SUN_ANGLES_DEG) + 4),
    ]
    for tool, tool_shares in wrong_shares.items():
        shares = [*tool_shares[:, 0], *tool_shares.mean(axis=0)]
        rows.append(f"| {tool.name} | " + " | ".join(f"{100 * share:.4f}" for share in shares) + " |")
    return rows + ["", *_format_targets(seconds, wrong_shares, side)]


def _format_targets(seconds: dict[SweepTool, np.ndarray], wrong_shares: dict[SweepTool, np.ndarray], side: int) -> list[str]:
    """Format the targets and the results. Ratios are medians over pairs of results of one run."""
    by_threads = {(bool(tool.lines), tool.threads): tool_seconds[..., 0] for tool, tool_seconds in seconds.items()}
    sweep_s = by_threads[True, 1]
    result = [("million cells/s on one core", side**2 / np.median(sweep_s) / 1e6, MIN_CELLS_PER_S / 1e6)]
    if (True, 2) in by_threads:
        result.append(("two cores against one", float(np.median(sweep_s / by_threads[True, 2])), MIN_TWO_CORE_SPEEDUP))
    if (False, 1) in by_threads:
        result.append(("speed against insolation's, one core", float(np.median(by_threads[False, 1] / sweep_s)), 1.0))
        sweep_wrong, insolation_wrong = (
            float(np.mean([shares[:, 0] for tool, shares in wrong_shares.items() if bool(tool.lines) == is_sweep]))
            for is_sweep in (True, False)
        )
        result.append(
            (
                "insolation's wrong cells against the sweep's",
                insolation_wrong / sweep_wrong if sweep_wrong else np.inf,
                MIN_WRONG_RATIO,
            )
        )
    return [
        f"- {target}: {value:.2f}, target at least {minimum:g}: {'met' if value >= minimum else 'missed'}"
        for target, value, minimum in result
    ]


def processor_name() -> str:
    """Return the name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def main() -> None:
    """Measure times and errors of the tools, and print and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=4096)
    parser.add_argument("--truth-side", type=int, default=2048)
    parser.add_argument("--lines", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    cores = os.cpu_count() or 1
    tools = [SweepTool("sweep", count, args.lines) for count in sorted({1, min(2, cores)})]
    try:
        import insolation  # noqa: F401
    except ImportError:
        print("insolation: not installed, skipped (pip install insolation)")
    else:
        other_tools = [SweepTool("insolation", count, 0) for count in sorted({1, cores})]  # all cores are its default
        check_convention(other_tools[0])
        tools += other_tools
    seconds, memory = measure_times(tools, args.side, args.repeats)
    wrong_shares = measure_wrong_shares([tool for tool in tools if tool.threads == 1], args.truth_side)
    lines = format_report(args.side, seconds, memory, args.truth_side, wrong_shares)
    print("\n".join(lines))
    if args.markdown:
        args.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
