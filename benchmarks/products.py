"""Time and memory of products, in this and in another checkout: blocks of tiles, maps, rasters of masks, and a day of sun hours.

    python -m benchmarks.products dem.tif --base ../before

The checkouts take turns, each run in a process of its own with compiled loops. The table shows the median CPU milliseconds of each
checkout, their ratio, and the peak memory. Each run draws the same ground under new suns.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

WORKER_PROGRAM = """
import json, resource, sys, time
from pathlib import Path
import skugga
from skugga.api.workers.jobs import BlockJob, LevelKey, MapJob
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.warm_up import warm_up
from skugga.api.workers.worker_state import WorkerState, tiles_view
from skugga.api.workers.jobs import ZoomTiles
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
try:
    from skugga.api.request import PictureRequest, ProductRequest
except ImportError:
    from skugga.api.workers.jobs import PictureRequest
    ProductRequest = None
raster, zoom, repeats = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
state, key = WorkerState(warm_up()), LevelKey(path=raster, version="1")
scene = build_scene(load_level(raster))
view = tiles_view(scene, ZoomTiles(matrix_set="WebMercatorQuad", zoom=zoom))
block_x, block_y = int(view.col0) // 1024, int(view.row0) // 1024
def job_fields(layer, azimuth):
    sun = SunSpec(azimuth=azimuth, altitude=20.0)
    if ProductRequest is None:
        return {"layer": layer, "request": PictureRequest(sun=sun)}
    return {"request": ProductRequest(product=layer, sun=sun)}
def block(layer, azimuth):
    place = {"matrix_set": "WebMercatorQuad", "zoom": zoom, "block_x": block_x, "block_y": block_y}
    run_job(BlockJob(level=key, **place, **job_fields(layer, azimuth)), state)
def draw_map(layer, azimuth):
    run_job(MapJob(level=key, bounds=None, crs=None, size=(700, 700), format="png", **job_fields(layer, azimuth)), state)
level = skugga.open_level(raster)
cases = {
    "block of colour tiles": lambda n: block("color", 100.0 + n), "block of mask tiles": lambda n: block("mask", 100.5 + n),
    "block of shadow tiles": lambda n: block("shadow", 101.0 + n), "block of heights": lambda n: block("terrarium", 100.0),
    "map of colours, 700 x 700": lambda n: draw_map("color", 102.0 + n),
    "raster of a mask": lambda n: level.shade("mask", azimuth=103.0 + n, altitude=20.0),
    "raster of colours": lambda n: level.shade("color", azimuth=104.0 + n, altitude=20.0),
    "raster of a day of hours": lambda n: level.sun_hours("2024-03-21", step_min=30.0),
}
medians_ms = {}
for name, run in cases.items():
    times_ms = []
    for n in range(repeats + 1):
        start = time.process_time()
        run(7.0 * n)
        times_ms.append(1e3 * (time.process_time() - start))
    medians_ms[name] = sorted(times_ms[1:])[len(times_ms[1:]) // 2]
print(json.dumps({"ms": medians_ms, "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}))
"""


def measure_checkout(checkout: Path, raster: Path, zoom: int, repeats: int) -> dict[str, float]:
    """Measure by case the CPU milliseconds of a checkout's code, and its peak memory in MiB. Tiles are those of ``zoom``.

    Each case is run ``repeats`` times after one untimed run.
    """
    command = [sys.executable, "-c", WORKER_PROGRAM, str(raster.resolve()), str(zoom), str(repeats)]
    process = subprocess.run(
        command, cwd=checkout, env={**os.environ, "PYTHONPATH": str(checkout)}, capture_output=True, text=True, check=False
    )  # fmt: skip
    if process.returncode:
        raise SystemExit(process.stderr)
    result = json.loads(process.stdout.splitlines()[-1])
    return {**result["ms"], "peak of memory, MiB": result["peak_mib"]}


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("raster", type=Path)
    parser.add_argument("--base", type=Path, required=True, help="the other checkout")
    parser.add_argument("--zoom", type=int, default=12)
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each case in a process")
    parser.add_argument("--turns", type=int, default=3, help="timed processes of each checkout, after one that compiles the loops")
    args = parser.parse_args()
    times_by_case: dict[str, list[tuple[float, float]]] = {}
    for turn_number in range(args.turns + 1):
        pair = [measure_checkout(entry, args.raster, args.zoom, args.repeats) for entry in (args.base.resolve(), ROOT)]
        if turn_number:
            for name in pair[0]:
                times_by_case.setdefault(name, []).append((pair[0][name], pair[1][name]))
    print("| what | before | now | ratio |\n| --- | --- | --- | --- |")
    for name, values in times_by_case.items():
        before, after = (statistics.median(entry) for entry in zip(*values, strict=True))
        print(f"| {name} | {before:.0f} | {after:.0f} | {after / before:.2f} |")


if __name__ == "__main__":
    main()
