"""Masks of cast shadows by Skugga's line sweep and by other tools: time, memory, and wrong cells compared with traced rays.

    python -m benchmarks.peers [--python PATH] [--repeats 3] [--side 2048] [--json FILE] [--markdown FILE] [--readme] [--write-only]

There are two rasters: SRTM of the Jacksboro fault, and fractal mountains. Three sun azimuths are multiples of 45 degrees, three are
not. Every tool runs as a process of its own, reads the same GeoTIFF and writes a mask. Only one tool runs at a time, and the tools
take turns. A tool is skipped if its shadow of a pole has the wrong direction or length.

Truth is traced with rays from the nodes. Quads are cut along their higher diagonals, as in Skugga. Cells count if truth does not
depend on the rays' offset from the ground. For the other tools, truth must not depend on the choice of the diagonal either.

``--python`` is the interpreter of the Python packages (`pip install insolation numba topocalc solweig whitebox-workflows
rasterio`), which may have an environment of their own. The other tools are in Debian's packages `grass-core`, `saga`, `pktools` and
`gdal-bin`. Tools that are not installed are reported and skipped. ``--side`` makes smaller rasters, for trials; ``--readme`` prints
the short table of README.md; ``--write-only`` measures nothing and writes the report, its picture and the summary in docs/peers.md
again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict
from datetime import date
from pathlib import Path

import numpy as np

from benchmarks.peers.figures import ComparedRaster, PeerComparison, SunShares, ToolRecord, ToolResult
from benchmarks.peers.pages import format_page, format_summary, short_table
from benchmarks.peers.picture import write_plot
from benchmarks.peers.tools import Tool, ToolJob, ToolRun, check_pole, make_tools, write_dem
from benchmarks.report_pages import REPORTS, head_commit, write_between_marks
from benchmarks.sweep_accuracy import GridRays, GridTruth
from benchmarks.sweep_speed import CELL_M, fractal_heights_m, processor_name
from skugga.terrain.level.bundled import BUNDLED

HERE = Path(__file__).parent
DOCS = HERE.parents[1] / "docs"
PAGE = DOCS / "peers.md"

SUN_ANGLES_DEG = [(315.0, 30.0), (135.0, 10.0), (90.0, 3.0), (202.0, 30.0), (113.0, 10.0), (67.0, 3.0)]
"""Azimuth and altitude, degrees. The first three azimuths are those of the grid's axes and diagonals."""

MAX_REPEATED_RUN_S = 2.0
"""Longest run, seconds, that is repeated. A slower tool runs only once, without a median."""


def read_jacksboro() -> tuple[np.ndarray, float]:
    """Return SRTM heights in UTM 16N without the incomplete rim, float32 (rows, cols) in metres, and the side of a cell."""
    with BUNDLED["jacksboro_utm"]().open() as source:
        height_m, cell_m = source.read(1), source.transform.a
    while np.isnan(height_m).any():
        rims = {(0, 0): height_m[0], (0, -1): height_m[-1], (1, 0): height_m[:, 0], (1, -1): height_m[:, -1]}
        axis, edge_index = max(rims, key=lambda rim: np.isnan(rims[rim]).mean())
        height_m = np.delete(height_m, edge_index, axis)
    return height_m, cell_m


def make_compared_rasters(side: int) -> dict[str, tuple[np.ndarray, float]]:
    """Return by name the heights, float32 (rows, cols) in metres, and the side of a cell in metres.

    Rasters have at most ``side`` cells a side.
    """
    height_m, cell_m = read_jacksboro()
    return {"Jacksboro": (np.ascontiguousarray(height_m[:side, :side]), cell_m), "fractal": (fractal_heights_m(side), CELL_M)}


def check_tools(python: str, folder: Path) -> tuple[dict[Tool, float], dict[str, str], list[ToolRecord]]:
    """Check all tools. Return the usable tools, the skipped tools, and the records of the usable ones.

    The first dictionary has the least wall time of a tool's process on the small raster of the pole, seconds. The second has the
    reason why a tool is skipped.
    """
    start_s: dict[Tool, float] = {}
    skip_reasons: dict[str, str] = {}
    records = []
    for tool in make_tools(python):
        version = tool.installed_version()
        if version is None:
            skip_reasons[tool.name] = "absent"
            print(f"{tool.name}: not installed, skipped", flush=True)
            continue
        try:
            start_s[tool] = min(run.wall_s for run in check_pole(tool, folder))
        except RuntimeError as error:
            skip_reasons[tool.name] = str(error)
            print(f"{tool.name}: skipped: {error}", flush=True)
            continue
        records.append(ToolRecord(tool.name, version, tool.algorithm, tool.is_skugga, tool.decode_mask is not None, start_s[tool]))
        print(f"{tool.name} {version}: the pole's shadow is right", flush=True)
    return start_s, skip_reasons, records


def describe_raster(name: str, height_m: np.ndarray, cell_m: float) -> tuple[ComparedRaster, list[GridTruth]]:
    """Return a raster's description, and the truth under each of ``SUN_ANGLES_DEG``.

    ``height_m`` is (rows, cols). The shares in the description count cells whose truth is certain for either diagonal of a quad.
    """
    rays = GridRays(height_m, (cell_m, cell_m))
    truths = [rays.truth(*sun) for sun in SUN_ANGLES_DEG]
    sun_shares = [
        SunShares(
            *sun,
            float((~truth.lit & truth.certain_for_any_cut).sum() / truth.certain_for_any_cut.sum()),
            float((~truth.certain_for_any_cut).mean()),
        )
        for sun, truth in zip(SUN_ANGLES_DEG, truths, strict=True)
    ]
    rows, cols = height_m.shape
    return ComparedRaster(name, rows, cols, cell_m, float(height_m.min()), float(height_m.max()), sun_shares), truths


