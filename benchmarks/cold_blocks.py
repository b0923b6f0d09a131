"""CPU time by pass of blocks of tiles that are drawn with empty caches, as in seeding.

    taskset -c 0 python -m benchmarks.cold_blocks FILE --zoom 13     # FILE is a raster or a level; one core, like a render process

The script draws the first blocks of a pyramid in several rounds. Each round starts with empty caches and draws one untimed block
first. The result is the round with the least CPU time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

from morecantile import tms as matrix_sets

from skugga.api.catalogue import find_level
from skugga.api.compute import draw_picture
from skugga.api.matrices import ZoomRange
from skugga.api.request import ProductRequest
from skugga.api.seed.messages import MIN_TASK_TIMEOUT_S, Task
from skugga.api.seed.planning import PlannedRun, SeedRequest, plan_run
from skugga.api.seed.run_spec import MATRIX_SET
from skugga.api.seed.running import task_of
from skugga.api.seed.task_table import TaskTable
from skugga.api.workers.block_tiles import tiles_of_picture
from skugga.api.workers.block_views import block_of_grid
from skugga.terrain.cache import clear_caches
from skugga.terrain.geo.grid import tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import Scene, build_scene

TILES_KEY, CPU_KEY, ENCODING_KEY = "tiles", "CPU of the block", "encoding"
"""Keys of the counters besides the names of passes: number of tiles with data, CPU milliseconds in total and for encoding."""


def time_block(scene: Scene, run: PlannedRun, task: Task) -> Counter[str]:
    """Draw a task's block and encode its tiles. Return CPU milliseconds by pass, for encoding, and in total.

    The counter also contains the number of tiles with data.
    """
    view, request = block_of_grid(tile_grid(matrix_sets.get(MATRIX_SET), task.zoom), task.x, task.y), run.spec.request(task.sun)
    begin = time.process_time()
    picture = draw_picture(scene, view, request.product_record, run.spec.plan_by_sun_and_zoom[task.sun, task.zoom])
    encode = time.process_time()
    files = tiles_of_picture(picture, request, scene, view, "png")
    end = time.process_time()
    times_ms = Counter({pass_record.name: pass_record.ms for pass_record in picture.passes})
    tiles = sum(body is not None for body in files.values())
    times_ms.update({ENCODING_KEY: (end - encode) * 1e3, CPU_KEY: (end - begin) * 1e3, TILES_KEY: tiles})
    return times_ms


def main() -> None:
    """Draw blocks, and print their times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("level")
    parser.add_argument("--zoom", type=int, required=True)
    parser.add_argument("--layer", default="color")
    parser.add_argument("--blocks", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    source = LevelSource(path=Path(find_level(args.level)).resolve())
    with tempfile.TemporaryDirectory() as folder:
        table = TaskTable(Path(folder) / "tasks.sqlite")
        request = SeedRequest(source, ZoomRange(args.zoom, args.zoom), (None,), ProductRequest(product=args.layer), "png")
        run = plan_run(table, request, lambda _: None)
        tasks = [task_of(table, run, number, MIN_TASK_TIMEOUT_S) for number in table.waiting_tasks()[: args.blocks]]
    scene = build_scene(load_level(run.spec.level)).with_sun(run.spec.suns[0])
    rounds = []
    for _ in range(args.rounds):
        clear_caches("light", "scene")
        time_block(scene, run, tasks[0])
        rounds.append(sum((time_block(scene, run, task) for task in tasks[1:]), Counter[str]()))
    best = min(rounds, key=lambda times_ms: times_ms[CPU_KEY])
    tiles_per_s = best[TILES_KEY] / best[CPU_KEY] * 1e3
    print(f"{len(tasks) - 1} blocks, {best[TILES_KEY]} tiles: {tiles_per_s:.0f} tiles per CPU second; milliseconds per block:")
    for name in sorted(best.keys() - {TILES_KEY}, key=lambda key: (key == CPU_KEY, key)):
        print(f"  {name:<20} {best[name] / (len(tasks) - 1):7.1f}")


if __name__ == "__main__":
    main()
