"""Costs of big rasters: time to open, memory of a render process, time of a metatile and of ``skugga shade``, distant shadows.

    python -m benchmarks.big_elevation FOLDER [--raster ../shared/data/mountain/bigtujunga_30m_utm11.tif] [--only worker ...]

FOLDER takes 6 GB: COGs of 2,500, 10,000 and 40,000 cells a side and a virtual raster of 100,000 (``benchmarks.big_rasters``). They
are made if absent, and remain. The overviews of the virtual raster are those of ``skugga overviews``.

* **open**: time of a level and its scene, in a fresh process.
* **worker**: a render process, warmed up as in the service, draws one block of 16 tiles. The figures are its peak memory
  (``VmHWM``) and the time of that first block, with a fresh process for each zoom.
* **flat**: CPU seconds per block for 1, 4, 16 and 64 blocks round the middle. Their ground is evicted before each repeat. The
  blocks are adjacent, so that they share the ground beside them, or far apart.
* **sizes**: CPU seconds of the middle block for rasters of all sizes over the same ground.
* **shade**: squares of the virtual raster, as by ``skugga shade --bounds``.
* **far**: where a mountain's shadow ends 60 km away under a sun at 2 degrees, in tiles of all zooms and in the grid of ``shade``.

Each measurement has a process of its own. Figures are medians with minimum and maximum.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from morecantile import tms as matrix_sets
from pyproj import CRS

from benchmarks.big_rasters import EPSG, MIDDLE_XY, make_rasters, mountain_xy, paths_in
from skugga.api.compute import write_rasters
from skugga.api.matrices import zoom_range
from skugga.api.overviews import make_overviews, reason_for_no_overviews
from skugga.api.raster_view import raster_view
from skugga.api.request import ProductRequest
from skugga.api.workers.jobs import BlockJob, LevelKey, ZoomTiles
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.warm_up import warm_up
from skugga.api.workers.worker_state import WorkerState, representative_block
from skugga.selector.select import plan_of_view
from skugga.shadows.render import render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView, blocks_of, tile_grid
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, WGS84, transformer
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

MERCATOR_SET = "WebMercatorQuad"
BLOCK_COUNTS = 1, 4, 16, 64
SUN = SunSpec(azimuth=113.0, altitude=30.0)
BLOCK_SPACINGS = {"together": 1, "apart": 4}
"""Distances between blocks: blocks far apart share no ground, so that each pays for all of the ground beside it."""

FAR_KM = 60.0
KIB_A_MIB = 1024
SQUARE_SIDES_KM = 30.0, 120.0, 240.0
"""Sides of the shaded squares."""


def status_mib(name: str) -> float:
    """Return a figure of this process's memory, MiB: ``VmRSS`` (now) or ``VmHWM`` (its peak)."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith(f"{name}:")).split()[1]) / KIB_A_MIB


