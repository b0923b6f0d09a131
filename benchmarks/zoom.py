"""Mean shadow of a mountain map by zoom, time of a block of coarse pixels, and errors of distant casters at lower detail.

    python -m benchmarks.zoom FOLDER [--raster mountain/bigtujunga_30m_utm11.tif] [--sun 113 20] [--repeats 5] [--far-suns 0.7 3]

A coarse pixel covers several cells. The engine averages the visibility of several sample points per pixel (supersampling). For
comparison, ``points`` uses a single sample point per pixel, its centre, on ground averaged to the pixel's size.

**Shares.** Mean shadow of the raster below FOLDER in tiles of its native zoom and of lower zooms: supersampled, by single points,
and as a mask.

**Time and memory.** The raster is mirrored and repeated until it fills blocks two zooms below the native zoom. Supersampled blocks
and blocks of single points take turns. Figures are medians in one process.

**Distant casters.** Ground more than ``FULL_DETAIL_NODES`` from a block is read at lower and lower detail. The benchmark compares a
block at the native zoom with and without this reduction, under suns so low that shadows are long. It also compares with a quarter
and an eighth of that distance.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import rasterio
from morecantile import tms as matrix_sets

from skugga.selector.planner.planner import make_plan
from skugga.shadows.passes import PassLog
from skugga.shadows.render import render_block, render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters import reach
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.supersampling import PixelSampling, subdivision_level
from skugga.terrain.geo.grid import BLOCK_PX, MapView, tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

MERCATOR = matrix_sets.get("WebMercatorQuad")

COARSER_ZOOM_COUNT = 5
"""Number of zooms below the native zoom whose mean shadow is printed."""

MOSAIC_CELLS = 4608
"""Cells a side of the mosaic under the timed blocks."""


def raster_scene(raster: Path, folder: Path, sun: tuple[float, float]) -> Scene:
    """Return the scene of a raster under a sun (azimuth, altitude), degrees. Its level file is written into ``folder``."""
    level = {"version": 1, "terrain": {"source": str(raster.resolve())}, "sun": {"azimuth": sun[0], "altitude": sun[1]}}
    (folder / "level.yaml").write_text(json.dumps(level), encoding="utf-8")  # JSON is YAML
    return build_scene(load_level(folder / "level.yaml"))


def write_mosaic(raster: Path, folder: Path) -> Path:
    """Write a raster's middle, mirrored and repeated, as a raster in a folder, and return its path."""
    with rasterio.open(raster) as dataset:
        rows, cols = (size // 2 * 2 for size in dataset.shape)
        heights, profile = dataset.read(1)[4 : rows - 4, 4 : cols - 4].astype(np.float32), dataset.profile
    mirrored = np.block([[heights, heights[:, ::-1]], [heights[::-1], heights[::-1, ::-1]]])
    times = [-(-MOSAIC_CELLS // size) for size in mirrored.shape]
    profile.update(width=MOSAIC_CELLS, height=MOSAIC_CELLS, dtype="float32", nodata=None, tiled=True)
    with rasterio.open(folder / "mosaic.tif", "w", **profile) as dataset:
        dataset.write(np.tile(mirrored, times)[:MOSAIC_CELLS, :MOSAIC_CELLS], 1)
    return folder / "mosaic.tif"


def native_zoom(scene: Scene) -> int:
    """Return the lowest zoom of Web Mercator at which a pixel has a single sample point and is about as wide as a cell."""
    return next(zoom for zoom in range(25) if subdivision_level(scene, block_view(scene, zoom)) == 0 and is_fine_zoom(scene, zoom))


def is_fine_zoom(scene: Scene, zoom: int) -> bool:
    """Return whether pixels of a zoom are less than 1.5 cells wide."""
    return scene.surface(tile_grid(MERCATOR, zoom)).cells_per_step < 1.5


def full_view(scene: Scene, zoom: int) -> MapView:
    """Return the view of the whole level with pixels of a zoom."""
    grid = tile_grid(MERCATOR, zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    row, col = int(np.floor(north)), int(np.floor(west))
    return MapView(grid, float(row), float(col), 1.0, 1.0, int(np.ceil(south)) - row + 1, int(np.ceil(east)) - col + 1)


def block_view(scene: Scene, zoom: int, east_share: float = 0.5) -> MapView:
    """Return the view of a block of tiles at a zoom, around the level's middle from south to north.

    ``east_share`` is the position of its middle from west to east, as a share of the level's width.
    """
    view = full_view(scene, zoom)
    row, col = view.row0 + view.rows // 2 - BLOCK_PX // 2, view.col0 + int(view.cols * east_share) - BLOCK_PX // 2
    return MapView(view.grid, row, col, 1.0, 1.0, BLOCK_PX, BLOCK_PX)


def ground_visibility(scene: Scene, view: MapView, pixel_sampling: PixelSampling, algorithm: str) -> np.ndarray:
    """Return the visibility (n,) of all pixels that show ground."""
    overrides = {} if algorithm == "auto" else {"algorithm": algorithm}
    plan = make_plan(describe(scene, view, pixel_sampling=pixel_sampling), scene.loaded.level, overrides)
    frame = render_frame(scene, view, plan, pixel_sampling=pixel_sampling)
    return frame.visibility[frame.valid]


def print_shares(scene: Scene, algorithm: str) -> None:
    """Print the mean shadow by zoom, with means over pixels and with single points. ``algorithm`` may be ``auto``."""
    finest_zoom = native_zoom(scene)
    print("| zoom | samples per pixel | shadow, % | single points, % | mask, % |\n| --- | --- | --- | --- | --- |")
    for zoom in range(finest_zoom, finest_zoom - COARSER_ZOOM_COUNT - 1, -1):
        view = full_view(scene, zoom)
        mean_visibility, point_visibility = (
            ground_visibility(scene, view, pixel_sampling, algorithm) for pixel_sampling in ("means", "points")
        )  # type: ignore[arg-type]
        side = 2 ** subdivision_level(scene, view)
        mask = (mean_visibility < 0.5).mean()
        print(
            (
                f"| {zoom} | {side} x {side} | {100 * (1 - mean_visibility.mean()):.2f} | "
                f"{100 * (1 - point_visibility.mean()):.2f} | {100 * mask:.2f} |"
            ),
            flush=True,
        )


def print_times(scene: Scene, repeats: int) -> None:
    """Print times of blocks of coarse pixels, medians of ``repeats`` rounds."""
    finest_zoom = native_zoom(scene)
    print("| zoom | samples per pixel | block, ms | single points, ms | ratio |\n| --- | --- | --- | --- | --- |")
    for zoom in range(finest_zoom - 1, finest_zoom - 5, -1):
        view, runs_by_sampling = block_view(scene, zoom), {}
        samplings: tuple[PixelSampling, ...] = ("means", "points")
        plan = make_plan(describe(scene, view), scene.loaded.level, {"algorithm": "sweep"})
        for repeat in range(repeats + 1):
            for pixel_sampling in samplings:
                clear_caches("light")
                log, start = PassLog(), time.perf_counter()
                render_block(scene, view, plan, log, pixel_sampling)
                if repeat:  # the first round compiles
                    runs_by_sampling.setdefault(pixel_sampling, []).append(((time.perf_counter() - start) * 1000.0, log))
        ms = {
            pixel_sampling: float(np.median([elapsed_ms for elapsed_ms, _ in runs]))
            for pixel_sampling, runs in runs_by_sampling.items()
        }
        ratio = float(
            np.median([a / b for (a, _), (b, _) in zip(runs_by_sampling["means"], runs_by_sampling["points"], strict=True)])
        )
        side = 2 ** subdivision_level(scene, view)
        print(f"| {zoom} | {side} x {side} | {ms['means']:.0f} | {ms['points']:.0f} | {ratio:.2f} |", flush=True)
        if zoom == finest_zoom - 2:
            for pixel_sampling in samplings:
                log = runs_by_sampling[pixel_sampling][-1][1]
                print(f"  {pixel_sampling}: " + ", ".join(f"{name} {record.ms:.0f} ms" for name, record in log.records.items()))
    print(f"peak memory of the process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


def print_far_caster_errors(scene: Scene, sun: tuple[float, float]) -> None:
    """Print the shares of missed and of false shadow that result from the lower detail of distant casters.

    ``sun`` is azimuth and altitude in degrees.
    """
    scene = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    view = block_view(scene, native_zoom(scene), east_share=0.12)
    plan = make_plan(describe(scene, view), scene.loaded.level, {"algorithm": "sweep"})
    shadow_masks, nodes = [], reach.FULL_DETAIL_NODES
    limits = nodes, nodes // 4, nodes // 8
    for limit in (*limits, 2**20):
        reach.FULL_DETAIL_NODES = limit
        clear_caches("light")
        shadow_masks.append(render_block(scene, view, plan, PassLog(), "means").visibility < 0.5)
    reach.FULL_DETAIL_NODES = nodes
    truth = shadow_masks.pop()
    print(f"sun {sun[1]:g} degrees high, {100 * truth.mean():.1f} % in shadow")
    for limit, shadow_mask in zip(limits, shadow_masks, strict=True):
        missed, false = (truth & ~shadow_mask).mean(), (shadow_mask & ~truth).mean()
        print(f"full detail up to {limit} nodes: {100 * (missed + false):.4f} % of the pixels differ, "
              f"{100 * missed:.4f} % missed and {100 * false:.4f} % false shadow")  # fmt: skip


def main() -> None:
    """Print the parts that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--raster", default="mountain/bigtujunga_30m_utm11.tif")
    parser.add_argument("--sun", type=float, nargs=2, default=(113.0, 20.0))
    parser.add_argument("--far-suns", type=float, nargs="+", default=(0.7, 3.0), help="altitudes in the east, degrees")
    parser.add_argument("--algorithm", default="auto")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", choices=("shares", "times", "far"), help="one of the three parts")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        raster = args.folder / args.raster
        if args.only in (None, "shares"):
            print_shares(raster_scene(raster, Path(folder), tuple(args.sun)), args.algorithm)
        if args.only != "shares":
            scene = raster_scene(write_mosaic(raster, Path(folder)), Path(folder), tuple(args.sun))
            if args.only in (None, "times"):
                print_times(scene, args.repeats)
            if args.only in (None, "far"):
                for altitude_deg in args.far_suns:
                    print_far_caster_errors(scene, (90.0, altitude_deg))


if __name__ == "__main__":
    main()
