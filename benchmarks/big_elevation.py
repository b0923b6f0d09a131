"""Costs of big rasters: time to open, memory of a render process, time of a metatile and of ``skugga shade``, distant shadows.

    python -m benchmarks.big_elevation FOLDER [--raster ../shared/data/mountain/bigtujunga_30m_utm11.tif] [--only worker ...]

FOLDER needs 6 GB: COGs of 2,500, 10,000 and 40,000 cells a side and a virtual raster of 100,000 (``benchmarks.big_rasters``). The
script writes missing rasters and keeps them. ``skugga overviews`` writes the overviews of the virtual raster.

* **open**: time to load a level and to build its scene, in a fresh process.
* **worker**: a render process, warmed up as in the service, draws one block of 16 tiles. The figures are its peak memory
  (``VmHWM``) and the time of that first block, with a fresh process for each zoom.
* **flat**: CPU seconds per block for 1, 4, 16 and 64 blocks round the middle. Caches of their ground are emptied before each
  repeat. The blocks are adjacent, so that they share the ground beside them, or far apart.
* **sizes**: CPU seconds of the middle block for rasters of all sizes over the same ground.
* **shade**: time and memory of ``skugga shade --bounds`` for squares of the virtual raster.
* **far**: distance at which a mountain's shadow ends, about 60 km under a sun at 2 degrees, in tiles of all zooms and in the grid
  of ``shade``.

Each measurement runs in its own process. Figures are medians with minimum and maximum; docs/reports/big-rasters.md has them.
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

from benchmarks.big_rasters import EPSG, MIDDLE_XY_M, make_rasters, mountain_xy, raster_paths
from skugga.api.compute import write_rasters
from skugga.api.matrices import zoom_range
from skugga.api.overviews import make_overviews, reason_against_overviews
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

TILE_MATRIX_SET = "WebMercatorQuad"
BLOCK_COUNTS = 1, 4, 16, 64
"""Numbers of blocks of ``flat``. They are squares of whole numbers, because the blocks form a square."""
SUN = SunSpec(azimuth=113.0, altitude=30.0)
BLOCK_SPACINGS = {"together": 1, "apart": 4}
"""Distances between the north-west corners of neighbouring blocks, in blocks, by label. Blocks far apart share no ground, so that
each must load all of the ground beside it."""

ANCHOR_DISTANCE_KM = 60.0
"""Distance from the mountain to the anchor of the level of ``far``. The sun's angles of a level are those at its anchor."""
KIB_PER_MIB = 1024
SHADED_SQUARE_SIDES_KM = 30.0, 120.0, 240.0
"""Sides of the shaded squares."""


def process_memory_mib(name: str) -> float:
    """Return a figure of this process's memory, MiB: ``VmRSS`` (now) or ``VmHWM`` (its peak)."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith(f"{name}:")).split()[1]) / KIB_PER_MIB


def reset_peak_memory() -> None:
    """Reset this process's peak memory ``VmHWM`` to its present memory."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def level_key(raster: Path) -> LevelKey:
    """Return the key by which a render process knows the level of a raster file."""
    return LevelKey(path=raster, version="1")


