"""Resident memory of one render process that draws many blocks of map tiles under many suns.

    python -m benchmarks.render_memory RASTER [--blocks 6250]

Each block of 16 tiles is one of those of the zooms 9 to 14 that the raster lies in, under one of 24 suns, both at random. A line
gives the number of blocks and of tiles, the resident memory and its peak in MiB, and the seconds since the start.
"""

from __future__ import annotations

import argparse
import os
import random
import time
from pathlib import Path

os.environ.setdefault("LP_NUM_THREADS", "1")  # before OpenGL is loaded

import rasterio
from morecantile import tms as matrix_sets
from rasterio.warp import transform_bounds

from skugga.api.http.server.first_blocks import central_block
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.request import ProductRequest
from skugga.api.workers.jobs import BlockJob
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.worker_state import WorkerState
from skugga.terrain.cache import MIB
from skugga.terrain.level.parts import SunSpec

SUNS = [SunSpec(azimuth=75.0 + 9.0 * n, altitude=8.0 + 47.0 * (1.0 - abs(n - 11.5) / 11.5)) for n in range(24)]
"""The suns of ``benchmarks.tiles``."""

BLOCK_TILES = 4
"""Tiles along the side of a block."""

REPORTED_BLOCKS = 20, 100, 500
"""Numbers of blocks after which memory is reported, besides each thousand."""


def memory_mib() -> tuple[float, float]:
    """Return the resident memory of this process and its peak, MiB."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    resident, peak = (1024.0 * int(lines[name].split()[0]) / MIB for name in ("VmRSS", "VmHWM"))
    return resident, peak


def main() -> None:
    """Draw blocks and print the memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("raster", type=Path)
    parser.add_argument("--blocks", type=int, default=6250)
    args = parser.parse_args()
    level = next(iter(ServedLevels([args.raster]).cached_levels()))
    central = central_block(level)
    assert central is not None, "the raster has no tiles"
    with rasterio.open(args.raster) as source:
        bounds = transform_bounds(source.crs, 4326, *source.bounds)
    west, south, east, north = bounds
    tiles = matrix_sets.get("WebMercatorQuad").tiles(west, south, east, north, list(range(9, 15)))
    blocks = sorted({(tile.z, tile.x // BLOCK_TILES, tile.y // BLOCK_TILES) for tile in tiles})
    choice, state, start = random.Random(1), WorkerState(""), time.monotonic()
    for number in range(1, args.blocks + 1):
        zoom, x, y = choice.choice(blocks)
        request = ProductRequest(sun=choice.choice(SUNS))
        place = {"matrix_set": "WebMercatorQuad", "zoom": zoom, "block_x": x, "block_y": y}
        run_job(BlockJob(level=central.level, request=request, **place), state)
        if number in REPORTED_BLOCKS or number % 1000 == 0:
            resident, peak = memory_mib()
            seconds = time.monotonic() - start
            print(f"{number} blocks, {number * BLOCK_TILES**2} tiles: {resident:.0f} MiB, peak {peak:.0f} MiB, {seconds:.0f} s")


if __name__ == "__main__":
    main()