def reset_peak_memory() -> None:
    """Reset the peak ``VmHWM``."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def key_of(raster: Path) -> LevelKey:
    return LevelKey(path=raster, version="1")


def zooms_of(scene: Scene) -> dict[str, int]:
    """Return the zooms of a level to measure, by label."""
    assert scene.bounds_lon_lat is not None
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    served = zoom_range(matrix_sets.get(MERCATOR_SET), scene.world, scene.bounds_lon_lat, cell_m)
    assert served is not None
    own_zoom = served.last - 3
    return {"lowest": served.first, "middle": (served.first + own_zoom) // 2, "own": own_zoom, "last": served.last}


def block_job(scene: Scene, raster: Path, zoom: int, down: int = 0, right: int = 0) -> BlockJob:
    """Return the job that draws the block at the middle of a level, or a block at an offset (in blocks) from it."""
    view = representative_block(scene, ZoomTiles(matrix_set=MERCATOR_SET, zoom=zoom))
    row, col = int(view.row0) // BLOCK_PX + down, int(view.col0) // BLOCK_PX + right
    request = ProductRequest(sun=SUN)
    return BlockJob(level=key_of(raster), matrix_set=MERCATOR_SET, zoom=zoom, block_x=col, block_y=row, tiles=4, request=request)


def measure_opening(raster: Path) -> dict[str, float]:
    """Measure time and memory of a level and its scene."""
    before_mib, start = status_mib("VmRSS"), time.perf_counter()
    loaded = load_level(raster)
    level_s = time.perf_counter() - start
    scene = build_scene(loaded)
    scene_s = time.perf_counter() - start - level_s
    return {
        "level_s": level_s, "scene_s": scene_s, "more_mib": status_mib("VmHWM") - before_mib,
        "files": len(loaded.linked_sources), "highest_m": scene.height_range_m[1],
    }  # fmt: skip


def measure_first_block(raster: Path, zoom: str) -> dict[str, float | str]:
    """Measure a render process's memory before and during its first block of a zoom, and the block's time."""
    state = WorkerState(warm_up())
    idle_mib = status_mib("VmRSS")
    scene = build_scene(load_level(raster))
    job = block_job(scene, raster, number := zooms_of(scene)[zoom])
    scene.close()
    clear_caches()
    reset_peak_memory()
    start = time.perf_counter()
    run_job(job, state)
    first_s = time.perf_counter() - start
    return {"zoom": f"{number} ({zoom})", "idle_mib": idle_mib, "peak_mib": status_mib("VmHWM"), "first_s": first_s}


def timed_blocks(raster: Path, state: WorkerState, zoom: int, count: int, spacing: int = 1) -> float:
    """Return CPU seconds per block for ``count`` blocks round the middle, ``spacing`` blocks apart.

    Their ground is not cached; data of the whole level is.
    """
    scene = state.scenes.get(key_of(raster))
    side = int(np.sqrt(count))
    first = -(side // 2)
    jobs = [block_job(scene, raster, zoom, (first + n // side) * spacing, (first + n % side) * spacing) for n in range(count)]
    clear_caches("light", "scene")
    state.blocks.clear()
    run_job(block_job(scene, raster, zoom, 18, 18), state)
    start = time.process_time()
    for job in jobs:
        run_job(job, state)
    return (time.process_time() - start) / count


def cpu_by_block_count(raster: Path, spacing: int, repeats: int) -> dict[str, list[float]]:
    """Return CPU seconds per block, a value for each repeat, by number of blocks."""
    state = WorkerState(warm_up())
    zoom = zooms_of(state.scenes.get(key_of(raster)))["own"]
    timed_blocks(raster, state, zoom, 4)
    return {str(count): [timed_blocks(raster, state, zoom, count, spacing) for _ in range(repeats)] for count in BLOCK_COUNTS}


def cpu_by_raster_size(rasters: list[Path], repeats: int) -> dict[str, list[float]]:
    """Return CPU seconds of the middle block, a value for each repeat, by raster. The rasters take turns."""
    state = WorkerState(warm_up())
    zoom = zooms_of(state.scenes.get(key_of(rasters[0])))["own"]
    result: dict[str, list[float]] = {}
    for repeat in range(repeats + 1):
        for raster in rasters:
            cpu_s = timed_blocks(raster, state, zoom, 1)
            if repeat:
                result.setdefault(raster.name, []).append(cpu_s)
    return result


def measure_shade(raster: Path, side_km: float) -> dict[str, float]:
    """Run ``skugga shade`` for a square round the middle of a raster. Measure CPU time per block, total time and peak memory."""
    start = time.perf_counter()
    scene = build_scene(load_level(raster)).with_sun(SUN)
    half = side_km * 500.0
    view = raster_view(scene, (MIDDLE_XY[0] - half, MIDDLE_XY[1] - half, MIDDLE_XY[0] + half, MIDDLE_XY[1] + half))
    blocks = len(blocks_of(view.view))
    opened_s = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        masks, path = [ProductRequest(product="mask")], Path(folder) / "mask.tif"
        start, times = time.perf_counter(), []
        write_rasters(scene, view, masks, [path], {}, lambda *_: times.append(time.process_time()))
        written_s = time.perf_counter() - start
    every = np.diff(times[1:])
    return {
        "cells": int(np.prod(view.shape)), "blocks": blocks, "open_s": opened_s, "all_s": written_s,
        "block_s": float(np.median(every)), "peak_mib": status_mib("VmHWM"),
    }  # fmt: skip


def far_shadow(raster: Path) -> dict[str, str]:
    """Return where the mountain's shadow ends along its middle line, in km from its top, for tiles of each zoom and for ``shade``.

    The level's anchor is 60 km west of the mountain. There the sun is 2 degrees high.
    """
    x, y = mountain_xy()
    crs = CRS.from_epsg(EPSG)
    lon, lat = transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
    far = {km: WGS84.fwd(lon, lat, 270.0, km * 1000.0)[:2] for km in np.arange(10.0, 110.0, 0.5)}
    anchor = far[FAR_KM]
    terrain = {"source": str(raster.resolve()), "bounds": [*(v - 1e-3 for v in anchor), *(v + 1e-3 for v in anchor)]}
    level = {
        "version": 1, "terrain": terrain,
        "sun": {"azimuth": 90.0 - 0.5 * (lon - anchor[0]) * np.sin(np.radians(lat)), "altitude": 2.0},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "far.yaml"
        path.write_text(json.dumps(level), encoding="utf-8")  # JSON is YAML
        scene = build_scene(load_level(path))
    result = {}
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    bounds = transformer(crs, LONGITUDE_LATITUDE).transform_bounds(*scene.elevation.bounds, densify_pts=21)
    served = zoom_range(matrix_sets.get(MERCATOR_SET), scene.world, bounds, cell_m)
    assert served is not None
    for zoom in range(served.first, served.last + 1):
        grid = tile_grid(matrix_sets.get(MERCATOR_SET), zoom)
        result[f"zoom {zoom}"] = _shadow_end(scene, grid, far)
    shade_view = raster_view(scene, (x, y - 1.0, x + 1.0, y)).view
    result["shade"] = _shadow_end(scene, shade_view.grid, far)
    return result


def _shadow_end(scene: Scene, grid: Grid, far: dict[float, tuple[float, float]]) -> str:
    """Return, as text, the two neighbouring distances in km between which places change from shadow to sun.

    ``far`` holds longitude and latitude of places by their distance.
    """
    lit, (lon, lat) = {}, np.array(list(far.values())).T
    x, y = transformer(LONGITUDE_LATITUDE, grid.crs).transform(lon, lat)
    plan = None
    low, high = 0, len(far) - 1
    while high - low > 1:  # shadow at the near end, sun at the far end
        middle = (low + high) // 2
        view = MapView(grid, float(int(grid.row(y[middle])) - 4), float(int(grid.col(x[middle])) - 4), 1.0, 1.0, 8, 8)
        plan = plan or plan_of_view(scene, view, policy="rules")
        lit[middle] = float(np.median(render_frame(scene, view, plan).visibility))
        low, high = (middle, high) if lit[middle] < 0.5 else (low, middle)
    names = list(far)
    return f"{names[low]:.1f} to {names[high]:.1f}"


Case = Callable[[list[Path], str, int], Any]

CASES: dict[str, Case] = {
    "open": lambda rasters, of, _: measure_opening(rasters[int(of)]),
    "worker": lambda rasters, of, _: measure_first_block(rasters[int(of.split(":")[0])], of.split(":")[1]),
    "flat": lambda rasters, of, repeats: cpu_by_block_count(rasters[int(of[0])], BLOCK_SPACINGS[of[2:]], repeats),
    "sizes": lambda rasters, _, repeats: cpu_by_raster_size(rasters, repeats),
    "shade": lambda rasters, of, _: measure_shade(rasters[-1], float(of)),
    "far": lambda rasters, _, __: far_shadow(rasters[-1]),
}
"""Measurements of a process by name, with their rasters and repeats."""

CASE_ARGUMENTS: dict[str, tuple[str, ...]] = {
    "open": ("2", "3"),
    "worker": tuple(f"{index}:{zoom}" for index in (2, 3) for zoom in ("lowest", "middle", "own", "last")),
    "flat": tuple(f"{index}:{how}" for index in (2, 3) for how in BLOCK_SPACINGS),
    "sizes": ("all",),
    "shade": tuple(f"{side:g}" for side in SQUARE_SIDES_KM),
    "far": ("vrt",),
}


def run_case_in_process(args: argparse.Namespace, case: str, of: str) -> Any:
    """Run a measurement in a fresh process, and return its result."""
    command = [sys.executable, "-m", "benchmarks.big_elevation", str(args.folder), "--case", case, "--of", of]
    process = subprocess.run([*command, "--repeats", str(args.repeats)], capture_output=True, text=True, check=False)
    if process.returncode:
        raise RuntimeError(process.stderr[-2000:])
    return json.loads(process.stdout.splitlines()[-1])


def format_figures(figures: Any) -> str:
    """Format figures in a line."""

    def format_value(value: Any) -> str:
        if isinstance(value, list):
            return f"{np.median(value):.3f} ({min(value):.3f} to {max(value):.3f})"
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    return ", ".join(f"{name} {format_value(value)}" for name, value in figures.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--raster", type=Path, default=Path("../shared/data/mountain/bigtujunga_30m_utm11.tif"))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--case", choices=list(CASES), help=argparse.SUPPRESS)
    parser.add_argument("--of", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.case:
        print(json.dumps(CASES[args.case](paths_in(args.folder), args.of, args.repeats)))
        return
    for raster in make_rasters(args.folder, args.raster):
        print(f"{raster.path.name}: {raster.path.stat().st_size / 2**20:.0f} MiB, made in {raster.made_s:.0f} s", flush=True)
    vrt = paths_in(args.folder)[-1]
    if reason_for_no_overviews(vrt) is None:
        start = time.perf_counter()
        path = make_overviews(vrt)
        print(f"{path.name}: {path.stat().st_size / 2**20:.0f} MiB, {time.perf_counter() - start:.0f} s", flush=True)
    for case in args.only:
        for of in CASE_ARGUMENTS[case]:
            print(f"{case} {of}: {format_figures(run_case_in_process(args, case, of))}", flush=True)


if __name__ == "__main__":
    main()