def zooms_by_label(scene: Scene) -> dict[str, int]:
    """Return the zooms of a level to measure: first and last served zoom, the raster's own resolution, and a zoom between."""
    assert scene.bounds_lon_lat is not None
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    served = zoom_range(matrix_sets.get(TILE_MATRIX_SET), scene.world, scene.bounds_lon_lat, cell_m)
    assert served is not None
    own_zoom = served.last - 3
    return {"lowest": served.first, "middle": (served.first + own_zoom) // 2, "own": own_zoom, "last": served.last}


def block_job(scene: Scene, raster: Path, zoom: int, rows_south: int = 0, cols_east: int = 0) -> BlockJob:
    """Return the job that draws the block at the middle of a level, or the block ``rows_south`` and ``cols_east`` blocks away."""
    view = representative_block(scene, ZoomTiles(matrix_set=TILE_MATRIX_SET, zoom=zoom))
    row, col = int(view.row0) // BLOCK_PX + rows_south, int(view.col0) // BLOCK_PX + cols_east
    request = ProductRequest(sun=SUN)
    return BlockJob(
        level=level_key(raster), matrix_set=TILE_MATRIX_SET, zoom=zoom, block_x=col, block_y=row, tiles_per_side=4, request=request
    )


def measure_opening(raster: Path) -> dict[str, float]:
    """Measure time and memory of loading a level and building its scene."""
    before_mib, start = process_memory_mib("VmRSS"), time.perf_counter()
    loaded = load_level(raster)
    level_s = time.perf_counter() - start
    scene = build_scene(loaded)
    scene_s = time.perf_counter() - start - level_s
    return {
        "level_s": level_s, "scene_s": scene_s, "more_mib": process_memory_mib("VmHWM") - before_mib,
        "files": len(loaded.linked_sources), "highest_m": scene.height_range_m[1],
    }  # fmt: skip


def measure_first_block(raster: Path, zoom: str) -> dict[str, float | str]:
    """Measure a render process's memory before and during its first block of a zoom, and the block's time.

    ``zoom`` is a label of ``zooms_by_label``.
    """
    state = WorkerState(warm_up())
    idle_mib = process_memory_mib("VmRSS")
    scene = build_scene(load_level(raster))
    job = block_job(scene, raster, number := zooms_by_label(scene)[zoom])
    scene.close()
    clear_caches()
    reset_peak_memory()
    start = time.perf_counter()
    run_job(job, state)
    first_s = time.perf_counter() - start
    return {"zoom": f"{number} ({zoom})", "idle_mib": idle_mib, "peak_mib": process_memory_mib("VmHWM"), "first_s": first_s}


def measure_cpu_s_per_block(raster: Path, state: WorkerState, zoom: int, count: int, spacing: int = 1) -> float:
    """Return CPU seconds per block for ``count`` blocks round the middle, ``spacing`` blocks apart.

    Caches hold data of the whole level, but no ground of these blocks.
    """
    scene = state.scenes.get(level_key(raster))
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


def measure_cpu_by_block_count(raster: Path, spacing: int, repeats: int) -> dict[str, list[float]]:
    """Return CPU seconds per block, a value for each repeat, by number of blocks. Blocks are ``spacing`` blocks apart."""
    state = WorkerState(warm_up())
    zoom = zooms_by_label(state.scenes.get(level_key(raster)))["own"]
    measure_cpu_s_per_block(raster, state, zoom, 4)
    return {
        str(count): [measure_cpu_s_per_block(raster, state, zoom, count, spacing) for _ in range(repeats)] for count in BLOCK_COUNTS
    }


def measure_cpu_by_raster_size(rasters: list[Path], repeats: int) -> dict[str, list[float]]:
    """Return CPU seconds of the middle block, a value for each repeat, by raster. The rasters take turns."""
    state = WorkerState(warm_up())
    zoom = zooms_by_label(state.scenes.get(level_key(rasters[0])))["own"]
    result: dict[str, list[float]] = {}
    for repeat in range(repeats + 1):
        for raster in rasters:
            cpu_s = measure_cpu_s_per_block(raster, state, zoom, 1)
            if repeat:
                result.setdefault(raster.name, []).append(cpu_s)
    return result


def measure_shade(raster: Path, side_km: float) -> dict[str, float]:
    """Run ``skugga shade`` for a square round the middle of a raster. Measure CPU time per block, total time and peak memory."""
    start = time.perf_counter()
    scene = build_scene(load_level(raster)).with_sun(SUN)
    half = side_km * 500.0
    view = raster_view(scene, (MIDDLE_XY_M[0] - half, MIDDLE_XY_M[1] - half, MIDDLE_XY_M[0] + half, MIDDLE_XY_M[1] + half))
    blocks = len(blocks_of(view.view))
    opened_s = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        masks, path = [ProductRequest(product="mask")], Path(folder) / "mask.tif"
        start, times = time.perf_counter(), []
        write_rasters(scene, view, masks, [path], {}, lambda *_: times.append(time.process_time()))
        written_s = time.perf_counter() - start
    block_cpu_s = np.diff(times[1:])
    return {
        "cells": int(np.prod(view.shape)), "blocks": blocks, "open_s": opened_s, "all_s": written_s,
        "block_s": float(np.median(block_cpu_s)), "peak_mib": process_memory_mib("VmHWM"),
    }  # fmt: skip


def find_shadow_end_by_zoom(raster: Path) -> dict[str, str]:
    """Return where the mountain's shadow ends along its middle line, in km from its top, for tiles of each zoom and for ``shade``.

    The level's anchor is 60 km west of the mountain. There the sun is 2 degrees high.
    """
    x, y = mountain_xy()
    crs = CRS.from_epsg(EPSG)
    lon, lat = transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
    lon_lat_by_km = {km: WGS84.fwd(lon, lat, 270.0, km * 1000.0)[:2] for km in np.arange(10.0, 110.0, 0.5)}
    anchor = lon_lat_by_km[ANCHOR_DISTANCE_KM]
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
    served = zoom_range(matrix_sets.get(TILE_MATRIX_SET), scene.world, bounds, cell_m)
    assert served is not None
    for zoom in range(served.first, served.last + 1):
        grid = tile_grid(matrix_sets.get(TILE_MATRIX_SET), zoom)
        result[f"zoom {zoom}"] = _find_shadow_end(scene, grid, lon_lat_by_km)
    shade_view = raster_view(scene, (x, y - 1.0, x + 1.0, y)).view
    result["shade"] = _find_shadow_end(scene, shade_view.grid, lon_lat_by_km)
    return result


def _find_shadow_end(scene: Scene, grid: Grid, lon_lat_by_km: dict[float, tuple[float, float]]) -> str:
    """Return, as text, the two neighbouring distances in km between which places change from shadow to sun.

    ``lon_lat_by_km`` holds longitude and latitude of places by their distance.
    """
    lit, (lon, lat) = {}, np.array(list(lon_lat_by_km.values())).T
    x, y = transformer(LONGITUDE_LATITUDE, grid.crs).transform(lon, lat)
    plan = None
    low, high = 0, len(lon_lat_by_km) - 1
    while high - low > 1:  # shadow at the near end, sun at the far end
        middle = (low + high) // 2
        view = MapView(grid, float(int(grid.row(y[middle])) - 4), float(int(grid.col(x[middle])) - 4), 1.0, 1.0, 8, 8)
        plan = plan or plan_of_view(scene, view, policy="rules")
        lit[middle] = float(np.median(render_frame(scene, view, plan).visibility))
        low, high = (middle, high) if lit[middle] < 0.5 else (low, middle)
    names = list(lon_lat_by_km)
    return f"{names[low]:.1f} to {names[high]:.1f}"


Measurement = Callable[[list[Path], str, int], Any]

MEASUREMENTS: dict[str, Measurement] = {
    "open": lambda rasters, argument, _: measure_opening(rasters[int(argument)]),
    "worker": lambda rasters, argument, _: measure_first_block(rasters[int(argument.split(":")[0])], argument.split(":")[1]),
    "flat": lambda rasters, argument, repeats: measure_cpu_by_block_count(
        rasters[int(argument[0])], BLOCK_SPACINGS[argument[2:]], repeats
    ),
    "sizes": lambda rasters, _, repeats: measure_cpu_by_raster_size(rasters, repeats),
    "shade": lambda rasters, argument, _: measure_shade(rasters[-1], float(argument)),
    "far": lambda rasters, _, __: find_shadow_end_by_zoom(rasters[-1]),
}
"""Measurements by name: functions of the rasters, the measurement's argument and the number of repeats."""

MEASUREMENT_ARGUMENTS: dict[str, tuple[str, ...]] = {
    "open": ("2", "3"),
    "worker": tuple(f"{index}:{zoom}" for index in (2, 3) for zoom in ("lowest", "middle", "own", "last")),
    "flat": tuple(f"{index}:{spacing}" for index in (2, 3) for spacing in BLOCK_SPACINGS),
    "sizes": ("all",),
    "shade": tuple(f"{side:g}" for side in SHADED_SQUARE_SIDES_KM),
    "far": ("vrt",),
}
"""Arguments with which each measurement is run: the raster's index in order of size, with a zoom or a spacing; or a square's side
in kilometres. The arguments of ``sizes`` and ``far`` are only labels.
"""


def measure_in_process(args: argparse.Namespace, measurement: str, argument: str) -> Any:
    """Run a measurement in a fresh process, and return its result."""
    command = [sys.executable, "-m", "benchmarks.big_elevation", str(args.folder), "--case", measurement, "--of", argument]
    process = subprocess.run([*command, "--repeats", str(args.repeats)], capture_output=True, text=True, check=False)
    if process.returncode:
        raise RuntimeError(process.stderr[-2000:])
    return json.loads(process.stdout.splitlines()[-1])


def format_figures(figures: Any) -> str:
    """Format figures by name as one line of text."""

    def format_value(value: Any) -> str:
        if isinstance(value, list):
            return f"{np.median(value):.3f} ({min(value):.3f} to {max(value):.3f})"
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    return ", ".join(f"{name} {format_value(value)}" for name, value in figures.items())


def main() -> None:
    """Measure what the command line asks for, each measurement in a process of its own, and print the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--raster", type=Path, default=Path("../shared/data/mountain/bigtujunga_30m_utm11.tif"))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=list(MEASUREMENTS), default=list(MEASUREMENTS))
    parser.add_argument("--case", choices=list(MEASUREMENTS), help=argparse.SUPPRESS)
    parser.add_argument("--of", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.case:
        print(json.dumps(MEASUREMENTS[args.case](raster_paths(args.folder), args.of, args.repeats)))
        return
    for raster in make_rasters(args.folder, args.raster):
        print(f"{raster.path.name}: {raster.path.stat().st_size / 2**20:.0f} MiB, written in {raster.write_s:.0f} s", flush=True)
    vrt = raster_paths(args.folder)[-1]
    if reason_against_overviews(vrt) is None:
        start = time.perf_counter()
        path = make_overviews(vrt)
        print(f"{path.name}: {path.stat().st_size / 2**20:.0f} MiB, written in {time.perf_counter() - start:.0f} s", flush=True)
    for case in args.only:
        for argument in MEASUREMENT_ARGUMENTS[case]:
            print(f"{case} {argument}: {format_figures(measure_in_process(args, case, argument))}", flush=True)


if __name__ == "__main__":
    main()
