"""CPU time of a block of map tiles among woods and houses, compared with the bare ground of the same place.

    taskset -c 0 nice -n 15 python -m benchmarks.wooded_blocks --zoom 14     # one core, like a render process

Each round draws one block of either level in turns: first with empty caches ("cold"), then under other suns ("new sun"). The
script prints medians of CPU time, the ratios of the wooded block to the bare one, the passes of the wooded block, the bytes that
caches hold for it, and the largest resident memory of the process.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("LP_NUM_THREADS", "1")  # before OpenGL is loaded

from morecantile import tms as matrix_sets

from skugga.api.compute import draw_picture
from skugga.api.request import ProductRequest
from skugga.api.workers.block_tiles import tiles_of_picture
from skugga.selector.select import plan_of_view
from skugga.terrain.cache import MIB, caches, clear_caches
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.geo.grid import BLOCK_PX, MapView, tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

ROOT = Path(__file__).resolve().parents[1]

SUNS = [(75.0 + 9.0 * n, 8.0 + 47.0 * (1.0 - abs(n - 11.5) / 11.5)) for n in (6, *range(1, 24, 4))]
"""Azimuths and altitudes, degrees: the sun of the cold block, then the new suns. They are those of ``benchmarks.tiles``."""

WOODED, BARE = "jacksboro_wooded", "jacksboro"
"""Names of the levels."""


@dataclass
class BlockTimes:
    """CPU milliseconds of a block: cold and under each new sun, in total and by pass."""

    cold_ms: list[float] = field(default_factory=list)
    new_sun_ms: list[float] = field(default_factory=list)
    cold_passes: list[Counter[str]] = field(default_factory=list)
    new_sun_passes: list[Counter[str]] = field(default_factory=list)


def middle_block(scene: Scene, zoom: int) -> MapView:
    """Return the block of web tiles in the middle of a level's raster."""
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    row, col = (float((low + high) / 2 // BLOCK_PX * BLOCK_PX) for low, high in ((north, south), (west, east)))
    return MapView(grid, row, col, 1.0, 1.0, BLOCK_PX, BLOCK_PX)


def time_block(scene: Scene, view: MapView, sun: tuple[float, float]) -> tuple[float, Counter[str]]:
    """Draw and encode a block under a sun. Return its CPU milliseconds, in total and by pass. The plan is not timed."""
    scene = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    plan, request = plan_of_view(scene, view, "map", {}), ProductRequest()
    begin = time.process_time()
    picture = draw_picture(scene, view, request.product_record, plan)
    encode = time.process_time()
    tiles_of_picture(picture, request, scene, view, "png")
    end = time.process_time()
    passes = Counter({record.name: record.ms for record in picture.passes})
    passes["encoding"] = 1e3 * (end - encode)
    return 1e3 * (end - begin), passes


def time_level(scene: Scene, view: MapView, times: BlockTimes) -> int:
    """Draw a level's block cold and under the new suns, and add the times to ``times``. Return the bytes that caches hold then."""
    clear_caches("light", "scene")
    plan_of_view(scene, view, "map", {})  # the level's own facts, such as trees in the CRS of the map, belong to no block
    for number, sun in enumerate(SUNS):
        total_ms, passes = time_block(scene, view, sun)
        (times.new_sun_ms if number else times.cold_ms).append(total_ms)
        (times.new_sun_passes if number else times.cold_passes).append(passes)
    return sum(cache.nbytes for cache in caches("light", "scene"))


def median_by_pass(records: list[Counter[str]]) -> dict[str, float]:
    """Return the median milliseconds of each pass, largest first."""
    names = {name for record in records for name in record}
    medians = {name: statistics.median(record[name] for record in records) for name in names}
    return dict(sorted(medians.items(), key=lambda item: -item[1]))


def main() -> None:
    """Measure, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zoom", type=int, default=14)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    scenes = {name: build_scene(load_level(ROOT / "configs" / f"{name}.yaml")) for name in (BARE, WOODED)}
    view = middle_block(scenes[WOODED], args.zoom)
    peak_mib, cached_bytes = {}, {}
    for name, scene in scenes.items():  # an untimed round compiles the loops and shaders
        time_level(scene, view, BlockTimes())
        peak_mib[name] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    times = {name: BlockTimes() for name in scenes}
    for _ in range(args.rounds):
        for name, scene in scenes.items():
            cached_bytes[name] = time_level(scene, view, times[name])
    print(f"zoom {args.zoom}, {args.rounds} rounds of {len(SUNS) - 1} new suns; CPU milliseconds of a block, medians")
    for title, values in (
        ("cold", {name: statistics.median(each.cold_ms) for name, each in times.items()}),
        ("new sun", {name: statistics.median(each.new_sun_ms) for name, each in times.items()}),
    ):
        print(f"{title:<8} wooded {values[WOODED]:7.0f}  bare {values[BARE]:7.0f}  ratio {values[WOODED] / values[BARE]:5.1f}")
    for title, records in (("cold", times[WOODED].cold_passes), ("new sun", times[WOODED].new_sun_passes)):
        print(f"passes of the wooded block, {title}:")
        for name, ms in median_by_pass(records).items():
            print(f"  {name:<40} {ms:7.1f}")
    for name in scenes:
        print(f"{name}: caches hold {cached_bytes[name] / MIB:.0f} MiB, peak memory after it {peak_mib[name]:.0f} MiB")


if __name__ == "__main__":
    main()