def shadow_errors(lit: np.ndarray, truth: GridTruth, certain: np.ndarray) -> tuple[float, float]:
    """Return false and missed shadow as shares of the cells in ``certain``, which is one of the masks of ``truth``.

    ``lit`` is a tool's mask of cells that see the sun (rows, cols).
    """
    count = certain.sum()
    false, missed = (certain & (truth.lit == sunny) & (lit != sunny) for sunny in (True, False))
    return float(false.sum() / count), float(missed.sum() / count)


def measure_all(python: str, side: int, repeats: int) -> PeerComparison:
    """Check the tools, trace truth, run the tools in turns, and return all results.

    ``python`` is the interpreter of the other tools' packages. ``side`` is the largest side of a raster, in cells.
    """
    begin = time.perf_counter()
    runs: dict[tuple[Tool, str, int], list[ToolRun]] = {}
    error_shares: dict[tuple[Tool, str, int], tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        tools, left_out, records = check_tools(python, folder)
        terrains, truths = [], {}
        for name, (height_m, cell_m) in make_compared_rasters(side).items():
            terrain, truths[name] = describe_raster(name, height_m, cell_m)
            terrains.append(terrain)
            write_dem(folder / f"{name}.tif", height_m, cell_m)
            print(f"{time.perf_counter() - begin:4.0f} s  truth of {name}", flush=True)
        for repeat in range(repeats):
            for name in truths:
                for sun_index, sun in enumerate(SUN_ANGLES_DEG):
                    job = ToolJob(folder / f"{name}.tif", *sun, folder / "mask.tif")
                    for tool in [*tools][:: -1 if repeat % 2 else 1]:
                        key = tool, name, sun_index
                        if repeat and max(run.wall_s for run in runs[key]) > MAX_REPEATED_RUN_S:
                            continue
                        try:
                            runs.setdefault(key, []).append(tool.run(job))
                        except RuntimeError as error:
                            left_out[tool.name] = f"{name} under the sun {' / '.join(job.sun_arguments)}: {error}"
                            print(f"{tool.name}: skipped: {left_out[tool.name]}", flush=True)
                            del tools[tool]
                            continue
                        if tool.decode_mask is not None and key not in error_shares:
                            truth = truths[name][sun_index]
                            error_shares[key] = shadow_errors(
                                tool.read_mask(job), truth, truth.certain if tool.is_skugga else truth.certain_for_any_cut
                            )
                print(f"{time.perf_counter() - begin:4.0f} s  round {repeat + 1} of {repeats}: {name}", flush=True)
    answers = [
        _tool_result(*key[:2], SUN_ANGLES_DEG[key[2]], key_runs, error_shares.get(key))
        for key, key_runs in runs.items()
        if key[0] in tools
    ]
    records = [record for record in records if record.name not in left_out]
    machine = f"{processor_name()}, {os.cpu_count()} cores"
    took_s = time.perf_counter() - begin
    return PeerComparison(
        machine, repeats, MAX_REPEATED_RUN_S, took_s, terrains, records, left_out, answers, date.today().isoformat(), head_commit()
    )


def _tool_result(
    tool: Tool, name: str, sun: tuple[float, float], runs: list[ToolRun], error_shares: tuple[float, float] | None
) -> ToolResult:
    """Return the result of a tool's runs on the raster ``name`` under a sun (azimuth and altitude, degrees).

    ``error_shares`` are false and missed shadow; ``None`` if the tool casts no shadows.
    """
    compute_s = [run.compute_s for run in runs if run.compute_s is not None]
    return ToolResult(
        tool=tool.name,
        terrain=name,
        azimuth_deg=sun[0],
        altitude_deg=sun[1],
        runs=len(runs),
        compute_s=float(np.median(compute_s)) if compute_s else None,
        whole_s=float(np.median([run.wall_s for run in runs])),
        peak_mb=max(run.peak_mb for run in runs),
        cores=float(np.median([run.cores for run in runs])),
        false_shadow=error_shares[0] if error_shares else None,
        missed_shadow=error_shares[1] if error_shares else None,
    )


def main() -> None:
    """Measure, and write figures, report and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--python", default=sys.executable, metavar="PATH", help="the interpreter that has the packages of the other tools"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--side", type=int, default=2048, help="cells a side of the fractal mountains, and maximum of the other raster"
    )
    parser.add_argument("--json", type=Path, default=HERE / "peers.json", metavar="FILE")
    parser.add_argument("--markdown", type=Path, default=REPORTS / "peers.md", metavar="FILE")
    parser.add_argument("--picture", type=Path, default=DOCS / "images" / "peers.webp", metavar="FILE")
    parser.add_argument("--readme", action="store_true", help="print the short table")
    parser.add_argument("--write-only", action="store_true")
    args = parser.parse_args()
    if not args.write_only:
        comparison = measure_all(args.python, args.side, args.repeats)
        args.json.write_text(json.dumps(asdict(comparison), indent=1) + "\n", "utf-8")
    comparison = PeerComparison.read(json.loads(args.json.read_text("utf-8")))
    args.markdown.write_text(format_page(comparison, Path(os.path.relpath(args.picture, args.markdown.parent)).as_posix()), "utf-8")
    write_between_marks(PAGE, format_summary(comparison))
    write_plot(comparison, args.picture)
    if args.readme:
        print("\n".join(short_table(comparison)))


if __name__ == "__main__":
    main()
